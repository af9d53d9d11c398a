"""Episodes of tasks with discrete actions: the same on the host and on the device."""

import dataclasses
from collections.abc import Iterator
from functools import cache, partial
from typing import Any, ClassVar, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from frequencies import assert_frequency

from race.algorithms.base import Teams
from race.config.presets import resolve
from race.config.settings import Config, FacmacConfig, RaceConfig
from race.config.shape import shape_of
from race.envs import make_discrete_task
from race.envs.discrete_probe.rules import CLIMB_PAYOFFS
from race.errors import DivergenceError, TaskError
from race.learners.facmac import logits, new_encoder
from race.method.exploration import greedy
from race.method.normalisation import Observed, Running, scaling_of
from race.networks.recurrent import embed_episodes
from race.replay.buffer import Replay
from race.rollouts import device, discrete
from race.rollouts.base import Generation, Play, Trial
from race.rollouts.choosing import Exploration
from race.rollouts.discrete import EpisodeRollouts
from race.rollouts.episodes import Part, Played, empty_episode, seen_in
from race.rollouts.host_episodes import HostEnvs
from race.rollouts.pool import EnvPool
from race.types import DeviceEnv, DiscreteSpec, DiscreteTask, Observation, Outcome

BATTLE_STEPS = 5


def config_of(task: str, n_population: int = 4, **facmac: Any) -> Config:
    settings = {"hidden_size": 6, "batch_size": 2, "replay_precision": "float32", **facmac}
    return resolve(
        Config(
            task,
            env_steps=200,
            facmac=FacmacConfig(**settings),
            race=RaceConfig(population_size=n_population, elite_copy=False),
        ),
        discrete=True,
    )


@cache
def task_of(name: str) -> DiscreteTask:
    task = COUNTDOWN if name == "countdown" else make_discrete_task(name)
    if name.startswith("micro/"):
        task = task._replace(spec=dataclasses.replace(task.spec, episode_limit=BATTLE_STEPS))
    return task


def teams_of(spec: DiscreteSpec, count: int, seed: int = 0) -> Teams:
    """Teams that differ, and whose agents do."""
    encoder_key, head_key = jax.random.split(jax.random.key(seed))
    encoder = new_encoder(encoder_key, spec, shape_of(config_of(spec.task)))
    shape = (count, spec.n_agents, 7, spec.n_actions)
    return Teams(encoder, 3.0 * jax.random.normal(head_key, shape))


def exploring(share: float, *teams: bool, seed: int = 0) -> Exploration:
    shares = jnp.full(len(teams), share, jnp.float32)
    return Exploration(jnp.array(teams), shares, jax.random.key(seed))


def play(
    task: DiscreteTask,
    teams: Teams,
    seeds: Any,
    how: Exploration | None = None,
    precision: str = "float32",
    on_device: bool = True,
) -> Played:
    """One episode per team, as numpy arrays."""
    seeds = np.asarray(seeds, np.uint32)
    if on_device:
        assert task.device is not None
        parts = [Part(teams, seeds, how)]
        (played,) = device.play(task.device(), parts, task.spec, precision)
        return jax.tree.map(np.asarray, played)
    with HostEnvs(EnvPool(task, len(seeds), processes=False)) as envs:
        return envs.play(teams, seeds, how, precision)


def generation_of(
    rollouts: EpisodeRollouts,
    config: Config,
    teams: Teams,
    generation: int = 0,
    env_steps: int = 0,
    replay: Replay | None = None,
    n_marl: int = 1,
) -> tuple[Replay, Generation]:
    """What one run's generation brings; its divergence is raised."""
    replay = rollouts.empty_replay(config) if replay is None else replay
    (result,) = rollouts.play([Play(config, teams, n_marl, generation, env_steps, replay)])
    if isinstance(result, DivergenceError):
        raise result
    return result


def assert_same(one: Any, other: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b, strict=True)


# A task whose episodes end and are cut, and that shows rubbish after the end.


class CountState(NamedTuple):
    """Of ``countdown``."""

    length: Any
    steps: Any


def draw_length(key: Any) -> Any:
    return jax.random.randint(key, (), 1, 7, jnp.int32)


def count_reset(bonus: Any, key: Any) -> tuple[CountState, Observation]:
    state = CountState(draw_length(key), jnp.zeros((), jnp.int32))
    return state, _count_look(state)


def count_step(
    bonus: Any, state: CountState, actions: Any, key: Any
) -> tuple[CountState, Observation, Outcome]:
    """Pays a bonus and the step's number; even lengths end themselves and odd ones are cut."""
    state = state._replace(steps=state.steps + 1)
    over, even = state.steps >= state.length, state.length % 2 == 0
    after = state.steps > state.length
    reward = jnp.where(after, jnp.nan, bonus + state.steps.astype(jnp.float32))
    outcome = Outcome(reward, over & even, over & ~even, after)
    return state, _count_look(state), outcome


def _count_look(state: CountState) -> Observation:
    numbers = jnp.stack([state.length, state.steps]).astype(jnp.float32)
    shown = jnp.where(state.steps > state.length, jnp.nan, numbers)
    return Observation(jnp.stack([shown, shown + 10.0]), shown, jnp.ones((2, 3), bool))


class Countdown(gymnasium.Env[Any, Any]):
    """``countdown`` on the host; remembers what was made, and can fail."""

    made: ClassVar[list["Countdown"]] = []

    def __init__(self, failure: str = "") -> None:
        self.failure, self.closed = failure, False
        self.made.append(self)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        if self.failure == "reset":
            raise OSError("no game here")
        self.length = int(draw_length(jax.random.split(jax.random.key(seed))[1]))
        self.steps = 0
        return self._look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.steps < self.length, "nobody may step an episode that is over"
        self.steps += 1
        if self.failure == "step" and self.steps == 2:
            raise OSError("the game is gone")
        over, even = self.steps == self.length, self.length % 2 == 0
        reward = float("nan") if self.failure == "reward" else 0.5 + self.steps
        info: Any = None if self.failure == "info" else {}
        return self._look(), reward, over and even, over and not even, info

    def close(self) -> None:
        self.closed = True

    def _look(self) -> dict[str, Any]:
        shown = np.array([self.length, self.steps], np.float64)
        if self.failure == "large" and self.steps == 1:
            shown[0] = 1e5
        seen = {
            "obs": np.stack([shown, shown + 10]),
            "state": shown[:1] if self.failure == "shape" else shown,
            "avail_actions": np.ones((2, 3), np.int8),
        }
        if self.failure == "idle" and self.steps == 1:
            seen["avail_actions"][1] = 0
        if self.failure == "nan":
            seen["obs"][1, 0] = np.nan
        if self.failure == "told":
            raise TaskError("What to do about it.")
        if self.failure == "key":
            del seen["state"]
        return seen


def make_countdown(render_mode: str | None, failure: str = "") -> Countdown:
    return Countdown(failure)


COUNTDOWN = DiscreteTask(
    DiscreteSpec("countdown", 2, 2, 2, 3, 7),
    make_countdown,
    lambda: DeviceEnv(np.float32(0.5), count_reset, count_step),
)


def broken(failure: str) -> DiscreteTask:
    return COUNTDOWN._replace(make=partial(make_countdown, failure=failure), device=None)


@pytest.fixture
def made() -> Iterator[list[Countdown]]:
    Countdown.made.clear()
    yield Countdown.made
    Countdown.made.clear()


@pytest.mark.parametrize(
    ("name", "precision"),
    [
        ("probe/matching", "float32"),
        ("probe/lives", "float16"),
        ("probe/memory", "float32"),
        ("countdown", "float32"),
        ("micro/3s_vs_3z", "float16"),
    ],
)
def test_host_and_device_play_the_same_episodes(name: str, precision: str) -> None:
    task = task_of(name)
    teams, how = teams_of(task.spec, 5), exploring(0.4, False, True, False, True, True)
    both = [play(task, teams, range(7, 12), how, precision, place) for place in (True, False)]
    assert_same(*both)
    episodes = both[0].episodes
    assert episodes.obs.dtype == episodes.state.dtype == precision
    assert np.isfinite(episodes.obs).all()
    # Otherwise there is little to agree on.
    assert len(np.unique(episodes.action[:, 0].reshape(5, -1), axis=0)) > 1
    if name in ("probe/lives", "countdown"):
        assert len(set(episodes.length.tolist())) > 1


@pytest.mark.parametrize("on_device", [True, False])
def test_episodes_hold_what_happened_and_nothing_after_the_end(on_device: bool) -> None:
    seeds = np.arange(24)
    lengths = [int(draw_length(jax.random.split(jax.random.key(s))[1])) for s in seeds]
    assert set(lengths) == {1, 2, 3, 4, 5, 6}
    teams = teams_of(COUNTDOWN.spec, 24)
    episodes, returns, won = play(COUNTDOWN, teams, seeds, on_device=on_device)
    np.testing.assert_array_equal(episodes.length, lengths)
    assert not won.any()
    for row, length in enumerate(lengths):
        # Moments 0 ... length; an end of its own at even lengths, a cut at odd ones.
        state = np.zeros((8, 2))
        state[: length + 1] = [(length, steps) for steps in range(length + 1)]
        np.testing.assert_array_equal(episodes.state[row], state)
        np.testing.assert_array_equal(episodes.obs[row, :, 0], state)
        np.testing.assert_array_equal(episodes.obs[row, : length + 1, 1], state[: length + 1] + 10)
        assert (episodes.obs[row, length + 1 :] == 0).all()
        assert episodes.avail_actions[row, : length + 1].all()
        assert not episodes.avail_actions[row, length + 1 :].any()
        paid = [step + 0.5 if step <= length else 0 for step in range(1, 8)]
        np.testing.assert_array_equal(episodes.reward[row], paid)
        assert returns[row] == sum(paid)
        ended = [step == length and length % 2 == 0 for step in range(1, 8)]
        np.testing.assert_array_equal(episodes.terminated[row], ended)
        assert (episodes.action[row, length:] == 0).all()
    assert episodes.action.any()


@pytest.mark.parametrize("on_device", [True, False])
def test_the_limit_of_the_task_ends_an_episode_without_terminating_it(on_device: bool) -> None:
    task = COUNTDOWN._replace(spec=dataclasses.replace(COUNTDOWN.spec, episode_limit=2))
    played = play(task, teams_of(task.spec, 24), range(24), on_device=on_device)
    whole = play(COUNTDOWN, teams_of(task.spec, 24), range(24), on_device=on_device)
    np.testing.assert_array_equal(played.episodes.length, np.minimum(whole.episodes.length, 2))
    np.testing.assert_array_equal(played.episodes.terminated, whole.episodes.terminated[:, :2])
    assert played.episodes.obs.shape[1] == 3


def test_an_episode_does_not_depend_on_its_neighbours() -> None:
    task = task_of("probe/lives")
    teams = teams_of(task.spec, 5)
    together = play(task, teams, range(5))
    for team in range(5):
        alone = Teams(teams.encoder, teams.heads[team : team + 1])
        row = jax.tree.map(lambda leaf, i=team: leaf[i : i + 1], together)
        assert_same(play(task, alone, [team]), row)


@pytest.mark.parametrize("on_device", [True, False])
@pytest.mark.parametrize("name", ["probe/memory", "probe/lives"])
def test_teams_did_what_their_networks_say_of_the_episode(name: str, on_device: bool) -> None:
    """From an empty memory, with the last action and agent i's own head."""
    task = task_of(name)
    teams = teams_of(task.spec, 5)
    rollouts = [play(task, teams, range(5), on_device=on_device) for _ in range(2)]
    assert_same(*rollouts)
    episodes = rollouts[1].episodes
    obs, taken = (np.swapaxes(column, 0, 1) for column in (episodes.obs, episodes.action))
    taken = taken.astype(np.int32)
    last = np.concatenate([np.full_like(taken[:1], -1), taken])
    first = jnp.zeros(last.shape[:2], bool).at[0].set(True)
    z = embed_episodes(teams.encoder, jnp.asarray(obs), jnp.asarray(last), first)
    for team in range(5):
        scores = logits(z[:, team], teams.heads[team])
        chosen = greedy(scores, jnp.asarray(episodes.avail_actions[team]))
        length = episodes.length[team]
        np.testing.assert_array_equal(chosen[:length], episodes.action[team, :length])


@pytest.mark.parametrize("on_device", [True, False])
def test_environments_that_are_used_again_remember_nothing(
    on_device: bool, made: list[Countdown]
) -> None:
    teams = teams_of(COUNTDOWN.spec, 5)
    if on_device:
        first, _, again = (play(COUNTDOWN, teams, seeds) for seeds in SEEDS)
    else:
        with HostEnvs(EnvPool(COUNTDOWN, 5, processes=False)) as envs:
            assert not made  # not before they are needed
            first, _, again = (envs.play(teams, s, None, "float32") for s in SEEDS)
            assert len(made) == 5
            envs.play(Teams(teams.encoder, teams.heads[:2]), SEEDS[0][:2], None, "float32")
            assert len(made) == 5
            assert not any(env.closed for env in made)
        assert all(env.closed for env in made)
    assert_same(first, again)


SEEDS = [np.arange(first, first + 5, dtype=np.uint32) for first in (0, 90, 0)]


# Exploration.


def bandit(probabilities: list[float], count: int) -> Teams:
    """Teams that choose by these probabilities whatever they see."""
    spec = task_of("probe/climb").spec
    teams = teams_of(spec, count)
    heads = jnp.zeros_like(teams.heads).at[:, :, -1].set(jnp.log(jnp.array(probabilities)))
    return Teams(teams.encoder, heads)


@pytest.mark.parametrize(
    ("share", "expected"),
    [(0.0, [0.6, 0.3, 0.1]), (1.0, [1 / 3] * 3), (0.6, [0.44, 0.32, 0.24])],
)
def test_exploring_teams_sample_and_now_and_then_are_uniform(
    share: float, expected: list[float]
) -> None:
    count = 3000
    how = exploring(share, *[True] * count)
    played = play(task_of("probe/climb"), bandit([0.6, 0.3, 0.1], count), np.arange(count), how)
    first, second = played.episodes.action[:, 0].T.astype(int)
    for actions in (first, second):
        np.testing.assert_allclose(np.bincount(actions) / count, expected, atol=0.03)
    # Agents choose, and explore, independently.
    pairs = np.bincount(3 * first + second, minlength=9).reshape(3, 3) / count
    np.testing.assert_allclose(pairs, np.outer(expected, expected), atol=0.03)


def test_teams_that_do_not_explore_choose_the_best() -> None:
    task, teams = task_of("probe/climb"), bandit([0.3, 0.3, 0.4], 9)
    for how in (None, exploring(1.0, *[False] * 9)):
        assert (play(task, teams, range(9), how).episodes.action == 2).all()


@pytest.mark.parametrize("on_device", [True, False])
def test_only_the_team_that_explores_is_changed_and_takes_what_is_available(
    on_device: bool,
) -> None:
    task = task_of("probe/lives")
    teams = teams_of(task.spec, 5)
    quiet = play(task, teams, range(5), on_device=on_device)
    changed = set()
    for seed in range(6):
        how = exploring(1.0, False, False, False, False, True, seed=seed)
        loud = play(task, teams, range(5), how, on_device=on_device)
        assert_same(*(jax.tree.map(lambda leaf: leaf[:4], played) for played in (quiet, loud)))
        episode = jax.tree.map(lambda leaf: leaf[4], loud.episodes)
        for step in range(int(episode.length)):
            taken = episode.action[step].astype(int)
            assert episode.avail_actions[step, np.arange(3), taken].all()
        changed.add(episode.action.tobytes())
    assert len(changed) > 3


def certain(config: Config, task: DiscreteTask) -> Teams:
    """All teams always choose action 1, unless they explore."""
    teams = teams_of(task.spec, config.n_teams)
    return Teams(teams.encoder, jnp.zeros_like(teams.heads).at[:, :, -1, 1].set(50.0))


@pytest.mark.parametrize("on_device", [True, False])
def test_the_marl_team_alone_explores_in_training_less_and_less(on_device: bool) -> None:
    task = task_of("probe/climb")
    shares = {"epsilon_start": 1.0, "epsilon_finish": 0.0, "epsilon_steps": 100}
    config = dataclasses.replace(config_of("probe/climb", **shares), seed=2)
    replay_of: dict[int, Any] = {}
    with EpisodeRollouts(config, task, on_device) as rollouts:
        for env_steps in (0, 50, 100, 1000):
            replay = rollouts.empty_replay(config)
            for generation in range(30):
                teams = certain(config, task)
                replay, _ = generation_of(rollouts, config, teams, generation, env_steps, replay)
            replay_of[env_steps] = replay
    shown = {}
    for env_steps, replay in replay_of.items():
        assert int(replay.inserted) == 150
        actions = np.asarray(replay.data.action[:150, 0]).reshape(30, 5, 2)
        assert (actions[:, :-1] == 1).all()
        shown[env_steps] = (actions[:, -1] != 1).mean()
    assert shown[0] == pytest.approx(2 / 3, abs=0.2)
    assert shown[50] == pytest.approx(1 / 3, abs=0.2)
    assert shown[100] == shown[1000] == 0


def sampling(config: Config) -> Config:
    """The population samples its actions."""
    race = dataclasses.replace(config.race, population_actions="sampled")
    return dataclasses.replace(config, race=race)


@pytest.mark.parametrize(("on_device", "count"), [(True, 500), (False, 60)])
def test_the_population_may_sample_its_policies_in_training_alone(
    on_device: bool, count: int
) -> None:
    """The MARL team, last, is uniform throughout."""
    task, chances = task_of("probe/climb"), [0.6, 0.3, 0.1]
    shares = {"epsilon_start": 1.0, "epsilon_finish": 1.0}
    greedily = config_of("probe/climb", count, **shares)
    config, teams = sampling(greedily), bandit(chances, count + 1)
    with EpisodeRollouts(config, task, on_device) as rollouts:

        def chosen(config: Config, generation: int, n_marl: int = 1) -> Any:
            found = generation_of(rollouts, config, teams, generation, n_marl=n_marl)
            return np.asarray(found[0].data.action[: count + 1, 0]).astype(int)

        actions, again, later = (chosen(config, g) for g in (0, 0, 1))
        usual, alone = chosen(greedily, 0), chosen(config, 0, n_marl=0)
        heads = {"marl": teams.heads[-1], "champion": teams.heads[0]}
        (scores,) = rollouts.test([Trial(teams.encoder, heads, np.arange(9))])
        assert (rollouts.episode(teams.at(np.array([0])), 3) == 0).all()
    for action, p in enumerate(chances):
        assert_frequency((actions[:-1] == action).sum(), p, 2 * count)
        both = (actions[:-1] == action).all(axis=1)
        assert_frequency(both.sum(), p * p, count)  # agents choose independently
    np.testing.assert_array_equal(actions, again)
    assert (actions != later).any()
    assert (usual[:-1] == 0).all()
    np.testing.assert_array_equal(actions[-1], usual[-1])
    np.testing.assert_array_equal(alone[:-1], actions[:-1])
    best = CLIMB_PAYOFFS[0][0]
    assert all((score.returns == best).all() for score in scores.values())


def test_sampled_actions_are_available() -> None:
    task = task_of("probe/lives")
    config = sampling(config_of("probe/lives"))
    with EpisodeRollouts(config, task) as rollouts:
        replay, _ = generation_of(rollouts, config, teams_of(task.spec, config.n_teams))
    episodes = jax.tree.map(np.asarray, replay.data)
    for team in range(config.n_teams):
        for step in range(int(episodes.length[team])):
            taken = episodes.action[team, step].astype(int)
            assert episodes.avail_actions[team, step, np.arange(3), taken].all()


# The rollouts of training and of tests.


@pytest.mark.parametrize(
    ("name", "sampled"), [("probe/lives", False), ("countdown", False), ("probe/lives", True)]
)
def test_training_is_the_same_on_host_and_device(name: str, sampled: bool) -> None:
    task = task_of(name)
    config = config_of(name, replay_capacity=13)
    config = sampling(config) if sampled else config
    teams, found = teams_of(task.spec, config.n_teams), []
    for on_device in (True, False):
        with EpisodeRollouts(config, task, on_device) as rollouts:
            replay, results = rollouts.empty_replay(config), []
            for generation in range(3):
                replay, result = generation_of(rollouts, config, teams, generation, 0, replay)
                results.append(result)
        found.append((replay, results))
    (replay, results), _ = found
    assert_same(*found)
    assert replay.capacity == 13
    assert int(replay.inserted) == 15
    lengths = np.asarray(replay.data.length)
    # The first two episodes have made room for the last two.
    assert sum(int(length) for length in lengths[5:]) == sum(
        result.env_steps for result in results[1:]
    ) - int(lengths[:2].sum())
    assert lengths[:2].min() > 0
    rewards = np.asarray(replay.data.reward).sum(axis=1)
    np.testing.assert_allclose(rewards[5:10], results[1].episode_return, rtol=1e-6)
    assert results[0].episode_return.dtype == np.float64
    # Each generation and each team has seeds of its own.
    starts = np.asarray(replay.data.state).reshape(13, -1)
    assert len(np.unique(starts, axis=0)) > 5


@pytest.mark.parametrize("on_device", [False, True])
def test_rewards_are_scaled_and_returns_are_not(on_device: bool) -> None:
    task, plain = task_of("countdown"), config_of("countdown", replay_capacity=13)
    small = dataclasses.replace(plain, env=dataclasses.replace(plain.env, reward_scale=0.25))
    teams, found = teams_of(task.spec, plain.n_teams), []
    for config in (plain, small):
        with EpisodeRollouts(config, task, on_device) as rollouts:
            replay = rollouts.empty_replay(config)
            found.append(generation_of(rollouts, config, teams, 0, 0, replay))
    (whole, told), (part, same) = found
    np.testing.assert_array_equal(told.episode_return, same.episode_return)
    assert np.abs(whole.data.reward).max() > 0
    np.testing.assert_array_equal(part.data.reward, np.float32(0.25) * whole.data.reward)
    assert_same(part.data._replace(reward=0), whole.data._replace(reward=0))


def test_teams_that_normalise_play_alike_on_host_and_device() -> None:
    task = task_of("countdown")
    spec, raw = task.spec, teams_of(task.spec, 3)
    rng = np.random.default_rng(2)

    def seen(*shape: int) -> Running:
        mean = 10 * rng.normal(size=shape)
        return Running(np.asarray(9.0), mean, 9 * rng.uniform(1, 100, shape))

    known = Observed(seen(spec.n_agents, spec.obs_size), seen(spec.state_size))
    teams = dataclasses.replace(raw, scaling=scaling_of(known))
    here, there = (play(task, teams, SEEDS[0][:3], None, on_device=on) for on in (False, True))
    assert_same(here.episodes, there.episodes)
    plain = play(task, raw, SEEDS[0][:3], None, on_device=True)
    assert (plain.episodes.action != there.episodes.action).any()
    episodes, found = there.episodes, seen_in(there.episodes)
    acted = [(t, i) for t in range(3) for i in range(int(episodes.length[t]))]
    assert found.obs is not None
    for running, column in ((found.obs, episodes.obs), (found.state, episodes.state)):
        rows = np.stack([column[place] for place in acted]).astype(np.float64)
        assert running.number == len(rows)
        np.testing.assert_allclose(running.mean, rows.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(running.squares / len(rows), rows.var(axis=0), atol=1e-12)


@pytest.mark.parametrize(("name", "on_device"), [("probe/memory", True), ("probe/lives", False)])
def test_tests_give_every_team_the_same_seeds(
    name: str, on_device: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(name)
    heads = dict(zip(("marl", "champion"), teams_of(task.spec, 2).heads, strict=True))
    encoder = teams_of(task.spec, 1).encoder
    seeds = np.array([3, 1, 4, 1, 5], np.int64)
    expected = {}
    for team, head in heads.items():
        every = Teams(encoder, jnp.repeat(head[None], 5, axis=0))
        expected[team] = play(task, every, seeds, on_device=on_device)
    with EpisodeRollouts(config_of(name), task, on_device) as rollouts:
        for size in (2, 32):  # in parts, of which the last is not full, and at once
            monkeypatch.setattr(discrete, "TESTS_AT_ONCE", size)
            (scores,) = rollouts.test([Trial(encoder, heads, seeds)])
            assert list(scores) == ["marl", "champion"]
            for team, score in scores.items():
                want = expected[team]
                np.testing.assert_array_equal(score.returns, want.episode_return)
                np.testing.assert_array_equal(score.lengths, want.episodes.length)
                assert score.mean == pytest.approx(want.episode_return.mean())
                if name == "probe/memory":
                    np.testing.assert_array_equal(score.won, want.won)
                    assert score.win_rate == pytest.approx(want.won.mean())
                else:
                    assert score.won is score.win_rate is None
        for team, head in heads.items():
            actions = rollouts.episode(Teams(encoder, head[None]), 4)
            length = expected[team].episodes.length[2]
            np.testing.assert_array_equal(actions, expected[team].episodes.action[2, :length])
    # Both answers are right now and then: otherwise nothing of this is seen.
    if name == "probe/memory":
        assert 0 < np.mean([played.episode_return for played in expected.values()]) < 1


def test_large_seeds_are_those_of_31_bits() -> None:
    task = task_of("probe/lives")
    teams = teams_of(task.spec, 1)
    with EpisodeRollouts(config_of("probe/lives"), task) as rollouts:
        scores = [
            rollouts.test([Trial(teams.encoder, {"marl": teams.heads[0]}, np.array([seed]))])[0]
            for seed in (5, 5 + 2**31)
        ]
    np.testing.assert_array_equal(*(score["marl"].returns for score in scores))


def test_the_program_is_traced_once_for_all_that_has_its_shape() -> None:
    task = task_of("countdown")
    teams = teams_of(task.spec, 5)
    count = device._play._cache_size
    device._play.clear_cache()  # of what other tests have compiled

    def run(bonus: float = 0.5, n: int = 5, seed: int = 0, how: Any = None) -> Played:
        env = DeviceEnv(np.float32(bonus), count_reset, count_step)
        some = Teams(teams.encoder, teams.heads[:n])
        seeds = np.arange(seed, seed + n, dtype=np.uint32)
        (played,) = device.play(env, [Part(some, seeds, how)], task.spec, "float32")
        return played

    first = run()
    before = count()
    run(seed=60)
    other = run(bonus=2.5)
    run()
    assert count() == before
    # It is the same program, not the same answer.
    length = np.asarray(first.episodes.length)
    np.testing.assert_allclose(other.episode_return - first.episode_return, 2.0 * length)
    run(n=3)
    run(n=3, how=exploring(0.1, False, False, True))
    assert count() == before + 2
    run(n=3, how=exploring(0.9, True, False, False, seed=4))
    assert count() == before + 2


# What goes wrong.


@pytest.mark.parametrize(
    ("failure", "told"),
    [
        ("reset", r"countdown failed in the reset .*: OSError: no game here, in .*, line \d+"),
        (
            "step",
            r"countdown failed at step 2 .*: OSError: the game is gone, in .*episodes.py, lin",
        ),
        ("info", r"countdown broke the contract at step 1 .*: step returned a tuple of 5 .*None"),
        (
            "shape",
            r"countdown broke .* in the reset .*: state has shape \(1,\), .* task says \(2,\)",
        ),
        (
            "key",
            r"a dictionary \('obs', 'avail_actions'\), but must be a dictionary of obs \[2, 2\]",
        ),
        ("idle", r"at step 1 .*: no action is available to agent 1.*Countdown.step: .*, line \d+"),
        ("told", "^What to do about it.$"),
        ("reward", "at step 1 of the episode .*: the reward is nan. That is no number"),
        ("nan", r"in the reset of the episode .*: entry \(1, 0\) of obs is nan. That is no number"),
    ],
)
def test_an_environment_that_fails_names_its_task(
    failure: str, told: str, made: list[Countdown]
) -> None:
    task, config = broken(failure), config_of("countdown")
    with EpisodeRollouts(config, task) as rollouts, pytest.raises(TaskError, match=told):
        generation_of(rollouts, config, teams_of(task.spec, 5))
    assert made
    assert all(env.closed for env in made)


def test_observations_too_large_for_the_buffer_are_refused(made: list[Countdown]) -> None:
    task = broken("large")
    for precision, fits in (("float16", False), ("float32", True)):
        config = config_of("countdown", replay_precision=precision)
        with EpisodeRollouts(config, task) as rollouts:
            teams = teams_of(task.spec, 5)
            if fits:
                assert int(generation_of(rollouts, config, teams)[0].inserted) == 5
            else:
                with pytest.raises(DivergenceError, match="replay-precision float16"):
                    generation_of(rollouts, config, teams)


@pytest.mark.parametrize(("n_actions", "dtype"), [(256, np.uint8), (257, np.uint16)])
def test_actions_are_stored_whole(n_actions: int, dtype: Any) -> None:
    spec = dataclasses.replace(COUNTDOWN.spec, n_actions=n_actions)
    episodes = empty_episode(spec, "float16", 4)
    assert episodes.action.dtype == dtype
    assert np.iinfo(dtype).max >= n_actions - 1
    assert episodes.action.shape == (4, 7, 2)
    assert episodes.obs.shape == (4, 8, 2, 2)
    assert episodes.length.shape == (4,)
