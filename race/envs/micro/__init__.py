"""Micromanagement battles behind SMAC's interface, as pure functions of JAX.

    battle = make("2s3z")
    env_state, observation = battle.reset(key)
    env_state, timestep = battle.step(env_state, actions, key)

Both functions can be jitted, vmapped and scanned. All 23 maps of SMAC come with the
package; a map of your own is a text file (`race.envs.micro.maps`).
"""

from dataclasses import dataclass
from typing import Any, final

import jax
from jaxtyping import Array, Int, Key

from race.envs.micro import smac
from race.envs.micro.maps import MapSpec, load_map, map_names
from race.envs.micro.scenario import Scenario, Shape, build
from race.envs.micro.smac import Info, Timestep
from race.envs.micro.state import EnvState
from race.types import Observation

__all__ = [
    "Battle",
    "EnvState",
    "Info",
    "MapSpec",
    "Observation",
    "Shape",
    "Timestep",
    "load_map",
    "make",
    "map_names",
]

_reset = jax.jit(smac.reset)
_step = jax.jit(smac.step)


@final
@dataclass(frozen=True)
class Battle:
    """A map, ready to be played.

    Attributes:
        spec: the map as its file describes it.
        scenario: the map as arrays, a pytree. To compile a program once for several maps of equal
            shape, pass it as an argument to `race.envs.micro.smac.reset` and ``step``.
    """

    spec: MapSpec
    scenario: Scenario

    @property
    def shape(self) -> Shape:
        """Numbers of agents, enemies and actions, sizes of observations and state."""
        return self.scenario.shape

    def reset(self, key: Key[Array, ""]) -> tuple[EnvState, Observation]:
        """A new battle. Where units start is the same for every key, as in SMAC's maps."""
        state: tuple[EnvState, Observation] = _reset(self.scenario, key)
        return state

    def step(
        self, env_state: EnvState, actions: Int[Any, "n"], key: Key[Array, ""]
    ) -> tuple[EnvState, Timestep]:
        """Half a second of battle; see `race.envs.micro.smac.step`."""
        result: tuple[EnvState, Timestep] = _step(self.scenario, env_state, actions, key)
        return result


def make(name: str) -> Battle:
    """The battle of a map's name (`map_names`), or of a path that ends with ``.toml``.

    Raises:
        TaskError: if there is no such map, or its file is wrong.
    """
    spec = load_map(name)
    return Battle(spec, build(spec))
