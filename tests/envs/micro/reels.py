"""Battles on film: played once per map, seed and manner, the units kept after every game loop."""

import functools
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from race.envs.micro import EnvState, Timestep, battle, make, smac
from race.envs.micro.scenario import Scenario
from race.envs.micro.state import Units

STEPS = 60
EPSILON = 1e-4
# Weights of no-op, stop, north, south, east, west and each attack.
MANNERS = {
    "anything": (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    "advance": (1.0, 0.1, 4.0, 0.1, 4.0, 0.1, 40.0),
    "hit and run": (1.0, 0.1, 0.5, 1.0, 0.5, 2.0, 4.0),
}
SPEED = {
    **dict.fromkeys(("Stalker", "Zergling"), 2.9531),
    **dict.fromkeys(("Zealot", "Colossus", "Marine", "Marauder", "Hydralisk"), 2.25),
    **{"Medivac": 2.75, "Baneling": 2.5, "SpineCrawler": 0.0},
}
HEALTH = {
    **{"Stalker": 80, "Zealot": 100, "Colossus": 200, "Marine": 45, "Marauder": 125},
    **{"Medivac": 150, "Zergling": 35, "Baneling": 30, "Hydralisk": 80, "SpineCrawler": 300},
}
SHIELD = {"Stalker": 80, "Zealot": 50, "Colossus": 150}
ZERG = ("Zergling", "Baneling", "Hydralisk", "SpineCrawler")
PATIENTS = ("Marine", "Marauder", "Zealot", *ZERG)
RADIUS = {"Marine": 0.375, "Marauder": 0.5625, "Medivac": 0.75}


class Reel(NamedTuple):
    """A battle in numpy: T steps until its end, L = 8 T game loops, U units, allies first."""

    types: list[str]
    n: int
    cells: NDArray[Any]  # [X, Y]
    scale: float  # what rewards are divided by
    before: EnvState  # [T]
    after: EnvState  # [T]
    shots: Units  # [L + 1], the first one before the first loop
    timestep: Timestep  # [T]

    def per_type(self, table: dict[str, Any], other: float = 0.0) -> NDArray[np.float64]:
        return np.array([table.get(kind, other) for kind in self.types], float)


def step_on_film(
    scenario: Scenario, env_state: EnvState, actions: Any, key: Any
) -> tuple[EnvState, Timestep, Units]:
    """A step, and the units after each of its game loops."""
    films: list[Units] = []

    def fight(*arguments: Any) -> Units:
        films.append(battle.film(*arguments))
        last: Units = jax.tree.map(lambda shots: shots[-1], films[0])
        return last

    with mock.patch.object(battle, "fight", fight):
        after, timestep = smac.step(scenario, env_state, actions, key)
    return after, timestep, films[0]


@jax.jit
def _play(scenario: Scenario, key: Any, weights: Any) -> Any:
    env_state, observation = smac.reset(scenario, key)
    kind = jnp.minimum(jnp.arange(scenario.shape.n_actions), battle.FIRST_TARGET)
    preference = jnp.log(weights)[kind]

    def step(carry: Any, key: Any) -> tuple[Any, Any]:
        env_state, observation = carry
        choice, chance = jax.random.split(key)
        logits = jnp.where(observation.avail_actions, preference[None], -jnp.inf)
        actions = jax.random.categorical(choice, logits)
        after, timestep, film = step_on_film(scenario, env_state, actions, chance)
        return (after, timestep.observation), (env_state, after, timestep, film)

    return jax.lax.scan(step, (env_state, observation), jax.random.split(key, STEPS))[1]


def play(name: str, seed: int, manner: str) -> Any:
    played = _play(make(name).scenario, jax.random.key(seed), jnp.array(MANNERS[manner]))
    return jax.tree.map(np.asarray, played)


@functools.cache
def reel(name: str, seed: int, manner: str) -> Reel:
    before, after, timestep, film = play(name, seed, manner)
    spec, length = make(name).spec, int((~before.over).sum())
    before, after, timestep, film = jax.tree.map(
        lambda leaf: leaf[:length], (before, after, timestep, film)
    )
    shots = jax.tree.map(
        lambda first, loops: np.concatenate(
            [first[:1], loops.reshape(8 * length, *loops.shape[2:])]
        ),
        before.units,
        film,
    )
    types = [start.unit for start in (*spec.allies, *spec.enemies)]
    worth = [10 + HEALTH[start.unit] + SHIELD.get(start.unit, 0) for start in spec.enemies]
    scale = (200 + sum(worth)) / 20
    return Reel(types, len(spec.allies), spec.cells, scale, before, after, shots, timestep)


def at(tree: Any, k: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[k]), tree)


def likeliest(observation: smac.Observation) -> Any:
    """Attacks where there are any, else a way east or north."""
    weights = np.array([1, 2, 3, 2, 4, 2] + [5] * (observation.avail_actions.shape[1] - 6))
    return (np.asarray(observation.avail_actions) * weights[None]).argmax(1).astype(np.int32)


def busiest(name: str) -> tuple[EnvState, Any]:
    """The state before the best paid step of a battle, and actions."""
    played = reel(name, 0, "advance")
    t = max(1, int(played.timestep.reward[: len(played.timestep.reward) - 1].argmax()))
    return at(played.before, t), likeliest(at(played.timestep.observation, t - 1))
