"""Numbers over tasks from their definitions, by hand, and where they have no interval."""

import math

import numpy as np
import pytest
from scipy import stats

from race.statistics.intervals import mean_estimate
from race.statistics.separation import difference, seeds_needed, surely_apart
from race.statistics.stratified import (
    bootstrap_interval,
    interquartile_mean,
    optimality_gap,
    probability_of_improvement,
    relative_gain,
    share_above,
)

# Methods by tasks by seeds, as in rliable: {name: [seeds, tasks]}.
RNG = np.random.default_rng(3)
X = [RNG.normal(0.8, 0.2, 5), RNG.normal(0.5, 0.3, 5), np.array([1.0, 1.0, 0.5, 0.2, 1.5])]
Y = [RNG.normal(0.6, 0.2, 5), RNG.normal(0.5, 0.3, 5), np.array([1.0, 0.5, 0.5, 0.2, 0.1])]


def test_interquartile_mean_drops_a_quarter_at_each_end() -> None:
    values = np.array([9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -70.0])
    assert interquartile_mean([values[:3], values[3:]]) == pytest.approx((2 + 3 + 4 + 5) / 4)
    # Fewer than four runs are not cut; five lose one at each end.
    assert interquartile_mean([np.array([1.0, 2.0, 9.0])]) == 4.0
    assert interquartile_mean([np.array([0.0, 1.0, 2.0, 6.0, 99.0])]) == 3.0


def test_optimality_gap_counts_what_is_missing_and_nothing_else() -> None:
    assert optimality_gap([np.array([0.5, 2.0]), np.array([1.0, 0.0])]) == pytest.approx(1.5 / 4)
    assert optimality_gap([np.array([0.5])], goal=3.0) == 2.5


def test_relative_gain_is_the_mean_over_tasks() -> None:
    method = [np.array([110.0, 130.0]), np.array([2.0])]
    base = [np.array([100.0]), np.array([1.0, 3.0])]
    assert relative_gain([*method, *base]) == pytest.approx((0.2 + 0.0) / 2)


def test_probability_of_improvement_is_the_mann_whitney_statistic() -> None:
    found = probability_of_improvement(X, Y)
    wanted = []
    for x, y in zip(X, Y, strict=True):
        wanted.append(stats.mannwhitneyu(x, y, alternative="greater").statistic / (5 * 5))
    assert found.value == pytest.approx(np.mean(wanted))
    assert found.low < found.value < found.high
    other = probability_of_improvement(Y, X)
    np.testing.assert_allclose(
        [other.value, other.low, other.high], [1 - found.value, 1 - found.high, 1 - found.low]
    )


def test_runs_that_all_beat_the_others_prove_no_certainty() -> None:
    sure = probability_of_improvement([np.arange(5.0) + 10], [np.arange(5.0)])
    assert (sure.value, sure.high) == (1.0, 1.0)
    assert 0.4 < sure.low < 0.8  # a bootstrap would say 1
    (top,) = share_above([np.ones(5)], np.array([0.5]))
    # Clopper and Pearson by hand: 0.025^(1 / 5).
    assert (top.value, top.high) == (1.0, 1.0)
    assert top.low == pytest.approx(0.025 ** (1 / 5))


def test_newcombe_by_hand() -> None:
    """At the edges of the interval, distance and width are equal."""
    n, m, width = 5, 3, float(stats.t.ppf(0.975, 6))
    found = probability_of_improvement(
        [np.array([1.0, 2.0, 3.0, 4.0, 5.0])], [np.array([0.5, 2.5, 4.5])]
    )
    assert found.value == pytest.approx((5 + 3 + 1) / 15)
    for edge in (found.low, found.high):
        middle = (n + m) / 2 - 1
        spread = 1 + middle * (1 - edge) / (2 - edge) + middle * edge / (1 + edge)
        variance = edge * (1 - edge) / (n * m) * spread
        assert abs(found.value - edge) == pytest.approx(width * math.sqrt(variance))


def test_the_profile_is_the_mean_of_shares() -> None:
    points = share_above([np.array([0.0, 1.0]), np.array([2.0] * 4)], np.array([0.5, 3.0]))
    assert [point.value for point in points] == [0.75, 0.0]
    # Two tasks with 2 and 4 seeds vary like 4 / (1/2 + 1/4) runs.
    runs = 4 / 0.75
    assert points[1].high == pytest.approx(1 - 0.025 ** (1 / runs))
    assert points[1].low == 0.0


def test_of_one_task_and_a_mean_the_bootstrap_interval_is_students() -> None:
    values = RNG.normal(size=6)
    found = bootstrap_interval([values], lambda s: s[0].mean(axis=-1), draws=20_000)
    wanted = mean_estimate(values)
    np.testing.assert_allclose(found, wanted, rtol=0.03)
    again = bootstrap_interval([values], lambda s: s[0].mean(axis=-1), draws=20_000)
    assert found == again


def test_of_two_tasks_and_a_difference_it_is_welchs() -> None:
    found = bootstrap_interval(
        [X[0], Y[1]], lambda s: s[0].mean(axis=-1) - s[1].mean(axis=-1), draws=20_000
    )
    np.testing.assert_allclose(found, difference(X[0], Y[1]), rtol=0.05, atol=0.01)


def test_intervals_stay_within_bounds_and_equal_seeds_have_none_of_any_width() -> None:
    gap = bootstrap_interval([np.array([0.9, 1.0, 1.1])], optimality_gap, (0.0, math.inf))
    assert gap.low == 0.0
    assert bootstrap_interval([np.ones(3)], interquartile_mean) == (1.0, 1.0, 1.0)


def test_one_seed_has_a_value_but_no_interval() -> None:
    for found in (
        bootstrap_interval([np.ones(1), np.arange(3.0)], interquartile_mean),
        probability_of_improvement([np.ones(1)], [np.zeros(3)]),
        difference(np.ones(1), np.zeros(3)),
    ):
        assert found.value == 1.0
        assert np.isnan([found.low, found.high]).all()
    assert seeds_needed(np.ones(1), np.zeros(3)) is None


def test_nothing_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="at least one seed"):
        bootstrap_interval([np.zeros(0)], interquartile_mean)
    with pytest.raises(ValueError, match="at least one task"):
        probability_of_improvement([], [])
    with pytest.raises(ValueError, match="at least one task"):
        share_above([], np.zeros(1))
    with pytest.raises(ValueError, match="at least one seed"):
        difference(np.zeros(0), np.zeros(2))


def test_seeds_needed_as_in_textbooks() -> None:
    """Cohen (1988): with d = 0.8 and power 0.8, 26 a group; with d = 0.5, 64."""
    for d, seeds in ((0.8, 26), (0.5, 64)):
        sample = np.array([-1.0, 1.0]) / math.sqrt(2)  # of variance 1
        assert seeds_needed(sample + d, sample) == seeds
    assert seeds_needed(np.array([0.0, 1.0]), np.array([1.0, 0.0])) is None
    assert seeds_needed(np.array([1e-6, 1.0]), np.array([1.0, 0.0])) is None
    assert seeds_needed(np.ones(2), np.zeros(2)) == 2
    assert seeds_needed(np.array([1e6, 1e6 + 1]), np.array([0.0, 1.0])) == 2


def test_seeds_needed_are_those_with_which_the_difference_is_found() -> None:
    rng = np.random.default_rng(0)
    method, base = np.array([1.0, 3.0, 2.0]), np.array([0.0, 1.0, 2.0])
    n = seeds_needed(method, base)
    assert n is not None
    draws = (rng.normal(2, 1, (2000, n)), rng.normal(1, 1, (2000, n)))
    found = stats.ttest_ind(*draws, axis=1, equal_var=False).pvalue < 0.05
    assert 0.78 < found.mean() < 0.86


@pytest.mark.slow
def test_numbers_are_those_of_rliable() -> None:
    metrics = pytest.importorskip("rliable.metrics")
    scores = np.stack(X, axis=1), np.stack(Y, axis=1)  # [seeds, tasks]
    assert interquartile_mean(X) == pytest.approx(metrics.aggregate_iqm(scores[0]))
    assert optimality_gap(X) == pytest.approx(metrics.aggregate_optimality_gap(scores[0]))
    assert probability_of_improvement(X, Y).value == pytest.approx(
        metrics.probability_of_improvement(*scores)
    )
    library = pytest.importorskip("rliable.library")
    taus = np.linspace(-0.5, 1.5, 21)
    profile = [library.run_score_deviation(scores[0], tau) for tau in taus]
    np.testing.assert_allclose([p.value for p in share_above(X, taus)], profile)


def test_four_seeds_of_each_can_tell_for_sure() -> None:
    """By hand: 2 / 70 for four and four, 2 / 56 for five and three, 2 / 20 for three and three."""
    assert [surely_apart(*n) for n in ((4, 4), (5, 3), (3, 3), (2, 2), (1, 9))] == [
        *(True, True, False, False, False)
    ]
