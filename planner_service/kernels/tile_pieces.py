"""A tree cut into pieces at the borders of tiles: what it consists of, and what its cells cost inside a tile.

When the root of a tree moves a cell, nearly all cells keep their parent, and the costs of whole trunks change by
one number each. The map is therefore partitioned into tiles of `SIDE` x `SIDE` cells. All cells of a tile whose
ways leave it over the same cell, the *exit*, are a *piece*. A cell's cost is the total of its piece (from the
exit to the root) plus its offset (from the cell to the exit). The piece that an exit leads into is its *successor*.
A move evaluates the totals, some 2 % of the cells; what a cell costs inside its tile changes only where parents do.

A piece is named by where on the tile's border its exit is, 0..251, or `ROOT_PIECE`; so the name stays when the
tile changes. Costs are float64: stated costs are those driven, and all comparisons are of sums that differ by a few
units in the last place. Tiles are numbered row by row, `across` in a row; n is the number of tiles.

A move or a change of the map, step by step:
1. `tile_search.merge_parents` takes over parents of a window, `cut_parents` takes parents away.
2. `relabel_tiles` labels again the tiles in which a parent has changed.
3. `piece_totals.evaluate_totals` adds up what each piece costs, along successors.
4. `piece_totals.queue_checks` finds the tiles in which a cell may be offered less than it costs by now.
5. `tile_search.improve_tiles` improves these, and begins again at 3 until there are none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner_service.kernels.decorators import helper, kernel, type_of
from planner_service.kernels.layout import (
    GRID,
    NONE,
    RULE_OCTILE,
    SQRT2_EXACT,
    ByteRows,
    Bytes,
    DoubleRows,
    Doubles,
    Floats,
    IntRows,
    Ints,
    LongRows,
    Longs,
    Shorts,
    step_offsets,
)

BITS = 6
SIDE = 1 << BITS
"""Cells of a tile's side: a tile with all that belongs to it stays in a core's own cache."""
WIDE = SIDE + 2
"""Side of a tile with one cell around it."""
CELLS = SIDE * SIDE
PIECES = 256
"""Pieces that a tile may have, one for each cell of its border and one of the root; names fit a byte."""
INSIDE = SIDE - 1
"""Bits of a row or column within its tile."""
TOTAL, BEFORE, OFFSET = range(3)
"""Columns of `Tree.total`."""
SUCCESSOR, STAMP = 6, 7
"""Columns of `Tree.successor`."""

ROOT_PIECE = np.uint8(252)
"""Name of the piece of the root: the first behind the 252 cells of a tile's border."""
NO_PIECE = np.uint8(255)
"""Name of the piece of a cell without a path."""

CHECK, RELINK, RELINK_INTO, CUT_OFF, RECHECK, CHECKED_CUT_OFF, RECONNECTED = (
    np.uint8(1 << bit) for bit in range(7)
)
"""Bits of `Tiles.wanted`, pending work or known facts of a tile:

CHECK            it may hold a cell that is offered less than it costs
RELINK           its pieces may have another successor, or another way to it
RELINK_INTO      those of its pieces may that lead into a tile with `RELINK`
CUT_OFF          it has pieces without a path to the root
RECHECK          it is to be checked as long as it has
CHECKED_CUT_OFF  it was checked while it or a tile about it had
RECONNECTED      a piece of it has found a way; said while changes are noted
"""
LINKING, SUMMING, CHANGED, NOTED, NEARBY, CHECKING = range(6)
"""Work queues, rows of `Schedule.sets`: tiles whose pieces are to be linked to successors; whose totals are to be
added up; whose totals have changed; have, and are so noted; about which something has changed; which are to be
checked."""
COSTLIER, ALTERED = np.uint8(1), np.uint8(2)
"""Kinds of change in a tile: cells got more expensive, or lost their path; or any other change, perhaps that
too."""
FINEST = 2.0**-46
"""Fraction of a cell's own cost: offers that are less by a smaller difference are not taken. Sums of the same
numbers in another order differ by a 32nd of it; all are sums of positive numbers, so this holds for any ratio of
costs."""
KEPT = 1.0 - FINEST
"""Fraction of a cell's cost: an offer below it is taken."""
MOST_SLACK = 8 * FINEST
"""Fraction of a cell's own cost: no cell of an exact tree is offered less than it costs by more than this. It holds
`FINEST`, what `piece_totals` leaves unchecked, and the rounding of sums."""


class Tree(NamedTuple):
    """Parent of each cell, and cost of each piece."""

    parent: Bytes
    """(size,) padded; direction of the next cell, NONE at the root and where there is no path."""
    piece: Bytes
    """(n * CELLS,) of each cell, tile by tile, the rows of one behind each other; NO_PIECE where there is no path,
    and beyond the grid."""
    rim: Doubles
    """(n * PIECES,) s; from each cell on the border of a tile to its piece's exit, by the name that a piece has
    whose exit it is. The cost of cells inside follows from the parents."""
    total: DoubleRows
    """(n * PIECES, 4) s; of each piece: TOTAL, from its exit to the root, inf of NO_PIECE and without a path;
    BEFORE, its value before the last evaluation that has changed a total of its tile, and without a path, less than
    0, its value when it had one; OFFSET, from its exit to the exit of its successor."""
    successor: IntRows
    """(n * PIECES, 8) the same memory, for what of a piece is used together to lie together: SUCCESSOR, the piece
    that its exit leads into, -1 at the root; STAMP, the evaluation by which TOTAL is right."""
    root: int
    """Padded cell."""


class Tiles(NamedTuple):
    """State of each tile."""

    exits: Bytes
    """(n * PIECES,) names of the pieces that a tile has, as many as `many` says."""
    many: Ints
    """(n,)"""
    wanted: Bytes
    """(n,) pending work on a tile before the tree is right again: `CHECK` and others."""
    falls: DoubleRows
    """(3, n) s; the least and the greatest change of a piece's total while these are noted, else 0, or inf and -inf
    without a piece; and the largest amount by which all changes since its tile was checked may lower an offer to a
    cell."""
    ends: DoubleRows
    """(2, n) s; the least and the greatest total of a tile; inf and 0 if there is none."""
    across: int
    """Tiles in a row of them."""


class Scratch(NamedTuple):
    """One tile with one cell around: WIDE ** 2 cells, of which all arrays are whose shape is (w,)."""

    border: Shorts
    """(PIECES,) of each name, the cell of a tile."""
    cost: Doubles
    """(w,) s; what a cell costs."""
    own: Doubles
    """(w,) s; cell costs."""
    inner: Doubles
    """(w,) s; offset of each cell; 0 around the tile."""
    least: Doubles
    """(w,) s; the least that a cell is offered, from the first cell of the tile on."""
    queue: Ints
    """(w,) cells; while costs spread, the items of a heap."""
    keys: Floats
    """(w,) s; of the heap."""
    code: Bytes
    """(w,) parents; NONE around the tile."""
    name: Bytes
    """(w,) pieces."""
    around: Longs
    """(8,) what each direction adds to a cell of these arrays."""
    kept: Doubles
    """(m * CELLS,) s; offsets of the tiles that were worked on last, m of them at most: of all tiles of a large
    map, it would be most of a tree's memory."""
    place: Ints
    """(n,) where in `kept` a tile is; -1 if it is not."""
    holder: Ints
    """(m + 1,) which tile is in each place, -1 if none; behind, the place that goes next."""
    spot: Ints
    """(w,) where in the heap a cell is; -1 between calls."""


class Schedule(NamedTuple):
    """In which order tiles are worked on, and which of them are still to be."""

    order: Longs
    """(n,) all tiles, those nearest the root first."""
    place: Longs
    """(n,) where in the order each tile is."""
    turn: Doubles
    """(n,) of tiles beside each other the one with the least is checked first."""
    now: int
    """A number that it never was, where most totals are expected to have changed; 0 elsewhere."""
    stack: Ints
    """(n * PIECES,) scratch."""
    sets: ByteRows
    """(6, k) whether a tile is in `LINKING` and others, by its place; k is n or a few more."""
    words: LongRows
    """(6, k / 8) the same memory, so that empty entries are skipped by eight."""


TREE, TILES, SCRATCH, SCHEDULE = (type_of(each) for each in (Tree, Tiles, Scratch, Schedule))


def make_scratch(tiles: int, most: int) -> Scratch:
    """Makes the scratch for a map of `tiles` tiles, with offsets for a bounded number of them."""
    tile = np.arange(CELLS, dtype=np.int16).reshape(SIDE, SIDE)
    border = np.zeros(PIECES, np.int16)
    border[: 4 * SIDE - 4] = np.concatenate((tile[0], tile[-1], tile[1:-1, 0], tile[1:-1, -1]))
    size, places = WIDE * WIDE, min(tiles, most)
    return Scratch(
        border=border,
        cost=np.full(size, np.inf),
        own=np.full(size, np.inf),
        inner=np.zeros(size),
        least=np.zeros(size),
        queue=np.empty(size, np.int32),
        keys=np.zeros(size, np.float32),
        code=np.full(size, NONE),
        name=np.full(size, NO_PIECE),
        around=step_offsets(WIDE),
        kept=np.empty(places * CELLS),
        place=np.full(tiles, -1, np.int32),
        holder=np.append(np.full(places, -1), 0).astype(np.int32),
        spot=np.full(size, -1, np.int32),
    )


def make_totals(tiles: int) -> tuple[DoubleRows, IntRows]:
    """Returns (total, successor) of `tiles` tiles without a piece."""
    total = np.full((tiles * PIECES, 4), np.inf)
    successor = total.view(np.int32)
    successor[:, SUCCESSOR], successor[:, STAMP] = -1, 0
    return total, successor


@helper
def step_cost(rule, own, code):
    """float64, s: a step in this direction into a cell whose cell cost is `own`."""
    return np.float64(own) * (SQRT2_EXACT if code & 1 and rule == RULE_OCTILE else 1.0)


@helper
def border_index(cell):
    """Returns the index of the piece whose exit is this cell on the border of a tile."""
    row, col = cell >> BITS, cell & INSIDE
    if row == 0:
        return col
    if row == SIDE - 1:
        return SIDE + col
    return (2 * SIDE if col == 0 else 3 * SIDE - 2) + row - 1


@helper
def in_scratch(cell):
    """A cell of a tile on the scratch."""
    return ((cell >> BITS) + 1) * WIDE + (cell & INSIDE) + 1


@helper
def corner_of(grid, across, t):
    """(padded cell of a tile's first cell, rows, cols that lie on the grid)."""
    stride = grid[2]
    row, col = t // across * SIDE, t % across * SIDE
    rows = grid[0].size // stride - 2
    return (row + 1) * stride + col + 1, min(SIDE, rows - row), min(SIDE, stride - 2 - col)


@helper
def tile_of(v, stride, across):
    """(tile, cell of it) of a padded cell."""
    row, col = v // stride - 1, v % stride - 1
    return (row >> BITS) * across + (col >> BITS), ((row & INSIDE) << BITS) + (col & INSIDE)


@helper
def step_of(code):
    """(rows, cols) that a step goes."""
    row = -1 if code == 7 or code <= 1 else (1 if 3 <= code <= 5 else 0)
    return row, 1 if 1 <= code <= 3 else (-1 if code >= 5 else 0)


@helper
def cell_behind(across, t, cell, code):
    """(tile, cell of it) where a step from a cell of a tile leads."""
    down, right = step_of(code)
    row, col = (cell >> BITS) + down, (cell & INSIDE) + right
    return t + (row >> BITS) * across + (col >> BITS), ((row & INSIDE) << BITS) + (col & INSIDE)


@helper
def next_in(which, n, sets, words):
    """The first place from `n` on that is in a set, or one beyond all."""
    while n < sets.shape[1]:
        if n & 7 == 0 and words[which, n >> 3] == 0:
            n += 8
        elif sets[which, n]:
            return n
        else:
            n += 1
    return n


@helper
def rows_about(t, across, tiles):
    """(row0, col0, row1, col1) of a tile and those about it; row1 and col1 lie outside.

    tiles  how many there are in all
    """
    row, col = t // across, t % across
    return max(row - 1, 0), max(col - 1, 0), min(row + 2, tiles // across), min(col + 2, across)


@helper
def push_around(which, t, across, place, sets):
    """Puts a tile and those about it into a set."""
    row0, col0, row1, col1 = rows_about(t, across, place.size)
    for row in range(row0, row1):
        for other in range(row * across + col0, row * across + col1):
            sets[which, place[other]] = 1


@helper
def _copy_rows(source, first, source_stride, rows, cols, target, at, target_stride):
    """Copies rows of cells, from `first` on, to `at` and below. Vectorises."""
    for row in range(rows):
        i, j = np.uint64(first + row * source_stride), np.uint64(at + row * target_stride)
        for col in range(np.uint64(cols)):
            target[j + col] = source[i + col]


@helper
def _load_own(t, grid, across, scratch):
    """Puts cell costs of a tile on the scratch."""
    own = scratch.own
    origin, rows, cols = corner_of(grid, across, t)
    if rows < SIDE or cols < SIDE:
        for i in range(own.size):
            own[i] = np.inf
    _copy_rows(grid[0], origin, grid[2], rows, cols, own, WIDE + 1, WIDE)


@helper
def _load_parents(t, grid, tree, across, scratch):
    """Puts the parents of a tile on the scratch. The costs of its cells inside it are less than 0 until known, and
    they have no piece."""
    stride, parent = grid[2], tree.parent
    inner, code, name = scratch.inner, scratch.code, scratch.name
    origin, rows, cols = corner_of(grid, across, t)
    if rows < SIDE or cols < SIDE:
        for i in range(inner.size):
            inner[i] = 0.0
            code[i] = NONE
            name[i] = NO_PIECE
    for row in range(rows):
        g, at = np.uint64(origin + row * stride), np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(cols)):
            code[at + col] = parent[g + col]
            name[at + col] = NO_PIECE
        for col in range(np.uint64(cols)):
            inner[at + col] = 0.0 if parent[g + col] == NONE else -1.0


@helper
def _follow(t, grid, across, scratch):
    """Costs inside a tile, and names, of all cells on the scratch by their parents, where those of its exits are
    known."""
    rule = grid[3]
    own, inner, queue, code, name, around = (
        scratch.own,
        scratch.inner,
        scratch.queue,
        scratch.code,
        scratch.name,
        scratch.around,
    )
    _, rows, cols = corner_of(grid, across, t)
    for row in range(rows):
        for col in range(cols):
            at = (row + 1) * WIDE + col + 1
            steps = 0
            while inner[at] < 0.0:
                queue[steps] = at
                steps += 1
                at += around[code[at]]
            for i in range(steps - 1, -1, -1):
                u = at
                at = np.int64(queue[i])
                inner[at] = inner[u] + step_cost(rule, own[u], np.int64(code[at]))
                name[at] = name[u]


@helper
def load_offsets(t, grid, tree, tiles, scratch):
    """Puts cell costs of a tile on the scratch, and what each cell costs inside it."""
    exits, many, across = tiles.exits, tiles.many, tiles.across
    names, inner, kept, place = scratch.border, scratch.inner, scratch.kept, scratch.place
    _load_own(t, grid, across, scratch)
    if place[t] >= 0:
        _copy_rows(kept, np.int64(place[t]) * CELLS, SIDE, SIDE, SIDE, inner, WIDE + 1, WIDE)
        return
    _load_parents(t, grid, tree, across, scratch)
    for j in range(many[t]):
        name = exits[t * PIECES + j]
        if name != ROOT_PIECE:  # which has no parent
            inner[in_scratch(np.int64(names[name]))] = 0.0
    _follow(t, grid, across, scratch)
    _cache_offsets(t, scratch)


@helper
def _cache_offsets(t, scratch):
    """Keeps what the cells of a tile cost inside it, from the scratch, in the place of another tile where all
    places are taken: of the one that has had its place for longest."""
    inner, kept, place, holder = scratch.inner, scratch.kept, scratch.place, scratch.holder
    if place[t] < 0:
        next = holder[holder.size - 1]
        if holder[next] >= 0:
            place[holder[next]] = -1
        holder[next] = t
        place[t] = next
        holder[holder.size - 1] = next + 1 if next + 2 < holder.size else 0
    _copy_rows(inner, WIDE + 1, WIDE, SIDE, SIDE, kept, np.int64(place[t]) * CELLS, SIDE)


@helper
def store_offsets(t, tree, scratch):
    """Keeps what the cells of a tile cost inside it, from the scratch: those on its border for good."""
    rim = tree.rim
    names, inner = scratch.border, scratch.inner
    for each in range(4 * SIDE - 4):
        rim[t * PIECES + each] = inner[in_scratch(np.int64(names[each]))]
    _cache_offsets(t, scratch)


@helper
def relabel_tile(t, grid, tree, tiles, scratch):
    """Writes which piece each cell of a tile is of, and what it costs inside the tile, by the parents. Cells behind
    one that has no parent have no path."""
    piece, root = tree.piece, tree.root
    exits, many, across = tiles.exits, tiles.many, tiles.across
    names, inner, code, name = scratch.border, scratch.inner, scratch.code, scratch.name
    _load_own(t, grid, across, scratch)
    _load_parents(t, grid, tree, across, scratch)
    count = 0
    home, cell = tile_of(root, grid[2], across)
    if home == t:
        at = in_scratch(cell)
        name[at] = ROOT_PIECE
        inner[at] = 0.0
        exits[t * PIECES] = ROOT_PIECE
        count = 1
    for each in range(4 * SIDE - 4):
        cell = np.int64(names[each])
        at = in_scratch(cell)
        way = code[at]
        if way == NONE:
            continue
        other, _ = cell_behind(across, t, cell, way)
        if other != t:
            name[at] = each
            inner[at] = 0.0
            exits[t * PIECES + count] = each
            count += 1
    many[t] = count
    _follow(t, grid, across, scratch)
    _copy_rows(name, WIDE + 1, WIDE, SIDE, SIDE, piece, t * CELLS, SIDE)
    store_offsets(t, tree, scratch)


@helper
def request_around(tiles, t, what):
    """Asks something of a tile, and of those about it."""
    wanted, across = tiles.wanted, tiles.across
    row0, col0, row1, col1 = rows_about(t, across, wanted.size)
    for row in range(row0, row1):
        for other in range(row * across + col0, row * across + col1):
            wanted[other] |= what


@kernel(GRID, TREE, TILES, SCRATCH, "i8[::1]", "u1[::1]")
def relabel_tiles(grid, tree, tiles, scratch, which, changed):
    """Labels these tiles again, whose parents or cell costs have changed, and schedules a check of them. Tiles
    about them are checked, too, unless cells only got more expensive (`changed` is `COSTLIER`, uint8 (n,)): that
    lowers no offer, and a piece that leads there sees its totals rise."""
    wanted = tiles.wanted
    for i in range(which.size):
        t = which[i]
        relabel_tile(t, grid, tree, tiles, scratch)
        request_around(tiles, t, RELINK_INTO if changed[t] == COSTLIER else CHECK | RELINK_INTO)
        wanted[t] |= CHECK | RELINK
