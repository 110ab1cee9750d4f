"""The statements of mark sets: their kinds and times, and the rules of their columns, for one set or for many."""

from __future__ import annotations

import enum
import struct
from typing import TYPE_CHECKING

from swarm.grid import TILE_CELLS
from swarm.lazy_numpy import np, numpy_loaded
from swarm.wire.fields import check_column, column

if TYPE_CHECKING:
    from numpy.typing import NDArray

TILE_AREA = TILE_CELLS * TILE_CELLS

STAMP_LIMIT_NS = 1 << 62
"""Marks stamped from here on (year 2116) are rejected by all processes, so that there is always a newer stamp."""

PACE_LEAST: float = struct.unpack("<f", struct.pack("<f", 1 / 340))[0]
"""s/m; what drives quicker than sound is no vehicle. Float32, as marks are."""
PACE_MOST = 100.0
"""s/m, a cell of 10 m in 17 minutes: slower ground is better told as lethal. Both bound what one wrong mark can do
to lower bounds and to the number of buckets of every planner."""

FOREVER = (1 << 63) - 1
"""`until_ns` of a mark that does not expire."""


class MarkKind(enum.IntEnum):
    """What a mark states about a cell."""

    PACE = 0
    """It can be driven at this pace, in s/m."""
    LETHAL = 1
    """It must not be entered."""
    CLEAR = 2
    """It is as the prior map has it: undoes older marks."""


LAST_KIND = int(max(MarkKind))
_FEW = 100
"""Up to this many statements, which most sets have, lists are checked several times faster than arrays."""


def check_lengths(
    count: int, cells: bytes, kinds: bytes, paces: bytes, stamps_ns: bytes, untils_ns: bytes = b""
) -> None:
    """Raise ValueError unless these are columns of `count` statements; `untils_ns` may be empty."""
    if (
        len(kinds) == count
        and len(cells) == 2 * count
        and len(paces) == 4 * count
        and len(stamps_ns) == 8 * count
        and len(untils_ns) in (0, 8 * count)
    ):
        return
    check_column("cells", cells, 2, count)
    check_column("kinds", kinds, 1, count)
    check_column("paces", paces, 4, count)
    check_column("stamps_ns", stamps_ns, 8, count)
    if untils_ns:
        check_column("untils_ns", untils_ns, 8, count)


def check_statements(cells: bytes, kinds: bytes, paces: bytes, stamps_ns: bytes) -> None:
    """Raise ValueError with the rule that the columns of one set break. It has one or more statements."""
    if max(kinds) > LAST_KIND:
        raise ValueError(f"kind {max(kinds)} is not in 0..{LAST_KIND}")
    if len(kinds) > _FEW and numpy_loaded():
        array = column(cells, "<u2")
        rising = bool((array[1:] > array[:-1]).all())
        last = int(array[-1])
        times = column(stamps_ns, "<i8")
        oldest_ns, newest_ns = int(times.min()), int(times.max())
        told = column(paces, "<f4")[column(kinds, "<u1") == MarkKind.PACE]
        possible = bool(((told >= PACE_LEAST) & (told <= PACE_MOST)).all())
    else:
        listed = memoryview(cells).cast("H").tolist()
        rising = sorted(set(listed)) == listed
        last = listed[-1]
        stamps = memoryview(stamps_ns).cast("q").tolist()
        oldest_ns, newest_ns = min(stamps), max(stamps)
        said = zip(memoryview(paces).cast("f").tolist(), kinds, strict=True)
        possible = all(kind != MarkKind.PACE or PACE_LEAST <= pace <= PACE_MOST for pace, kind in said)
    if not rising or last >= TILE_AREA:
        raise ValueError(f"cells must increase strictly below {TILE_AREA}")
    if not possible:
        raise ValueError(f"the pace of a PACE mark must be in {PACE_LEAST:.4g} ... {PACE_MOST:g} s/m")
    if oldest_ns < 0 or newest_ns >= STAMP_LIMIT_NS:
        raise ValueError("stamps_ns must not be negative, and below 2**62")


def faulty_sets(
    counts: NDArray[np.int64], cells: bytes, kinds: bytes, paces: bytes, stamps_ns: bytes
) -> NDArray[np.int64]:
    """Numbers of the sets that break a rule of `check_statements`, in order.

    counts  int64 (sets,)  statements of each set; the columns hold those of all sets, one set after the other
    """
    cell, kind = column(cells, "<u2"), column(kinds, "<u1")
    pace, stamp_ns = column(paces, "<f4"), column(stamps_ns, "<i8")
    wrong = (cell >= TILE_AREA) | (kind > LAST_KIND) | (stamp_ns < 0) | (stamp_ns >= STAMP_LIMIT_NS)
    wrong |= (kind == MarkKind.PACE) & ~((pace >= PACE_LEAST) & (pace <= PACE_MOST))
    fallen = np.zeros(len(cell), bool)
    fallen[1:] = cell[1:] <= cell[:-1]
    starts = np.cumsum(counts) - counts
    fallen[starts[counts > 0]] = False
    wrong |= fallen
    if not wrong.any():
        return np.empty(0, np.int64)
    return np.unique(np.repeat(np.arange(len(counts)), counts)[wrong])
