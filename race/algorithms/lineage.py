"""Lineage: where each team of a population comes from, and which operators improve teams."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from race.method.crossover import Bred

ORIGINS = (
    *("initial", "elite", "parent", "copy", "offspring", "injected"),
    *("sampled", "own", "kept"),
)
"""Where a team comes from: it was there at the start, or is the elite or second parent of the last
evolution, a copy of one of them, offspring of several teams, or the MARL team; it was drawn from a
distribution, made by an operator of the user's own, or left alone by it."""
INITIAL, ELITE, PARENT, COPY, OFFSPRING, INJECTED, SAMPLED, OWN, KEPT = range(len(ORIGINS))
OPERATORS = ("crossover", "mutation", "crossover_and_mutation")
"""What made a child: the bits of its number, less one, are crossover and mutation."""


class Lineage(NamedTuple):
    """Of each team: an id that lasts as long as the team is unchanged, and where it comes from.

    Unchanged by evolution: what heads learn beside it, where they do, does not count.
    """

    id: Int[Array, "P"]
    origin: Int[Array, "P"]  # of `ORIGINS`
    first: Int[Array, "P N"]  # id of the team of old that each agent's policy began as; -1: none
    second: Int[Array, "P N"]  # id of the team that gave it rows; the first again: none
    share: Float[Array, "P N"]  # of its rows that the second gave
    changes: Int[Array, "P N 3"]  # weights that mutation changed: strongly, anew, mildly
    operator: Int[Array, "P"]  # 1 + the index in `OPERATORS`, 0 for none
    rival: Float[Array, "P"]  # fitness of the better parent when it was chosen


class Record(NamedTuple):
    """The lineage of the teams that are there, of those that played last, and what it tells."""

    now: Lineage
    played: Lineage
    next_id: Int[Array, ""]
    children: Int[Array, "3"]  # of each operator, that have played
    better: Int[Array, "3"]  # of these, whose fitness was above their better parent's


def first_record(size: int, n_agents: int) -> Record:
    """That of teams nobody has bred yet."""
    ids = jnp.arange(size, dtype=jnp.int32)
    zeros = jnp.zeros(size, jnp.int32)
    nobody = jnp.full((size, n_agents), -1, jnp.int32)
    none = Lineage(
        id=ids,
        origin=zeros,
        first=nobody,
        second=nobody,
        share=jnp.zeros((size, n_agents)),
        changes=jnp.zeros((size, n_agents, 3), jnp.int32),
        operator=zeros,
        rival=jnp.zeros(size),
    )
    count = jnp.zeros(len(OPERATORS), jnp.int32)
    return Record(none, none, jnp.asarray(size, jnp.int32), count, count)


def played(record: Record, fitness: Float[Array, "P"]) -> Record:
    """The record once the teams have played: children are compared with their parents."""
    lineage = record.now
    of_operator = lineage.operator[None] == jnp.arange(1, 1 + len(OPERATORS))[:, None]
    better = of_operator & (fitness > lineage.rival)[None]
    return record._replace(
        played=lineage,
        children=record.children + jnp.sum(of_operator.astype(jnp.int32), axis=1),
        better=record.better + jnp.sum(better.astype(jnp.int32), axis=1),
    )


def bred(
    record: Record,
    made: Bred,
    changes: Int[Array, "P N 3"],
    elite: Int[Array, ""],
    fitness: Float[Array, "P"],
) -> Record:
    """The record of a new generation of teams.

    Args:
        record: of the old one.
        made: by crossover.
        changes: by mutation.
        elite: the elite's place.
        fitness: of the old teams.
    """
    places = jnp.arange(fitness.shape[0])
    of_one = jnp.all((made.first == made.second) & (made.first == made.first[:, :1]), axis=1)
    unmoved = of_one & (made.first[:, 0] == places)
    origin = jnp.where(unmoved, PARENT, jnp.where(of_one, COPY, OFFSPRING))
    origin = jnp.where(places == elite, ELITE, origin)
    mutated = jnp.any(changes > 0, axis=(1, 2))
    new = ~unmoved | mutated
    ids = record.next_id - 1 + jnp.cumsum(new.astype(jnp.int32))
    old, finite = record.now.id, jnp.nan_to_num(fitness)
    lineage = Lineage(
        id=jnp.where(new, ids, old),
        origin=origin.astype(jnp.int32),
        first=old[made.first],
        second=old[made.second],
        share=made.share,
        changes=changes,
        operator=(origin == OFFSPRING).astype(jnp.int32) + 2 * mutated.astype(jnp.int32),
        rival=jnp.max(jnp.maximum(finite[made.first], finite[made.second]), axis=1),
    )
    count = jnp.sum(new.astype(jnp.int32))
    return record._replace(now=lineage, next_id=record.next_id + count)


def replaced(record: Record, new: Bool[Array, "P"], origin: int) -> Record:
    """The record once some teams were replaced by others that have no parents to be told."""
    none = first_record(*record.now.first.shape).now
    ids = record.next_id - 1 + jnp.cumsum(new.astype(jnp.int32))
    lineage = none._replace(
        id=jnp.where(new, ids, record.now.id),
        origin=jnp.where(new, origin, KEPT).astype(jnp.int32),
    )
    count = jnp.sum(new.astype(jnp.int32))
    return record._replace(now=lineage, next_id=record.next_id + count)


def injected(record: Record, place: Int[Array, ""]) -> Record:
    """The record once the MARL team has taken a place."""
    stranger = {"id": record.next_id, "origin": INJECTED, "first": -1, "second": -1}
    changed = {
        name: column.at[place].set(stranger.get(name, jnp.zeros((), column.dtype)))
        for name, column in record.now._asdict().items()
    }
    return record._replace(now=Lineage(**changed), next_id=record.next_id + 1)


def rows(lineage: Lineage, fitness: tuple[float, ...]) -> list[dict[str, Any]]:
    """What a generation's row tells of each team, as plain values.

    ``parents`` are the ids of the one or two teams it was made of, or of each agent's, where they
    are not the same for all agents; ``from_second`` is the share of each agent's rows that the
    second gave; ``changes`` the numbers of each agent's weights that changed strongly, were drawn
    anew and changed mildly.
    """
    columns: Lineage = jax.device_get(lineage)
    first, second = columns.first, columns.second
    alike = np.all((first == first[:, :1]) & (second == second[:, :1]), axis=1).tolist()
    mixed = np.any(columns.share > 0, axis=1).tolist()
    mutated = np.any(columns.changes > 0, axis=(1, 2)).tolist()
    share = np.round(columns.share.astype(np.float64), 4).tolist()
    host: Any = Lineage(*(column.tolist() for column in columns))  # type: ignore[arg-type]
    found = []
    for place, value in enumerate(fitness):
        team: dict[str, Any] = {
            "id": host.id[place],
            "fitness": value,
            "origin": ORIGINS[host.origin[place]],
        }
        if host.origin[place] in (COPY, OFFSPRING):
            pairs = zip(host.first[place], host.second[place], strict=True)
            parents = [[a] if a == b else [a, b] for a, b in pairs]
            team["parents"] = parents[0] if alike[place] else parents
        if mixed[place]:
            team["from_second"] = share[place]
        if mutated[place]:
            team["changes"] = host.changes[place]
        found.append(team)
    return found
