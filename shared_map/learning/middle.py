"""Mean and variance of the middle half of many numbers: what a kind of ground is like, whatever lies on a few of
its cells.

A road with rubble on every tenth cell is not a slower road: the rubble is marked, cell by cell. The mean of all
cells would say that each of the others is slower, and every vehicle that sees one would mark that it is not.

The mean is the trimmed one, by a quarter at each end, and the variance that of its Winsorized numbers, so that
variance / cells is the square of the mean's standard error (Tukey and McLaughlin 1963).
"""

from __future__ import annotations

from shared_map.learning.words import MOST, ONE, Said

_BIN = ONE // 64
"""Numbers are kept by bins so wide, each with the exact sums of its own: memory does not grow with the cells."""
_CUT = 4
"""One in so many is left out at each end."""
_MOST_VARIANCE = MOST * MOST // ONE


class Middle:
    """Takes in y of each cell, in `ONE`.

    cells  how many there are
    """

    def __init__(self) -> None:
        self.cells = 0
        self._bins: dict[int, list[int]] = {}  # bin -> cells, sum of y, sum of y * y

    def add(self, y: int) -> None:
        one = self._bins.setdefault(y // _BIN, [0, 0, 0])
        one[0] += 1
        one[1] += y
        one[2] += y * y
        self.cells += 1

    @property
    def said(self) -> Said:
        """What to say of them; there is at least one."""
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
        return Said(cells, rounded(middle, kept), min(variance, _MOST_VARIANCE))


def _first(order: list[list[int]], cut: int) -> tuple[int, int, int]:
    """(the number that comes after so many, the sum of these, that of their squares); of a bin that is cut in two
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
