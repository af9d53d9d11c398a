"""What evolution did in a run, from the lineage in its rows."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

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


def generations_of(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows that tell of teams; archives keep none."""
    return [row for row in rows if isinstance(row.get("teams"), list) and row["teams"]]


def births(rows: Sequence[dict[str, Any]]) -> dict[int, Born]:
    """Every team that ever played, by its id.

    A parent that mutation changed keeps its place, so that the team there before is its parent.
    """
    found: dict[int, Born] = {}
    before: list[dict[str, Any]] = []
    for row in generations_of(rows):
        for place, team in enumerate(row["teams"]):
            if team["id"] in found:
                continue
            parents = set(_flat(team.get("parents", [])))
            if not parents and team["origin"] in ("parent", "elite") and place < len(before):
                parents = {before[place]["id"]}
            fitness = team.get("fitness")
            found[team["id"]] = Born(
                int(row.get("generation", 0)),
                float("nan") if fitness is None else float(fitness),
                kind_of(team),
                tuple(sorted(parents)),
            )
        before = row["teams"]
    return found


def kind_of(team: dict[str, Any]) -> int:
    """Which of `KINDS` a team of a row is."""
    origin, mutated = team["origin"], "changes" in team
    if origin == "offspring":
        return KINDS.index("crossover and mutation" if mutated else "crossover")
    named = {"initial": "initial", "injected": "injected", "sampled": "sampled"}
    if origin == "own":
        return KINDS.index("own operator")
    return KINDS.index(named.get(origin, "mutation" if mutated else "unchanged"))


def fitness_of_teams(rows: Sequence[dict[str, Any]]) -> dict[str, list[Any]]:
    """Fitness of every team of some generations, evenly chosen, and how each team came about.

    Returns:
        ``generation`` ``[G]``, ``fitness`` and ``kind`` ``[G][P]``: a team that lives on keeps the
        kind of its birth.
    """
    told, born = generations_of(rows), births(rows)
    step = max(1, -(-len(told) // MOST_GENERATIONS))
    kept = told[::-1][::step][::-1]  # the last one is among them
    return {
        "generation": [row.get("generation", 0) for row in kept],
        "fitness": [[team.get("fitness") for team in row["teams"]] for row in kept],
        "kind": [[born[team["id"]].kind for team in row["teams"]] for row in kept],
    }


def ancestry(rows: Sequence[dict[str, Any]]) -> dict[str, list[Any]]:
    """The teams of the last generation and all that they come from, youngest first.

    Returns:
        ``id``, ``generation`` of birth, ``fitness`` when first measured, ``kind`` and ``parents``
        (ids) of at most `MOST_ANCESTORS` teams; ``cut``: whether there are more.
    """
    told = generations_of(rows)
    names = ("id", "generation", "fitness", "kind", "parents", "cut")
    out: dict[str, list[Any]] = {name: [] for name in names}
    if not told:
        return out
    born = births(rows)
    todo = [team["id"] for team in told[-1]["teams"]]
    seen = set(todo)
    while todo and len(out["id"]) < MOST_ANCESTORS:
        todo.sort(key=lambda team: born[team].generation)
        this = todo.pop()
        birth = born[this]
        for name, value in zip(names, (this, *birth), strict=False):
            out[name].append(list(value) if isinstance(value, tuple) else value)
        fresh = [p for p in birth.parents if p in born and p not in seen]
        seen.update(fresh)
        todo += fresh
    out["cut"] = [bool(todo)]
    return out


def winners(rows: Sequence[dict[str, Any]]) -> list[int]:
    """How many teams of each of `KINDS` were the fittest of a generation, each team once."""
    born, counts = births(rows), [0] * len(KINDS)
    best = {
        max(row["teams"], key=lambda team: _or_least(team.get("fitness")))["id"]
        for row in generations_of(rows)
    }
    for team in best:
        counts[born[team].kind] += 1
    return counts


def _or_least(value: Any) -> float:
    return float("-inf") if value is None else float(value)


def _flat(parents: Iterable[Any]) -> list[int]:
    return [p for entry in parents for p in (_flat(entry) if isinstance(entry, list) else [entry])]
