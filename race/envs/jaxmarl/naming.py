"""What the entries of SMAX are called; of JaxMARL's other environments nothing is known.

The order is that of JaxMARL's ``get_obs_unit_list``, ``get_world_state`` and
``_decode_discrete_actions``, as seen by allies.
"""

from typing import Any

MOVES = ("north", "east", "south", "west", "stop")


def names_of(
    env: Any, agents: list[Any]
) -> tuple[list[str], list[list[str]], list[list[str]]] | None:
    """Names of the entries of the state, and of each agent's observation and actions.

    Args:
        env: JaxMARL's environment.
        agents: those whose observations are wanted.

    Returns:
        None if nothing is known of the environment.
    """
    if getattr(env, "observation_type", None) != "unit_list":
        return None
    allies, enemies = ([f"{kind}_{i}" for i in range(count)] for kind, count in _sides(env))
    if not set(agents) <= set(allies):
        return None
    units, own = [*allies, *enemies], [str(name) for name in env.own_features]
    state = [f"{unit}: {feature}" for unit in units for feature in own]
    state += [f"{unit}: {fact}" for fact in ("team", "type") for unit in units]
    obs = [
        [
            *(f"{unit}: {name}" for unit in units if unit != agent for name in env.unit_features),
            *(f"own {name}" for name in own),
        ]
        for agent in agents
    ]
    actions = [*MOVES, *(f"attack {enemy}" for enemy in enemies)]
    return state, obs, [actions] * len(agents)


def _sides(env: Any) -> list[tuple[str, int]]:
    return [("ally", int(env.num_allies)), ("enemy", int(env.num_enemies))]
