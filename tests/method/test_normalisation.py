"""Running statistics against numpy in float64, and what networks are shown by them."""

import itertools

import numpy as np
import pytest

from race.method.normalisation import (
    CLIP,
    Observed,
    affine_of,
    merged,
    nothing_observed,
    observed_more,
    running_of,
    scaled,
    scaling_of,
    unseen,
)
from race.replay.shown import as_shown
from race.types import DiscreteSpec, EnvSpec, Slots, Transition


def samples(count: int, *shape: int, seed: int = 0) -> np.ndarray:
    """Of means and spreads that differ by many orders."""
    rng = np.random.default_rng(seed)
    mean = 10.0 ** rng.integers(-3, 6, shape)
    return (mean + mean * rng.normal(size=(count, *shape)) / 30).astype(np.float32)


@pytest.mark.parametrize("cuts", [(), (1,), (40,), (3, 3, 70), tuple(range(1, 100))])
def test_statistics_in_any_parts_are_those_of_all(cuts: tuple[int, ...]) -> None:
    x = samples(100, 2, 3)
    total = unseen(2, 3)
    for first, end in itertools.pairwise((0, *cuts, 100)):
        total = merged(total, running_of(x[first:end]))
    exact = x.astype(np.float64)
    assert float(total.number) == 100
    np.testing.assert_allclose(total.mean, exact.mean(axis=0), rtol=1e-13)
    np.testing.assert_allclose(total.squares / 100, exact.var(axis=0), rtol=1e-10)
    assert {part.dtype for part in total} == {np.dtype(np.float64)}


def test_more_rows_than_are_taken_at_once() -> None:
    x = samples(9001, 2)
    found, exact = running_of(x), x.astype(np.float64)
    assert float(found.number) == 9001
    np.testing.assert_allclose(found.mean, exact.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.squares / 9001, exact.var(axis=0), rtol=1e-9)


def test_what_is_shown_has_mean_0_and_variance_1() -> None:
    x = samples(500, 2, 3)
    shown = np.asarray(scaled(x, affine_of(running_of(x))), np.float64)
    np.testing.assert_allclose(shown.mean(axis=0), 0, atol=1e-4)
    exact = x.astype(np.float64)
    wide = exact.std(axis=0) > 1e-2  # spreads near the floor of 1e-4 are shown smaller
    assert wide.sum() > 2
    np.testing.assert_allclose(shown.std(axis=0)[wide], 1, atol=1e-3)
    expected = (exact - exact.mean(axis=0)) / np.sqrt(exact.var(axis=0) + 1e-8)
    np.testing.assert_allclose(shown, expected, atol=3e-5)


def test_what_never_changes_is_0_and_what_is_far_off_is_clipped() -> None:
    x = np.tile(np.array([0.1, 1e4, 0.0], np.float32), (77, 1))
    x[:, 2] = np.arange(77) % 2
    affine = affine_of(running_of(x))
    assert not np.asarray(scaled(x, affine))[:, :2].any()
    strange = np.array([0.2, -1e15, 30.0], np.float32)
    np.testing.assert_array_equal(scaled(strange, affine), [CLIP, -CLIP, CLIP])


def test_after_nothing_things_are_shown_as_they_are() -> None:
    spec = DiscreteSpec("tiny", 2, 3, 4, 2, 5)
    before = nothing_observed(spec)
    x = np.linspace(-3, 3, 6, dtype=np.float16).reshape(2, 3)
    scaling = scaling_of(before)
    assert scaling.obs is not None
    shown = np.asarray(scaled(x, scaling.obs))
    assert shown.dtype == np.float32
    np.testing.assert_array_equal(shown, x.astype(np.float32))
    now = Observed(running_of(samples(9, 2, 3)), running_of(samples(9, 4)))
    after = observed_more(before, now)
    assert after.obs is not None
    assert now.obs is not None
    np.testing.assert_array_equal(after.obs.mean, now.obs.mean)
    np.testing.assert_array_equal(after.state.squares, now.state.squares)
    same = observed_more(after, before)
    np.testing.assert_array_equal(same.state.mean, after.state.mean)
    assert float(same.state.number) == 9


def test_minibatches_are_shown_as_the_teams_are(tiny_spec: EnvSpec) -> None:
    seen = Observed(None, running_of(samples(50, 4)))
    scaling = scaling_of(seen)
    states, later = samples(6, 4, seed=1), samples(6, 4, seed=2)
    rest = np.arange(6, dtype=np.float32)
    batch = Transition(states, np.zeros((6, 3), np.float32), rest, rest, later)
    shown = as_shown(batch, scaling)
    for name, raw in (("state", states), ("next_state", later)):
        np.testing.assert_array_equal(getattr(shown, name), scaled(raw, scaling.state))
    assert shown.reward is batch.reward
    assert as_shown(batch, None) is batch


def test_empty_slots_stay_zeros() -> None:
    seen = Observed(running_of(samples(50, 2, 3)), running_of(samples(50, 4)))
    scaling = scaling_of(seen)
    assert scaling.obs is not None
    real = np.array([[True], [True], [False]])
    obs, state = samples(3, 1, 2, 3, seed=3), samples(3, 1, 4, seed=4)
    obs[2] = state[2] = 0
    others = {name: np.zeros((3, 1)) for name in Slots._fields}
    batch = Slots(**{**others, "obs": obs, "state": state, "real": real})
    shown = as_shown(batch, scaling)
    np.testing.assert_array_equal(shown.obs[:2], scaled(obs[:2], scaling.obs))
    np.testing.assert_array_equal(shown.state[:2], scaled(state[:2], scaling.state))
    assert not np.asarray(shown.obs[2]).any()
    assert not np.asarray(shown.state[2]).any()
