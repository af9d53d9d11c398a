"""Which agents of an environment of somebody else's are the team (``--env.agents``)."""

import fnmatch
from typing import Any

from race.errors import TaskError


def picked(agents: list[Any], patterns: str) -> list[Any]:
    """The agents whose names match one of several patterns, in their own order.

    Args:
        agents: names of all, texts or numbers.
        patterns: with commas in between.

    Raises:
        TaskError: if a pattern fits none of them.
    """
    wanted = [part.strip() for part in patterns.split(",")]
    for pattern in wanted:
        if not any(fnmatch.fnmatchcase(str(agent), pattern) for agent in agents):
            raise TaskError(
                f"--env.agents {pattern} is none of its agents, which are "
                f"{', '.join(map(str, agents))}."
            )
    return [a for a in agents if any(fnmatch.fnmatchcase(str(a), one) for one in wanted)]
