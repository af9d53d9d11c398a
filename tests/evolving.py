"""Evolution of a whole state of an algorithm."""

from collections.abc import Callable
from typing import Any

from race.algorithms import Algorithm


def evolving(algorithm: Algorithm) -> Callable[..., Any]:
    """(state, ...) -> the state whose population has evolved; as it is if it has none."""
    evolve = algorithm.evolve
    if evolve is None:
        return lambda state, *given, **named: state
    return lambda state, *given, **named: state._replace(
        population=evolve(state.population, *given, **named)
    )
