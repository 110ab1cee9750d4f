"""A tree cut into pieces at the borders of tiles: what it consists of.

When the root of a tree moves a cell, nearly all cells keep their parent, and the costs of whole trunks change by
one number each. So the map is cut into tiles of `SIDE` x `SIDE` cells. All cells of a tile whose ways leave it over
the same cell, the *exit*, are a *piece*. A cell's cost is the piece's total, of its exit, and what it costs to go
from the cell to the exit. A move evaluates the totals, some 2 % of the cells; what a cell costs inside its tile
changes only where parents do.

A piece is named by where on the tile's border its exit is, 0..251, or `ROOT_PIECE`; so names last. Costs are
float64: what is stated is what is driven, and all comparisons are of sums that differ by a few units in the last
place.

Arrays, beside those of `layout`; tiles are numbered row by row, `across` in a row; n is their number:
    piece    uint8    (n * CELLS,)  of each cell, tile by tile, the rows of one behind each other; NO_PIECE where
                                    there is no way, and beyond the grid
    rim      float64  (n * ROOM,)   s; from each cell on the border of a tile to its piece's exit, by the name that
                                    a piece has whose exit it is. What cells inside cost follows from the parents
    total    float64  (n * ROOM, 4) s; of each piece, ROOM names a tile: TOTAL, from its exit to the root, inf of
                                    NO_PIECE and where there is no way; BEFORE, what that was before the last
                                    evaluation that has changed a total of its tile, and where it had no way, less
                                    than 0, what it was when it had one; LENGTH, from its exit to the next piece's
    hook     int32    (n * ROOM, 8) the same memory, for what of a piece is used together to lie together: HOOK, the
                                    piece that its exit leads into, -1 at the root; STAMP, the evaluation by which
                                    TOTAL is right
    exits    uint8    (n * ROOM,)   names of the pieces that a tile has, as many as `many` says
    many     int32    (n,)
    span     float64  (n,)          s; no cell of a tile costs more inside it
    wanted   uint8    (n,)          what is to be done to a tile before the tree is right again: `LOOK` and others
    falls    float64  (3, n)        s; the least and the greatest change of a piece's total while these are noted,
                                    else 0, or inf and -inf where there is no piece; and how much less a cell may be
                                    offered by all changes since its tile was looked at
    ends     float64  (2, n)        s; the least and the greatest total of a tile; inf and 0 if there is none

While a tree is mended, tiles are taken in an order:
    order    int64    (n,)          all tiles, those nearest the root first
    place    int64    (n,)          where in the order each tile is
    stack    int32    (n * ROOM,)   scratch
    sets     uint8    (6, m)        whether a tile is in `HOOKS` and others, by its place; m is n or a few more
    words    int64    (6, m / 8)    the same memory, so that what is empty is passed over by eight

A tile is worked on with one cell around, WIDE ** 2 cells that are called its bench, which is scratch:
    names    int16    (ROOM,)       of each name, the cell of a tile
    cost     float64  (WIDE ** 2,)  s; what a cell costs
    own      float64  (WIDE ** 2,)  s; cell costs
    inner    float64  (WIDE ** 2,)  s; from each cell to its piece's exit; 0 around the tile
    kept     float64  (m * CELLS,)  s; the same of the tiles that were worked on last, m of them at most: of all
                                    tiles of a large map, it would be most of a tree's memory
    place    int32    (n,)          where in `kept` a tile is; -1 if it is not
    holder   int32    (m + 1,)      which tile is in each place, -1 if none; behind, the place that goes next
    less     int32    (WIDE ** 2,)  whether a cell is offered less
    queue    int32    (WIDE ** 2,)  cells; while costs spread, the items of a `kernels.heap`
    keys     float32  (WIDE ** 2,)  s; of the heap
    spot     int32    (WIDE ** 2,)  where in the heap a cell is; -1 between calls
    code     uint8    (WIDE ** 2,)  parents; NONE around the tile
    name     uint8    (WIDE ** 2,)  pieces
    around   int64    (8,)          what each direction adds to a cell of these arrays
    changes  float64  (16,)         s; different changes of totals of a tile
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.compile import helper
from planner_service.kernels.layout import NONE, RULE_OCTILE, SQRT2_EXACT, step_offsets

BITS = 6
SIDE = 1 << BITS
WIDE = SIDE + 2
CELLS = SIDE * SIDE
ROOM = 256
INSIDE = SIDE - 1
TOTAL, BEFORE, LENGTH = range(3)
HOOK, STAMP = 6, 7
"""Columns of `total` and `hook`."""

ROOT_PIECE = np.uint8(252)
NO_PIECE = np.uint8(255)

LOOK, REHOOK, LED, LOST, SEEK, BLIND, FOUND = (np.uint8(1 << bit) for bit in range(7))
"""What is wanted or known of a tile: it is to be looked at; its pieces may lead elsewhere, or be longer; those of
them may that lead into a tile with `REHOOK`; it has pieces without a way; it is to be looked at as long as it has;
it was looked at while it or a tile about it had; a piece of it has found a way, which is said while changes are
noted."""
HOOKS, WAITS, CHANGED, NOTED, NEAR, TODO = range(6)
"""Sets of tiles: whose pieces may lead elsewhere; whose totals are to be added up; whose totals have changed; have,
and are so noted; about which something has changed; which are to be looked at."""
DEARER, ALTERED = np.uint8(1), np.uint8(2)
"""What has changed in a tile: cells got dearer, or lost their way; or anything else, perhaps that too."""
FINEST = 2.0**-46
"""Of a cost: what is offered less than by this is not taken. Sums of the same numbers in another order differ by a
32nd of it; it keeps costs within so much a step of the optimum."""
MOST_SLACK = 8 * FINEST
"""Of the farthest cost: no cell of an exact tree is offered less than it costs by more than this. It holds both of
these and the rounding of sums."""

Cells = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64], int]
"""(parent, piece, rim, root), root a padded cell."""
Pieces = tuple[NDArray[np.float64], NDArray[np.int32]]
"""(total, hook)."""
Tiles = tuple[
    NDArray[np.uint8],
    NDArray[np.int32],
    NDArray[np.float64],
    NDArray[np.uint8],
    NDArray[np.float64],
    NDArray[np.float64],
    int,
]
"""(exits, many, span, wanted, falls, ends, across)."""
Bench = tuple[
    NDArray[np.int16],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.float32],
    NDArray[np.uint8],
    NDArray[np.uint8],
    NDArray[np.int64],
    NDArray[np.float64],
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.float64],
]
"""(names, cost, own, inner, less, queue, keys, code, name, around, kept, place, holder, spot, changes)."""

Sets = tuple[NDArray[np.uint8], NDArray[np.int64]]
"""(sets, words)."""
Turns = tuple[
    NDArray[np.int64],
    NDArray[np.int64],
    NDArray[np.float64],
    int,
    NDArray[np.int32],
    NDArray[np.uint8],
    NDArray[np.int64],
]
"""(order, place, turn, now, stack, sets, words)."""

LABELLED = "Tuple((u1[::1], u1[::1], f8[::1], i8))"
PIECES = "Tuple((f8[:, ::1], i4[:, ::1]))"
TURNS = "Tuple((i8[::1], i8[::1], f8[::1], i4, i4[::1], u1[:, ::1], i8[:, ::1]))"
TILES = "Tuple((u1[::1], i4[::1], f8[::1], u1[::1], f8[:, ::1], f8[:, ::1], i8))"
_SCRATCH = "i2[::1], f8[::1], f8[::1], f8[::1], i4[::1], i4[::1], f4[::1], u1[::1], u1[::1], i8[::1]"
BENCH = f"Tuple(({_SCRATCH}, f8[::1], i4[::1], i4[::1], i4[::1], f8[::1]))"


def make_bench(tiles: int, most: int) -> Bench:
    """Of a map of so many tiles, of which costs inside are kept for so many at most."""
    tile = np.arange(CELLS, dtype=np.int16).reshape(SIDE, SIDE)
    names = np.zeros(ROOM, np.int16)
    names[: 4 * SIDE - 4] = np.concatenate((tile[0], tile[-1], tile[1:-1, 0], tile[1:-1, -1]))
    size, places = WIDE * WIDE, min(tiles, most)
    return (
        *(names, np.full(size, np.inf), np.full(size, np.inf), np.zeros(size)),
        *(np.zeros(size, np.int32), np.empty(size, np.int32)),
        *(np.zeros(size, np.float32), np.full(size, NONE), np.full(size, NO_PIECE), step_offsets(WIDE)),
        *(
            np.empty(places * CELLS),
            np.full(tiles, -1, np.int32),
            np.append(np.full(places, -1), 0).astype(np.int32),
            np.full(size, -1, np.int32),
            np.zeros(16),
        ),
    )


def make_sets(tiles: int) -> Sets:
    """(sets, words) of so many tiles, all empty."""
    words = np.zeros((6, -(-tiles // 8)), np.int64)
    return words.view(np.uint8), words


def make_pieces(tiles: int) -> Pieces:
    """(total, hook) of so many tiles without a piece."""
    total = np.full((tiles * ROOM, 4), np.inf)
    hook = total.view(np.int32)
    hook[:, HOOK], hook[:, STAMP] = -1, 0
    return total, hook


@helper
def step_cost(rule, own, code):
    """float64, s: a step in this direction into a cell whose cell cost is `own`."""
    return np.float64(own) * (SQRT2_EXACT if code & 1 and rule == RULE_OCTILE else 1.0)


@helper
def name_of(cell):
    """Of the piece whose exit is this cell on the border of a tile."""
    row, col = cell >> BITS, cell & INSIDE
    if row == 0:
        return col
    if row == SIDE - 1:
        return SIDE + col
    return (2 * SIDE if col == 0 else 3 * SIDE - 2) + row - 1


@helper
def on_bench(cell):
    """A cell of a tile on the bench."""
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
def moved(code):
    """(rows, cols) that a step goes."""
    row = -1 if code == 7 or code <= 1 else (1 if 3 <= code <= 5 else 0)
    return row, 1 if 1 <= code <= 3 else (-1 if code >= 5 else 0)


@helper
def where_to(across, t, cell, code):
    """(tile, cell of it) where a step from a cell of a tile leads."""
    down, right = moved(code)
    row, col = (cell >> BITS) + down, (cell & INSIDE) + right
    return t + (row >> BITS) * across + (col >> BITS), ((row & INSIDE) << BITS) + (col & INSIDE)


@helper
def following(which, n, sets, words):
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
def put_about(which, t, across, place, sets):
    """Put a tile and those about it into a set."""
    row, col = t // across, t % across
    down = place.size // across
    for i in range(max(row - 1, 0), min(row + 2, down)):
        for j in range(max(col - 1, 0), min(col + 2, across)):
            sets[which, place[i * across + j]] = 1
