"""The merge law: which statement about a cell wins, and which cells' winners change when sets of marks change.

The newest unexpired mark of a cell wins; of two with one timestamp, that of the larger author id. An operator's
statement (a zone) wins over all others: a vehicle that sees open ground must not open what people have closed. The
law reads nothing but the sets that are held, so the order, grouping and repetition in which they arrived cannot
matter. A newer set, a tombstone, an expiry and a region that is left are each a `TileChange`: the sets of a tile
before and after.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared_map.replication.mark_sets import NO_STATEMENT, NO_STATEMENTS, Statements, is_zone
from shared_map.replication.tiles import grid_cells, tile_corners
from swarm.grid import TILE_CELLS, GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.map_data import FOREVER, TILE_AREA, MarkKind, MarkSet


class TileChange(NamedTuple):
    """A tile's sets before and after a change: at most one per author, in increasing order of author."""

    tile: int
    before: Sequence[MarkSet]
    after: Sequence[MarkSet]


class NewWinners(NamedTuple):
    """Cells whose winning statement has another kind or pace than before. Columns of one length, no cell twice.

    cells      uint32   flat index in the grid
    kinds      uint8    MarkKind; CLEAR where no author states anything any more
    paces      float32  s/m, 0 where the kind is not PACE
    stamps_ns  int64    NO_STATEMENT where no author states anything any more
    counts     list     number of such cells in each `TileChange`
    """

    cells: NDArray[np.uint32]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]
    stamps_ns: NDArray[np.int64]
    counts: list[int]


def winners(sets: Sequence[MarkSet], now_ns: int) -> Statements:
    """The winning statements about the cells of one tile, in increasing order of cell.

    sets    at most one per author, in increasing order of author
    now_ns  statements that expired by then do not count
    """
    if not any([each.kinds for each in sets]):  # noqa: C419 - twice as fast as a generator
        return NO_STATEMENTS
    won = _winners([(0, each) for each in sets], now_ns)
    return Statements(won.places.astype(np.uint16), won.kinds, won.paces, won.stamps_ns)


def new_winners(grid: GridSpec, changes: Sequence[TileChange], before_ns: int, now_ns: int) -> NewWinners:
    """The cells whose winner differs between `before` at `before_ns` and `after` at `now_ns`.

    changes  each of another tile
    """
    statements = sum([len(each.kinds) for change in changes for sets in change[1:] for each in sets])
    if statements <= _FEW:
        return _new_winners_of_few(grid, changes, before_ns, now_ns)
    before = _winners([(n, each) for n, change in enumerate(changes) for each in change.before], before_ns)
    after = _winners([(n, each) for n, change in enumerate(changes) for each in change.after], now_ns)
    changed = _changed(before, after)
    numbers = changed.places >> _AREA_BITS
    corners = tile_corners(grid, [change.tile for change in changes])
    cells = grid_cells(grid, corners[numbers], changed.places & (TILE_AREA - 1))
    counts = np.bincount(numbers, minlength=len(changes)).tolist()
    return NewWinners(cells, changed.kinds, changed.paces, changed.stamps_ns, counts)


# --- few statements, as lists -----------------------------------------------------------------------------------


def _new_winners_of_few(grid: GridSpec, changes: Sequence[TileChange], before_ns: int, now_ns: int) -> NewWinners:
    """The same in Python lists and dicts."""
    changed: list[tuple[int, int, float, int]] = []
    counts: list[int] = []
    for tile, sets_before, sets_after in changes:
        before, after = _winners_of_few(sets_before, before_ns), _winners_of_few(sets_after, now_ns)
        here: list[tuple[int, int, float, int]] = []
        for cell, (kind, pace, stamp_ns) in after.items():
            was = before.pop(cell, _NOTHING)
            if kind != was[0] or pace != was[1]:
                here.append((cell, kind, pace, stamp_ns))
        here.extend((cell, *_NOTHING) for cell, was in before.items() if was[0] != _CLEAR)
        counts.append(len(here))
        if here:
            tile_row, tile_col = divmod(tile % (grid.tiles + 1), grid.tile_cols)
            corner = tile_row * TILE_CELLS * grid.cols + tile_col * TILE_CELLS
            for cell, kind, pace, stamp_ns in sorted(here):
                changed.append((corner + cell // TILE_CELLS * grid.cols + cell % TILE_CELLS, kind, pace, stamp_ns))
    columns: Iterable[Sequence[float]] = zip(*changed, strict=True) if changed else ((),) * len(_TYPES)
    return NewWinners._make([*map(np.array, columns, _TYPES), counts])


def _winners_of_few(sets: Sequence[MarkSet], now_ns: int) -> dict[int, tuple[int, float, int]]:
    """Cell in the tile -> (kind, pace, stamp) of its winner."""
    zones = [each for each in sets if is_zone(each.author)]
    others = [each for each in sets if not is_zone(each.author)]
    return _newest_of_few(others, now_ns) | _newest_of_few(zones, now_ns)


def _newest_of_few(sets: Iterable[MarkSet], now_ns: int) -> dict[int, tuple[int, float, int]]:
    won: dict[int, tuple[int, float, int]] = {}
    for each in sets:
        if not each.kinds:
            continue
        paces: Sequence[float] = memoryview(each.paces).cast("f").tolist()
        if max(each.kinds) != _PACE:
            paces = [0.0 if kind else pace for kind, pace in zip(each.kinds, paces, strict=True)]
        stated = zip(each.kinds, paces, memoryview(each.stamps_ns).cast("q").tolist(), strict=True)
        listed: Iterable[tuple[int, tuple[int, float, int]]]
        listed = zip(memoryview(each.cells).cast("H").tolist(), stated, strict=True)
        if each.untils_ns:
            untils_ns = memoryview(each.untils_ns).cast("q").tolist()
            listed = (one for one, until_ns in zip(listed, untils_ns, strict=True) if until_ns > now_ns)
        if won:
            for cell, one in listed:
                held = won.get(cell)
                if held is None or one[2] >= held[2]:  # on a tie the later set, of the larger author
                    won[cell] = one
        else:
            won = dict(listed)
    return won


# --- many statements, as arrays ---------------------------------------------------------------------------------


class _Placed(NamedTuple):
    """Columns of statements about cells of several tiles.

    places  int32  number of the tile's change * TILE_AREA + cell in the tile; increasing, once resolved
    zones   bool   the statement is an operator's
    """

    places: NDArray[np.int32]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]
    stamps_ns: NDArray[np.int64]
    zones: NDArray[np.bool_]

    def taken(self, where: NDArray[np.intp] | NDArray[np.bool_]) -> _Placed:
        return _Placed._make(each[where] for each in self)


def _winners(sets: Sequence[tuple[int, MarkSet]], now_ns: int) -> _Placed:
    """The winners of each (change, cell). `sets` are in increasing order of change, then of author."""
    stated = _placed(sets, now_ns)
    places = stated.places
    if (places[1:] > places[:-1]).all():
        return stated  # no cell is disputed, as in nearly all traffic: nothing to sort
    # Stable: on a tie the larger author stays behind.
    order = np.lexsort((stated.stamps_ns, stated.zones, places))
    places = places[order]
    return stated.taken(order[np.append(places[1:] != places[:-1], True)])


def _placed(sets: Sequence[tuple[int, MarkSet]], now_ns: int) -> _Placed:
    """The statements of all sets that have not expired, one set after the other."""
    of = [each for _, each in sets]
    kinds = column(b"".join([each.kinds for each in of]), "<u1")
    paces = column(b"".join([each.paces for each in of]), "<f4")
    stamps_ns = column(b"".join([each.stamps_ns for each in of]), "<i8")
    cells = column(b"".join([each.cells for each in of]), "<u2")
    numbers = np.array([number for number, _ in sets], np.int32)
    counts = [len(each.kinds) for each in of]
    places = np.repeat(numbers << _AREA_BITS, counts)
    places += cells
    zones = np.repeat([is_zone(each.author) for each in of], counts) if of else np.zeros(0, bool)
    if kinds.any():
        paces = np.where(kinds == _PACE, paces, np.float32(0))
    stated = _Placed(places, kinds, paces, stamps_ns, zones)
    if not any([each.untils_ns for each in of]):  # noqa: C419 - twice as fast as a generator
        return stated
    forever = np.int64(FOREVER).tobytes()
    untils_ns = column(b"".join([each.untils_ns or forever * len(each.kinds) for each in of]), "<i8")
    return stated.taken(untils_ns > now_ns)


def _changed(before: _Placed, after: _Placed) -> _Placed:
    """Those of `after` that differ from `before` in kind or pace, and CLEAR for cells that only `before` has."""
    if not len(before.places):
        stated = after.kinds != _CLEAR
        return after if stated.all() else after.taken(stated)
    at = np.searchsorted(before.places, after.places)
    at[at == len(before.places)] = 0
    known = before.places[at] == after.places
    differs = after.kinds != _CLEAR
    were = at[known]
    differs[known] = (after.kinds[known] != before.kinds[were]) | (after.paces[known] != before.paces[were])
    changed = after.taken(differs)
    gone = before.kinds != _CLEAR
    gone[were] = False
    if not gone.any():
        return changed
    cleared = before.taken(gone)
    cleared.kinds[:], cleared.paces[:], cleared.stamps_ns[:] = _CLEAR, 0, NO_STATEMENT
    return _Placed._make(np.concatenate([changed[n], cleared[n]]) for n in range(len(changed)))


_CLEAR = int(MarkKind.CLEAR)
_PACE = int(MarkKind.PACE)
_AREA_BITS = TILE_AREA.bit_length() - 1
_FEW = 128
"""Up to this number of marks, before and after together, lists are faster than arrays."""
_NOTHING = (_CLEAR, 0.0, NO_STATEMENT)
_TYPES = (np.uint32, np.uint8, np.float32, np.int64)
"""Types of the columns of `NewWinners`."""
