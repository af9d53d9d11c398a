"""What evolution did in a run, from the lineage in its rows."""

from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple, final

KINDS = (
    *("initial", "unchanged", "crossover", "mutation", "crossover and mutation"),
    *("injected", "sampled", "own operator"),
)
"""How a team came about; ``unchanged`` are elites, parents and copies that nothing was done to."""
MOST_GENERATIONS = 120
MOST_ANCESTORS = 250


class Born(NamedTuple):
    """A team when it first played."""

    generation: int
    fitness: float
    kind: int  # of `KINDS`
    parents: tuple[int, ...]  # ids


@final
class Story:
    """All teams of a run that ever played. How each came about is looked up when it is asked for.

    Attributes:
        rows: those that tell of teams; archives keep none.
        ids: of the teams, in the order in which they first played.
    """

    def __init__(self, rows: Sequence[dict[str, Any]]) -> None:
        self.rows = [row for row in rows if isinstance(row.get("teams"), list) and row["teams"]]
        self._first: dict[int, tuple[int, int]] = {}  # row and place where it first is
        for number, row in enumerate(self.rows):
            for place, team in enumerate(row["teams"]):
                if team["id"] not in self._first:
                    self._first[team["id"]] = number, place
        self.ids: Collection[int] = self._first.keys()

    def born(self, this: int) -> Born:
        """How a team came about.

        A parent that mutation changed keeps its place, so that the team there before is its parent.
        """
        number, place = self._first[this]
        row, before = self.rows[number], self.rows[number - 1]["teams"] if number else []
        team = row["teams"][place]
        parents = set(_flat(team.get("parents", [])))
        if not parents and team["origin"] in ("parent", "elite") and place < len(before):
            parents = {before[place]["id"]}
        fitness = team.get("fitness")
        return Born(
            int(row.get("generation", 0)),
            float("nan") if fitness is None else float(fitness),
            kind_of(team),
            tuple(sorted(parents)),
        )


def kind_of(team: dict[str, Any]) -> int:
    """Which of `KINDS` a team of a row is."""
    origin, mutated = team["origin"], "changes" in team
    if origin == "offspring":
        return KINDS.index("crossover and mutation" if mutated else "crossover")
    named = {"initial": "initial", "injected": "injected", "sampled": "sampled"}
    if origin == "own":
        return KINDS.index("own operator")
    return KINDS.index(named.get(origin, "mutation" if mutated else "unchanged"))


def fitness_of_teams(story: Story) -> dict[str, list[Any]]:
    """Fitness of every team of some generations, evenly chosen, and how each team came about.

    Returns:
        ``generation`` ``[G]``, ``fitness`` and ``kind`` ``[G][P]``: a team that lives on keeps the
        kind of its birth.
    """
    step = max(1, -(-len(story.rows) // MOST_GENERATIONS))
    kept = story.rows[::-1][::step][::-1]  # the last one is among them
    return {
        "generation": [row.get("generation", 0) for row in kept],
        "fitness": [[team.get("fitness") for team in row["teams"]] for row in kept],
        "kind": [[story.born(team["id"]).kind for team in row["teams"]] for row in kept],
    }


def ancestry(story: Story) -> dict[str, list[Any]]:
    """The teams of the last generation and all that they come from, youngest first.

    Returns:
        ``id``, ``generation`` of birth, ``fitness`` when first measured, ``kind`` and ``parents``
        (ids) of at most `MOST_ANCESTORS` teams; ``cut``: whether there are more.
    """
    names = ("id", "generation", "fitness", "kind", "parents", "cut")
    out: dict[str, list[Any]] = {name: [] for name in names}
    if not story.rows:
        return out
    todo = {team["id"]: story.born(team["id"]) for team in story.rows[-1]["teams"]}
    seen = set(todo)
    while todo and len(out["id"]) < MOST_ANCESTORS:
        this = max(todo, key=lambda team: todo[team].generation)
        birth = todo.pop(this)
        for name, value in zip(names, (this, *birth), strict=False):
            out[name].append(list(value) if isinstance(value, tuple) else value)
        fresh = [p for p in birth.parents if p in story.ids and p not in seen]
        seen.update(fresh)
        todo |= {parent: story.born(parent) for parent in fresh}
    out["cut"] = [bool(todo)]
    return out


def winners(story: Story) -> list[int]:
    """How many teams of each of `KINDS` were the fittest of a generation, each team once."""
    counts = [0] * len(KINDS)
    best = {max(row["teams"], key=_fitness)["id"] for row in story.rows}
    for team in best:
        counts[story.born(team).kind] += 1
    return counts


def _fitness(team: dict[str, Any]) -> float:
    value = team.get("fitness")
    return float("-inf") if value is None else float(value)


def _flat(parents: Iterable[Any]) -> list[int]:
    return [p for entry in parents for p in (_flat(entry) if isinstance(entry, list) else [entry])]
