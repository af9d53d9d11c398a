"""Intervals of a mean over seeds, and what a quantity can be.

Student's t, because it keeps its promise at the few seeds there are: over simulated runs it covers
the true mean in 95% of cases at three and five seeds, where the percentile bootstrap covers under
80 and 88% (``tests/statistics/test_intervals.py``). No interval of three seeds helps where runs
fall into two kinds: three of one kind look certain.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

LEAST_SEEDS_OF_A_BAND = 4
"""With fewer seeds an interval is so wide that it hides the seeds; they are shown themselves."""

_SHARES = ("win_rate", "_rate", "_fraction")
_NOT_NEGATIVE = ("_std", "length_mean", "_seconds", "_per_second")


class Interval(NamedTuple):
    """A mean over seeds and the interval around it, of one number or of many side by side."""

    mean: NDArray[np.float64]
    low: NDArray[np.float64]  # NaN with one seed, as `high`
    high: NDArray[np.float64]


class Estimate(NamedTuple):
    """One number and the interval around it."""

    value: float
    low: float  # NaN where there are too few seeds for an interval, as `high`
    high: float


def mean_estimate(
    seeds: ArrayLike, bounds: tuple[float, float] = (-math.inf, math.inf)
) -> Estimate:
    """`mean_interval` of one number: the mean over ``[seeds]`` with its 95% interval."""
    found = mean_interval(seeds, bounds)
    return Estimate(float(found.mean), float(found.low), float(found.high))


def mean_interval(
    values: ArrayLike,
    bounds: tuple[float, float] = (-math.inf, math.inf),
    confidence: float = 0.95,
) -> Interval:
    """The mean over the first axis, with Student's t interval cut to what the quantity can be.

    ``mean +- t_{(1 + c) / 2, n - 1} s / sqrt(n)`` over n seeds.

    Args:
        values: one row per seed.
        bounds: smallest and largest value of the quantity (`bounds_of`).
        confidence: c, the share of experiments whose interval holds the true mean.

    Raises:
        ValueError: without a row.
    """
    seeds = np.asarray(values, np.float64)
    n = len(seeds)
    if n == 0:
        raise ValueError("an interval needs at least one seed")
    mean = seeds.mean(axis=0)
    if n == 1:
        nothing = np.full(mean.shape, np.nan)
        return Interval(mean, nothing, nothing)
    half = stats.t.ppf((1 + confidence) / 2, n - 1) * seeds.std(axis=0, ddof=1) / math.sqrt(n)
    return Interval(mean, np.maximum(mean - half, bounds[0]), np.minimum(mean + half, bounds[1]))


def bounds_of(quantity: str) -> tuple[float, float]:
    """What a quantity of ``metrics.jsonl`` can be: shares lie in [0, 1], times are not negative."""
    if quantity.endswith(_SHARES):
        return 0.0, 1.0
    return (0.0, math.inf) if quantity.endswith(_NOT_NEGATIVE) else (-math.inf, math.inf)
