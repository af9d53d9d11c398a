"""Teams that play one after the other, with the gradient steps that each owes in between."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cohort import assert_as_alone
from test_laws import POPULATION, check_resumption, check_rows, small
from whole_runs import rows, run, watch_rollouts

from race import programs
from race.config.cohort import Batching
from race.errors import ConfigError
from race.training import learning

Told = list[tuple[str, Any]]


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    """What happens, in order: who plays and what it returns, gradient steps, evolution."""
    found: Told = []
    watch_rollouts(monkeypatch, lambda *played: found.append(("play", played)))
    learned, evolved = programs.learn, programs.evolve

    def learn(*args: Any, **more: Any) -> Any:
        found.append(("learn", int(args[5])))
        return learned(*args, **more)

    def evolve(*args: Any, **more: Any) -> Any:
        found.append(("evolve", None))
        return evolved(*args, **more)

    monkeypatch.setattr(programs, "learn", learn)
    monkeypatch.setattr(programs, "evolve", evolve)
    return found


@pytest.mark.parametrize(
    ("algo", "base", "task", "race"),
    [
        ("merl", "matd3", "probe/time-limit", {"marl_episodes": 2, "evolution_from": 35}),
        pytest.param("race", "matd3", "probe/target", {}, marks=pytest.mark.slow),
        pytest.param(
            *("race", "facmac", "probe/lives", {"fitness_episodes": 2}), marks=pytest.mark.slow
        ),
    ],
)
def test_each_episode_is_learned_from_before_the_next(
    tmp_path: Path,
    told: Told,
    monkeypatch: pytest.MonkeyPatch,
    algo: str,
    base: str,
    task: str,
    race: dict[str, Any],
) -> None:
    monkeypatch.setattr(learning, "CHUNK", 7)
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 2)
    config = small(algo, base, task, learn_after="episode", **race)
    steps = 400 if task == "probe/time-limit" else 200 if config.discrete else 90
    config = dataclasses.replace(config, env_steps=steps)
    progress = run(tmp_path / "whole", config)
    generations = rows(tmp_path / "whole", "generation")
    assert sum("teams" in row for row in generations) > 1

    made, learned, returns = progress.random_steps, 0, []
    seen, remaining = [], iter(generations)
    for n, (what, value) in enumerate(told):
        if what == "play":
            one, _, played = value
            assert one.teams.count == 1
            made += played.env_steps
            returns.append(played.episode_return.item())
            seen.append(one.number)
        elif what == "learn":
            learned += value
        following = told[n + 1][0] if n + 1 < len(told) else "play"
        if following == "play" and not config.discrete:  # nothing is owed any more
            owed = made - progress.random_steps
            assert learned == owed - owed % config.policy_delay
        if following == "play" and (len(told) == n + 1 or told[n + 1][1][0].turn == 0):
            row = next(remaining)
            n_marl = config.n_marl_teams
            assert row["env_steps"] == made
            assert row["gradient_steps"] == learned
            assert row["marl/return"] == pytest.approx(np.mean(returns[-n_marl:]))
            if len(returns) > n_marl:
                assert len(returns) == config.n_teams
                times = config.race.fitness_episodes
                each = np.reshape(returns[:-n_marl], (times, POPULATION)).mean(axis=0)
                assert [team["fitness"] for team in row["teams"]] == pytest.approx(each.tolist())
            returns = []
    assert next(remaining, None) is None
    assert len(seen) == len(set(seen)) == progress.episodes  # each has chance of its own
    # The population in order, then the MARL team; whom evolution left alone plays as before.
    last = [value for what, value in told if what == "play"][-2 * config.n_teams :]
    assert [play.turn for play, _, _ in last] == [*range(config.n_teams)] * 2
    marl = [*[0] * config.n_population_teams, *[1] * config.n_marl_teams]
    assert [play.n_marl for play, _, _ in last] == marl * 2
    returned = [made.episode_return[0] for _, _, made in last[:POPULATION]]
    if config.whole_teams and len(set(returned)) > 1:
        elite = last[int(np.argmax(returned))][1]
        assert any(np.array_equal(elite, head) for _, head, _ in last[config.n_teams :])
    # Evolution follows the last turn.
    for n, (what, _) in enumerate(told):
        if what == "evolve":
            before, _, _ = told[n - 1][1]
            assert before.turn == config.n_teams - 1
            assert before.n_marl == 1
    assert [what for what, _ in told].count("evolve") == sum("teams" in r for r in generations)
    if not race:
        check_rows(tmp_path / "whole", config, progress)
    check_resumption(tmp_path, config)


@pytest.mark.slow
@pytest.mark.parametrize("batching", ["map", "vmap"])
def test_runs_of_a_cohort_take_turns_as_alone(tmp_path: Path, batching: Batching) -> None:
    config = small("merl", "matd3", "probe/terminates", learn_after="episode")
    assert_as_alone(tmp_path, config, batching, exactly=batching == "map")


@pytest.mark.parametrize(
    ("race", "why"),
    [
        ({"surrogate_probability": 0.5}, "--race.surrogate-probability above 0"),
        ({"replayed": "better"}, "--race.replayed better"),
    ],
)
def test_what_needs_all_teams_at_once_is_refused(race: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=f"--race.learn-after is .*episode.*{why}"):
        small("race", "matd3", "probe/target", learn_after="episode", **race)
