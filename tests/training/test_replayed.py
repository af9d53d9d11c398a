"""What of a generation goes into the buffer, and what of it is the MARL team's, over whole runs."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from test_laws import POPULATION, check_resumption, small
from whole_runs import rows, run

from race.config.settings import Config
from race.replay.buffer import init_replay
from race.rollouts import discrete, transitions
from race.rollouts.base import Play, keepers
from race.rollouts.episodes import empty_episode
from race.runs import checkpoints
from race.training import generation, learning
from race.training.run_state import Progress
from race.types import DiscreteSpec, Rollout, Transition

LIVES = DiscreteSpec("d", n_agents=2, obs_size=3, state_size=4, n_actions=5, episode_limit=6)


class Count:
    """Of teams no more is asked."""

    def __init__(self, count: int) -> None:
        self.count = count


def of_teams(config: Config, count: int, n_marl: int) -> Play:
    return Play(config, Count(count), n_marl, 0, 0, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("returns", "n_marl", "kept"),
    [
        ([3.0, 1.0, 2.0, 5.0, 4.0, -9.0], 1, [1, 0, 0, 1, 1, 1]),
        ([3.0, 1.0, 2.0, 5.0, 4.0, 2.0], 0, [1, 0, 0, 1, 1, 0]),  # the median is 2.5
        ([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0], 2, [1, 1, 1, 0, 0, 1, 1]),
        ([1.0, 1.0, 1.0], 1, [1, 1, 1]),
        ([7.0], 1, [1]),  # the MARL team plays alone
    ],
)
def test_of_the_population_the_better_half_is_kept(
    returns: list[float], n_marl: int, kept: list[int]
) -> None:
    config = small("race", "matd3", "probe/terminates", replayed="better")
    found = keepers(np.array(returns), of_teams(config, len(returns), n_marl))
    assert found.tolist() == [bool(k) for k in kept]
    everyone = small("race", "matd3", "probe/terminates")
    assert keepers(np.array(returns), of_teams(everyone, len(returns), n_marl)).all()


RETURNS = np.array([1.0, 4.0, 2.0, 3.0, 0.0, 0.0])
"""Of four episodes of the population and two of the MARL team; the first and third are left out."""


def test_episodes_of_a_generation_are_stored_with_whose_they_are() -> None:
    """Episode n has n + 1 steps; the buffer has wrapped round after the second generation."""
    config = small("race", "facmac", "probe/lives", own_share=0.5, replayed="better")
    play, replay = of_teams(config, 6, 2), init_replay(empty_episode(LIVES, "float32"), 6, True)
    episodes = empty_episode(LIVES, "float32", 6)._replace(length=np.arange(6, dtype=np.int32) + 1)
    for lengths, own in (
        ([2, 4, 5, 6, 0, 0], [0, 0, 1, 1, 0, 0]),
        ([5, 6, 5, 6, 2, 4], [1, 1, 1, 1, 0, 0]),
    ):
        replay = discrete._with_episodes(replay, episodes, keepers(RETURNS, play), play)
        assert replay.own is not None
        assert replay.data.length.tolist() == lengths
        assert replay.own.astype(int).tolist() == own


def test_steps_of_a_generation_are_stored_with_whose_they_are() -> None:
    """Step n is paid n; teams end their episodes at unequal times."""
    config = small("merl", "matd3", "probe/target", own_share=0.5, replayed="better")
    play, team = of_teams(config, 6, 2), np.array([0, 1, 2, 3, 4, 5, 1, 2, 4, 5, 4])
    numbers = np.arange(len(team), dtype=np.float32)
    wide = np.stack([numbers] * 3, axis=1)
    steps = Transition(wide, wide, numbers, 0 * numbers, wide)
    item = Transition(*(column[0] for column in steps))
    played = Rollout(steps, RETURNS, np.ones(6, int), team, np.zeros(6, int))
    replay = transitions._with_steps(
        init_replay(item, 12, True), played, keepers(RETURNS, play), play
    )
    assert replay.own is not None
    stored = [1, 3, 4, 5, 6, 8, 9, 10]
    assert replay.data.reward[:8].tolist() == stored
    assert replay.own[:8].tolist() == [team[step] >= 4 for step in stored]


@pytest.mark.parametrize(
    ("algo", "base", "task"),
    [
        ("merl", "matd3", "probe/target"),
        pytest.param("race", "facmac", "probe/lives", marks=pytest.mark.slow),
    ],
)
def test_what_is_replayed_over_a_whole_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algo: str, base: str, task: str
) -> None:
    monkeypatch.setattr(learning, "CHUNK", 7)
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 2)
    config = small(algo, base, task, own_share=0.5, replayed="better")
    config = dataclasses.replace(config, env_steps=130)
    progress = run(tmp_path / "whole", config)
    newest = checkpoints.newest(tmp_path / "whole" / "checkpoints")
    assert newest is not None
    replay = checkpoints.load(newest).rows["replay"]
    made = rows(tmp_path / "whole", "generation")
    better = sum(
        np.sum(fitness >= np.median(fitness))
        for row in made
        for fitness in [np.array([team["fitness"] for team in row["teams"]])]
    )
    assert progress.stored == better + len(made)
    assert progress.stored < progress.episodes == (POPULATION + 1) * len(made)
    own = replay.columns["own"][: replay.size]
    if config.discrete:
        assert replay.inserted == progress.stored
        assert own.sum() == len(made)
    else:
        assert progress.gradient_steps == progress.env_steps - progress.random_steps
        assert not own[: progress.random_steps].any()
        # Every probe episode has a step at least; none of the MARL team's is lost.
        assert len(made) <= own.sum() < replay.inserted - progress.random_steps
    check_resumption(tmp_path, config)


def test_episodes_are_learned_from_when_a_minibatch_of_them_is_stored() -> None:
    config = small("race", "facmac", "probe/lives", replayed="better")
    progress = Progress(episodes=6, stored=2)
    assert generation.owed(config, progress) == 0
    assert generation.owed(config, progress.but(stored=3)) == 4
