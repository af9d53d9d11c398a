"""Small games with JaxMARL's interface, as its documentation has it, without JaxMARL."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


class Choice(NamedTuple):
    """As JaxMARL's ``Discrete``."""

    n: int
    shape: tuple[int, ...] = ()


class Numbers(NamedTuple):
    """As JaxMARL's ``Box``."""

    shape: tuple[int, ...]


class World(NamedTuple):
    x: Any  # [M]
    step: Any


class Climbers:
    """Two climb by their choices, which chance makes harder; a rival loses what they win.

    Agent i sees the heights of the first i + 1, as a picture of one row; ``red`` sees the step.
    Heights of 20 or more end the episode, and so does the step after ``max_steps``.
    """

    max_steps = 4

    def __init__(self, masks: bool = True, world_state: bool = True, top: int = 20) -> None:
        self.agents = ["blue_0", "blue_1", "red"]
        self._masks, self._world_state, self._top = masks, world_state, top
        self._counts = {"blue_0": 3, "blue_1": 4, "red": 2}

    def action_space(self, agent: str) -> Any:
        return Choice(self._counts[agent])

    def reset(self, key: Any) -> tuple[dict[str, Any], World]:
        world = World(jax.random.randint(key, (3,), 0, 5), jnp.zeros((), jnp.int32))
        return self.get_obs(world), world

    def get_obs(self, world: World) -> dict[str, Any]:
        shown = {"blue_0": world.x[None, :1], "blue_1": world.x[None, :2], "red": world.step}
        if self._world_state:
            shown["world_state"] = jnp.append(world.x, world.step).astype(jnp.float32)
        return shown

    def get_avail_actions(self, world: World) -> dict[str, Any]:
        """Zero is out of reach at even heights; red cannot do anything at even steps."""
        if not self._masks:
            raise NotImplementedError
        even = world.x % 2 == 0
        return {
            "blue_0": jnp.append(~even[:1], jnp.ones(2, bool)),
            "blue_1": jnp.append(~even[1:2], jnp.ones(3, bool)).astype(jnp.uint8),
            "red": jnp.full(2, world.step % 2),
        }

    def step_env(self, key: Any, world: World, actions: dict[str, Any]) -> tuple[Any, ...]:
        taken = jnp.stack([actions[agent] for agent in self.agents])
        done = world.step >= self.max_steps  # before it is counted, as in JaxMARL's
        x = world.x + taken * jax.random.randint(key, (3,), 1, 3)
        world = World(x, world.step + 1)
        won = taken.astype(jnp.float32)
        gain = {"blue_0": won[0], "blue_1": won[1] * 10, "red": -won[0] - won[1]}
        over = done | (x[:2].sum() >= self._top)
        dones = dict.fromkeys(self.agents, over) | {"__all__": over}
        return self.get_obs(world), world, gain, dones, {}

    def step(self, key: Any, world: World, actions: dict[str, Any]) -> tuple[Any, ...]:
        """As JaxMARL's: an episode that is over begins anew."""
        key, again = jax.random.split(key)
        seen, after, gain, dones, info = self.step_env(key, world, actions)
        first, fresh = self.reset(again)

        def chosen(x: Any, y: Any) -> Any:
            return jnp.where(dones["__all__"], x, y)

        after, seen = (jax.tree.map(chosen, *p) for p in ((fresh, after), (first, seen)))
        return seen, after, gain, dones, info


class Battle(NamedTuple):
    unit_alive: Any
    step: Any


class Duel:
    """Two against one: who is told to fight wins or falls, whoever it is."""

    max_steps, num_allies, num_agents = 3, 2, 3
    agents = ("ally_0", "ally_1", "enemy_0")

    def action_space(self, agent: str) -> Any:
        return Choice(3)  # nothing, fall, or hit a unit of the other side

    def reset(self, key: Any) -> tuple[dict[str, Any], Battle]:
        battle = Battle(jnp.ones(3, bool), jnp.zeros((), jnp.int32))
        return self._obs(battle), battle

    def _obs(self, battle: Battle) -> dict[str, Any]:
        return dict.fromkeys(self.agents, battle.unit_alive)

    def step_env(self, key: Any, battle: Battle, actions: dict[str, Any]) -> tuple[Any, ...]:
        taken = jnp.stack([actions[agent] for agent in self.agents])
        falls = taken == 1
        hit = jnp.stack([taken[2] == 2, taken[2] == 2, jnp.any(taken[:2] == 2)])
        alive = battle.unit_alive & ~falls & ~hit
        over = ~alive[:2].any() | ~alive[2] | (battle.step >= self.max_steps)
        battle = Battle(alive, battle.step + 1)
        paid = {agent: jnp.ones(()) for agent in self.agents}
        return self._obs(battle), battle, paid, {"__all__": over}, {}


class Continuous(Climbers):
    def action_space(self, agent: str) -> Any:
        return Numbers((2,))


def climbers() -> Climbers:
    return Climbers()
