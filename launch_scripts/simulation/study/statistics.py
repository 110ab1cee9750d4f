"""Means, medians and shares of few or many seeds, with intervals that hold them with 95 %."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import msgspec
import numpy as np
from scipy import stats

LEVEL = 0.95
MOST_BOOTSTRAPPED = 1000
"""Of more values than this the mean is as good as normal, and Student's t says the same in no time."""
_RESAMPLES = 9999
_SAME = 1e-12
"""Values that differ by less, relative to the largest, are one: rounding."""
METHOD = (
    f"Intervals hold with 95 %: of means BCa bootstrap ({_RESAMPLES:,} resamples; Student's t above "
    f"{MOST_BOOTSTRAPPED:,} values), of medians order statistics, which assume nothing, of shares Wilson's. Of one "
    "or two values, and of medians of fewer than six, there is none. Differences are of the same seeds."
)


class Estimate(msgspec.Struct, frozen=True):
    """A value, and the interval that holds it; None where there are too few values to tell."""

    value: float
    low: float | None = None
    high: float | None = None


def mean(values: Sequence[float]) -> Estimate:
    """The mean. The bootstrap draws by a fixed seed: the same values give the same interval."""
    data = np.asarray(values, np.float64)
    middle = float(data.mean())
    if len(data) < 3:
        return Estimate(middle)
    if np.ptp(data) <= _SAME * np.abs(data).max():
        return Estimate(middle, middle, middle)
    if len(data) > MOST_BOOTSTRAPPED:
        low, high = stats.t.interval(LEVEL, len(data) - 1, middle, stats.sem(data))
        return Estimate(middle, float(low), float(high))
    # Of values at the limits of floats there is no interval.
    with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore", category=stats.DegenerateDataWarning):
        found = stats.bootstrap(
            (data,),
            np.mean,
            n_resamples=_RESAMPLES,
            confidence_level=LEVEL,
            rng=np.random.default_rng(0),
            batch=1000,
        ).confidence_interval
    low, high = float(found.low), float(found.high)
    return Estimate(middle, low, high) if math.isfinite(low) and math.isfinite(high) else Estimate(middle)


def median(values: Sequence[float]) -> Estimate:
    """The median, between two of the values: so many ranks from either end that the binomial law says."""
    data = np.sort(np.asarray(values, np.float64))
    middle = float(np.median(data))
    # Below the rank r lie r values or more, if r of n coins show heads.
    rank = int(stats.binom.ppf((1 - LEVEL) / 2, len(data), 0.5))
    if rank == 0 or stats.binom.cdf(rank - 1, len(data), 0.5) > (1 - LEVEL) / 2:
        return Estimate(middle)
    return Estimate(middle, float(data[rank - 1]), float(data[len(data) - rank]))


def share(hits: int, count: int) -> Estimate:
    """The share of hits, by Wilson's interval."""
    found = stats.binomtest(hits, count).proportion_ci(LEVEL, "wilson")
    return Estimate(hits / count, float(found.low), float(found.high))
