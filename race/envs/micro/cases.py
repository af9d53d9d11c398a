"""Compares this package with literal inputs and outputs of SMAC.

    python -m race.envs.micro.cases FILE.json...

Each file holds cases of one map: units before and after each step, and what SMAC's own code made
of them. For each quantity the largest absolute difference is printed. Exit status: 0 if all are
within 1e-5, 1 if not, 2 if a file cannot be used.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from race.envs.micro import make, smac
from race.envs.micro.scenario import Scenario
from race.envs.micro.smac import View
from race.errors import RaceError, TaskError

TOLERANCE: Final = 1e-5
_FIELDS: Final = ("x", "y", "health", "shield", "energy", "cooldown")
_observe = jax.jit(smac.observe)
_judge = jax.jit(smac.judge)


def main(arguments: list[str] | None = None) -> int:
    """Runs the comparison; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m race.envs.micro.cases",
        description="Compares observations, states, masks, rewards and endings with SMAC's.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE.json", help="cases of a map")
    chosen = parser.parse_args(arguments)
    exact = usable = True
    for path in chosen.files:
        try:
            worst = compare(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RaceError) as error:
            what = f"it has no entry {error}" if isinstance(error, KeyError) else str(error)
            print(f"{path}: no usable cases: {what}", file=sys.stderr)
            usable = False
            continue
        print(path)
        for quantity, difference in worst.items():
            good = difference <= TOLERANCE
            exact &= good
            print(f"  {quantity:<20}{difference:.3g}{'' if good else '   differs'}")
    print("all within 1e-5" if exact and usable else "not all within 1e-5")
    return (0 if exact else 1) if usable else 2


def compare(table: dict[str, Any]) -> dict[str, float]:
    """The largest absolute difference of each quantity over all cases of a map.

    Truth values count as 0 and 1, and arrays of different shapes differ infinitely.

    Raises:
        TaskError: if the map is unknown, or a frame does not fit it.
        KeyError: if an entry is missing.
    """
    if not isinstance(table, dict) or not table["cases"]:
        raise TaskError("a case file is an object with a map and a list of cases")
    battle = make(table["map"])
    worst: dict[str, float] = {}

    def note(quantity: str, ours: Any, theirs: Any) -> None:
        difference = _difference(ours, theirs)
        worst[quantity] = max(worst.get(quantity, 0.0), difference)

    shape = battle.shape
    note("n_agents", shape.n_allies, table["n_agents"])
    note("n_enemies", shape.n_enemies, table["n_enemies"])
    note("n_actions", shape.n_actions, table["n_actions"])
    note("obs_size", shape.obs_size, table["obs_size"])
    note("state_size", shape.state_size, table["state_size"])
    note("episode_limit", battle.spec.episode_limit, table["episode_limit"])
    for case in table["cases"]:
        for quantity, ours, theirs in _play(battle.scenario, case):
            note(quantity, ours, theirs)
    return worst


def _play(scenario: Scenario, case: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """What the package and SMAC make of each frame: quantity, ours, theirs."""
    tags = [*case["agent_tags"], *case["enemy_tags"]]
    if len(case["agent_tags"]) != scenario.shape.n_allies or len(tags) != scenario.shape.n_units:
        raise TaskError(f"case {case['name']!r} does not have the units of the map")
    steps = int(case["episode_steps_before_first_step"])
    last = jnp.full(scenario.shape.n_allies, -1)
    before: View | None = None
    for frame in case["frames"]:
        units = _view(frame["units"], tags, before)
        if before is not None:
            steps += 1
            last = jnp.asarray(frame["actions"], jnp.int32)
            reward, terminated, info = _judge(scenario, before, units, jnp.asarray(steps))
            yield "reward", reward, frame["reward"]
            yield "terminated", terminated, frame["terminated"]
            for name, theirs in frame["info"].items():
                yield f"info.{name}", getattr(info, name, np.nan), theirs
            if terminated and case.get("stats_after"):
                yield from _stats(info, case["stats_after"])
        shown = _observe(scenario, units, last)
        yield "obs", shown.obs, frame["obs"]
        yield "state", shown.state, frame["state"]
        yield "avail_actions", shown.avail_actions, frame["avail"]
        before = units


def _stats(info: smac.Info, theirs: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Statistics after one battle; SMAC calls a time-out a draw."""
    ours = {
        "battles_won": info.battle_won,
        "battles_game": 1,
        "battles_draw": info.timed_out,
        "win_rate": info.battle_won,
        "timeouts": info.timed_out,
    }
    for name, value in ours.items():
        yield f"stats.{name}", value, theirs[name]


def _view(units: list[dict[str, Any]], tags: list[int], before: View | None) -> View:
    """The units of a frame in order. One that is missing is dead, where it was last seen."""
    rows: NDArray[np.float32] = (
        np.zeros((len(tags), len(_FIELDS)), np.float32)
        if before is None
        else np.stack([np.asarray(column) for column in before], axis=1)
    )
    rows[:, _FIELDS.index("health")] = 0.0
    for unit in units:
        if unit["tag"] in tags:  # others are a next battle's: the map respawns when all are dead
            rows[tags.index(unit["tag"])] = [unit[field] for field in _FIELDS]
    return View(*(jnp.asarray(column) for column in rows.T))


def _difference(ours: Any, theirs: Any) -> float:
    one, other = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    if one.shape != other.shape:
        return float("inf")
    difference = np.abs(one - other)
    return float(np.where(np.isnan(difference), np.inf, difference).max(initial=0.0))


if __name__ == "__main__":
    sys.exit(main())
