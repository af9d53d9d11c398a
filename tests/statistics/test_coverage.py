"""How often each interval holds the truth at five seeds: 90% of 1,000 draws or more."""

from collections.abc import Callable

import numpy as np
import pytest

from race.statistics.intervals import Estimate, mean_estimate
from race.statistics.separation import difference
from race.statistics.stratified import (
    Statistic,
    bootstrap_interval,
    interquartile_mean,
    optimality_gap,
    probability_of_improvement,
    relative_gain,
    share_above,
)

DRAWS = 1000
SEEDS = 5
Draw = Callable[[np.random.Generator, int, int], np.ndarray]


def gaussian(rng: np.random.Generator, seeds: int, task: int) -> np.ndarray:
    return rng.normal(0.6 + 0.05 * task, 0.15, seeds)


def two_gaits(rng: np.random.Generator, seeds: int, task: int) -> np.ndarray:
    """Half of the runs end in a slow gait, half in a fast one."""
    fast = rng.random(seeds) < 0.5
    return np.where(fast, 1.0, 0.5) + rng.normal(0.0, 0.07, seeds)


def skewed(rng: np.random.Generator, seeds: int, task: int) -> np.ndarray:
    """Most runs do well, some fall behind; with a shape of 1.5 a mean of one task has 0.90."""
    return 1 - rng.gamma(3.0, 0.1, seeds)


def often(draw: Draw, tasks: int, times: int, interval: Callable[..., Estimate]) -> float:
    """The share of draws that hold what a great many seeds give."""
    rng = np.random.default_rng(tasks)
    held = 0
    # The first `tasks` samples are the method's, the others the base's, a little worse.
    sizes = [(task, 0.0 if half == 0 else 0.1) for half in range(2) for task in range(tasks)]
    many = [draw(rng, 100_000, task) - worse for task, worse in sizes]
    truth = interval(many, None)
    for number in range(times):
        found = interval([draw(rng, SEEDS, task) - worse for task, worse in sizes], number)
        held += found.low <= truth.value <= found.high
    return held / times


def of_statistic(statistic: Statistic, both: bool) -> Callable[..., Estimate]:
    def interval(strata: list[np.ndarray], number: int | None) -> Estimate:
        chosen = strata if both else strata[: len(strata) // 2]
        if number is None:
            return Estimate(float(statistic([s[None] for s in chosen])[0]), 0.0, 0.0)
        return bootstrap_interval(chosen, statistic, draws=300, seed=number)

    return interval


def improvement(strata: list[np.ndarray], number: int | None) -> Estimate:
    half = len(strata) // 2
    if number is None:  # pairs of all would be too many
        shares = [np.mean(x > y) for x, y in zip(strata[:half], strata[half:], strict=True)]
        return Estimate(float(np.mean(shares)), 0.0, 0.0)
    return probability_of_improvement(strata[:half], strata[half:])


def profile(strata: list[np.ndarray], number: int | None) -> Estimate:
    return share_above(strata[: len(strata) // 2], np.array([0.9]))[0]


def mean(strata: list[np.ndarray], number: int | None) -> Estimate:
    return mean_estimate(strata[0])


def welch(strata: list[np.ndarray], number: int | None) -> Estimate:
    return difference(strata[0], strata[-1])


INTERVALS = {
    "mean": mean,
    "difference": welch,
    "interquartile mean": of_statistic(interquartile_mean, False),
    "optimality gap": of_statistic(optimality_gap, False),
    "relative gain": of_statistic(relative_gain, True),
    "probability of improvement": improvement,
    "profile": profile,
}


# A standard deviation of the simulated share is 0.007, so that 0.9 is asked of what lies at 0.92
# and above; with 200 draws it is 0.015, and 0.9 of what was measured to lie at 0.95.
@pytest.mark.parametrize("draw", [gaussian, two_gaits, skewed])
@pytest.mark.parametrize("name", INTERVALS)
def test_an_interval_holds_the_truth(name: str, draw: Draw) -> None:
    assert often(draw, 1, 200, INTERVALS[name]) >= (0.87 if draw is skewed else 0.9)


@pytest.mark.slow
@pytest.mark.parametrize("tasks", [1, 3, 8])
@pytest.mark.parametrize("draw", [gaussian, two_gaits, skewed])
@pytest.mark.parametrize("name", INTERVALS)
def test_an_interval_holds_the_truth_in_a_thousand_draws(name: str, draw: Draw, tasks: int) -> None:
    assert often(draw, tasks, DRAWS, INTERVALS[name]) >= 0.9


def test_the_plain_bootstrap_would_not() -> None:
    """Why it is not what is used: a gap of one task, percentiles of the same draws."""
    rng = np.random.default_rng(0)
    truth = float(optimality_gap([gaussian(rng, 100_000, 0)]))
    held = 0
    for _ in range(DRAWS):
        sample = gaussian(rng, SEEDS, 0)
        drawn = optimality_gap([sample[rng.integers(0, SEEDS, (300, SEEDS))]])
        low, high = np.quantile(drawn, [0.025, 0.975])
        held += low <= truth <= high
    assert held / DRAWS < 0.88
