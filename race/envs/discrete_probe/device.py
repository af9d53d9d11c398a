"""The probes as pure functions of JAX; see `race.envs.discrete_probe.host` for their rules.

Letters: ``N`` agents, ``A`` actions.
"""

from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from race.envs.discrete_probe.chance import (
    draw_lives,
    draw_lives_start,
    draw_matching,
    draw_memory,
)
from race.envs.discrete_probe.rules import (
    CLIMB_PAYOFFS,
    LIVES_AGENTS,
    LIVES_STEPS,
    MATCHING_ACTIONS,
    MEMORY_STEPS,
    MEMORY_WAIT,
)
from race.types import DeviceEnv, Observation, Outcome

Actions = Int[Any, "N"]


class MatchingState(NamedTuple):
    """Between ``reset`` and ``step`` of ``probe/matching``."""

    cues: Int[Any, "2"]
    blocked: Bool[Any, "2 A"]


def matching_reset(arrays: Any, key: Key[Array, ""]) -> tuple[MatchingState, Observation]:
    """Draws cues and blocked actions."""
    env_state = MatchingState(*draw_matching(key))
    return env_state, _matching_look(env_state)


def matching_step(
    arrays: Any, env_state: MatchingState, actions: Actions, key: Key[Array, ""]
) -> tuple[MatchingState, Observation, Outcome]:
    """Pays the share of agents that are right, and ends."""
    seen = _matching_look(env_state)
    right = _taken(seen.avail_actions, actions) == env_state.cues
    return env_state, seen, _outcome(_share(right), jnp.ones((), bool))


def _matching_look(env_state: MatchingState) -> Observation:
    bits = jax.nn.one_hot(env_state.cues, MATCHING_ACTIONS, dtype=jnp.float32)
    return Observation(bits, bits.reshape(-1), ~env_state.blocked | (bits > 0))


class MemoryState(NamedTuple):
    """Between the steps of ``probe/memory``."""

    cues: Int[Any, "2"]
    steps: Int[Any, ""]


def memory_reset(arrays: Any, key: Key[Array, ""]) -> tuple[MemoryState, Observation]:
    """Draws the cues."""
    env_state = MemoryState(draw_memory(key), jnp.zeros((), jnp.int32))
    return env_state, _memory_look(env_state)


def memory_step(
    arrays: Any, env_state: MemoryState, actions: Actions, key: Key[Array, ""]
) -> tuple[MemoryState, Observation, Outcome]:
    """Pays at the last step the share of agents that name their cue; won if all do."""
    right = _taken(_memory_look(env_state).avail_actions, actions) == env_state.cues
    env_state = env_state._replace(steps=env_state.steps + 1)
    over = env_state.steps >= MEMORY_STEPS
    reward = jnp.where(over, _share(right), 0.0)
    return env_state, _memory_look(env_state), _outcome(reward, over, over & jnp.all(right))


def _memory_look(env_state: MemoryState) -> Observation:
    bits = jax.nn.one_hot(env_state.cues, 2, dtype=jnp.float32)
    time = _float(env_state.steps) / MEMORY_STEPS
    shown = jnp.where(env_state.steps == 0, bits, 0.0)
    obs = jnp.concatenate([shown, jnp.full((2, 1), time)], axis=1)
    second = jnp.full((2, 1), env_state.steps != MEMORY_WAIT)
    available = jnp.concatenate([jnp.ones((2, 1), bool), second], axis=1)
    return Observation(obs, jnp.concatenate([bits.reshape(-1), time[None]]), available)


class ClimbState(NamedTuple):
    """``probe/climb`` has nothing to remember but its steps."""

    steps: Int[Any, ""]


def climb_reset(payoffs: Float[Any, "A A"], key: Key[Array, ""]) -> tuple[ClimbState, Observation]:
    """There is nothing to draw."""
    return ClimbState(jnp.zeros((), jnp.int32)), _climb_look(payoffs)


def climb_step(
    payoffs: Float[Any, "A A"], env_state: ClimbState, actions: Actions, key: Key[Array, ""]
) -> tuple[ClimbState, Observation, Outcome]:
    """Pays the joint action, and ends."""
    seen = _climb_look(payoffs)
    first, second = _taken(seen.avail_actions, actions)
    outcome = _outcome(jnp.asarray(payoffs)[first, second], jnp.ones((), bool))
    return ClimbState(env_state.steps + 1), seen, outcome


def _climb_look(payoffs: Float[Any, "A A"]) -> Observation:
    actions = len(payoffs)
    one = jnp.ones((), jnp.float32)
    return Observation(jnp.full((2, 1), one), one[None], jnp.ones((2, actions), bool))


class LivesState(NamedTuple):
    """Between the steps of ``probe/lives``."""

    cues: Int[Any, "N"]
    steps: Int[Any, ""]
    length: Int[Any, ""]


def lives_reset(arrays: Any, key: Key[Array, ""]) -> tuple[LivesState, Observation]:
    """Draws the number of steps and the first cues."""
    length, cues = draw_lives_start(key)
    env_state = LivesState(cues, jnp.zeros((), jnp.int32), length)
    return env_state, _lives_look(env_state)


def lives_step(
    arrays: Any, env_state: LivesState, actions: Actions, key: Key[Array, ""]
) -> tuple[LivesState, Observation, Outcome]:
    """Pays the share of the living that are right, lets one agent die, and draws new cues."""
    alive = _living(env_state)
    # The dead are never right: they take 0, which no cue names.
    right = _taken(_lives_look(env_state).avail_actions, actions) == env_state.cues
    share = _float(jnp.sum(right)) / jnp.maximum(_float(jnp.sum(alive)), 1.0)
    reward = jnp.where(jnp.any(alive), share, 1.0) / _float(env_state.length)
    env_state = env_state._replace(cues=draw_lives(key), steps=env_state.steps + 1)
    over = env_state.steps >= env_state.length
    return env_state, _lives_look(env_state), _outcome(reward, over)


def _living(env_state: LivesState) -> Bool[Any, "N"]:
    return env_state.steps <= jnp.arange(LIVES_AGENTS)


def _lives_look(env_state: LivesState) -> Observation:
    alive = _living(env_state)[:, None]
    time, length = (
        _float(count)[None] / LIVES_STEPS[1] for count in (env_state.steps, env_state.length)
    )
    bits = jax.nn.one_hot(env_state.cues - 1, 2, dtype=jnp.float32)
    cues = jnp.where(alive, jnp.concatenate([jnp.ones_like(bits[:, :1]), bits], axis=1), 0.0)
    return Observation(
        jnp.concatenate([cues, jnp.where(alive, time[None], 0.0)], axis=1),
        jnp.concatenate([cues.reshape(-1), time, length]),
        jnp.concatenate([~alive, alive, alive], axis=1),
    )


# What they share.


def _taken(available: Bool[Any, "N A"], actions: Actions) -> Int[Any, "N"]:
    """The actions, where available; elsewhere the available one of the lowest number."""
    numbers = jnp.arange(available.shape[1], dtype=jnp.int32)
    chosen = available & (jnp.asarray(actions, jnp.int32)[:, None] == numbers[None])
    offered = jnp.where(jnp.any(chosen, axis=1, keepdims=True), chosen, available)
    return jnp.argmax(offered, axis=1).astype(jnp.int32)


def _float(number: Int[Any, ""]) -> Float[Any, ""]:
    return number.astype(jnp.float32)


def _share(facts: Bool[Any, "N"]) -> Float[Any, ""]:
    return jnp.mean(facts.astype(jnp.float32))


def _outcome(reward: Any, terminated: Any, won: Any = None) -> Outcome:
    no = jnp.zeros((), bool)
    return Outcome(reward, terminated, no, no if won is None else won)


ENVS: Final[dict[str, DeviceEnv]] = {
    "probe/matching": DeviceEnv((), matching_reset, matching_step),
    "probe/memory": DeviceEnv((), memory_reset, memory_step),
    "probe/climb": DeviceEnv(np.array(CLIMB_PAYOFFS, np.float32), climb_reset, climb_step),
    "probe/lives": DeviceEnv((), lives_reset, lives_step),
}
"""The probes, by id."""
