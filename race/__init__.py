"""RACE: multi-agent reinforcement learning coupled with an evolving population of teams.

From Python: `race.train`, `race.load`, `race.evaluate`, `race.render`, `race.export`
(`race.api`).
"""

import importlib
from typing import Any

__version__ = "0.2.0"

ALGORITHM_VERSION = 2
"""Raised whenever equal settings and seeds begin to give other numbers than before."""

# They import JAX, which takes seconds: each is imported when it is asked for. Type checkers read
# ``__init__.pyi``.
_WHERE = {
    **dict.fromkeys(("Rows", "Run", "Team", "load"), "race.api.run"),
    **dict.fromkeys(("evaluate", "export", "render", "train"), "race.api.commands"),
}


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        value = getattr(importlib.import_module(_WHERE[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_WHERE})
