"""RACE: multi-agent reinforcement learning coupled with an evolving population of teams.

From Python: `race.train`, `race.load`, `race.evaluate`, `race.render`, `race.export`
(`race.api`).
"""

import importlib
from typing import Any

__version__ = "0.2.0"

ALGORITHM_VERSION = 2
"""Raised whenever equal settings and seeds begin to give other numbers than before."""

# Their module imports JAX, which takes seconds: it is imported when one of them is asked for.
# ``__init__.pyi`` tells type checkers.
_OF_API = ("Rows", "Run", "Team", "evaluate", "export", "load", "render", "train")


def __getattr__(name: str) -> Any:
    if name in _OF_API:
        value = getattr(importlib.import_module("race.api"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_OF_API})
