"""Whether a file acts as the team does that it is of: on random observations and on real ones."""

import contextlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from race.algorithms.base import Teams
from race.envs.checked import CheckedEnv
from race.envs.contract import in_units
from race.errors import ExportError
from race.method.normalisation import Affine, Scaling
from race.programs import joint_actions
from race.rollouts.choosing import Memory, choose
from race.teams.formats import Function, signature
from race.teams.portable import Portable
from race.teams.team import Team
from race.types import EnvSpec, Observation

RANDOM = 64
"""Random observations that a file is checked on."""
REAL = 64
"""Observations of an episode, at most."""
TOLERANCE = 1e-5
"""Of actions, as a share of half their range, and of memories."""


_joint = jax.jit(joint_actions, static_argnames=("spec", "base"))
_step = jax.jit(choose)


class Moments(NamedTuple):
    """What a team was shown, and what it did."""

    inputs: dict[str, NDArray[Any]]  # with axes [B, N, ...]
    expected: NDArray[Any]  # joint actions [B, U] in units, or scores [B, N, A]
    next_memory: NDArray[np.float32] | None
    real: int  # how many of them are of an episode: the last


def shown_to(team: Team) -> Moments:
    """Random observations, then real ones; and what the team itself, as it was trained, does."""
    spec, rng = team.spec, np.random.default_rng(0)
    real, masks = _episode(team)
    size = (RANDOM, spec.n_agents, spec.obs_size)
    random = rng.normal(size=size).astype(np.float32)
    if "obs.mean" in team.portable.arrays:  # spread as what was seen, and so is not all clipped
        mean, factor = (team.portable.arrays[name] for name in ("obs.mean", "obs.factor"))
        random = random / np.where(factor > 0, factor, np.float32(1)) + mean
    obs = np.concatenate([random, real])
    teams = team.trained.acting(team.name)
    encoder, heads = teams.encoder, teams.heads[0]
    if isinstance(spec, EnvSpec):
        # Observations as they were, laid out as a state that shows each agent its own.
        apart, states = _apart(spec, obs)
        base = str(team.trained.config.base)
        alike = Teams(
            encoder,
            jnp.broadcast_to(heads[None], (len(obs), *heads.shape)),
            scaling=_of_apart(spec, teams.scaling),
        )
        chosen = np.asarray(_joint(alike, states, spec=apart, base=base))
        low, high = (np.array(b, np.float32) for b in (spec.action_low, spec.action_high))
        return Moments({"obs": obs}, in_units(chosen, low, high), None, len(real))
    available = rng.random((RANDOM, spec.n_agents, spec.n_actions)) < 0.5
    available[..., 0] |= ~available.any(axis=-1)
    available = np.concatenate([available, masks])
    units = team.portable.memory_size - spec.n_actions
    memory = np.zeros((len(obs), spec.n_agents, team.portable.memory_size), np.float32)
    scores = np.zeros((len(obs), spec.n_agents, spec.n_actions))
    after = np.zeros_like(memory)
    carried = Memory(
        jnp.zeros((1, spec.n_agents, units), np.float32),
        jnp.full((1, spec.n_agents), -1, np.int32),
    )
    head = np.asarray(heads, np.float64)
    actions = np.eye(spec.n_actions, dtype=np.float32)
    state = np.zeros((1, spec.state_size), np.float32)
    for t, (seen, mask) in enumerate(zip(obs, available, strict=True)):
        memory[t, :, :units] = carried.carry[0]
        last = np.asarray(carried.last_action[0])
        memory[t, :, units:] = actions[last] * (last >= 0)[:, None]
        moment = Observation(seen[None], state, mask[None])
        carried = _step(teams, carried, moment, np.int32(0), None)[0]
        z = np.asarray(carried.carry[0], np.float64)
        found = np.einsum("nh,nha->na", z, head[:, :-1]) + head[:, -1]
        scores[t] = np.where(mask, found, -np.inf)
        after[t, :, :units] = carried.carry[0]
        after[t, :, units:] = actions[np.asarray(carried.last_action[0])]
    inputs = {"obs": obs, "memory": memory, "avail_actions": available}
    return Moments(inputs, scores, after, len(real))


def _apart(spec: EnvSpec, obs: NDArray[np.float32]) -> tuple[EnvSpec, NDArray[np.float32]]:
    """A task whose state is all observations side by side, and its states for some."""
    size = spec.obs_size
    index = tuple(
        tuple(range(agent * size, agent * size + own)) for agent, own in enumerate(spec.obs_sizes)
    )
    apart = EnvSpec(
        task=spec.task,
        state_size=spec.n_agents * size,
        obs_index=index,
        action_index=spec.action_index,
        action_low=spec.action_low,
        action_high=spec.action_high,
        episode_limit=spec.episode_limit,
    )
    return apart, obs.reshape(len(obs), -1)


def _of_apart(spec: EnvSpec, scaling: Scaling | None) -> Scaling | None:
    if scaling is None:
        return None
    return Scaling(None, Affine(*(part[spec.obs_gather].reshape(-1) for part in scaling.state)))


def _episode(team: Team) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """What a team sees in an episode that it plays: observations, and available actions."""
    spec = team.spec
    obs = np.zeros((REAL, spec.n_agents, spec.obs_size), np.float32)
    masks = np.ones((REAL, spec.n_agents, 1 if isinstance(spec, EnvSpec) else spec.n_actions), bool)
    player, env = Team(team.trained, team.name), CheckedEnv(team.trained.task)
    with contextlib.closing(env):
        seen: Any = env.reset(0)
        for t in range(REAL):
            if isinstance(spec, EnvSpec):
                obs[t] = seen[spec.obs_gather] * spec.obs_mask
                action = player.act(state=seen)
            else:
                obs[t], masks[t] = seen.obs, seen.avail_actions
                action = player.act(seen.obs, seen.avail_actions)
            step = env.step(action)
            seen = step.seen
            if step.terminated or step.truncated:
                break
    return obs[: t + 1], masks[: t + 1]


def checked(function: Function, team: Team, agent: int | None, shown: Moments, path: Path) -> float:
    """The largest difference between a file and the team.

    Raises:
        ExportError: if it is more than the tolerance.
    """
    inputs = dict(shown.inputs)
    if agent is not None:
        inputs = {name: array[:, agent] for name, array in inputs.items()}
        size = signature(team.agent(agent), True).inputs["obs"][0][0]
        inputs["obs"] = inputs["obs"][..., :size]
    inputs = {name: np.ascontiguousarray(array) for name, array in inputs.items()}
    largest = 0.0
    for rows in (slice(None), slice(0, 1), slice(len(inputs["obs"]) - 1, None)):
        found = function({name: array[rows] for name, array in inputs.items()})
        largest = max(largest, _difference(found, team.portable, agent, shown, rows))
    if not largest <= TOLERANCE:
        raise ExportError(
            f"{path} was not written: it would act otherwise than the team by {largest:.3g}, where "
            f"{TOLERANCE:g} is allowed. Weights of such a size are beyond 32 bits; train with a "
            "smaller --race.largest-weight, or take another format."
        )
    return largest


def _difference(
    found: dict[str, NDArray[Any]],
    team: Portable,
    agent: int | None,
    shown: Moments,
    rows: slice,
) -> float:
    """In shares of half the range of actions; of choices, by how much a better one was missed."""
    spec, expected = team.spec, shown.expected[rows]
    if isinstance(spec, EnvSpec):
        entries = list(range(spec.joint_action_size) if agent is None else spec.action_index[agent])
        half = (team.arrays["high"] - team.arrays["low"])[entries] / 2
        away = np.abs(found["action"] - expected[:, entries]) / half
        return float(away.max()) if away.shape[0] == len(expected) else np.inf
    assert shown.next_memory is not None
    after, action = shown.next_memory[rows], found["action"]
    if agent is not None:
        expected, after = expected[:, agent], after[:, agent]
    size = after.shape[-1] - spec.n_actions
    carried = np.abs(found["next_memory"][..., :size] - after[..., :size]).max()
    taken = np.take_along_axis(expected, action[..., None].astype(np.int64), axis=-1)[..., 0]
    # Two actions of the same score may change places by rounding; nothing else may.
    scale = np.maximum(1.0, np.abs(expected[np.isfinite(expected)]).max())
    missed = ((expected.max(axis=-1) - taken) / scale).max()
    told = found["next_memory"][..., size:].argmax(axis=-1)
    return float(max(carried, missed)) if (told == action).all() else np.inf
