"""Multi-Agent MuJoCo: gymnasium's robots, their joints divided among agents.

The factorisation is gymnasium-robotics' (Multi-Agent MuJoCo, version 1 of its interface); the
environment that is stepped is gymnasium's own single-agent one, which is the same physics
without the cost of building dictionaries of observations nobody reads.
"""

import contextlib
import difflib
import functools
import io
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from race.config.settings import EnvConfig
from race.envs import joints
from race.errors import ConfigError, TaskError, blamed
from race.types import EnvSpec, Task

# Partitions that gymnasium-robotics knows, for listing and suggestions. The many-segment robots
# take any "<agents>x<segments per agent>". CoupledHalfCheetah is left out: its observation does
# not survive the sparse tendon Jacobian of recent versions of mujoco.
KNOWN_PARTITIONS: Final[dict[str, tuple[str, ...]]] = {
    "HalfCheetah": ("2x3", "6x1"),
    "Ant": ("2x4", "2x4d", "4x2"),
    "Hopper": ("3x1",),
    "Humanoid": ("9x8",),
    "HumanoidStandup": ("9x8",),
    "Walker2d": ("2x3",),
    "Swimmer": ("2x1",),
    "Reacher": ("2x1",),
    "Pusher": ("3p",),
    "ManySegmentAnt": ("2x3", "3x2"),
    "ManySegmentSwimmer": ("2x5", "6x1", "10x2"),
}

_CATEGORIES: Final = (
    *("qpos", "qvel", "cinert", "cvel", "qfrc_actuator", "cfrc_ext"),
    *("ten_J", "ten_length", "ten_velocity", "fingertip_dist"),
)
_COUPLED_LIMIT: Final = 1000  # steps; the only robot that gymnasium does not register
_MANY_SEGMENTS: Final = {"ManySegmentAnt": "Ant-v5", "ManySegmentSwimmer": "Swimmer-v5"}


def make_task(task_id: str, config: EnvConfig) -> Task:
    """A Multi-Agent MuJoCo task.

    The state is the observation of gymnasium's single-agent environment, in float64, and an
    agent's observation is a gather of it. Where the reference's observation is no such gather
    (Reacher and Pusher, whose agents see sines, cosines and positions of bodies), the state is
    the original one followed by the observations of all agents, and ``obs_index`` points at
    these. Which of the two holds is found out here, by comparing with the reference over a few
    random steps.

    Args:
        task_id: ``mamujoco/<Scenario>-<partition>``, such as ``mamujoco/HalfCheetah-2x3``. The
            humanoids' partition is ``9x8``; the library's own spelling ``9|8`` means the same.
        config: what agents observe.

    Raises:
        TaskError: if the library does not know the scenario or the partition, or cannot build it.
        ConfigError: if the environment has no such observations.
    """
    scenario, partition = _parse(task_id)
    name = f"mamujoco/{scenario}-{partition.replace('|', 'x')}"
    make = functools.partial(_make, scenario, partition, config)
    with quiet():
        try:
            env = _single_agent_env(scenario, partition, None)
        except Exception as error:
            raise TaskError(
                f"gymnasium-robotics cannot build {name} with the installed mujoco "
                f"({type(error).__name__}: {error}). Choose another task (`race list`)."
            ) from error
        try:
            reference = _reference(env, scenario, partition, config)
            obs_index = _library_index(reference)
            if obs_index is None or not _is_gather(env, reference, obs_index):
                env = _ReferenceState(env, reference)
                obs_index = env.obs_index
                make = functools.partial(_make, scenario, partition, config, augmented=True)
            spec = _spec(name, env, reference, obs_index)
        finally:
            env.close()
    return Task(spec, make)


def _parse(task_id: str) -> tuple[str, str]:
    """Scenario and partition in the library's spelling.

    Raises:
        TaskError: if the library does not know them.
    """
    match = re.fullmatch(r"mamujoco/(\w+)-([\w|]+)", task_id)
    if match is not None:
        scenario, partition = match.groups()
        if scenario.startswith("Humanoid"):
            partition = partition.replace("9x8", "9|8")
        if scenario in _MANY_SEGMENTS:
            known = re.fullmatch(r"[1-9]\d*x[1-9]\d*", partition) is not None
        else:
            known = _library_knows(scenario, partition)
        if known:
            return scenario, partition
    known_ids = [
        f"mamujoco/{s}-{p}" for s, partitions in KNOWN_PARTITIONS.items() for p in partitions
    ]
    nearest = difflib.get_close_matches(task_id, known_ids, n=3, cutoff=0.0)
    raise TaskError(
        f"There is no task {task_id!r}. The nearest names are {', '.join(nearest)}; `race list` "
        "shows all. ManySegmentAnt and ManySegmentSwimmer take any <agents>x<segments per agent>."
    )


def _library_knows(scenario: str, partition: str) -> bool:
    with quiet():
        from gymnasium_robotics.envs.multiagent_mujoco.obsk import get_parts_and_edges
    try:
        get_parts_and_edges(scenario, partition)
    # The library says "unknown" with a bare Exception.
    except Exception:
        return False
    return True


def _make(
    scenario: str,
    partition: str,
    config: EnvConfig,
    render_mode: str | None = None,
    *,
    augmented: bool = False,
) -> gymnasium.Env[Any, Any]:
    with quiet():
        env = _single_agent_env(scenario, partition, render_mode)
        if augmented:
            return _ReferenceState(env, _reference(env, scenario, partition, config))
        return env


def _single_agent_env(
    scenario: str, partition: str, render_mode: str | None
) -> gymnasium.Env[Any, Any]:
    options: dict[str, Any] = {"render_mode": render_mode, "disable_env_checker": True}
    if scenario in _MANY_SEGMENTS:
        from gymnasium_robotics.envs.multiagent_mujoco import many_segment_ant, many_segment_swimmer

        agents, segments = map(int, partition.split("x"))
        library = many_segment_ant if scenario == "ManySegmentAnt" else many_segment_swimmer
        # The library writes this file into its own package, where two processes would collide.
        with tempfile.TemporaryDirectory() as folder:
            path = str(Path(folder) / "robot.xml")
            library.gen_asset(n_segs=agents * segments, asset_path=path)
            return gymnasium.make(_MANY_SEGMENTS[scenario], xml_file=path, **options)
    if scenario == "CoupledHalfCheetah":
        from gymnasium_robotics.envs.multiagent_mujoco.coupled_half_cheetah import (
            CoupledHalfCheetahEnv,
        )

        env = CoupledHalfCheetahEnv(render_mode)
        env.reset(seed=0)  # fails here, where it can be explained, if mujoco is too new for it
        return gymnasium.wrappers.TimeLimit(env, max_episode_steps=_COUPLED_LIMIT)
    return gymnasium.make(f"{scenario}-v5", **options)


def _reference(
    env: gymnasium.Env[Any, Any], scenario: str, partition: str, config: EnvConfig
) -> Any:
    """The library's multi-agent environment around `env`, its joints those of the model."""
    from gymnasium_robotics import mamujoco_v1

    options: dict[str, Any] = {}
    obsk = 1 if config.library_observation else config.agent_obsk
    unwrapped: Any = env.unwrapped
    graph = joints.factorization(scenario, partition, obsk, unwrapped.model)
    if not config.library_observation:
        _check_categories(config)
        depths = range(config.agent_obsk + 1)
        categories = config.local_categories
        options = {
            "agent_obsk": config.agent_obsk,
            "local_categories": [list(categories[min(k, len(categories) - 1)]) for k in depths],
            "global_categories": tuple(config.global_categories),
        }
    try:
        reference = mamujoco_v1.parallel_env(
            scenario, partition, gym_env=env, agent_factorization=graph, **options
        )
    except Exception as error:
        raise ConfigError(
            f"gymnasium-robotics cannot build these observations of {scenario} ({error}): "
            f"{options or 'its own defaults'}. Leave out categories that this robot does not have; "
            "every robot has qpos and qvel."
        ) from error
    # The library sorts joints by name, and two joints of Pusher have the same one: their order
    # would differ from process to process.
    for nodes in (nodes for near in reference.k_dicts for nodes in near.values()):
        nodes.sort(key=lambda node: (node.label, node.act_ids))
    return reference


def _check_categories(config: EnvConfig) -> None:
    named = {c for depth in config.local_categories for c in depth} | set(config.global_categories)
    if not config.local_categories or not named <= set(_CATEGORIES):
        raise ConfigError(
            f"env.local-categories {config.local_categories} and env.global-categories "
            f"{config.global_categories} must name what to observe at each distance, out of "
            f"{', '.join(_CATEGORIES)}."
        )


def _library_index(reference: Any) -> tuple[tuple[int, ...], ...] | None:
    """For each agent the entries of the state that it observes, as far as the library can tell."""
    factorization = reference.observation_factorization
    if factorization is None:
        return None
    return tuple(tuple(map(int, factorization[agent])) for agent in reference.possible_agents)


def _is_gather(
    env: gymnasium.Env[Any, Any],
    reference: Any,
    obs_index: tuple[tuple[int, ...], ...],
    steps: int = 20,
) -> bool:
    """Whether agents observe exactly those entries of the state, in a few random steps."""
    assert isinstance(env.action_space, gymnasium.spaces.Box)
    rng = np.random.default_rng(0)
    state, _ = env.reset(seed=0)
    for _ in range(steps):
        for agent, index in enumerate(obs_index):
            if not np.array_equal(state[list(index)], _observation(env, reference, agent)):
                return False
        action = rng.uniform(env.action_space.low, env.action_space.high)
        state, *_ = env.step(action.astype(np.float32))
    return True


def _observation(env: gymnasium.Env[Any, Any], reference: Any, agent: int) -> NDArray[np.float64]:
    from gymnasium_robotics.envs.multiagent_mujoco.obsk import build_obs

    unwrapped: Any = env.unwrapped
    return build_obs(
        unwrapped.data,
        reference.k_dicts[agent],
        reference.local_categories,
        reference.mujoco_globals,
        reference.global_categories,
    )


@final
class _ReferenceState(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Appends the reference's observations of all agents to the state."""

    def __init__(self, env: gymnasium.Env[Any, Any], reference: Any) -> None:
        super().__init__(env)
        assert isinstance(env.observation_space, gymnasium.spaces.Box)
        self._reference = reference
        sizes = [reference.observation_space(a).shape[0] for a in reference.possible_agents]
        starts = np.cumsum([env.observation_space.shape[0], *sizes])
        self.obs_index = tuple(
            tuple(range(start, start + size)) for start, size in zip(starts, sizes, strict=False)
        )
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (starts[-1],), np.float64)

    def observation(self, observation: NDArray[np.float64]) -> NDArray[np.float64]:
        agents = range(len(self.obs_index))
        return np.concatenate(
            [observation, *(_observation(self.env, self._reference, agent) for agent in agents)]
        )


def _spec(
    name: str,
    env: gymnasium.Env[Any, Any],
    reference: Any,
    obs_index: tuple[tuple[int, ...], ...],
) -> EnvSpec:
    assert isinstance(env.observation_space, gymnasium.spaces.Box)
    assert isinstance(env.action_space, gymnasium.spaces.Box)
    limit = env.spec.max_episode_steps if env.spec is not None else _COUPLED_LIMIT
    assert limit is not None
    return EnvSpec(
        task=name,
        state_size=env.observation_space.shape[0],
        obs_index=obs_index,
        action_index=tuple(
            tuple(int(node.act_ids) for node in nodes)
            for nodes in reference.agent_action_partitions
        ),
        action_low=tuple(env.action_space.low.tolist()),
        action_high=tuple(env.action_space.high.tolist()),
        episode_limit=limit,
    )


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Loads the library and keeps back what third parties say of it that is known as harmless."""
    asked = os.environ.get("MUJOCO_GL")
    why = f" (MUJOCO_GL is {asked!r}; without it, it may be)" if asked else ""
    with blamed(TaskError, f"mujoco cannot be imported, which Multi-Agent MuJoCo runs on{why}"):
        import mujoco

    def warn(message: str) -> None:
        # HalfCheetah's model file is gymnasium's; nobody here can mend it.
        if "settotalmass" not in message:
            warnings.warn(message, stacklevel=2)

    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        import gymnasium_robotics  # noqa: F401
    for line in said.getvalue().splitlines():
        # News of other environments of the same library, printed at import.
        if "Adroit" not in line:
            print(line, file=sys.stderr)
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warn)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)
