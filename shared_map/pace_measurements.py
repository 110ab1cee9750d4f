"""An author's measurements of kinds of ground (class and slope), and their encoding: as one more mark set, in a
tile beyond the map.

Measurements therefore have all properties of mark sets: numbers of which the newest wins, groups, quotas, authority
by key, digests, late joins, the keeper's store. The cells of such a set are no places: cell 3 * key is the number
of cells driven on that kind of ground, the next two are the mean and the variance of y = ln(driven pace / prior
pace). Each number is written as a pace of 1 + n / 65536, which float32 holds exactly, within the bounds of marks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bytes
from swarm.wire.fields import column
from swarm.wire.messages.map_data import MarkKind, MarkSet

KEYS = 256
"""More kinds of ground than any terrain has; their number is a byte."""
ONE = 1 << 16
"""The integer for 1 in y and in its variance."""
MOST = 5 * ONE
"""No |y| is taken for more: a pace e^5 times the prior's. The variance is at most the square of it, 25."""
MOST_CELLS = (1 << 20) - 1
"""Cells of one kind of ground that count at most; a number of them stays below _MOST_NUMBER."""
_SIGN = 1 << 19
"""Added to a mean, so that it is written as a positive number: more than MOST, and far below _MOST_NUMBER."""
_MOST_NUMBER = (1 << 21) - 1
"""Largest number that is written as a pace, 1 + number / ONE: float32 holds each exactly."""
_MOST_VARIANCE = MOST * MOST // ONE
_BIN = ONE // 64
"""Width of the bins of a trimmed mean, each with the exact sums of its own: memory does not grow with the cells."""
_CUT = 4
"""One of this number is left out at each end: the middle half stays."""


class Measurement(NamedTuple):
    """An author's measurement of one kind of ground: cells, and mean and variance of y in `ONE`."""

    cells: int
    mean: int
    variance: int


Columns = tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64]]
"""Cells, kinds, paces and stamps of a set of marks, as in `MarkSet`."""


def columns_of(measured: Mapping[int, Measurement], stamp_ns: int) -> Columns:
    """The statements of a set that carries these measurements, by key."""
    keys = sorted(measured)
    of = [measured[key] for key in keys]
    numbers = [n for each in of for n in (each.cells, each.mean + _SIGN, each.variance)]
    cells = [3 * key + part for key in keys for part in range(3)]
    return (
        np.array(cells, np.uint16),
        np.full(len(cells), MarkKind.PACE, np.uint8),
        (1 + np.array(numbers, np.float64) / ONE).astype(np.float32),
        np.full(len(cells), stamp_ns, np.int64),
    )


def measurements_in(mark_set: MarkSet) -> dict[int, Measurement] | None:
    """Returns key -> measurement, of a set in the tile beyond the map; None if it carries none, and is refused."""
    if not mark_set.kinds:
        return {}
    cells = column(mark_set.cells, "<u2").astype(np.int64)
    keys = cells[::3] // 3
    if mark_set.untils_ns or any(mark_set.kinds) or len(cells) % 3 or int(cells[-1]) >= 3 * KEYS:
        return None
    if (cells.reshape(-1, 3) != keys[:, None] * 3 + np.arange(3)).any():
        return None
    numbers = (column(mark_set.paces, "<f4").astype(np.float64) - 1) * ONE
    if (numbers != np.floor(numbers)).any() or numbers.min() < 0 or numbers.max() > _MOST_NUMBER:
        return None
    rows = numbers.astype(np.int64).reshape(-1, 3)
    rows[:, 1] -= _SIGN
    counts, means, variances = rows.T
    if (counts < 1).any() or (counts > MOST_CELLS).any() or (abs(means) > MOST).any():
        return None
    if (variances > _MOST_VARIANCE).any():
        return None
    return dict(zip(keys.tolist(), map(Measurement._make, rows.tolist()), strict=True))


class TrimmedMean:
    """Mean and variance of the middle half of many y, in `ONE`: what a kind of ground is like, whatever lies on a
    few of its cells.

    A road with rubble on every tenth cell is not a slower road: the rubble is marked, cell by cell. The mean of all
    cells would slow each of the others, and vehicles would then mark every clear cell as faster.

    A quarter is left out at each end. The variance is that of the Winsorized numbers, so that variance / cells is
    the square of the mean's standard error (Tukey and McLaughlin 1963).

    cells  how many there are
    """

    def __init__(self) -> None:
        self.cells = 0
        self._bins: dict[int, list[int]] = {}  # bin -> cells, sum of y, sum of y * y

    def add(self, y: int) -> None:
        """Takes in y of one more cell."""
        bin_sums = self._bins.setdefault(y // _BIN, [0, 0, 0])
        bin_sums[0] += 1
        bin_sums[1] += y
        bin_sums[2] += y * y
        self.cells += 1

    @property
    def measurement(self) -> Measurement:
        """The mean and the variance; there is at least one cell."""
        cells, cut = self.cells, self.cells // _CUT
        order = [self._bins[number] for number in sorted(self._bins)]
        low, below, below_squares = _first(order, cut)
        high, above, above_squares = _first(order[::-1], cut)
        middle = sum(total for _, total, _ in order) - below - above
        squares = sum(square for _, _, square in order) - below_squares - above_squares
        kept = cells - 2 * cut
        # The cells that are left out count for the nearest one that is not.
        total = middle + cut * (low + high)
        spread = max(0, (squares + cut * (low * low + high * high)) * cells - total * total)
        variance = spread // (kept * kept * ONE)
        return Measurement(cells, rounded(middle, kept), min(variance, _MOST_VARIANCE))


def _first(order: list[list[int]], cut: int) -> tuple[int, int, int]:
    """Returns (the number at this rank, the sum of those below, that of their squares); of a bin that is cut in two
    each part has the mean of the whole."""
    total = squares = 0
    for cells, of_bin, of_squares in order:
        if cut < cells:
            return rounded(of_bin, cells), total + rounded(of_bin * cut, cells), squares + of_squares * cut // cells
        cut -= cells
        total += of_bin
        squares += of_squares
    raise ValueError("at most half of the numbers can be left out")


def rounded(number: int, by: int) -> int:
    """The nearest integer to a quotient, halves away from 0, the same for both signs."""
    half = (2 * abs(number) + by) // (2 * by)
    return half if number >= 0 else -half


class Measured:
    """Measurements of one author. A cell counts once, the first time that it is driven.

    version  grows with every cell that counts
    """

    def __init__(self, keys: Bytes) -> None:
        self.version = 0
        self._keys = keys.reshape(-1)
        self._driven = np.zeros(len(self._keys), np.bool_)
        self._means: dict[int, TrimmedMean] = {}  # by key

    def add(self, cell: int, driven_s_per_m: float, prior_s_per_m: float) -> None:
        """A cell was driven at this pace. An invalid pace, or a lethal prior, gives no measurement."""
        if self._driven[cell] or not (0 < driven_s_per_m < math.inf and 0 < prior_s_per_m < math.inf):
            return
        self._driven[cell] = True
        y = max(-MOST, min(MOST, round(math.log(driven_s_per_m / prior_s_per_m) * ONE)))
        mean = self._means.setdefault(int(self._keys[cell]), TrimmedMean())
        if mean.cells < MOST_CELLS:
            mean.add(y)
            self.version += 1

    @property
    def by_key(self) -> dict[int, Measurement]:
        """Key -> what to state of it."""
        return {key: mean.measurement for key, mean in sorted(self._means.items())}
