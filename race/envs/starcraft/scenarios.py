"""SMACv2's scenarios, whose teams and places are drawn anew for each battle."""

import re
from typing import Any, Final, NamedTuple


class Race(NamedTuple):
    """What SMACv2 draws a team from: units, their probabilities, and which are no whole team."""

    units: tuple[str, ...]
    weights: tuple[float, ...]
    never_alone: tuple[str, ...]


# Facts of SMACv2's configs/sc2_gen_*.yaml, which pip leaves out when it installs the package.
RACES: Final = {
    "protoss": Race(("stalker", "zealot", "colossus"), (0.45, 0.45, 0.1), ()),
    "terran": Race(("marine", "marauder", "medivac"), (0.45, 0.45, 0.1), ("medivac",)),
    "zerg": Race(("zergling", "baneling", "hydralisk"), (0.45, 0.1, 0.45), ("baneling",)),
}
NAMES: Final = tuple(
    f"{race}_{sizes}"
    for sizes in ("5_vs_5", "10_vs_10", "10_vs_11", "20_vs_20", "20_vs_23")
    for race in RACES
)
"""Those of the SMACv2 paper; other numbers work too."""

_FORM: Final = re.compile(r"(\w+)_([1-9]\d?)_vs_([1-9]\d?)")


def settings(name: str) -> dict[str, Any] | None:
    """The arguments of SMACv2's environment that are not its defaults; None if there is no such.

    Args:
        name: ``<race>_<n>_vs_<m>``: n units of ours against m.
    """
    found = _FORM.fullmatch(name)
    if found is None or found[1] not in RACES:
        return None
    race = RACES[found[1]]
    team = {
        "dist_type": "weighted_teams",
        "unit_types": list(race.units),
        "weights": list(race.weights),
        "observe": True,
    }
    if race.never_alone:
        team["exception_unit_types"] = list(race.never_alone)
    return {
        "map_name": f"10gen_{found[1]}",
        "use_unit_ranges": True,
        "obs_own_pos": True,
        "capability_config": {
            "n_units": int(found[2]),
            "n_enemies": int(found[3]),
            "team_gen": team,
            "start_positions": {
                "dist_type": "surrounded_and_reflect",
                "p": 0.5,
                "map_x": 32,
                "map_y": 32,
            },
        },
    }
