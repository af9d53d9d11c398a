"""Whether two methods are told apart, and how many seeds would tell them apart."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from race.statistics.intervals import Estimate

MOST_SEEDS = 1000
"""A difference that takes more is none that an experiment will show."""


def difference(
    method: NDArray[np.float64], base: NDArray[np.float64], confidence: float = 0.95
) -> Estimate:
    """Difference of two means over ``[seeds]`` each, with Welch's interval.

    Methods are told apart where it does not hold zero, which is Welch's test.

    Raises:
        ValueError: without a seed of either.
    """
    if len(method) == 0 or len(base) == 0:
        raise ValueError("a difference needs at least one seed of each method")
    value = float(method.mean() - base.mean())
    if min(len(method), len(base)) < 2:
        return Estimate(value, math.nan, math.nan)
    if method.std() == base.std() == 0.0:
        return Estimate(value, value, value)
    found = stats.ttest_ind(method, base, equal_var=False).confidence_interval(confidence)
    return Estimate(value, float(found.low), float(found.high))


def surely_apart(seeds: int, others: int, significance: float = 0.05) -> bool:
    """Whether two methods are told apart if every seed of the one is better than all of the other.

    By the exact test of permutations (Mann and Whitney, 1947), two-sided: of all ways to draw the
    seeds two are as extreme. It takes four of each, or five and three.
    """
    return 2 / math.comb(seeds + others, seeds) <= significance


def seeds_needed(
    method: NDArray[np.float64],
    base: NDArray[np.float64],
    power: float = 0.8,
    significance: float = 0.05,
) -> int | None:
    """Seeds of each method with which a difference as large as the one seen would be found.

    The fewest n with which Welch's test, two-sided, finds a difference of the observed size under
    the observed standard deviations with the probability ``power`` (noncentral t). The difference
    seen is itself uncertain, and with it this number.

    Returns:
        None if there is no difference to be seen, too few seeds to know the spread, or more than
        `MOST_SEEDS` would be needed.
    """
    if min(len(method), len(base)) < 2:
        return None
    gap = abs(float(method.mean() - base.mean()))
    variances = float(method.var(ddof=1)), float(base.var(ddof=1))
    if gap == 0.0:
        return None
    if sum(variances) == 0.0:
        return 2
    n = np.arange(2, MOST_SEEDS + 1, dtype=np.float64)
    freedom = (n - 1) * sum(variances) ** 2 / (variances[0] ** 2 + variances[1] ** 2)
    # Beyond this, the test finds it at any n, and the noncentral t is no longer computed well.
    shift = np.minimum(gap / np.sqrt(sum(variances) / n), 30.0)
    edge = stats.t.ppf(1 - significance / 2, freedom)
    found = stats.nct.sf(edge, freedom, shift) + stats.nct.cdf(-edge, freedom, shift)
    enough = np.flatnonzero(found >= power)
    return int(n[enough[0]]) if enough.size else None
