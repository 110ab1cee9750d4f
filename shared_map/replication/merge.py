"""The merge rule of `marks` for thousands of sets at once: which cells' winners change, as one set of arrays.

One set costs some 20 microseconds to merge, most of it for handling arrays of ten values. Here the columns of all
sets are laid one after the other and resolved together, for a small part of that. `test_merge.py` holds the
two to the same answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared_map.replication.marks import NO_STATEMENT
from swarm.grid import TILE_CELLS, GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.marks import MarkSet, MarkSets
from swarm.wire.statements import FOREVER, TILE_AREA, MarkKind


class Arrival(NamedTuple):
    """A set to be merged into its tile. Of several arrivals that are taken together each has a tile of its own.

    old     the set of the same author that it replaces
    others  the sets of the tile's other authors
    """

    new: MarkSet
    old: MarkSet | None
    others: Sequence[MarkSet]


class Said(NamedTuple):
    """Columns of statements about cells of several tiles; all of one length.

    places     arrival * TILE_AREA + cell in its tile, below 2**31; increasing, none twice, once resolved
    kinds      MarkKind
    paces      s/m, 0 where the kind is not PACE
    stamps_ns  NO_STATEMENT where nobody says anything any more
    """

    places: NDArray[np.int32]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]
    stamps_ns: NDArray[np.int64]

    def taken(self, where: NDArray[np.intp] | NDArray[np.bool_]) -> Said:
        return Said(self.places[where], self.kinds[where], self.paces[where], self.stamps_ns[where])


def difference_of_many(arrivals: Sequence[Arrival], now_ns: int) -> Said:
    """The cells whose winner changes in kind or pace when all arrivals are merged, with their winners since."""
    alone = [at for at, each in enumerate(arrivals) if not any(other.kinds for other in each.others)]
    found = [_undisputed(arrivals, alone, now_ns)] if alone else []
    if len(alone) < len(arrivals):
        lonely = set(alone)
        found.append(_disputed(arrivals, [at for at in range(len(arrivals)) if at not in lonely], now_ns))
    return found[0] if len(found) == 1 else _together(found)


def said_in(bulk: MarkSets, which: NDArray[np.bool_]) -> Said:
    """What these sets of a message say of tiles that nobody has spoken of; each set's number is its place there.

    which  bool (sets,)  sets of which no statement ends by itself
    """
    counts = column(bulk.counts, "<u2")
    kinds = column(bulk.kinds, "<u1")
    places = np.repeat(np.arange(len(counts), dtype=np.int32) << _AREA_BITS, counts)
    places += column(bulk.cells, "<u2")
    paces = column(bulk.paces, "<f4")
    if kinds.any():
        paces = np.where(kinds == _PACE, paces, np.float32(0))
    said = Said(places, kinds, paces, column(bulk.stamps_ns, "<i8"))
    heard = kinds != _CLEAR
    if not which.all():
        heard &= np.repeat(which, counts)
    return said if heard.all() else said.taken(heard)


def cells_of(grid: GridSpec, tiles: NDArray[np.int64], places: NDArray[np.int32]) -> NDArray[np.uint32]:
    """Flat indices in the grid. `tiles` are those of the arrivals."""
    tile_rows, tile_cols = np.divmod(tiles, grid.tile_cols)
    corners = (tile_rows * (TILE_CELLS * grid.cols) + tile_cols * TILE_CELLS).astype(np.uint32)
    inner = np.arange(TILE_AREA)
    offsets = (inner // TILE_CELLS * grid.cols + inner % TILE_CELLS).astype(np.uint32)
    cells: NDArray[np.uint32] = corners[places >> _AREA_BITS] + offsets[places & (TILE_AREA - 1)]
    return cells


def _undisputed(arrivals: Sequence[Arrival], numbers: list[int], now_ns: int) -> Said:
    """Nobody else says anything about these tiles: what the author says now differs from what it said."""
    after = _columns([arrivals[at].new for at in numbers], numbers, now_ns)
    replaced = [(at, old) for at in numbers if (old := arrivals[at].old) is not None and old.kinds]
    if not replaced:
        clear = after.kinds == _CLEAR
        return after.taken(~clear) if clear.any() else after
    before = _columns([old for _, old in replaced], [at for at, _ in replaced], now_ns)
    return _changed(before, after)


def _disputed(arrivals: Sequence[Arrival], numbers: list[int], now_ns: int) -> Said:
    others = [(at, each) for at in numbers for each in arrivals[at].others]
    old = [(at, each) for at in numbers if (each := arrivals[at].old) is not None]
    new = [(at, arrivals[at].new) for at in numbers]
    rank = {name: n for n, name in enumerate(sorted({each.author for _, each in others + new}))}
    return _changed(_winners(others + old, rank, now_ns), _winners(others + new, rank, now_ns))


def _winners(sets: list[tuple[int, MarkSet]], rank: dict[str, int], now_ns: int) -> Said:
    """Per place the newest statement, on a tie that of the larger author."""
    all_sets = [each for _, each in sets]
    said = _columns(all_sets, [at for at, _ in sets], now_ns)
    ranks = _per_statement([rank[each.author] for each in all_sets], all_sets, now_ns)
    order = np.lexsort((ranks, said.stamps_ns, said.places))
    places = said.places[order]
    last = np.ones(len(places), bool)
    last[:-1] = places[1:] != places[:-1]
    return said.taken(order[last])


def _columns(sets: list[MarkSet], numbers: list[int], now_ns: int) -> Said:
    """The statements of all sets that still stand, in the order of the sets."""
    kinds = column(b"".join([each.kinds for each in sets]), "<u1")
    paces = column(b"".join([each.paces for each in sets]), "<f4")
    stamps_ns = column(b"".join([each.stamps_ns for each in sets]), "<i8")
    cells = column(b"".join([each.cells for each in sets]), "<u2")
    places = np.repeat(np.array(numbers, np.int32) << _AREA_BITS, [len(each.kinds) for each in sets])
    places += cells
    if kinds.any():
        paces = np.where(kinds == _PACE, paces, np.float32(0))
    said = Said(places, kinds, paces, stamps_ns)
    stands = _stand(sets, now_ns)
    return said if stands is None else said.taken(stands)


def _per_statement(values: list[int], sets: list[MarkSet], now_ns: int) -> NDArray[np.int32]:
    """A value of each set, repeated for each of its statements that still stand."""
    spread = np.repeat(np.array(values, np.int32), [len(each.kinds) for each in sets])
    stands = _stand(sets, now_ns)
    return spread if stands is None else spread[stands]


def _stand(sets: list[MarkSet], now_ns: int) -> NDArray[np.bool_] | None:
    """Which statements have not ended; None if none of them ever ends."""
    if not any([each.untils_ns for each in sets]):  # noqa: C419 - a list is looked through in half the time
        return None
    forever = np.int64(FOREVER).tobytes()
    ends = b"".join([each.untils_ns or forever * len(each.kinds) for each in sets])
    return np.asarray(column(ends, "<i8") > now_ns)


def _changed(before: Said, after: Said) -> Said:
    """Those of `after` that differ from `before`, and what is said no more."""
    at = np.searchsorted(before.places, after.places)
    at[at == len(before.places)] = 0
    known = before.places[at] == after.places if len(before.places) else np.zeros(len(after.places), bool)
    gone = np.ones(len(before.places), bool)
    gone[at[known]] = False
    gone &= before.kinds != _CLEAR
    differs = after.kinds != _CLEAR
    were = at[known]
    differs[known] = (after.kinds[known] != before.kinds[were]) | (after.paces[known] != before.paces[were])
    changed = after.taken(differs)
    if not gone.any():
        return changed
    places = before.places[gone]
    nothing = Said(
        places,
        np.full(len(places), _CLEAR, np.uint8),
        np.zeros(len(places), np.float32),
        np.full(len(places), NO_STATEMENT, np.int64),
    )
    return _together([changed, nothing])


def _together(parts: Sequence[Said]) -> Said:
    return Said(
        np.concatenate([part.places for part in parts]),
        np.concatenate([part.kinds for part in parts]),
        np.concatenate([part.paces for part in parts]),
        np.concatenate([part.stamps_ns for part in parts]),
    )


_CLEAR = int(MarkKind.CLEAR)
_PACE = int(MarkKind.PACE)
_AREA_BITS = TILE_AREA.bit_length() - 1
