"""Numbers over several tasks, and intervals that hold what they promise at few seeds.

The strata are the tasks: seeds of one task are alike, tasks are not. A plain percentile bootstrap
resamples n seeds of a task with a variance that is (n - 1) / n of the right one, and knows nothing
of how uncertain that variance is: at five seeds of one task its nominal 95% interval holds the
truth in 88% of draws of an interquartile mean and in 81 to 83% of an optimality gap
(``tests/statistics/test_coverage.py``). So the
stratified bootstrap gives the standard error, corrected by n / (n - 1), and Student's t the width.
Shares have exact intervals, since a bootstrap of runs that are all alike has no width at all.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from race.statistics.intervals import Estimate

Floats = NDArray[np.float64]
Strata = Sequence[Floats]
"""One array ``[seeds]`` for each task; numbers of seeds may differ."""
Statistic = Callable[[Strata], Floats]
"""Arrays ``[draws, seeds]`` for each stratum -> ``[draws]``."""

UNBOUNDED = (-math.inf, math.inf)


def interquartile_mean(strata: Strata) -> Floats:
    """Mean of the middle half of all tasks' runs (Agarwal et al., 2021).

    Raises:
        ValueError: without a stratum.
    """
    return np.asarray(stats.trim_mean(np.concatenate(strata, axis=-1), 0.25, axis=-1))


def optimality_gap(strata: Strata, goal: float = 1.0) -> Floats:
    """By how much runs fall short of ``goal`` on average; what is above it does not count."""
    short = np.minimum(np.concatenate(strata, axis=-1), goal).mean(axis=-1)
    return np.asarray(goal - short)


def relative_gain(strata: Strata) -> Floats:
    """Mean over tasks of ``mean(method) / mean(base) - 1``.

    Args:
        strata: the method's on every task, then the base's on the same tasks; the means of the
            base should be well above zero.
    """
    half = len(strata) // 2
    methods, bases = strata[:half], strata[half:]
    ratios = [m.mean(axis=-1) / b.mean(axis=-1) for m, b in zip(methods, bases, strict=True)]
    return np.asarray(np.mean(ratios, axis=0) - 1.0)


def bootstrap_interval(
    strata: Strata,
    statistic: Statistic,
    bounds: tuple[float, float] = UNBOUNDED,
    confidence: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> Estimate:
    """A number of all strata with an interval from the stratified bootstrap over seeds.

    ``value +- t s``, where ``s^2 = sum v_m n_m / (n_m - 1)`` over strata, ``v_m`` is the variance
    of the statistic while seeds of stratum m alone are drawn again, and t has the degrees of
    freedom of Welch and Satterthwaite, ``s^4 / sum (v_m n_m / (n_m - 1))^2 / (n_m - 1)``.

    Args:
        strata: see `Strata`.
        statistic: see `Statistic`; close to a sum over strata.
        bounds: smallest and largest value of the number.
        confidence: the share of experiments whose interval is to hold the truth.
        draws: bootstrap draws of each stratum.
        seed: of the draws, so that the same runs give the same interval.

    Returns:
        The estimate; without an interval (NaN) if a stratum has one seed.

    Raises:
        ValueError: without a stratum, or for one without a seed.
    """
    if not strata or any(len(values) == 0 for values in strata):
        raise ValueError("an interval needs at least one seed of each stratum")
    whole = [np.asarray(values, np.float64)[None] for values in strata]
    value = float(statistic(whole)[0])
    if any(len(values) == 1 for values in strata):
        return Estimate(value, math.nan, math.nan)
    rng = np.random.default_rng(seed)
    variances, freedoms = [], []
    for place, values in enumerate(whole):
        n = values.shape[1]
        drawn = [np.broadcast_to(other, (draws, other.shape[1])) for other in whole]
        drawn[place] = values[0][rng.integers(0, n, (draws, n))]
        variances.append(float(statistic(drawn).var()) * n / (n - 1))
        freedoms.append(n - 1)
    total = sum(variances)
    if total == 0.0:
        return Estimate(value, value, value)
    freedom = total**2 / sum(v**2 / f for v, f in zip(variances, freedoms, strict=True))
    half = float(stats.t.ppf((1 + confidence) / 2, freedom)) * math.sqrt(total)
    return Estimate(value, max(value - half, bounds[0]), min(value + half, bounds[1]))


def probability_of_improvement(
    methods: Strata, bases: Strata, confidence: float = 0.95
) -> Estimate:
    """How likely a run of the method beats one of the base on a task drawn at random.

    The mean over tasks of the Mann-Whitney statistic ``P(X > Y) + P(X = Y) / 2`` (Agarwal et al.,
    2021). Its interval is Newcombe's (2006, method 5) score interval: all values p that are no
    further than ``t sqrt(V(p))`` from the estimate, with

        ``V(p) = p (1 - p) / (n m) (1 + N (1 - p) / (2 - p) + N p / (1 + p))``

    and ``N = (n + m) / 2 - 1`` on one task; on several, the mean of V over tasks, divided by their
    number: V is concave, so that tasks with unlike p make the interval too wide, not too narrow.
    Newcombe's z is Student's t with the seeds' degrees of freedom here, on the safe side.

    Args:
        methods: one array ``[seeds]`` a task.
        bases: likewise, of the same tasks.
        confidence: the share of experiments whose interval is to hold the truth.

    Raises:
        ValueError: without a task, or for unequal numbers of tasks.
    """
    if not methods:
        raise ValueError("a probability of improvement needs at least one task")
    pairs = list(zip(methods, bases, strict=True))
    shares = [np.mean((x[:, None] > y[None]) + 0.5 * (x[:, None] == y[None])) for x, y in pairs]
    value = float(np.mean(shares))
    sizes = np.array([(len(x), len(y)) for x, y in pairs], np.float64)
    if sizes.min() < 2:
        return Estimate(value, math.nan, math.nan)
    width = float(stats.t.ppf((1 + confidence) / 2, (sizes.sum(axis=1) - 2).sum()))
    n, m = sizes.T

    def beyond(p: float) -> float:
        middle = (n + m) / 2 - 1
        spread = 1 + middle * (1 - p) / (2 - p) + middle * p / (1 + p)
        variance = np.mean(p * (1 - p) / (n * m) * spread) / len(pairs)
        return float(abs(value - p) - width * math.sqrt(variance))

    # The variance vanishes at 0 and 1, where the estimate itself may be: begin inside.
    inside = min(max(value, 1e-9), 1 - 1e-9)
    low = 0.0 if value == 0.0 else float(optimize.brentq(beyond, 0.0, inside))
    high = 1.0 if value == 1.0 else float(optimize.brentq(beyond, inside, 1.0))
    return Estimate(value, low, high)


def share_above(strata: Strata, thresholds: Floats, confidence: float = 0.95) -> list[Estimate]:
    """The performance profile: the share of runs above each threshold, the mean over tasks.

    With the interval of Clopper and Pearson, pointwise. On several tasks the number of runs is that
    which has the same variance; unlike tasks make it too wide (Hoeffding, 1956).

    Raises:
        ValueError: without a stratum.
    """
    if not strata:
        raise ValueError("a profile needs at least one task")
    above = np.mean([(v[:, None] > thresholds[None]).mean(axis=0) for v in strata], axis=0)
    runs = len(strata) ** 2 / sum(1 / len(values) for values in strata)
    hits, tail = above * runs, (1 - confidence) / 2
    with np.errstate(invalid="ignore"):
        low = np.where(hits <= 0, 0.0, stats.beta.ppf(tail, hits, runs - hits + 1))
        high = np.where(hits >= runs, 1.0, stats.beta.ppf(1 - tail, hits + 1, runs - hits))
    return [Estimate(*map(float, point)) for point in zip(above, low, high, strict=True)]
