"""Lineage of scripted generations: what is told of teams is what happened to them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.algorithms import lineage
from race.algorithms.evolutions import evolve, start
from race.algorithms.population import Population, inject_team
from race.config.hyper import Hyper, hyper_of
from race.config.settings import Config
from race.config.shape import shape_of
from race.types import EnvSpec, Team

P = 6
FITNESS = np.array([5.0, 9.0, 1.0, 7.0, 3.0, 6.0])  # from the best: 1, 3, 5, 0, 4, 2


class World:
    """A population of heads that play no task."""

    def __init__(self, spec: EnvSpec, config: Config) -> None:
        self.spec, self.shape, self.hyper = spec, shape_of(config), hyper_of(config)
        heads = jax.random.normal(jax.random.key(0), (P, spec.n_agents, 5, spec.action_size))
        heads = heads * jnp.asarray(spec.action_mask, jnp.float32)[None, :, None]
        self.start = start(Team(None, heads), spec, self.shape)
        self.marl = Team(None, jnp.full(heads.shape[1:], 0.5))
        self._evolve = jax.jit(
            lambda population, fitness, key, hyper: evolve(
                population, fitness, key, spec, self.shape, hyper
            )
        )
        self._inject = jax.jit(inject_team)

    def evolve(self, population: Population, fitness: Any, seed: int, **numbers: float) -> Any:
        hyper = self.numbers(**numbers)
        fitness = jnp.asarray(fitness, jnp.float32)
        return self._evolve(population, fitness, jax.random.key(seed), hyper)

    def inject(self, population: Population, **numbers: float) -> Any:
        return self._inject(population, self.marl, jax.random.key(0), self.numbers(**numbers))

    def numbers(self, **numbers: float) -> Hyper:
        return self.hyper._replace(**{name: np.float32(x) for name, x in numbers.items()})


@pytest.fixture(scope="module")
def world(tiny_spec: EnvSpec, tiny_config: Callable[..., Config]) -> World:
    return World(tiny_spec, tiny_config("race", "matd3", race={"population_size": P}))


def told(population: Population, which: str = "now") -> list[dict[str, Any]]:
    return lineage.rows(getattr(population.record, which), tuple(FITNESS.tolist()))


def test_teams_of_the_start_come_from_nowhere(world: World) -> None:
    for place, team in enumerate(told(world.start)):
        assert team == {"id": place, "fitness": FITNESS[place], "origin": "initial"}


def test_roles_parents_and_ids(world: World) -> None:
    before = world.start
    after = world.inject(world.evolve(before, FITNESS, 1, mutation_probability=0.0))
    teams = told(after)
    origins = {place: team["origin"] for place, team in enumerate(teams)}
    # All teams enter the tournament: the second is the parent, the third's place is the copy's.
    assert origins == {
        **{1: "elite", 3: "parent", 5: "copy"},
        **{0: "offspring", 4: "offspring", 2: "injected"},
    }
    # Who is unchanged keeps its id; all others have new ones, the injected team the newest.
    assert [team["id"] for team in teams] == [6, 1, 10, 3, 8, 9]
    assert teams[5]["parents"] == [1]
    old, new = np.asarray(before.teams.heads), np.asarray(after.teams.heads)
    for place, parents in ((0, [1, 3]), (4, [3, 1])):
        assert teams[place]["parents"] == parents
        share = np.array(teams[place]["from_second"])
        assert sorted(share) == [0, 1]
        source = np.where(share == 1, parents[1], parents[0])
        np.testing.assert_array_equal(new[place], old[source, np.arange(2)])
    assert all("changes" not in team for team in teams)


def test_mutations_are_told_by_agent_and_kind(world: World) -> None:
    numbers = {"mutation_probability": 0.5, "agent_mutation_probability": 0.3}
    shown = set()
    for seed in range(12):
        before, kept = world.start, {}
        bred = world.evolve(before, FITNESS, seed, mutation_probability=0.0)
        after = world.evolve(before, FITNESS, seed, **numbers)
        changed = np.asarray(after.teams.heads) != np.asarray(bred.teams.heads)
        for place, team in enumerate(told(after)):
            counts = np.array(team.get("changes", np.zeros((2, 3))))
            np.testing.assert_array_equal(counts.sum(axis=1), changed[place].sum(axis=(1, 2)))
            origin = team["origin"]
            assert (team["id"] < P) == (
                origin == "elite" or (origin == "parent" and not counts.any())
            )
            kept[origin] = counts.any()
            shown.add((origin, bool(counts.any())))
        assert not kept["elite"]
    assert {("parent", True), ("parent", False), ("copy", True), ("offspring", True)} <= shown


def test_ids_are_never_used_twice(world: World) -> None:
    population, owners = world.start, {}
    rng = np.random.default_rng(0)
    for seed in range(12):
        for place, team in enumerate(np.asarray(population.teams.heads)):
            # The same id is the same team, wherever and whenever it is.
            key = int(population.record.now.id[place])
            assert np.array_equal(owners.setdefault(key, team), team)
        assert len(set(population.record.now.id.tolist())) == P
        population = world.inject(world.evolve(population, rng.normal(size=P), seed))
    assert int(population.record.next_id) == max(population.record.now.id.tolist()) + 1
    assert len(owners) > 3 * P


def test_children_are_compared_with_their_better_parent(world: World) -> None:
    """Two offspring and a mutated copy or parent; the elite had 9, the parent 7."""
    crossed = world.evolve(world.start, FITNESS, 1, mutation_probability=0.0)
    assert crossed.record.children.tolist() == [0, 0, 0]  # nobody of the start is a child
    # Offspring are in places 0 and 4, and 2 before somebody is injected there.
    again = world.evolve(crossed, [9.5, 0, 8.9, 0, 100, 0], 2, mutation_probability=0.0)
    assert again.record.children.tolist() == [3, 0, 0]
    assert again.record.better.tolist() == [2, 0, 0]
    injected = world.evolve(world.inject(crossed), [9.5, 0, 99, 0, 100, 0], 2)
    assert injected.record.children.tolist() == [2, 0, 0]
    mutated = world.evolve(
        world.start, FITNESS, 1, mutation_probability=1.0, crossover_probability=0.0
    )
    # All but the elite are mutants of it or of the second: of 3 in place, of 1 elsewhere, by turns.
    fitness = np.full(P, 8.0)
    again = world.evolve(mutated, fitness, 2)
    assert again.record.children.tolist() == [0, 5, 0]
    assert again.record.better.tolist() == [0, 2, 0]
    both = world.evolve(world.start, FITNESS, 1, mutation_probability=1.0)
    again = world.evolve(both, np.full(P, 9.1), 2)
    assert again.record.children.tolist() == [0, 2, 3]
    assert again.record.better.tolist() == [0, 2, 3]


def test_what_played_is_told_and_not_what_came_after(world: World) -> None:
    one = world.inject(world.evolve(world.start, FITNESS, 1))
    two = world.evolve(one, FITNESS[::-1], 2)
    for name, column in two.record.played._asdict().items():
        np.testing.assert_array_equal(column, getattr(one.record.now, name))


def test_without_injection_nothing_is_told_of_it(world: World) -> None:
    one = world.evolve(world.start, FITNESS, 1)
    left = world.inject(one, injection_probability=0.0)
    for a, b in zip(*map(jax.tree.leaves, (left.record, one.record)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_parents_of_each_agent(tiny_spec: EnvSpec, tiny_config: Callable[..., Config]) -> None:
    """With a tournament for each agent, teams may have as many parents as agents, and more."""
    race = {"population_size": P, "selection": "agent", "tournament_size": 1}
    world = World(tiny_spec, tiny_config("race", "matd3", race=race))
    several = 0
    for seed in range(6):
        after = world.evolve(world.start, FITNESS, seed, mutation_probability=0.0)
        old, new = np.asarray(world.start.teams.heads), np.asarray(after.teams.heads)
        record = after.record.now
        source = np.where(record.share == 1, record.second, record.first)
        np.testing.assert_array_equal(new, old[source, np.arange(2)])
        np.testing.assert_array_equal(new[1], old[1])
        for team in told(after):
            several += isinstance(team.get("parents", [0])[0], list)
    assert several


def test_teams_whose_agents_come_from_different_places(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config]
) -> None:
    """Where they are dealt out: a team is told as a copy only if all of it is one team's."""
    race = {"population_size": P, "places": "agent"}
    world = World(tiny_spec, tiny_config("race", "matd3", race=race))
    old, found = np.asarray(world.start.teams.heads), set()
    for seed in range(12):
        after = world.evolve(world.start, FITNESS, seed, mutation_probability=0.0)
        new = np.asarray(after.teams.heads)
        assert int(after.worst) == 2
        for place, team in enumerate(told(after)):
            sources = [
                [was for was in range(P) if np.array_equal(new[place, i], old[was, i])]
                for i in range(2)
            ]
            (one,), (two,) = sources
            assert {one, two} <= {1, 3}
            if place in (1, 3):
                assert team["origin"] == {1: "elite", 3: "parent"}[place]
                assert (team["id"], one, two) == (place,) * 3
                continue
            assert team["id"] >= P
            assert team["origin"] == ("copy" if one == two else "offspring")
            assert team["parents"] == ([one] if one == two else [[one], [two]])
            assert "from_second" not in team
            crossed = int(after.record.now.operator[place])
            assert crossed == (one != two)
            found.add((one, two))
        entered = world.inject(after)
        np.testing.assert_array_equal(entered.teams.heads[2], world.marl.heads)
        assert told(entered)[2]["origin"] == "injected"
    assert found == {(1, 1), (1, 3), (3, 1), (3, 3)}
