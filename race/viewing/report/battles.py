"""A battle as plain numbers, for the page to draw and step through."""

import base64
import gzip
import json
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from race.envs.micro import Battle, colors
from race.envs.micro.battle import LOOPS_PER_STEP
from race.envs.micro.canvas import Window
from race.envs.micro.ground import reachable
from race.envs.micro.maps import MapSpec
from race.envs.micro.recording import Recording
from race.envs.micro.render import used
from race.envs.micro.sprites import Color
from race.envs.micro.state import NOBODY, Units
from race.envs.micro.units import CLIFF, UNIT_TYPES
from race.envs.micro.watching import Watch

_PER_CELL = 100
_NARROWEST = 2
"""How many times as long as wide a window is at most."""


def as_numbers(played: Battle, recording: Recording) -> dict[str, Any]:
    """A battle, step by step.

    Args:
        played: the map.
        recording: of a battle on it.

    Returns:
        What stays: ``map``, ``limit`` (steps), ``agents`` (how many units are), ``verdict``,
        ``window`` (left, bottom, right, top, in cells), ``ground`` (a text for each row of cells of
        the window, the northern one first: floor ``.``, cliff ``^``, where nobody can come
        ``#``), and for each of ``U`` units ``names``, ``labels``, ``colours``, ``radii`` (cells).
        What changes, for each of the moments after 0, 1, ... steps: ``x`` and ``y`` in hundredths
        of a cell, ``health`` and ``shield`` in percent, rounded up (0: dead, or none left; shield
        None where no unit has one), ``targets``: whom each unit struck or healed in the step
        before, -1 for nobody; ``returns``: the sum of rewards.
    """
    spec = played.spec
    units = [start.unit for start in (*spec.allies, *spec.enemies)]
    types = [UNIT_TYPES[name] for name in units]
    n_allies = played.shape.n_allies
    window = _window(spec, recording.units)
    full = np.array([kind.health for kind in types])
    shield = np.array([kind.shield for kind in types])
    at = {name: getattr(recording.units, name)[::LOOPS_PER_STEP] for name in Units._fields}
    return {
        "map": spec.name,
        "limit": spec.episode_limit,
        "agents": n_allies,
        "verdict": recording.verdict,
        "window": [round(float(edge), 2) for edge in window],
        "ground": _ground(spec, window),
        "names": units,
        "labels": [t.letter + (str(k) if k < n_allies else "") for k, t in enumerate(types)],
        "colours": [_hex(colors.of_type(name, k < n_allies)) for k, name in enumerate(units)],
        "radii": [kind.radius for kind in types],
        "x": np.rint(at["x"] * _PER_CELL).astype(int).tolist(),
        "y": np.rint(at["y"] * _PER_CELL).astype(int).tolist(),
        "health": _percent(at["health"], full),
        "shield": _percent(at["shield"], shield) if shield.any() else None,
        "targets": _targets(played, recording),
        "returns": [0.0, *(round(float(value), 3) for value in recording.returns)],
    }


def packed(replay: dict[str, Any]) -> str:
    """Numbers as compressed text, a fifth of their size."""
    text = json.dumps(replay, separators=(",", ":"), allow_nan=False)
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()


def _targets(played: Battle, recording: Recording) -> list[list[int]]:
    """Whom each unit struck or healed in the step before each moment."""
    watch = Watch(jax.tree.map(np.asarray, played.scenario))
    found, healed = [], np.full(len(recording.units.x[0]), NOBODY)
    for loop in range(len(recording.units.x)):
        watch.see(Units(*(leaf[loop] for leaf in recording.units)))
        moment = watch.moment
        healed = np.where(moment.heals, moment.units.target, healed)
        if loop % LOOPS_PER_STEP == 0:
            struck = moment.since_strike < LOOPS_PER_STEP
            found.append(np.where(struck, moment.units.struck, healed).tolist())
            healed = np.full_like(healed, NOBODY)
    return found


def _percent(values: NDArray[Any], full: NDArray[Any]) -> list[Any]:
    """Rounded up: only the dead have nothing."""
    share = 100 * values / np.maximum(full, 1e-9)
    return np.where(full > 0, np.ceil(np.clip(share, 0, 100) - 1e-6), 0).astype(int).tolist()


def _window(spec: MapSpec, units: Units) -> Window:
    """Every place that a living unit comes to, and no narrow strip, as far as the map is wide."""
    left, bottom, right, top = used(spec, units)
    width, height = spec.cells.shape
    left, right = _widened(left, right, (top - bottom) / _NARROWEST, width)
    bottom, top = _widened(bottom, top, (right - left) / _NARROWEST, height)
    return Window(left, bottom, right, top)


def _widened(low: float, high: float, least: float, limit: int) -> tuple[float, float]:
    more = max(least - (high - low), 0.0) / 2
    return max(low - more, 0.0), min(high + more, float(limit))


def _ground(spec: MapSpec, window: Window) -> list[str]:
    floor = np.where(spec.cells == CLIFF, "^", np.where(reachable(spec), ".", "#"))
    left, bottom = int(window.left), int(window.bottom)
    right, top = int(np.ceil(window.right)), int(np.ceil(window.top))
    return ["".join(row) for row in floor[left:right, bottom:top].T[::-1]]


def _hex(color: Color) -> str:
    return "#" + "".join(f"{part:02x}" for part in color)
