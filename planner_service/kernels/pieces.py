"""A tree cut into pieces at the borders of tiles: labelled, measured, read.

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
    local    float64  (n * CELLS,)  s; from each cell to its piece's exit
    total    float64  (n * ROOM, 4) s; of each piece, ROOM names a tile: TOTAL, from its exit to the root, inf of
                                    NO_PIECE and where there is no way; BEFORE, what that was by the last
                                    evaluation; LENGTH, from its exit to the next piece's
    hook     int32    (n * ROOM, 8) the same memory, for what of a piece is used together to lie together: HOOK, the
                                    piece that its exit leads into, -1 at the root; STAMP, the evaluation by which
                                    TOTAL is right
    exits    uint8    (n * ROOM,)   names of the pieces that a tile has, as many as `many` says
    many     int32    (n,)
    span     float64  (n,)          s; no cell of a tile costs more inside it
    wanted   uint8    (n,)          LOOK, REHOOK or both: what is to be done to a tile before the tree is right
                                    again
    falls    float64  (3, n)        s; the least and the greatest change of a piece's total in the last evaluation,
                                    and how much less a cell may be offered by all changes since its tile was looked
                                    at
    ends     float64  (2, n)        s; the least and the greatest total of a tile; inf and 0 if there is none
    stack    int32    (n * ROOM,)   scratch

A tile is worked on with one cell around, WIDE ** 2 cells that are called its bench, which is scratch:
    names    int16    (ROOM,)       of each name, the cell of a tile
    cost     float64  (WIDE ** 2,)  s; what a cell costs
    own      float64  (WIDE ** 2,)  s; cell costs
    less     int32    (WIDE ** 2,)  whether a cell is offered less
    queue    int32    (WIDE ** 2,)  cells; while costs spread, the items of a `kernels.heap`
    keys     float32  (WIDE ** 2,)  s; of the heap
    place    int32    (WIDE ** 2,)  of the heap; -1 between calls
    code     uint8    (WIDE ** 2,)  parents; NONE around the tile
    name     uint8    (WIDE ** 2,)  pieces
    around   int64    (8,)          what each direction adds to a cell of these arrays
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.layout import GRID, NONE, RULE_OCTILE, SQRT2_EXACT, check_cells, step_offsets

BITS = 6
SIDE = 1 << BITS
WIDE = SIDE + 2
CELLS = SIDE * SIDE
ROOM = 256
_INSIDE = SIDE - 1
TOTAL, BEFORE, LENGTH = range(3)
HOOK, STAMP = 6, 7
"""Columns of `total` and `hook`."""

ROOT_PIECE = np.uint8(252)
NO_PIECE = np.uint8(255)

LOOK, REHOOK, _WAITS, _CHANGED = np.uint8(1), np.uint8(2), np.uint8(4), np.uint8(8)
FINEST = 2.0**-46
"""Of a cost: what is offered less than by this is not taken. Sums of the same numbers in another order differ by a
32nd of it; it keeps costs within so much a step of the optimum."""
_DRIFT = 4.0
"""How many times that a tile's totals may come apart before it is looked at."""
MOST_SLACK = 8 * FINEST
"""Of the farthest cost: no cell of an exact tree is offered less than it costs by more than this. It holds both of
these and the rounding of sums."""

Cells = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64], int]
"""(parent, piece, local, root), root a padded cell."""
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
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.float32],
    NDArray[np.int32],
    NDArray[np.uint8],
    NDArray[np.uint8],
    NDArray[np.int64],
]
"""(names, cost, own, less, queue, keys, place, code, name, around)."""

LABELLED = "Tuple((u1[::1], u1[::1], f8[::1], i8))"
PIECES = "Tuple((f8[:, ::1], i4[:, ::1]))"
TILES = "Tuple((u1[::1], i4[::1], f8[::1], u1[::1], f8[:, ::1], f8[:, ::1], i8))"
BENCH = "Tuple((i2[::1], f8[::1], f8[::1], i4[::1], i4[::1], f4[::1], i4[::1], u1[::1], u1[::1], i8[::1]))"


def make_bench() -> Bench:
    """(names, cost, own, less, queue, keys, place, code, name, around)."""
    tile = np.arange(CELLS, dtype=np.int16).reshape(SIDE, SIDE)
    names = np.zeros(ROOM, np.int16)
    names[: 4 * SIDE - 4] = np.concatenate((tile[0], tile[-1], tile[1:-1, 0], tile[1:-1, -1]))
    size = WIDE * WIDE
    return (
        *(names, np.full(size, np.inf), np.full(size, np.inf), np.zeros(size, np.int32), np.empty(size, np.int32)),
        *(
            np.zeros(size, np.float32),
            np.full(size, -1, np.int32),
            np.full(size, NONE),
            np.full(size, NO_PIECE),
            step_offsets(WIDE),
        ),
    )


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
    row, col = cell >> BITS, cell & _INSIDE
    if row == 0:
        return col
    if row == SIDE - 1:
        return SIDE + col
    return (2 * SIDE if col == 0 else 3 * SIDE - 2) + row - 1


@helper
def on_bench(cell):
    """A cell of a tile on the bench."""
    return ((cell >> BITS) + 1) * WIDE + (cell & _INSIDE) + 1


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
    return (row >> BITS) * across + (col >> BITS), ((row & _INSIDE) << BITS) + (col & _INSIDE)


@helper
def moved(code):
    """(rows, cols) that a step goes."""
    row = -1 if code == 7 or code <= 1 else (1 if 3 <= code <= 5 else 0)
    return row, 1 if 1 <= code <= 3 else (-1 if code >= 5 else 0)


@helper
def where_to(across, t, cell, code):
    """(tile, cell of it) where a step from a cell of a tile leads."""
    down, right = moved(code)
    row, col = (cell >> BITS) + down, (cell & _INSIDE) + right
    return t + (row >> BITS) * across + (col >> BITS), ((row & _INSIDE) << BITS) + (col & _INSIDE)


@helper
def relabel_tile(t, grid, labels, tiles, bench):
    """Write which piece each cell of a tile is of, and what it costs inside the tile, by the parents. Cells behind
    one that has no parent have no way. Breadth first from the exits, without a branch for each neighbour."""
    cell_cost, _, stride, rule, _ = grid
    parent, piece, local, root = labels
    exits, many, span, _, _, _, across = tiles
    names, cost, own, _, queue, _, _, code, name, around = bench
    origin, rows, cols = corner_of(grid, across, t)
    for row in range(SIDE):
        at = np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(SIDE)):
            code[at + col] = NONE
            name[at + col] = NO_PIECE
            cost[at + col] = 0.0
    for row in range(rows):
        g, at = np.uint64(origin + row * stride), np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(cols)):
            code[at + col] = parent[g + col]
            own[at + col] = cell_cost[g + col]
    count = 0
    home, cell = tile_of(root, stride, across)
    if home == t:
        at = on_bench(cell)
        name[at] = ROOT_PIECE
        queue[0] = at
        exits[t * ROOM] = ROOT_PIECE
        count = 1
    for each in range(4 * SIDE - 4):
        cell = np.int64(names[each])
        at = on_bench(cell)
        way = code[at]
        if way == NONE:
            continue
        other, _ = where_to(across, t, cell, way)
        if other != t:
            name[at] = each
            queue[count] = at
            exits[t * ROOM + count] = each
            count += 1
    many[t] = count
    first, last = 0, count
    while first < last:
        at = np.int64(queue[first])
        if first >= count:
            way = np.int64(code[at])
            u = at + around[way]
            name[at] = name[u]
            cost[at] = cost[u] + step_cost(rule, own[u], way)
        first += 1
        for way in range(8):
            v = at + around[way]
            queue[last] = v
            last += code[v] == (way + 4) & 7
    longest = 0.0
    for row in range(SIDE):
        i, at = np.uint64(t * CELLS + (row << BITS)), np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(SIDE)):
            piece[i + col] = name[at + col]
            local[i + col] = cost[at + col]
    for each in range(count, last):
        longest = max(longest, cost[queue[each]])
    span[t] = longest


@helper
def want(tiles, t, what):
    """Ask something of a tile, and of those about it."""
    across = tiles[6]
    wanted = tiles[3]
    row, col = t // across, t % across
    down = wanted.size // across
    for i in range(max(row - 1, 0), min(row + 2, down)):
        for j in range(max(col - 1, 0), min(col + 2, across)):
            wanted[i * across + j] |= what


@kernel(f"({GRID}, {LABELLED}, {TILES}, {BENCH}, i8[::1])")
def relabel_tiles(grid, labels, tiles, bench, which):
    """Label these tiles anew, whose parents or cell costs have changed, and have those about them looked at."""
    for i in range(which.size):
        relabel_tile(which[i], grid, labels, tiles, bench)
        want(tiles, which[i], LOOK | REHOOK)


@helper
def _hook_tile(t, grid, labels, pieces, tiles, names):
    """Write where the pieces of a tile lead, and how far that is."""
    cell_cost, offsets, stride, rule, _ = grid
    parent, piece, local, _ = labels
    total, hook = pieces
    exits, many, _, _, _, _, across = tiles
    origin, _, _ = corner_of(grid, across, t)
    for j in range(many[t]):
        name = np.int64(exits[t * ROOM + j])
        y = t * ROOM + name
        if name == ROOT_PIECE:
            hook[y, HOOK] = -1
            total[y, LENGTH] = 0.0
            continue
        cell = np.int64(names[name])
        v = origin + (cell >> BITS) * stride + (cell & _INSIDE)
        way = np.int64(parent[v])
        other, beside = where_to(across, t, cell, way)
        i = other * CELLS + beside
        hook[y, HOOK] = other * ROOM + np.int64(piece[i])
        total[y, LENGTH] = local[i] + step_cost(rule, cell_cost[v + offsets[way]], way)


@helper
def _add_up(t, pieces, tiles):
    """Totals of a tile := what its exits are offered. Returns whether one has changed."""
    total, hook = pieces
    exits, many = tiles[0], tiles[1]
    changed = False
    for j in range(many[t]):
        y = t * ROOM + np.int64(exits[t * ROOM + j])
        next = np.int64(hook[y, HOOK])
        cost = total[y, LENGTH] + (total[next, TOTAL] if next >= 0 else 0.0)
        changed |= cost != total[y, TOTAL]
        total[y, TOTAL] = cost
    return changed


@helper
def _add_up_all(pieces, tiles, order, now, stack):
    """The same for all tiles, each piece after the one that it leads into."""
    total, hook = pieces
    exits, many, _, wanted, _, _, _ = tiles
    for n in range(order.size):
        t = order[n]
        wanted[t] = (wanted[t] & LOOK) | _CHANGED
        for j in range(many[t]):
            y = t * ROOM + np.int64(exits[t * ROOM + j])
            steps = 0
            while y >= 0 and hook[y, STAMP] != now:
                stack[steps] = y
                steps += 1
                y = np.int64(hook[y, HOOK])
            cost = total[y, TOTAL] if y >= 0 else 0.0
            for i in range(steps - 1, -1, -1):
                y = np.int64(stack[i])
                cost += total[y, LENGTH]
                total[y, TOTAL] = cost
                hook[y, STAMP] = now


@helper
def _note_changes(t, pieces, tiles):
    """Write `falls` and `ends` of a tile whose totals have changed."""
    total = pieces[0]
    exits, many, _, _, falls, ends, _ = tiles
    least, most, near, far = np.inf, -np.inf, np.inf, 0.0
    for j in range(many[t]):
        y = t * ROOM + np.int64(exits[t * ROOM + j])
        cost = total[y, TOTAL]
        change = 0.0
        if cost < np.inf or total[y, BEFORE] < np.inf:
            change = cost - total[y, BEFORE]
        total[y, BEFORE] = cost
        least = min(least, change)
        most = max(most, change)
        near = min(near, cost)
        far = max(far, cost)
    falls[0, t] = least
    falls[1, t] = most
    ends[0, t] = near
    ends[1, t] = far


@kernel(f"({GRID}, {LABELLED}, {PIECES}, {TILES}, i2[::1], i8[::1], i4, i4[::1])")
def evaluate(grid, labels, pieces, tiles, names, order, now, stack):
    """Totals := what is driven from each exit to the root.

    order  all tiles, those nearest the root first
    now    0, or a number that `now` never was: most totals are expected to have changed, as when the root has moved
    If not, tiles about one whose totals have changed are added up, sweep by sweep. That takes a tenth of the time
    where few change; where all do, each tile of 4096 x 4096 cells would be added up 7 times. Either way it ends, as
    no piece leads to itself.
    """
    many, wanted = tiles[1], tiles[3]
    for t in range(many.size):
        if wanted[t] & REHOOK:
            _hook_tile(t, grid, labels, pieces, tiles, names)
            wanted[t] = (wanted[t] & ~REHOOK) | _WAITS | _CHANGED
    if now:
        _add_up_all(pieces, tiles, order, now, stack)
    again = not now
    while again:
        again = False
        for n in range(order.size):
            t = order[n]
            if not wanted[t] & _WAITS:
                continue
            wanted[t] &= ~_WAITS
            if _add_up(t, pieces, tiles):
                wanted[t] |= _CHANGED
                want(tiles, t, _WAITS)
                wanted[t] &= ~_WAITS
                again = True


@kernel(f"({PIECES}, {TILES}, i8[::1])")
def find_risen(pieces, tiles, todo):
    """Returns how many tiles are to be looked at, and writes them to `todo`: those where it is wanted, and where
    totals have risen by more than others about them since this was last called."""
    _, many, _, wanted, falls, ends, across = tiles
    down = many.size // across
    for t in range(many.size):
        falls[0, t], falls[1, t] = (0.0, 0.0) if many[t] else (np.inf, -np.inf)
        if wanted[t] & _CHANGED:
            wanted[t] &= ~_CHANGED
            _note_changes(t, pieces, tiles)
    count = 0
    for row in range(down):
        for col in range(across):
            t = row * across + col
            least = np.inf
            for i in range(max(row - 1, 0), min(row + 2, down)):
                for j in range(max(col - 1, 0), min(col + 2, across)):
                    least = min(least, falls[0, i * across + j])
            # Its own pieces have risen by no more than those about it that offer them less.
            if falls[1, t] > least:
                falls[2, t] += falls[1, t] - least
            near = ends[0, t] if ends[0, t] < np.inf else 0.0
            if wanted[t] & LOOK or falls[2, t] > _DRIFT * FINEST * near:
                todo[count] = t
                count += 1
    return count


@kernel(f"({GRID}, {LABELLED}, {PIECES}, i8, i8[::1], f8[::1])")
def costs_at(grid, labels, pieces, across, cells, costs):
    """costs := float64, s, of padded cells; inf where there is no way. Raises ValueError where one is no cell."""
    _, piece, local, _ = labels
    total = pieces[0]
    stride = grid[2]
    check_cells(cells, grid[0].size)
    for i in range(cells.size):
        t, cell = tile_of(cells[i], stride, across)
        costs[i] = total[t * ROOM + np.int64(piece[t * CELLS + cell]), TOTAL] + local[t * CELLS + cell]
