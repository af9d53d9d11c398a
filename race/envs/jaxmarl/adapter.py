"""A JaxMARL environment as pure functions over what this library calls an observation.

Letters: ``N`` agents of the team, ``O`` entries of an observation, ``A`` actions, both padded to
the largest agent; ``S`` entries of the state.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from race.config.settings import EnvConfig
from race.envs.jaxmarl.naming import names_of
from race.envs.members import picked
from race.errors import TaskError
from race.types import DiscreteSpec, Observation, Outcome

WORLD_STATE = "world_state"
"""Where JaxMARL's environments put a global state among the observations."""
_MASKS = ("get_avail_actions", "get_legal_moves")


class State(NamedTuple):
    """Between two steps."""

    env_state: Any
    steps: Int[Array, ""]


@final
class Adapter:
    """One environment; its methods are those of a `race.types.DeviceEnv`.

    Steps are JaxMARL's own, with the keys that its ``step`` would use, but episodes do not begin
    anew by themselves: the observation behind the last step is that of its end. An end that the
    environment tells before the step limit terminates the episode, and the limit truncates it;
    battles of SMAX terminate when one side is dead, whenever that is.

    Attributes:
        spec: the task's sizes.
        facts: what else decides what a run means.
        team: names of the team's agents.
    """

    def __init__(self, env: Any, task: str, config: EnvConfig) -> None:
        """Looks at an environment without running it.

        Raises:
            TaskError: if it is none that can be learned, or a setting does not fit it.
        """
        self._env, self._task = env, task
        self._agents = list(env.agents)
        self._members = picked(self._agents, config.agents)
        self._others = [agent for agent in self._agents if agent not in self._members]
        if config.others != "random":
            raise self._wrong(
                f"--env.others {config.others} is a function on the host, and these environments "
                "run on the device: the other agents choose at random (--env.others random)"
            )
        self.team = list(map(str, self._members))
        self._counts = {agent: self._count(agent) for agent in self._agents}
        shown, inner = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), np.uint32))
        unseen = [agent for agent in self._agents if agent not in shown]
        if unseen:
            raise self._wrong(
                f"its reset shows {', '.join(map(str, shown))}, and nothing by the name of agent "
                f"{unseen[0]}: it has not the interface of JaxMARL's other environments"
            )
        sizes = {agent: math.prod(shown[agent].shape) for agent in self._agents}
        self._own_state = _own_state(shown, config, task)
        self._mask = _mask_of(env, inner)
        self._limit = self._limit_of(config)
        self._mean = config.team_reward == "mean"
        self._alive, self._side = _alive_of(env, inner), self._side_of(env)
        state_size = sum(sizes.values())
        if self._own_state:
            state_size = math.prod(shown[WORLD_STATE].shape)
            self._refuse_large(state_size, "its world_state", config)
        for agent in self._members if self._own_state else self._agents:
            self._refuse_large(sizes[agent], f"the observation of {agent}", config)
        self.spec = DiscreteSpec(
            task=task,
            n_agents=len(self._members),
            obs_size=max(sizes[agent] for agent in self._members),
            state_size=state_size,
            n_actions=max(self._counts[agent] for agent in self._members),
            episode_limit=self._limit,
            has_wins=self._alive is not None and self._side is not None,
        )
        self.facts: tuple[tuple[str, Any], ...] = (
            ("agent_names", self.team),
            ("other_agents", list(map(str, self._others))),
            ("others_act", config.others if self._others else None),
            ("team_reward", config.team_reward),
            ("state_is", "environment" if self._own_state else "observations"),
            ("env_kwargs", config.kwargs),
        )

    def reset(self, arrays: None, key: Key[Array, ""]) -> tuple[State, Observation]:
        """Begins an episode."""
        shown, inner = self._env.reset(jax.random.key_data(key))
        return State(inner, jnp.zeros((), jnp.int32)), self._observed(shown, inner)

    def step(
        self, arrays: None, state: State, actions: Int[Any, "N"], key: Key[Array, ""]
    ) -> tuple[State, Observation, Outcome]:
        """One step of all agents."""
        after, seen, outcome, _ = self.step_paid(state, actions, key)
        return after, seen, outcome

    def step_paid(
        self, state: State, actions: Int[Any, "N"], key: Key[Array, ""]
    ) -> tuple[State, Observation, Outcome, Float[Array, "N"]]:
        """One step, and what each agent of the team was paid."""
        chosen = {
            agent: jnp.clip(actions[i], 0, self._counts[agent] - 1).astype(jnp.int32)
            for i, agent in enumerate(self._members)
        }
        if self._others:
            key, own = jax.random.split(key)
            chosen |= self._random(state.env_state, own)
        # As JaxMARL's step, whose other half of the key is for a new episode.
        now, _ = jax.random.split(key)
        shown, inner, rewards, dones, _ = self._env.step_env(
            jax.random.key_data(now), state.env_state, chosen
        )
        steps = state.steps + 1
        paid = jnp.stack([_number(rewards[agent]) for agent in self._members])
        over, timed_out = jnp.reshape(dones["__all__"], ()).astype(bool), steps >= self._limit
        won = jnp.zeros((), bool)
        if self._alive is None:
            terminated = over & ~timed_out
        else:
            sides = self._alive(inner)
            terminated = ~sides[0] | ~sides[1]
            if self._side is not None:
                won = sides[self._side] & ~sides[1 - self._side]
        outcome = Outcome(
            reward=jnp.mean(paid) if self._mean else jnp.sum(paid),
            terminated=terminated,
            truncated=~terminated & (over | timed_out),
            won=won,
        )
        return State(inner, steps), self._observed(shown, inner), outcome, paid

    def names(self) -> tuple[list[str], list[list[str]], list[list[str]]] | None:
        """Names of the entries of the state, and of each agent's observation and actions."""
        found = names_of(self._env, self._members)
        if found is None or self._own_state:
            return found
        return [""] * self.spec.state_size, *found[1:]

    def _observed(self, shown: Any, inner: Any) -> Observation:
        obs = jnp.stack([_padded(shown[agent], self.spec.obs_size) for agent in self._members])
        parts = [shown[WORLD_STATE]] if self._own_state else [shown[a] for a in self._agents]
        state = jnp.concatenate([jnp.ravel(part).astype(jnp.float32) for part in parts])
        masks = self._available(inner)
        return Observation(obs, state, jnp.stack([masks[agent] for agent in self._members]))

    def _available(self, inner: Any) -> dict[Any, Bool[Array, "A"]]:
        """What each agent can choose, padded; one that could choose nothing can choose all."""
        size = max(self._counts.values())
        given = None if self._mask is None else self._mask(inner)
        found = {}
        for agent, count in self._counts.items():
            real = jnp.arange(count) < count
            if given is not None:
                told = jnp.ravel(given[agent])[:count].astype(bool)
                real = told | ~jnp.any(told)
            wide = self.spec.n_actions if agent in self._members else size
            found[agent] = jnp.zeros(wide, bool).at[:count].set(real)
        return found

    def _random(self, inner: Any, key: Key[Array, ""]) -> dict[Any, Int[Array, ""]]:
        masks = self._available(inner)
        keys = jax.random.split(key, len(self._others))
        return {
            agent: jax.random.categorical(one, jnp.where(masks[agent], 0.0, -jnp.inf))
            for agent, one in zip(self._others, keys, strict=True)
        }

    def _side_of(self, env: Any) -> int | None:
        """Of battles: 0 if the team are allies, 1 if they are enemies, None if they are both."""
        count = getattr(env, "num_allies", len(self._agents))
        sides = {int(self._agents.index(agent) >= count) for agent in self._members}
        return sides.pop() if len(sides) == 1 else None

    def _count(self, agent: Any) -> int:
        space = self._env.action_space(agent)
        count = getattr(space, "n", None)
        if count is None or np.ndim(count) or getattr(space, "shape", ()) != ():
            raise self._wrong(
                f"the actions of {agent} are {type(space).__name__} "
                f"{getattr(space, 'shape', '')}, and of JaxMARL those are learned that are one of "
                "a number of choices (Discrete). Continuous robots are there as mamujoco/*, and "
                "PettingZoo's environments with continuous actions as pettingzoo:*"
            )
        return int(count)

    def _limit_of(self, config: EnvConfig) -> int:
        own = _own_limit(self._env)
        if config.episode_limit is None:
            if own is None:
                raise self._wrong(
                    "after how many steps do its episodes end? It has no max_steps that says so: "
                    "name a number with --env.episode-limit. Episodes are cut off (truncated) there"
                )
            return own
        if own is not None and config.episode_limit > own:
            raise self._wrong(
                f"its episodes end after {own} steps, so --env.episode-limit "
                f"{config.episode_limit} would not be reached. Where it has an argument for that, "
                f"""--env.kwargs '{{"max_steps": {config.episode_limit}}}' makes them longer"""
            )
        return config.episode_limit

    def _refuse_large(self, size: int, what: str, config: EnvConfig) -> None:
        if not 1 <= size <= config.largest_observation:
            raise self._wrong(
                f"{what} has {size:,} entries, and at most {config.largest_observation:,} are "
                f"taken. If memory allows it: --env.largest-observation {size}"
            )

    def _wrong(self, text: str) -> TaskError:
        return TaskError(f"Task {self._task}: {text}.")


def _own_state(shown: Any, config: EnvConfig, task: str) -> bool:
    """Whether the state is the environment's own."""
    there = WORLD_STATE in shown
    if config.state == "environment" and not there:
        raise TaskError(
            f"Task {task}: it shows no {WORLD_STATE}: leave out --env.state environment."
        )
    if config.state == "auto" and there:
        return math.prod(shown[WORLD_STATE].shape) <= config.largest_observation
    return there and config.state != "observations"


def _mask_of(env: Any, inner: Any) -> Callable[[Any], Any] | None:
    """What tells the available actions; None where all always are."""
    for name in _MASKS:
        method = getattr(env, name, None)
        if method is None:
            continue
        try:
            jax.eval_shape(method, inner)
        except NotImplementedError:
            continue
        return method
    return None


def _own_limit(env: Any) -> int | None:
    for name in ("max_steps", "max_episode_steps", "episode_length"):
        found = getattr(env, name, None)
        if isinstance(found, int | np.integer) and found >= 1:
            return int(found)
    parts = [getattr(env, name, None) for name in ("num_inner_steps", "num_outer_steps")]
    if all(isinstance(part, int) for part in parts):
        return math.prod(parts)  # type: ignore[arg-type]
    return None


def _alive_of(env: Any, inner: Any) -> Callable[[Any], tuple[Any, Any]] | None:
    """Whether any allies, and any enemies, are alive: of battles, in which one can win."""
    count = getattr(env, "num_allies", None)
    path = ("state", "unit_alive") if hasattr(inner, "state") else ("unit_alive",)
    if count is None or not hasattr(getattr(inner, "state", inner), "unit_alive"):
        return None

    def alive(inner: Any) -> tuple[Any, Any]:
        units = inner
        for name in path:
            units = getattr(units, name)
        return jnp.any(units[:count]), jnp.any(units[count:])

    return alive


def _number(value: Any) -> Float[Array, ""]:
    return jnp.reshape(jnp.asarray(value).astype(jnp.float32), ())


def _padded(value: Any, size: int) -> Float[Array, "O"]:
    flat = jnp.ravel(value).astype(jnp.float32)
    return jnp.pad(flat, (0, size - flat.shape[0]))
