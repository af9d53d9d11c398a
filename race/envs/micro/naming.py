"""What the entries of SMAC's observations and states are called, in the order of `smac`."""

from race.envs.micro.maps import MapSpec, load_map
from race.envs.micro.units import UNIT_TYPES

Names = tuple[str, ...]


def names(map_name: str) -> tuple[Names, Names, tuple[Names, ...], tuple[Names, ...]]:
    """Agents, state, and of each agent what it observes and what it chooses from.

    Args:
        map_name: of a map, or the path of its file.

    Raises:
        TaskError: if there is no such map.
    """
    spec = load_map(map_name)
    agents = tuple(f"{number}: {start.unit}" for number, start in enumerate(spec.allies))
    enemies = [f"enemy {number} ({start.unit})" for number, start in enumerate(spec.enemies)]
    return (
        agents,
        _state(spec, enemies),
        (_observation(spec, enemies),) * len(agents),
        tuple(_choices(spec, enemies, UNIT_TYPES[start.unit].heals) for start in spec.allies),
    )


def _observation(spec: MapSpec, enemies: list[str]) -> Names:
    """The same for every agent: the others are counted without oneself."""
    ally, enemy = _features(spec, allies=True), _features(spec, allies=False)
    near = ("distance", "dx", "dy")
    others = [f"other agent {number}" for number in range(len(spec.allies) - 1)]
    return (
        *(f"can go {way}" for way in ("north", "south", "east", "west")),
        *(f"{one}: {what}" for one in enemies for what in ("available as target", *near, *enemy)),
        *(f"{one}: {what}" for one in others for what in ("in sight", *near, *ally)),
        *(f"own {what}" for what in ally),
    )


def _state(spec: MapSpec, enemies: list[str]) -> Names:
    ally, enemy = _features(spec, allies=True), _features(spec, allies=False)
    found = []
    for number, start in enumerate(spec.allies):
        charge = "energy" if UNIT_TYPES[start.unit].heals else "cooldown"
        parts = (ally[0], charge, "x", "y", *ally[1:])
        found += [f"agent {number} ({start.unit}): {part}" for part in parts]
    found += [f"{one}: {part}" for one in enemies for part in (enemy[0], "x", "y", *enemy[1:])]
    for number, start in enumerate(spec.allies):
        choices = _choices(spec, enemies, UNIT_TYPES[start.unit].heals)
        found += [f"agent {number} ({start.unit}): last did: {choice}" for choice in choices]
    return tuple(found)


def _choices(spec: MapSpec, enemies: list[str], heals: bool) -> Names:
    fixed = ("nothing (dead)", "stop", "north", "south", "east", "west")
    if not heals:
        return (*fixed, *(f"attack {enemy}" for enemy in enemies))
    patients = [f"heal agent {n} ({start.unit})" for n, start in enumerate(spec.allies)]
    return (*fixed, *patients, *["never available"] * (len(enemies) - len(patients)))


def _features(spec: MapSpec, *, allies: bool) -> Names:
    side = spec.allies if allies else spec.enemies
    columns = spec.ally_type_columns if allies else spec.enemy_type_columns
    shielded = any(UNIT_TYPES[start.unit].shield for start in side)
    return ("health", *["shield"] * shielded, *(f"is {unit}" for unit in columns))
