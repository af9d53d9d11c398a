"""What the teams of a population are judged by: the mean return of episodes of theirs."""

from collections.abc import Sequence

from race.config.settings import Config

Returns = tuple[tuple[float, ...], ...]
"""Of each team those of some of its episodes, the oldest first."""


def averages(config: Config) -> bool:
    """Whether fitness is the mean of several returns, of some teams at least."""
    return max(config.race.fitness_episodes, config.race.fitness_generations) > 1


def known_returns(
    played: Sequence[Sequence[float]],
    ids: Sequence[int],
    ids_before: Sequence[int],
    before: Returns,
    generations: int,
) -> Returns:
    """The returns by which each team is judged.

    Those of this generation, and of as many before it as it has been the same team, by its id in
    the lineage.

    Args:
        played: undiscounted returns of this generation's episodes, equally many of each team.
        ids: of the teams.
        ids_before: of the teams of the generation before.
        before: what they were judged by; empty if nobody was.
        generations: most generations, this one included.
    """
    # Before the first judgement nobody has a past, whatever the ids.
    known = dict(zip(ids_before, before, strict=True)) if before else {}
    return tuple(
        (*known.get(team, ()), *now)[-generations * len(now) :]
        for team, now in zip(ids, played, strict=True)
    )


def means(returns: Returns) -> tuple[float, ...]:
    """Each team's fitness."""
    return tuple(sum(of_team) / len(of_team) for of_team in returns)
