"""All measurements and the choice among them."""

from collections.abc import Callable
from fnmatch import fnmatchcase

from race.bench import (
    cohorts,
    environments,
    episodes,
    evolution,
    memory,
    micro,
    startup,
    training,
    update,
)
from race.bench.measurement import Measurement, Subject
from race.errors import ConfigError


def subjects() -> list[Subject]:
    """Everything that can be measured, in the order of the table."""
    modules = (update, cohorts, evolution, episodes, training, startup, memory, environments, micro)
    return [subject for module in modules for subject in module.subjects()]


def matches(name: str, pattern: str | None) -> bool:
    """Whether a measurement is asked for: by a part of its name, or a pattern with * and ?."""
    return pattern is None or pattern in name or fnmatchcase(name, pattern)


def chosen(every: list[Subject], pattern: str | None) -> list[Subject]:
    """The subjects with at least one measurement that is asked for.

    Without a pattern, all but those that are taken on request alone.

    Raises:
        ConfigError: if no measurement fits the pattern; the message lists all.
    """
    if pattern is None:
        return [subject for subject in every if not subject.on_request]
    found = [s for s in every if any(matches(name, pattern) for name in s.names)]
    if not found:
        names = "\n  ".join(name for subject in every for name in subject.names)
        raise ConfigError(f"Nothing to measure is called {pattern!r}. There is:\n  {names}")
    return found


def measure(
    subjects: list[Subject], pattern: str | None, begins: Callable[[Subject], None]
) -> list[Measurement]:
    """Takes the measurements asked for; ``begins`` is told of each subject first."""
    results: list[Measurement] = []
    for subject in subjects:
        begins(subject)
        results += [m for m in subject.measure() if matches(m.name, pattern)]
    return results
