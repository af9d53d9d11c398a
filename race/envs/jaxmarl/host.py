"""A JaxMARL environment on the host: for a first look at it, and for those who step it by hand."""

from functools import partial
from typing import Any, ClassVar, final

import gymnasium
import jax
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from race.envs.dictionary import as_dictionary, space_of
from race.envs.jaxmarl.adapter import Adapter, State
from race.errors import RenderError


@final
class JaxmarlEnv(gymnasium.Env[dict[str, Any], NDArray[np.integer[Any]]]):
    """The environment of an adapter; the same seed and actions give the device's episode.

    ``reset(seed=s)`` sets a key to ``jax.random.key(s % 2**32)``; each reset and each step takes
    ``key, now = jax.random.split(key)``.

    Attributes:
        team_names: names of the team's agents.
        team_paid: what each of them was paid in the newest step.
        names: of the entries of the state, and of each agent's observation and actions, if known.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}  # type: ignore[misc]

    def __init__(self, adapter: Adapter, render_mode: str | None = None) -> None:
        """Compiles nothing yet.

        Raises:
            RenderError: for a render mode.
        """
        spec = adapter.spec
        if render_mode is not None:
            raise RenderError(
                f"{spec.task} cannot be rendered here: JaxMARL's own visualizers draw its states."
            )
        n = spec.n_agents
        self.team_names, self.team_paid = adapter.team, [0.0] * n
        self.observation_space = space_of(n, spec.obs_size, spec.state_size, spec.n_actions)
        self.action_space = spaces.MultiDiscrete([spec.n_actions] * n)
        self._adapter, self.names = adapter, adapter.names()
        self._key: Any = None
        self._state: State | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode; returns its first observation and an empty dictionary."""
        super().reset(seed=seed)
        if seed is not None:
            self._key = jax.random.key(seed % 2**32)
        elif self._key is None:
            self._key = jax.random.key(int(self.np_random.integers(2**31)))
        self._state, seen = _reset(self._adapter, self._next_key())
        return as_dictionary(seen), {}

    def step(
        self, action: NDArray[Any]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One step.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("Call reset before the first step.")
        actions = np.asarray(action).astype(np.int32)
        now = self._next_key()
        self._state, seen, outcome, paid = _step(self._adapter, self._state, actions, now)
        self.team_paid = np.asarray(paid).tolist()
        ends = bool(outcome.terminated), bool(outcome.truncated)
        return as_dictionary(seen), float(outcome.reward), *ends, {"battle_won": bool(outcome.won)}

    def _next_key(self) -> Any:
        self._key, now = jax.random.split(self._key)
        return now


# Compiled once for an adapter, however many environments are made of it.
@partial(jax.jit, static_argnames="adapter")
def _reset(adapter: Adapter, key: Any) -> Any:
    return adapter.reset(None, key)


@partial(jax.jit, static_argnames="adapter")
def _step(adapter: Adapter, state: State, actions: Any, key: Any) -> Any:
    return adapter.step_paid(state, actions, key)
