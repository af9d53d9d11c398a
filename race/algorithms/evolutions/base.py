"""The interface of an evolution."""

from collections.abc import Callable
from typing import Any, NamedTuple

from race.algorithms.population import Population


class Evolution(NamedTuple):
    """Pure functions over a population, whatever of its teams evolves."""

    init: Callable[..., Any]
    """teams -> what it remembers besides the teams."""
    step: Callable[..., Population]
    """(population, fitness [P], key, spec, shape, hyper) -> the next generation."""
