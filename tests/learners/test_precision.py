"""What is lost by keeping observations in half precision: next to nothing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.algorithms import race
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, FacmacConfig
from race.config.shape import shape_of
from race.envs import make_discrete_task
from race.learners import facmac
from race.method.equations import marl_policy_loss, td_loss
from race.replay.buffer import Layout, Replay, slots_of
from race.replay.packing import layouts
from race.rollouts.device import play
from race.rollouts.episodes import Part
from race.types import Episode

EPISODES = 6


@pytest.fixture(scope="module")
def gradients() -> dict[str, Any]:
    """Critic's and policy's gradients on the same battles, by the precision they are kept in."""
    task = make_discrete_task("micro/2s_vs_1sc")
    spec, device = task.spec, task.device
    assert device is not None
    config = resolve(
        Config(spec.task, facmac=FacmacConfig(hidden_size=16, utility_sizes=(16, 16))),
        discrete=True,
    )
    state = race.init(jax.random.key(0), spec, shape_of(config), hyper_of(config))
    seeds = np.arange(EPISODES, dtype=np.uint32)
    teams = race.teams(state, spec, shape_of(config))
    (played,) = play(device(), [Part(teams, seeds, None)], spec, "float32")
    exact = played.episodes
    places = np.arange(EPISODES)[None]
    laid = layouts(places, np.asarray(exact.length)[None], spec.episode_limit)
    layout = Layout(*(jnp.asarray(column[0]) for column in laid))

    def losses(params: Any, episodes: Episode) -> jax.Array:
        encoder, head, critic = params
        batch = slots_of(Replay(episodes, jnp.int32(EPISODES)), layout)
        now, taken, mask = facmac.now(batch, spec)
        later = facmac.later(batch, spec)
        z = jax.lax.stop_gradient(facmac.encode(encoder, later, spec))
        action = facmac.target_action(z, head, later, jax.random.key(1), spec, hyper_of(config))
        target_critic = jax.lax.stop_gradient(critic)
        y = facmac.td_target(
            batch, facmac.q_marl(target_critic, later, action, spec)[0], hyper_of(config)
        )
        critic_loss = td_loss(facmac.q_marl(critic, now, taken, spec), y, mask)
        chosen = facmac.act(facmac.encode(encoder, now, spec), head, now, jax.random.key(2), spec)
        policy = marl_policy_loss(facmac.q_marl(target_critic, now, chosen, spec)[0], mask)
        return critic_loss + policy

    params = (
        state.policies.encoder.params,
        state.policies.head.params,
        state.critics.critic.params,
    )
    gradient = jax.jit(jax.grad(losses))
    half = exact._replace(obs=exact.obs.astype(jnp.float16), state=exact.state.astype(jnp.float16))
    parts = ("encoder", "head", "critic")
    found: dict[str, Any] = {}
    for name, episodes in {"float32": exact, "float16": half}.items():
        found[name] = dict(zip(parts, gradient(params, episodes), strict=True))
    return found


@pytest.mark.parametrize("part", ["encoder", "head", "critic"])
def test_half_precision_hardly_turns_a_gradient(gradients: dict[str, Any], part: str) -> None:
    exact, half = (
        np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(gradients[name][part])])
        for name in ("float32", "float16")
    )
    assert np.linalg.norm(exact) > 1e-4
    assert (exact != half).any()
    # The noise of drawing another minibatch is hundreds of times as large.
    assert np.linalg.norm(exact - half) < 2e-3 * np.linalg.norm(exact)
