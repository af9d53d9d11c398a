"""Tiny teams of every form there is, without training."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from race.config.presets import resolve
from race.config.settings import Config, FacmacConfig
from race.config.shape import shape_of
from race.learners import facmac
from race.networks.dense import init_encoder, init_head
from race.teams.trained import Trained
from race.training.run_state import Progress
from race.types import AnyTask, DiscreteSpec, DiscreteTask, EnvSpec, Task

# Unequal sizes, interleaved actions, and bounds around 0 and elsewhere.
CONTINUOUS = EnvSpec(
    task="tiny",
    state_size=4,
    obs_index=((2, 0, 3), (1, 3)),
    action_index=((1,), (2, 0)),
    action_low=(-0.4, -1.0, 2.0),
    action_high=(0.4, 3.0, 5.0),
    episode_limit=5,
)
DISCRETE = DiscreteSpec("tiny", 3, 5, 6, 4, 5)

FORMS = ("plain", "normalised", "shared agents")
DISCRETE_FORMS = ("one for all", "one each, normalised")


def continuous(form: str, spec: EnvSpec = CONTINUOUS) -> tuple[Any, Any]:
    """Encoder and heads, the biases of padding included."""
    k1, k2 = jax.random.split(jax.random.key(3))
    encoder = init_encoder(k1, spec, (6, 5), form != "plain", form == "shared agents")
    return encoder, 2.0 * init_head(k2, spec, 5)


def discrete(form: str) -> tuple[Any, Any]:
    normalised = form.endswith("normalised")
    config = resolve(
        Config("tiny", facmac=FacmacConfig(hidden_size=7, layer_norm=normalised)), discrete=True
    )
    k1, k2 = jax.random.split(jax.random.key(4))
    own = form.startswith("one each")
    new = facmac.init_own_encoder if own else facmac.init_encoder
    heads = 2.0 * facmac.init_heads(k2, DISCRETE, shape_of(config))
    return new(k1, DISCRETE, shape_of(config)), heads


def observations(spec: Any, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, spec.n_agents, spec.obs_size)).astype(np.float32)


def masks(count: int, seed: int = 1) -> np.ndarray:
    available = np.random.default_rng(seed).random((count, DISCRETE.n_agents, 4)) < 0.5
    available[..., 2] = True
    return available


def trained_of(encoder: Any, heads: Any, spec: Any, make: Any = None) -> Trained:
    """As if a run had trained the team."""
    discrete = isinstance(spec, DiscreteSpec)
    task: AnyTask = DiscreteTask(spec, make) if discrete else Task(spec, make)
    config = resolve(Config("tiny", algo="facmac"), discrete=discrete)
    teams = ({"marl": encoder}, {"marl": heads})
    return Trained(Path("tiny"), None, config, task, Progress(), *teams)
