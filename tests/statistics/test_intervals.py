"""The interval over seeds by hand, and how often it holds the truth."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from race.statistics.intervals import bounds_of, mean_interval

DRAWS = 4000


def test_the_interval_of_three_seeds_by_hand() -> None:
    found = mean_interval([[1.0, 2.0], [2.0, 4.0], [6.0, 12.0]])
    np.testing.assert_allclose(found.mean, [3.0, 6.0])
    # s = sqrt((4 + 1 + 9) / 2) = sqrt(7); t(0.975, 2) = 4.302653; half = t s / sqrt(3).
    half = 4.302653 * math.sqrt(7.0) / math.sqrt(3.0)
    np.testing.assert_allclose(found.high - found.mean, [half, 2 * half], rtol=1e-6)
    np.testing.assert_allclose(found.mean - found.low, [half, 2 * half], rtol=1e-6)


def test_one_seed_has_no_interval_and_none_is_a_mistake() -> None:
    found = mean_interval([[4.0]])
    assert found.mean.tolist() == [4.0]
    assert np.isnan([found.low, found.high]).all()
    with pytest.raises(ValueError, match="at least one"):
        mean_interval(np.zeros((0, 3)))


def test_equal_seeds_have_an_interval_of_no_width() -> None:
    found = mean_interval([[2.0]] * 5)
    assert found.low == found.mean == found.high


def test_intervals_are_cut_to_what_a_quantity_can_be() -> None:
    assert bounds_of("win_rate") == bounds_of("injection/elite_rate") == (0.0, 1.0)
    assert bounds_of("time/rollout_fraction") == (0.0, 1.0)
    assert bounds_of("return_mean") == (-math.inf, math.inf)
    assert bounds_of("length_mean") == bounds_of("return_std") == (0.0, math.inf)
    found = mean_interval([[0.1, 0.9], [0.2, 1.0], [0.9, 1.0]], bounds_of("win_rate"))
    assert found.low[0] == 0.0
    assert found.high[1] == 1.0
    assert (found.low < found.mean).all()


Draw = Callable[[np.random.Generator, int], np.ndarray]


def gaussian(rng: np.random.Generator, seeds: int) -> np.ndarray:
    return rng.normal(3000.0, 700.0, (seeds, DRAWS))


def two_gaits(rng: np.random.Generator, seeds: int) -> np.ndarray:
    """Half of the runs end in a slow gait, half in a fast one."""
    fast = rng.random((seeds, DRAWS)) < 0.5
    return np.where(fast, 4000.0, 2000.0) + rng.normal(0.0, 300.0, (seeds, DRAWS))


def coverage(draw: Draw, truth: float, seeds: int) -> float:
    found = mean_interval(draw(np.random.default_rng(seeds), seeds))
    return float(np.mean((found.low <= truth) & (truth <= found.high)))


@pytest.mark.parametrize("seeds", [3, 5])
def test_the_interval_holds_the_truth_as_often_as_it_says(seeds: int) -> None:
    assert 0.94 <= coverage(gaussian, 3000.0, seeds) <= 0.96


def test_five_seeds_hold_it_even_if_runs_fall_into_two_kinds_but_three_do_not() -> None:
    """Three runs of one kind look certain: a quarter of the time. So three are shown as lines."""
    assert coverage(two_gaits, 3000.0, 5) >= 0.91
    assert coverage(two_gaits, 3000.0, 3) < 0.85


@pytest.mark.parametrize(("seeds", "most"), [(3, 0.80), (5, 0.88)])
def test_the_percentile_bootstrap_would_not(seeds: int, most: float) -> None:
    """Why it is not what is used."""
    rng = np.random.default_rng(0)
    held = 0
    for sample in gaussian(rng, seeds).T[:1000]:
        means = sample[rng.integers(0, seeds, (500, seeds))].mean(axis=1)
        low, high = np.quantile(means, [0.025, 0.975])
        held += low <= 3000.0 <= high
    assert held / 1000 < most
