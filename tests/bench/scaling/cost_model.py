"""Fits of costs to terms that each have a mechanism. Pure.

Every cost is a sum of few terms, each with a coefficient that is never negative: nothing makes a swarm cheaper
because there is more of it. Coefficients are those with the smallest relative errors
(non-negative least squares of rows divided by what was measured), so that a small swarm counts as much as a large
one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

Terms = tuple[str, ...]
"""Names of terms, as in `TERMS`."""


@dataclass(frozen=True)
class Fitted:
    """One cost as a sum of terms.

    coefficients  of each term, none below 0
    rows          how many measurements they were fitted to
    """

    coefficients: Mapping[str, float]
    rows: int

    def at(self, values: Mapping[str, float]) -> float:
        """The cost where terms have these values."""
        return sum(each * values[name] for name, each in self.coefficients.items())


def fit(terms: Terms, values: Sequence[Mapping[str, float]], measured: Sequence[float]) -> Fitted:
    """The coefficients with the smallest sum of squared relative errors. Measurements of 0 are left out: they have
    no relative error.

    values    of each measurement, by term
    """
    kept = [row for row, value in enumerate(measured) if value > 0]
    if not kept:
        return Fitted(dict.fromkeys(terms, 0.0), 0)
    matrix = np.array([[values[row][name] for name in terms] for row in kept], np.float64)
    weighted = matrix / np.array([measured[row] for row in kept], np.float64)[:, np.newaxis]
    scale = np.abs(weighted).max(axis=0)
    scale[scale == 0] = 1.0
    solved, _ = nnls(weighted / scale, np.ones(len(kept)))
    return Fitted(dict(zip(terms, (solved / scale).tolist(), strict=True)), len(kept))


def relative_error(found: float, measured: float) -> float:
    """By which share of what was measured a prediction is off."""
    return abs(found - measured) / measured if measured > 0 else float(found > 0)
