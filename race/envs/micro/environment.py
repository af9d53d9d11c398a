"""Battles as an ordinary `gymnasium.Env`, for those who want no JAX of their own."""

import functools
from typing import Any, ClassVar, final

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Int, Key, UInt8
from numpy.typing import NDArray

from race.envs.dictionary import as_dictionary, space_of
from race.envs.micro import Battle, load_map, make, smac
from race.envs.micro.battle import LOOPS_PER_STEP
from race.envs.micro.canvas import SMALL
from race.envs.micro.maps import MapSpec
from race.envs.micro.recording import step_and_film, verdict_of
from race.envs.micro.render import Painter, whole
from race.envs.micro.scenario import Scenario, Shape
from race.envs.micro.smac import Info
from race.envs.micro.state import EnvState, Units
from race.envs.micro.units import UNIT_TYPES
from race.errors import RenderError, TaskError
from race.types import DeviceEnv, DiscreteSpec, DiscreteTask, Observation, Outcome

STEPS_PER_SECOND = 2
"""At the game's "normal" speed."""

_step_and_film = jax.jit(step_and_film)


def make_task(task_id: str) -> DiscreteTask:
    """The task ``micro/<map>`` or ``micro/<path>.toml``.

    Raises:
        TaskError: if there is no such map, or its file is wrong.
    """
    name = task_id.removeprefix("micro/")
    return DiscreteTask(
        _sizes(task_id, load_map(name)),
        functools.partial(_make, name),
        functools.partial(_device, name),
    )


def _device(name: str) -> DeviceEnv:
    return DeviceEnv(make(name).scenario, smac.reset, _device_step)


def _device_step(
    scenario: Scenario, env_state: EnvState, actions: Int[Any, "n"], key: Key[Array, ""]
) -> tuple[EnvState, Observation, Outcome]:
    env_state, timestep = smac.step(scenario, env_state, actions, key)
    no = jnp.zeros((), bool)
    outcome = Outcome(timestep.reward, timestep.terminated, no, timestep.info.battle_won)
    return env_state, timestep.observation, outcome


def _make(name: str, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    return MicroEnv(make(name), render_mode)


def _sizes(task_id: str, spec: MapSpec) -> DiscreteSpec:
    # The scenario has the same shape, but takes a second to build where the ground is not plain.
    allies, enemies = ([UNIT_TYPES[s.unit] for s in side] for side in (spec.allies, spec.enemies))
    shape = Shape(
        n_allies=len(allies),
        n_enemies=len(enemies),
        n_types=len(spec.ally_type_columns),
        ally_shields=any(unit.shield for unit in allies),
        enemy_shields=any(unit.shield for unit in enemies),
        # Observations and state are as long whatever the rest is.
        n_healers=0,
        n_beams=0,
        ally_bursts=False,
        enemy_bursts=False,
        flyers=False,
        plain=True,
        ground=0,
        width=spec.cells.shape[0],
        height=spec.cells.shape[1],
        ally_heals=False,
    )
    return DiscreteSpec(
        task=task_id,
        n_agents=shape.n_allies,
        obs_size=shape.obs_size,
        state_size=shape.state_size,
        n_actions=shape.n_actions,
        episode_limit=spec.episode_limit,
        has_wins=True,
    )


@final
class MicroEnv(gymnasium.Env[dict[str, Any], NDArray[np.integer[Any]]]):
    """A battle. ``n`` agents, ``A`` actions, ``O`` entries of an observation, ``S`` of the state.

    An observation is a dictionary of ``obs`` [n, O], ``state`` [S] and ``avail_actions`` [n, A]
    (0 or 1). An action is one number per agent; an agent whose action is not available stops
    instead, and ``info["refused"]`` tells. The time limit terminates an episode, as in SMAC;
    ``truncated`` is always False.

    Chance: ``reset(seed=s)`` sets a key to ``jax.random.key(s % 2**32)``. Each reset and each step
    then takes ``key, now = jax.random.split(key)`` and calls ``reset`` or ``step`` of
    `race.envs.micro.Battle` with ``now``; the same seed and actions give the same battle, and the
    same one as those functions. Without a seed the keys go on where they were; the first time the
    seed is drawn by the operating system.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": STEPS_PER_SECOND,
    }

    def __init__(self, played: Battle, render_mode: str | None = None) -> None:
        """An environment of a map.

        Args:
            played: the map, from `race.envs.micro.make`.
            render_mode: ``"rgb_array"`` to have pictures of it, or None, which is faster.

        Raises:
            RenderError: for another render mode.
        """
        if render_mode not in (None, "rgb_array"):
            raise RenderError(
                f"A battle can be rendered as 'rgb_array' or not at all (None), not as "
                f"{render_mode!r}."
            )
        shape = played.shape
        n, actions = shape.n_allies, shape.n_actions
        self.render_mode = render_mode
        self.observation_space = space_of(n, shape.obs_size, shape.state_size, actions)
        self.action_space = spaces.MultiDiscrete([actions] * n)
        self._battle = played
        self._painter = Painter(played, whole(played), SMALL) if render_mode else None
        self._key: Any = None
        self._env_state: EnvState | None = None
        self._return = 0.0
        self._verdict = ""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins a battle; returns its first observation and an empty dictionary."""
        super().reset(seed=seed)
        if seed is not None:
            self._key = jax.random.key(seed % 2**32)  # all that a key can tell apart
        elif self._key is None:
            self._key = jax.random.key(int(self.np_random.integers(2**31)))
        self._env_state, observation = self._battle.reset(self._next_key())
        self._return, self._verdict = 0.0, ""
        if self._painter is not None:
            self._painter.forget()
            self._painter.see(jax.tree.map(np.asarray, self._env_state.units))
        return as_dictionary(observation), {}

    def step(
        self, action: NDArray[Any]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Half a second of battle; see `race.envs.micro.smac.step`.

        Returns:
            observation, reward, terminated, False, and a dictionary of facts: ``battle_won``,
            ``dead_allies``, ``dead_enemies``, ``timed_out`` and ``refused`` [n].

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            TaskError: if the action is not one whole number per agent.
        """
        if self._env_state is None:
            raise gymnasium.error.ResetNeeded("Call reset before the first step.")
        actions, n = np.asarray(action), self._battle.shape.n_allies
        if actions.shape != (n,) or not np.issubdtype(actions.dtype, np.integer):
            raise TaskError(
                f"Map {self._battle.spec.name} needs one whole number per agent, {n} in all; the "
                f"action was an array of shape {actions.shape} and type {actions.dtype}."
            )
        actions = np.clip(actions, -1, self._battle.shape.n_actions).astype(np.int32)
        key, before = self._next_key(), self._env_state
        if self._painter is None:
            self._env_state, timestep = self._battle.step(before, actions, key)
        else:
            scenario = self._battle.scenario
            self._env_state, timestep, film = _step_and_film(scenario, before, actions, key)
            if not before.over:
                shots = jax.tree.map(np.asarray, film)
                for shot in zip(*shots, strict=True):
                    self._painter.see(Units(*shot))
        reward, terminated = float(timestep.reward), bool(timestep.terminated)
        self._return += reward
        if terminated and not before.over:
            self._verdict = verdict_of(self._battle.scenario, timestep.info)
        return as_dictionary(timestep.observation), reward, terminated, False, _facts(timestep.info)

    def render(self) -> UInt8[np.ndarray, "h w 3"] | None:
        """A picture of the battle as it stands, [height, width, 3]; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._painter is None:
            return None
        if self._env_state is None:
            raise gymnasium.error.ResetNeeded("Call reset before render.")
        loops = LOOPS_PER_STEP * int(self._env_state.steps)
        return self._painter.draw(loops, self._return, self._verdict)

    def _next_key(self) -> Any:
        self._key, now = jax.random.split(self._key)
        return now


def _facts(info: Info) -> dict[str, Any]:
    return {
        "battle_won": bool(info.battle_won),
        "dead_allies": int(info.dead_allies),
        "dead_enemies": int(info.dead_enemies),
        "timed_out": bool(info.timed_out),
        "refused": np.asarray(info.refused),
    }
