"""What an author has measured as one more set of marks, about a tile beyond the map.

So it has all that sets of marks have: numbers of which the newest wins, groups, quotas, authority by key, digests,
late joins, the keeper's store. Its cells are no places: the cell 3 * key is the number of cells driven on that kind
of ground, the next two are the mean and the variance of y. Each number is written as a pace of 1 + n / 65536, which
float32 holds exactly, and which is within the bounds of marks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm.wire.fields import column
from swarm.wire.messages.map_data import MarkKind, MarkSet

KEYS = 256
"""More kinds of ground than any terrain has; their number is a byte."""
ONE = 1 << 16
"""What is 1 in y and in its variance."""
MOST = 5 * ONE
"""No |y| is taken for more: a pace e^5 times the prior's. The variance is at most the square of it, 25."""
MOST_CELLS = (1 << 20) - 1
_SIGN = 1 << 19
_MOST_NUMBER = (1 << 21) - 1
_MOST_VARIANCE = MOST * MOST // ONE


class Said(NamedTuple):
    """What an author has measured of one kind of ground: cells, and mean and variance of y in `ONE`."""

    cells: int
    mean: int
    variance: int


class Columns(NamedTuple):
    """Columns of a set of marks, as in `MarkSet`."""

    cells: NDArray[np.uint16]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]
    stamps_ns: NDArray[np.int64]


def stated(said: Mapping[int, Said], stamp_ns: int) -> Columns:
    """The statements that tell these."""
    keys = sorted(said)
    numbers = [n for key in keys for n in (said[key].cells, said[key].mean + _SIGN, said[key].variance)]
    cells = [3 * key + part for key in keys for part in range(3)]
    return Columns(
        np.array(cells, np.uint16),
        np.full(len(cells), MarkKind.PACE, np.uint8),
        (1 + np.array(numbers, np.float64) / ONE).astype(np.float32),
        np.full(len(cells), stamp_ns, np.int64),
    )


def told(word: MarkSet) -> dict[int, Said] | None:
    """What a set about the tile beyond the map tells; None if it is no such word: then nobody takes it in."""
    if not word.kinds:
        return {}
    cells = column(word.cells, "<u2").astype(np.int64)
    keys = cells[::3] // 3
    if word.untils_ns or any(word.kinds) or len(cells) % 3 or int(cells[-1]) >= 3 * KEYS:
        return None
    if (cells.reshape(-1, 3) != keys[:, None] * 3 + np.arange(3)).any():
        return None
    numbers = (column(word.paces, "<f4").astype(np.float64) - 1) * ONE
    if (numbers != np.floor(numbers)).any() or numbers.min() < 0 or numbers.max() > _MOST_NUMBER:
        return None
    rows = numbers.astype(np.int64).reshape(-1, 3).tolist()
    words = {key: Said(n, mean - _SIGN, var) for key, (n, mean, var) in zip(keys.tolist(), rows, strict=True)}
    sound = all(
        0 < each.cells <= MOST_CELLS and abs(each.mean) <= MOST and each.variance <= _MOST_VARIANCE
        for each in words.values()
    )
    return words if sound else None
