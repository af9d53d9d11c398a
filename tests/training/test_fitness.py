"""What a population is judged by: returns of several episodes and generations."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_cohort import assert_as_alone
from test_laws import POPULATION, check_resumption, check_rows, small
from whole_runs import rows, run, watch_rollouts

from race.algorithms.base import Teams
from race.config.cohort import Batching
from race.errors import ConfigError
from race.runs import checkpoints
from race.training import learning
from race.training.fitness import known_returns, means

# --- which returns count ----------------------------------------------------------------------


def test_returns_of_teams_that_stay_what_they_are() -> None:
    """Three teams over three generations; the second changes, the third then takes its turn."""
    first = known_returns([[1.0], [2.0], [3.0]], [0, 1, 2], [0, 1, 2], (), 2)
    assert first == ((1.0,), (2.0,), (3.0,))
    second = known_returns([[10.0], [20.0], [30.0]], [0, 7, 2], [0, 1, 2], first, 2)
    assert second == ((1.0, 10.0), (20.0,), (3.0, 30.0))
    assert means(second) == (5.5, 20.0, 16.5)
    # No more than two generations; a team is known by its id, wherever it is.
    third = known_returns([[4.0], [5.0], [6.0]], [7, 0, 9], [0, 7, 2], second, 2)
    assert third == ((20.0, 4.0), (10.0, 5.0), (6.0,))


def test_several_episodes_of_each_generation_count_alike() -> None:
    before = known_returns([[1.0, 2.0], [3.0, 4.0]], [0, 1], [0, 1], (), 2)
    now = known_returns([[5.0, 6.0], [7.0, 8.0]], [0, 2], [0, 1], before, 2)
    assert now == ((1.0, 2.0, 5.0, 6.0), (7.0, 8.0))
    assert means(now) == (3.5, 7.5)
    later = known_returns([[0.0, 0.0], [0.0, 0.0]], [0, 3], [0, 2], now, 2)
    assert later == ((5.0, 6.0, 0.0, 0.0), (0.0, 0.0))


@given(
    script=st.lists(
        st.lists(st.tuples(st.booleans(), st.floats(-1e6, 1e6)), min_size=4, max_size=4),
        min_size=1,
        max_size=7,
    ),
    generations=st.integers(1, 4),
)
@settings(deadline=None)
def test_fitness_is_the_mean_since_a_team_changed(
    script: list[list[tuple[bool, float]]], generations: int
) -> None:
    """Against the whole story of each place, kept beside."""
    stories: list[list[float]] = [[] for _ in range(4)]
    ids, following, found = list(range(4)), 4, ()
    for played in script:
        before = list(ids)
        for place, (changes, value) in enumerate(played):
            if changes and stories[place]:
                stories[place], ids[place], following = [], following, following + 1
            stories[place].append(value)
        found = known_returns([[value] for _, value in played], ids, before, found, generations)
        expected = [np.mean(story[-generations:]) for story in stories]
        np.testing.assert_allclose(means(found), expected, rtol=1e-12, atol=1e-9)
        if generations == 1:
            assert means(found) == tuple(value for _, value in played)


# --- whole runs -------------------------------------------------------------------------------


@pytest.fixture
def returned(monkeypatch: pytest.MonkeyPatch) -> list[list[float]]:
    """What the episodes of each generation come to, of all teams that play."""
    monkeypatch.setattr(learning, "CHUNK", 7)
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 2)
    found: list[list[float]] = []
    watch_rollouts(monkeypatch, lambda _, __, made: found.append(made.episode_return.tolist()))
    return found


GENERATIONS = [
    ("race", "matd3", "probe/target", {}),
    ("ea", "matd3", "probe/target", {"fitness_episodes": 2}),
    pytest.param("merl", "facmac", "probe/lives", {}, marks=pytest.mark.slow),
    pytest.param("race", "facmac", "probe/lives", {"fitness_episodes": 3}, marks=pytest.mark.slow),
    pytest.param("race", "matd3", "probe/target", {"evolution_from": 20}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("algo", "base", "task", "race"), GENERATIONS)
def test_a_team_that_did_not_change_is_judged_by_several_generations(
    tmp_path: Path,
    returned: list[list[float]],
    algo: str,
    base: str,
    task: str,
    race: dict[str, Any],
) -> None:
    most, episodes = 3, race.get("fitness_episodes", 1)
    config = small(algo, base, task, fitness_generations=most, **race)
    steps = 300 if config.discrete else 90  # an episode has several there, and one here
    config = dataclasses.replace(config, env_steps=steps * episodes)
    progress = run(tmp_path / "whole", config)
    generations = [row for row in rows(tmp_path / "whole", "generation") if "teams" in row]
    played = [found for found in returned if len(found) == config.n_teams]
    assert len(played) == len(generations) > 4
    known: dict[int, list[float]] = {}
    lengths = set()
    for row, found in zip(generations, played, strict=True):
        # All play once, then all again.
        now = np.reshape(found[: POPULATION * episodes], (episodes, POPULATION)).T
        for team, mine in zip(row["teams"], now.tolist(), strict=True):
            expected = [*known.get(team["id"], []), *mine][-most * episodes :]
            assert team["returns"] == expected
            assert team["fitness"] == pytest.approx(np.mean(expected), rel=1e-12)
            lengths.add(len(expected) // episodes)
        known = {team["id"]: team["returns"] for team in row["teams"]}
        fitness = [team["fitness"] for team in row["teams"]]
        assert row["population/fitness_mean"] == pytest.approx(np.mean(fitness))
    # The run that begins to evolve late is too short for anybody to live through three.
    assert lengths == ({1, 2} if "evolution_from" in race else {1, 2, 3})
    assert progress.returns == tuple(tuple(team["returns"]) for team in generations[-1]["teams"])
    # Who lives on as the elite, and is the champion, is the fittest by these means.
    for row, following in itertools.pairwise(generations):
        fittest = max(row["teams"], key=lambda team: np.float32(team["fitness"]))
        (elite,) = (team for team in following["teams"] if team["origin"] == "elite")
        assert elite["id"] == fittest["id"]
    if "evolution_from" not in race:
        check_rows(tmp_path / "whole", config, progress)
    check_resumption(tmp_path, config)


def test_means_may_name_another_elite_than_the_last_episode(
    tmp_path: Path, returned: list[list[float]]
) -> None:
    """Or the setting would change nothing."""
    run(tmp_path, small("ea", "matd3", "probe/target", fitness_generations=4))
    generations = rows(tmp_path, "generation")
    others = 0
    for row in generations:
        newest = [team["returns"][-1] for team in row["teams"]]
        others += int(np.argmax(newest)) != int(np.argmax([t["fitness"] for t in row["teams"]]))
    assert others


@pytest.mark.parametrize(
    ("algo", "base", "task", "steps"),
    [
        ("ea", "matd3", "probe/time-limit", 10),
        pytest.param("race", "matd3", "probe/time-limit", 10, marks=pytest.mark.slow),
        pytest.param("merl", "facmac", "probe/climb", 1, marks=pytest.mark.slow),
    ],
)
def test_all_episodes_of_a_team_count_and_are_stored(
    tmp_path: Path, returned: list[list[float]], algo: str, base: str, task: str, steps: int
) -> None:
    config = small(algo, base, task, fitness_episodes=3)
    config = dataclasses.replace(config, env_steps=60 * steps)
    progress = run(tmp_path, config)
    before = progress.random_steps
    episodes = 3 * POPULATION + config.has_marl
    for row, found in zip(rows(tmp_path, "generation"), returned, strict=True):
        assert len(found) == episodes == config.n_teams
        assert row["env_steps"] - before == episodes * steps
        before = row["env_steps"]
        assert all(len(team["returns"]) == 3 for team in row["teams"])
    assert progress.episodes == episodes * progress.generation
    newest = checkpoints.newest(tmp_path / "checkpoints")
    assert newest is not None
    stored = progress.episodes if config.discrete else progress.env_steps
    assert checkpoints.load(newest).rows["replay"].inserted == stored * config.has_marl
    if not config.discrete:
        assert progress.gradient_steps == (progress.env_steps - progress.random_steps) * (
            config.has_marl
        )


def test_a_team_plays_unlike_episodes(tmp_path: Path) -> None:
    run(tmp_path, small("ea", "matd3", "probe/target", fitness_episodes=2))
    both = [team["returns"] for row in rows(tmp_path, "generation") for team in row["teams"]]
    assert all(first != second for first, second in both)


@pytest.mark.parametrize("own", [False, True])
def test_teams_are_there_as_often_as_they_play(own: bool) -> None:
    encoder = np.arange(3.0)[:, None] * np.ones((3, 2)) if own else np.ones(2)
    teams = Teams(encoder, jnp.arange(3.0)[:, None, None, None] * jnp.ones((3, 1, 2, 1)), own)
    assert teams.again(1, 1) is teams.again(1, 0) is teams
    cases = {(1, 3): [0, 1, 2, 2, 2], (2, 1): [0, 1, 0, 1, 2], (2, 0): [0, 1, 2, 0, 1, 2]}
    for (population, marl), expected in cases.items():
        found = teams.again(population, marl)
        assert found.heads[:, 0, 0, 0].tolist() == expected
        assert found.own_encoders == own
        if own:
            assert found.encoder[:, 1].tolist() == expected
        else:
            assert found.encoder is encoder
    alone = teams.at(slice(2, None))  # the MARL team before anything evolves
    assert alone.again(4, 2).heads[:, 0, 0, 0].tolist() == [2, 2]


def test_one_episode_of_one_generation_is_told_as_ever(tmp_path: Path) -> None:
    progress = run(tmp_path, small("ea", "matd3", "probe/target"))
    assert progress.returns == ()
    assert all("returns" not in t for row in rows(tmp_path, "generation") for t in row["teams"])


@pytest.mark.parametrize(
    ("algo", "task"),
    [
        ("ea", "probe/target"),
        pytest.param("race", "probe/target", marks=pytest.mark.slow),
        pytest.param("merl", "probe/lives", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("batching", ["map", "vmap"])
def test_runs_of_a_cohort_are_judged_as_alone(
    tmp_path: Path, returned: list[list[float]], algo: str, task: str, batching: Batching
) -> None:
    base = "facmac" if task == "probe/lives" else "matd3"
    config = small(algo, base, task, fitness_episodes=2, fitness_generations=2)
    assert_as_alone(tmp_path, config, batching, exactly=batching == "map" or algo == "ea")


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("race", "told"),
    [
        ({"fitness_generations": 0}, "--race.fitness-generations is 0"),
        ({"fitness_episodes": 0}, "--race.fitness-episodes is 0"),
        ({"fitness_episodes": 4000}, "--race.fitness-episodes is 4000.* over all teams"),
        ({"fitness_episodes": 2, "surrogate_probability": 0.5}, "--race.surrogate-probability"),
        ({"fitness_generations": 2, "head_learning_rate": 0.1}, "--race.head-learning-rate"),
        ({"fitness_generations": 2, "surrogate_probability": 0.5}, "--race.surrogate-probability"),
    ],
)
def test_what_cannot_work_is_refused(race: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        small("race", "matd3", "probe/target", **race)
