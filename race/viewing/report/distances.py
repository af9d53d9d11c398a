"""How far the teams of a population are from each other, in the checkpoints that a run kept."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from race.runs import checkpoints
from race.runs.directory import RunDirectory

MOST_CHECKPOINTS = 20
_EVOLVES = "['algorithm'].population.teams."
_MARL = "['algorithm'].policies.head.params"
_IDS = "['algorithm'].population.record.now.id"
_ELITE = "['algorithm'].population.elite"


def distances_of(path: Path) -> dict[str, Any] | None:
    """Distances between teams, of the newest checkpoints of a run; None if it has no population.

    Args:
        path: the run's directory.

    Returns:
        ``teams`` and ``matrix``: names and distances (`relative`) of the teams in the newest
        checkpoint; the MARL team is the last, where it has the form of the others. ``steps``,
        ``mean``, ``to_marl`` for each checkpoint, oldest first: mean over pairs of teams, and from
        the MARL team to the elite.

    Raises:
        CheckpointError: if a checkpoint is damaged.
    """
    found: dict[str, Any] = {"steps": [], "mean": [], "to_marl": []}
    for place in checkpoints.list_checkpoints(RunDirectory(path).checkpoints)[-MOST_CHECKPOINTS:]:
        saved = checkpoints.load(place, tables=False)
        weights = weights_of(saved.arrays)
        if weights is None:
            return None
        matrix, size = relative(weights), len(saved.arrays[_IDS])
        pairs = matrix[:size, :size][np.triu_indices(size, 1)]
        elite = int(saved.arrays[_ELITE])
        names = [
            f"team {number}" + (" (elite)" if k == elite else "")
            for k, number in enumerate(saved.arrays[_IDS].tolist())
        ]
        with_marl = len(matrix) > size
        found["steps"].append(int(saved.info["progress"]["env_steps"]))
        found["mean"].append(_short(pairs.mean()) if len(pairs) else None)
        found["to_marl"].append(_short(matrix[size, elite]) if with_marl else None)
        found["teams"] = names + ["MARL team"] * with_marl
        found["matrix"] = [[_short(value) for value in row] for row in matrix]
    return found if found["steps"] else None


def weights_of(arrays: Mapping[str, NDArray[Any]]) -> Float[NDArray[Any], "T W"] | None:
    """All that evolves of each team as one row; None where a checkpoint holds no population.

    With shared encoders these are the heads, and the MARL team's follows those of the population;
    a head that all of its agents share is that of each. Else they are whole networks.
    """
    names = sorted(name for name in arrays if name.startswith(_EVOLVES))
    if not names or _IDS not in arrays:  # of before teams had numbers, or without a population
        return None
    teams = np.concatenate([_rows(arrays[name]) for name in names], axis=1)
    heads, marl = f"{_EVOLVES}heads", arrays.get(_MARL)
    if names == [heads] and marl is not None:
        own = np.broadcast_to(marl, arrays[heads].shape[1:])
        teams = np.concatenate([teams, _rows(own[None])])
    return teams


def relative(weights: Float[NDArray[Any], "T W"]) -> Float[NDArray[Any], "T T"]:
    """Length of the difference of two teams' weights, by the root mean square of their lengths.

    0: they are equal; 1.41 (the root of 2): they have nothing to do with each other; 2: opposite.
    """
    squares = np.sum(weights**2, axis=1)
    # Of equal teams the difference itself, not that of large numbers.
    apart = np.stack([np.sum((weights - row) ** 2, axis=1) for row in weights])
    both = (squares[:, None] + squares[None, :]) / 2
    return np.sqrt(np.divide(apart, both, out=np.zeros_like(apart), where=both > 0))


def _rows(array: NDArray[Any]) -> Float[NDArray[Any], "T W"]:
    return np.asarray(array, np.float64).reshape(len(array), -1)


def _short(value: Any) -> float:
    return float(f"{float(value):.4g}")
