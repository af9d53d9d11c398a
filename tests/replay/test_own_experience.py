"""Minibatches of which a share is the MARL team's own experience."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race import programs
from race.algorithms import algorithm_of
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, RaceConfig
from race.config.shape import shape_of
from race.programs import cohort
from race.replay.buffer import (
    Replay,
    columns,
    distinct_places,
    init_replay,
    insert,
    sample,
    sources_of,
    with_columns,
)
from race.rollouts.episodes import empty_episode
from race.rollouts.transitions import empty_transition, store
from race.types import DiscreteSpec, EnvSpec, Transition

CAPACITY = 12
SPEC = EnvSpec("t", 2, ((0,), (1,)), ((0,), (1,)), (-1.0, -1.0), (1.0, 1.0), 5)
DISCRETE = DiscreteSpec("d", n_agents=2, obs_size=3, state_size=4, n_actions=5, episode_limit=6)
_sample = jax.jit(sample, static_argnames="batch_size")
_sources_of = jax.jit(sources_of)
_distinct_places = jax.jit(distinct_places, static_argnames="batch_size")


def transitions(numbers: list[int]) -> Transition:
    n = np.asarray(numbers, np.float32)
    wide = np.stack([n, n], axis=1)
    return Transition(wide, wide, n, 0 * n, wide)


def filled(own: list[bool], capacity: int = CAPACITY) -> Replay:
    """Items 0, 1, ..., some of them the MARL team's."""
    replay = init_replay(empty_transition(SPEC), capacity, owned=True)
    for number, mine in enumerate(own):
        replay = insert(replay, transitions([number]), jnp.int32(1), jnp.array([mine]))
    return replay


def drawn(replay: Replay, share: float, batch_size: int, seed: int = 0) -> np.ndarray:
    """The numbers of the items of a minibatch."""
    key = jax.random.key(seed)
    batch = _sample(replay, batch_size, key, jnp.float32(share), _sources_of(replay))
    return np.asarray(batch.reward).astype(int)


def test_the_buffer_remembers_who_made_what_as_long_as_it_holds_it() -> None:
    replay = filled([i % 3 == 0 for i in range(CAPACITY + 5)])
    numbers = np.asarray(replay.data.reward).astype(int)
    assert sorted(numbers) == list(range(5, CAPACITY + 5))
    np.testing.assert_array_equal(replay.own, numbers % 3 == 0)
    # Unless told, it is nobody's own; rows behind the count are not written.
    before = replay
    replay = insert(replay, transitions([90, 91]), jnp.int32(1))
    assert not replay.own[int(before.inserted) % CAPACITY]
    assert int(jnp.sum(replay.own != before.own)) <= 1


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 1.0])
def test_a_share_of_each_minibatch_is_own_and_each_item_of_a_kind_is_as_likely(
    share: float,
) -> None:
    """Two own items among nine, in a buffer that is not full."""
    own, draws = {2, 5}, 6000
    replay = filled([i in own for i in range(9)])
    for seed in range(3):  # exactly that many of every one
        assert np.isin(drawn(replay, share, 8, seed), [*own]).sum() == round(8 * share)
    numbers, counts = np.unique(drawn(replay, share, draws), return_counts=True)
    assert set(numbers) == (own if share else set()) | (set(range(9)) - own if share < 1 else set())
    for number, count in zip(numbers, counts, strict=True):
        total = draws * (share if number in own else 1 - share)
        p = 1 / (2 if number in own else 7)
        assert abs(count - total * p) <= 5 * np.sqrt(total * p * (1 - p)), number


@pytest.mark.parametrize("own", [True, False])
def test_where_there_is_one_kind_alone_all_is_of_it(own: bool) -> None:
    replay = filled([own] * 4)
    assert set(drawn(replay, 0.5, 200)) == {0, 1, 2, 3}


def test_a_buffer_that_has_wrapped_draws_nothing_that_is_gone() -> None:
    replay = filled([i < 4 for i in range(CAPACITY + 3)])  # of the own ones 3 alone is left
    numbers = drawn(replay, 0.5, 400)
    assert set(numbers[numbers < 4]) == {3}
    assert set(numbers) == set(range(3, CAPACITY + 3))


def test_without_the_setting_minibatches_are_what_they_were() -> None:
    plain = init_replay(empty_transition(SPEC), CAPACITY)
    assert plain.own is None
    assert sources_of(plain) is None
    plain = store(plain, transitions(list(range(9))), np.ones(9, bool))
    assert plain.own is None
    assert set(columns(plain)) == set(Transition._fields)
    key = jax.random.key(3)
    places = jax.random.randint(key, (5,), 0, 9)
    np.testing.assert_array_equal(sample(plain, 5, key).reward, plain.data.reward[places])


def test_pieces_of_any_length_keep_whose_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "INSERT_ROWS", 4)
    replay = init_replay(empty_transition(SPEC), 20, owned=True)
    own = np.arange(11) % 4 == 1
    replay = store(store(replay, transitions([50, 51])), transitions(list(range(11))), own)
    np.testing.assert_array_equal(replay.own[:13], [False, False, *own])


@pytest.mark.parametrize(
    ("share", "n_own", "expected"),
    [
        (0.5, 4, 3),
        (0.5, 2, 2),
        (0.25, 6, 2),
        (0.3, 5, 2),
        (0.0, 8, 4),
        (1.0, 8, 6),
        (0.0, 0, 0),
        (1.0, 10, 6),
    ],
)
def test_episodes_are_drawn_without_replacement(share: float, n_own: int, expected: int) -> None:
    """Six of ten; where one kind has too few, the other fills up."""
    replay = filled([i < n_own for i in range(10)])
    for seed in range(20):
        key = jax.random.key(seed)
        places = np.asarray(_distinct_places(replay, 6, key, jnp.float32(share)))
        assert len(set(places)) == 6
        assert places.max() < 10
        assert (places < n_own).sum() == expected


def test_every_episode_of_a_kind_is_as_likely() -> None:
    replay, draws = filled([i < 4 for i in range(10)]), 2000
    counts: Any = np.zeros(10)
    keys = jax.random.split(jax.random.key(1), draws)
    for places in np.asarray(jax.vmap(lambda k: distinct_places(replay, 6, k, 0.5))(keys)):
        counts[places] += 1
    p = np.where(np.arange(10) < 4, 3 / 4, 3 / 6)
    assert (np.abs(counts - draws * p) <= 5 * np.sqrt(draws * p * (1 - p))).all()


def told(state: Any, batch: Any, *_: Any) -> Any:
    """In the place of a gradient step: how much of its minibatch is below 4."""
    return state, {"own": jnp.mean(batch.reward < 4)}, {}


@pytest.mark.parametrize("share", [0.25, 1.0])
@pytest.mark.parametrize("together", [False, True])
def test_gradient_steps_get_the_share_of_the_configuration(share: float, together: bool) -> None:
    config = resolve(Config("t", race=RaceConfig(own_share=share)), discrete=False)
    config = dataclasses.replace(config, learner=dataclasses.replace(config.learner, batch_size=8))
    algorithm = algorithm_of(config)._replace(update=told, critic_losses=("own",), policy_losses=())
    shape, hyper, steps = shape_of(config), hyper_of(config), 3
    replay = filled([i < 4 for i in range(CAPACITY)])
    key, first = jax.random.key(2), np.int32(5)
    if together:
        drawn = cohort.minibatches(replay, key, first, hyper=hyper, room=steps, shape=shape)
        assert drawn.reward.shape == (steps, 8)
        np.testing.assert_array_equal(jnp.mean(drawn.reward < 4, axis=1), share)
        return
    statics: Any = {"algorithm": algorithm, "spec": SPEC, "shape": shape, "hyper": hyper}
    zeros = programs.empty_losses(algorithm)
    begun = jnp.zeros(())
    _, sums = programs.learn(begun, zeros, replay, key, first, np.int32(steps), **statics)
    assert sums["own"] == steps * share


def test_episodes_of_gradient_steps_too() -> None:
    config = Config("t", algo="race", race=RaceConfig(own_share=0.5))
    config = resolve(config, discrete=True)
    config = dataclasses.replace(config, facmac=dataclasses.replace(config.facmac, batch_size=6))
    replay = init_replay(empty_episode(DISCRETE, "float32"), CAPACITY, owned=True)
    empty = empty_episode(DISCRETE, "float32", CAPACITY)
    episodes = empty._replace(length=np.arange(CAPACITY, dtype=np.int32) + 1)
    replay = insert(replay, episodes, jnp.int32(CAPACITY), jnp.arange(CAPACITY) < 4)
    key, shape, hyper = jax.random.key(2), shape_of(config), hyper_of(config)
    places, lengths = programs.draw(
        replay, key, np.int32(7), np.int32(2), hyper=hyper, room=2, shape=shape
    )
    np.testing.assert_array_equal(lengths, places + 1)
    np.testing.assert_array_equal(jnp.sum(places < 4, axis=1), 3)


def test_columns_go_to_disk_and_back() -> None:
    replay = filled([i % 2 == 0 for i in range(7)])
    again = with_columns(filled([]), columns(replay), int(replay.inserted))
    jax.tree.map(np.testing.assert_array_equal, again, replay)
