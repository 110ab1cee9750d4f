"""Makes a tree of `tile_pieces` exact again after its root has moved or the map has changed.

A cell is *offered less* where a neighbour's cost and the step to it are less than what it costs. Tiles that may
hold such a cell, which `piece_totals` finds, are checked: with one cell around, by vectors; and cells that are
offered less take it, and spread it inside the tile, by a label-correcting search. Offers to cells of other tiles
are left to these.

The invariant: **what a cell costs is at least what its parent offers**. It holds if costs are those driven; a cell
that takes less takes the offering cell as its parent, so that its children are offered no more than they cost; and
only falls. Steps cost something, so costs fall strictly along parents: there is never a cycle.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels import tile_pieces
from planner_service.kernels.decorators import helper, kernel
from planner_service.kernels.heap_and_buckets import heap_lower, heap_pop
from planner_service.kernels.layout import (
    BOX,
    GRID,
    HUGE,
    INF,
    NONE,
    RULE_FOUR,
    RULE_OCTILE,
    SQRT2_EXACT,
    is_shut,
    leads_by,
)
from planner_service.kernels.parents_from_costs import least_offers
from planner_service.kernels.piece_totals import begin, evaluate_totals, queue_checks, settle
from planner_service.kernels.tile_pieces import BITS, CELLS, PIECES, SIDE, TOTAL, WIDE

_FIRST = np.uint64(WIDE + 1)
"""The first cell of a tile, on the scratch."""
_WINDOW = f"Tuple((f4[::1], u1[::1], {BOX}, f8))"


@helper
def _load_beside(t, row, col, origin, grid, tree, across, scratch):
    """Puts a cell beside a tile on the scratch. Row and column are counted from the tile's first cell, which is
    `origin`, padded."""
    at, own = (row + 1) * WIDE + col + 1, grid[0][origin + row * grid[2] + col]
    scratch.own[at] = own
    scratch.cost[at] = np.inf
    if own < INF:  # there is a tile
        other = t + (row >> BITS) * across + (col >> BITS)
        cell = ((row & (SIDE - 1)) << BITS) + (col & (SIDE - 1))
        at_exit = tree.total[other * PIECES + np.int64(tree.piece[other * CELLS + cell]), TOTAL]
        scratch.cost[at] = at_exit + tree.rim[other * PIECES + tile_pieces.border_index(cell)]


@helper
def _load_tile(t, grid, tree, tiles, scratch):
    """Puts a tile on the scratch, with the cells around."""
    piece, across = tree.piece, tiles.across
    cost, inner = scratch.cost, scratch.inner
    tile_pieces.load_offsets(t, grid, tree, tiles, scratch)
    origin, rows, cols = tile_pieces.corner_of(grid, across, t)
    if rows < SIDE or cols < SIDE:
        for i in range(cost.size):
            cost[i] = np.inf
    totals = np.uint64(t * PIECES)
    for row in range(rows):
        i = np.uint64(t * CELLS + (row << BITS))
        at = np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(cols)):
            cost[at + col] = tree.total[totals + np.uint64(piece[i + col]), TOTAL] + inner[at + col]
    for col in range(-1, cols + 1):
        _load_beside(t, -1, col, origin, grid, tree, across, scratch)
        _load_beside(t, rows, col, origin, grid, tree, across, scratch)
    for row in range(rows):
        _load_beside(t, row, -1, origin, grid, tree, across, scratch)
        _load_beside(t, row, cols, origin, grid, tree, across, scratch)


@helper
def _is_offered_less(i, cost, own, least):
    """Returns True if a cell (unsigned) on the scratch may be entered and is offered less than `KEPT` of its
    cost."""
    return (least[i - _FIRST] < cost[i] * tile_pieces.KEPT) & (own[i] < np.inf)


@helper
def _open(own, around, rule, corners, at, code):
    """Returns True if there is a step between a passable cell on the scratch and the one in this direction."""
    if not code & 1:
        return True
    return rule != RULE_FOUR and (corners or not is_shut(own, around, at, code))


@helper
def _relax(at, t, cell, grid, tree, tiles, scratch):
    """Have a cell of a tile, `at` in the scratch, take its least offer. Returns whether that is less."""
    _, _, stride, rule, corners = grid
    parent, piece = tree.parent, tree.piece
    cost, own, inner, around = scratch.cost, scratch.own, scratch.inner, scratch.around
    across = tiles.across
    best, by = np.inf, 0
    for code in range(8):
        u = at + around[code]
        if _open(own, around, rule, corners, at, code):
            offer = cost[u] + tile_pieces.step_cost(rule, own[u], code)
            if offer < best:
                best, by = offer, code
    if not best < cost[at] * tile_pieces.KEPT:
        return False
    cost[at] = best
    origin, _, _ = tile_pieces.corner_of(grid, across, t)
    parent[origin + (cell >> BITS) * stride + (cell & (SIDE - 1))] = by
    other, beside = tile_pieces.cell_behind(across, t, cell, by)
    i = t * CELLS + cell
    if other == t:
        u = at + around[by]
        piece[i] = piece[t * CELLS + beside]
        inner[at] = inner[u] + tile_pieces.step_cost(rule, own[u], by)
        return True
    name = tile_pieces.border_index(cell)
    if piece[i] != name or inner[at] > 0.0:
        exits, many = tiles.exits, tiles.many
        exits[t * PIECES + many[t]] = name
        many[t] += 1
        piece[i] = name
        inner[at] = 0.0
    total = tree.total
    total[t * PIECES + name, TOTAL] = best
    return True


@helper
def _spread(t, grid, tree, tiles, scratch, count):
    """Spreads what the `count` cells of the heap cost, inside the tile, the least first: most cells are then
    written once. Cells around that are offered less have their tile looked at."""
    _, offsets, stride, rule, corners = grid
    parent, piece = tree.parent, tree.piece
    wanted, across = tiles.wanted, tiles.across
    cost, own, inner, around = scratch.cost, scratch.own, scratch.inner, scratch.around
    queue, keys, spot = scratch.queue, scratch.keys, scratch.spot
    first = t * CELLS
    origin, rows, cols = tile_pieces.corner_of(grid, across, t)
    while count > 0:
        at = np.int64(queue[0])
        heap_pop(keys, queue, spot, count)
        count -= 1
        row, col = at // WIDE - 1, at % WIDE - 1
        v = origin + row * stride + col
        rim = row == 0 or col == 0 or row == rows - 1 or col == cols - 1
        for code in range(8):
            u = at + around[code]
            offer = cost[at] + tile_pieces.step_cost(rule, own[at], code)
            child = parent[v + offsets[code]] == (code + 4) & 7
            # A child always follows, so that the stated cost of a cell is the one driven.
            if not offer < cost[u] * (1.0 if child else tile_pieces.KEPT) or not own[u] < np.inf:
                continue
            if not child and not _open(own, around, rule, corners, at, code):
                continue
            down, right = tile_pieces.step_of(code)
            down += row
            right += col
            if rim and (down | right) & -SIDE:
                other = t + (down >> BITS) * across + (right >> BITS)
                # A child's tile sees that its total changes.
                wanted[other] |= tile_pieces.RELINK_INTO if child else tile_pieces.CHECK
                continue
            cost[u] = offer
            piece[first + (down << BITS) + right] = piece[first + (row << BITS) + col]
            inner[u] = inner[at] + tile_pieces.step_cost(rule, own[at], code)
            parent[v + offsets[code]] = (code + 4) & 7
            count = heap_lower(keys, queue, spot, count, np.float32(offer), u)


@helper
def _improve_tile(t, grid, tree, tiles, scratch):
    """Checks a tile; returns whether a parent has changed."""
    _, _, _, rule, corners = grid
    piece = tree.piece
    exits, many, across = tiles.exits, tiles.many, tiles.across
    names, cost, own, least = scratch.border, scratch.cost, scratch.own, scratch.least
    queue, keys, spot = scratch.queue, scratch.keys, scratch.spot
    _load_tile(t, grid, tree, tiles, scratch)
    _, rows, cols = tile_pieces.corner_of(grid, across, t)
    diagonal = np.inf if rule == RULE_FOUR else (SQRT2_EXACT if rule == RULE_OCTILE else 1.0)
    last, limit = np.uint64((rows + 1) * WIDE - 1), INF if corners else HUGE
    least_offers(own, cost, np.uint64(WIDE), _FIRST, last, diagonal, limit, None, least)
    count = 0
    for row in range(rows):
        first = np.uint64((row + 1) * WIDE + 1)
        some = np.int32(0)
        for col in range(np.uint64(cols)):
            some |= np.int32(_is_offered_less(first + col, cost, own, least))
        if some:
            for col in range(cols):
                at = (row + 1) * WIDE + col + 1
                less = _is_offered_less(np.uint64(at), cost, own, least)
                if less and _relax(*(at, t, (row << BITS) + col, grid, tree, tiles, scratch)):
                    count = heap_lower(keys, queue, spot, count, np.float32(cost[at]), at)
    if count == 0:
        return False
    _spread(t, grid, tree, tiles, scratch, count)
    tile_pieces.store_offsets(t, tree, scratch)
    # Exits whose path leads on inside the tile by now are none any more; no piece leads over them.
    kept = 0
    for j in range(many[t]):
        name = np.int64(exits[t * PIECES + j])
        if name == tile_pieces.ROOT_PIECE or piece[t * CELLS + names[name]] == name:
            exits[t * PIECES + kept] = name
            kept += 1
    many[t] = kept
    return True


@helper
def _is_next(t, across, schedule):
    """Returns True if no tile about this one, of those to be checked, has an earlier turn."""
    place, turn, sets = schedule.place, schedule.turn, schedule.sets
    row0, col0, row1, col1 = tile_pieces.rows_about(t, across, place.size)
    for row in range(row0, row1):
        for other in range(row * across + col0, row * across + col1):
            if turn[other] < turn[t] and sets[tile_pieces.CHECKING, place[other]]:
                return False
    return True


@helper
def _any_cut_off(t, wanted, across):
    """Returns True if a piece of a tile, or of those about it, has no path."""
    row0, col0, row1, col1 = tile_pieces.rows_about(t, across, wanted.size)
    what = np.uint8(0)
    for row in range(row0, row1):
        for other in range(row * across + col0, row * across + col1):
            what |= wanted[other]
    return what & tile_pieces.CUT_OFF != 0


@kernel(GRID, tile_pieces.TREE, tile_pieces.TILES, tile_pieces.SCRATCH, tile_pieces.SCHEDULE, "f8")
def improve_tiles(grid, tree, tiles, scratch, schedule, most):
    """Evaluates totals, checks tiles and repairs them, until the tree is optimal or `most` tiles have been checked;
    a check that ends in a repair counts as three. Returns (tiles checked, tiles repaired, rounds, whether some are
    left).

    schedule  (order, place, turn, now, stack, sets, words):
           order  int64 (n,), all tiles, those nearest the root first
           turn   float64 (n,): of neighbouring tiles the one with the least turn is checked first, and totals are
                  evaluated before the next. If all are equal, each round checks all tiles
           now    argument of the first `evaluate_totals`
    """
    wanted, falls, across = tiles.wanted, tiles.falls, tiles.across
    order, place, now, sets, words = schedule.order, schedule.place, schedule.now, schedule.sets, schedule.words
    looked = mended = rounds = 0
    begin(tiles, schedule)
    evaluate_totals(grid, tree, tiles, scratch.border, schedule, now)
    while True:
        rounds += 1
        queue_checks(tree, tiles, schedule)
        n = tile_pieces.next_in(tile_pieces.CHECKING, 0, sets, words)
        if n >= order.size or looked + 2 * mended > most:
            return looked, mended, rounds, n < order.size
        while n < order.size:
            t = order[n]
            if _is_next(t, across, schedule):
                looked += 1
                wanted[t] &= ~(tile_pieces.CHECK | tile_pieces.RECHECK | tile_pieces.CHECKED_CUT_OFF)
                wanted[t] |= tile_pieces.CHECKED_CUT_OFF if _any_cut_off(t, wanted, across) else np.uint8(0)
                falls[2, t] = 0.0
                sets[tile_pieces.NEARBY, n] = 1
                if _improve_tile(t, grid, tree, tiles, scratch):
                    # Until totals are evaluated its own are what its exits were offered, and those of others too
                    # high.
                    wanted[t] |= tile_pieces.RELINK
                    tile_pieces.push_around(tile_pieces.LINKING, t, across, place, sets)
                    tile_pieces.push_around(tile_pieces.NEARBY, t, across, place, sets)
                    mended += 1
            n = tile_pieces.next_in(tile_pieces.CHECKING, n + 1, sets, words)
        evaluate_totals(grid, tree, tiles, scratch.border, schedule, np.int64(0))


@helper
def _merge_tile(t, grid, tree, across, window, inner, old_root, changed):
    """`merge_parents` in one tile, which is on the scratch."""
    stride = grid[2]
    parent, piece, root, total = tree.parent, tree.piece, tree.root, tree.total
    part, part_parent, box, way = window
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    top, left = t // across * SIDE, t % across * SIDE
    for row in range(max(row0, top), min(row1, top + SIDE)):
        for col in range(max(col0, left), min(col1, left + SIDE)):
            i = (row - row0 + 1) * width + col - col0 + 1
            if not part[i] < INF:
                continue
            v = (row + 1) * stride + col + 1
            cell = ((row - top) << BITS) + col - left
            at_exit = total[t * PIECES + np.int64(piece[t * CELLS + cell]), TOTAL]
            cost = at_exit + inner[tile_pieces.in_scratch(cell)]
            code = NONE if v == root else part_parent[i]
            if (part[i] < cost + way or v == old_root) and parent[v] != code:
                parent[v] = code
                changed[t] = tile_pieces.ALTERED


@kernel(GRID, tile_pieces.TREE, tile_pieces.TILES, tile_pieces.SCRATCH, _WINDOW, "i8", "u1[::1]")
def merge_parents(grid, tree, tiles, scratch, window, old_root, changed):
    """Takes the parents of a window that was grown around a new root (`tree`), where its costs are less than the
    tree's and the way from the old root to the new one.

    window   (part, part_parent, box, way): its costs and parents, and the way between the roots, s
    changed  uint8 (n,), set to ALTERED for tiles in which a parent has changed
    Costs stay what they are until totals are evaluated. There is no cycle: with the lesser of the two costs, every
    cell's parent has a lower one.
    """
    across = tiles.across
    row0, col0, row1, col1 = window[2]
    for row in range(row0 >> BITS, ((row1 - 1) >> BITS) + 1):
        for col in range(col0 >> BITS, ((col1 - 1) >> BITS) + 1):
            t = row * across + col
            tile_pieces.load_offsets(t, grid, tree, tiles, scratch)
            _merge_tile(t, grid, tree, across, window, scratch.inner, old_root, changed)
    for v in (tree.root, old_root):
        t, _ = tile_pieces.tile_of(v, grid[2], across)
        changed[t] = tile_pieces.ALTERED


@kernel(GRID, tile_pieces.TREE, "i8", "i8[::1]", "f4[::1]", "u1[::1]")
def cut_parents(grid, tree, across, cells, before, changed):
    """Cells that became lethal, and those whose step they forbid, lose their parent.

    cells, before  padded cells whose cost changed, and their cell cost before, s
    changed        uint8 (n,), COSTLIER or ALTERED for tiles of cells that step into one of these, or are one
    """
    cell_cost, offsets, stride, _, corners = grid
    parent = tree.parent
    for j in range(cells.size):
        changed_cell = cells[j]
        t, _ = tile_pieces.tile_of(changed_cell, stride, across)
        what = tile_pieces.COSTLIER if cell_cost[changed_cell] > before[j] else tile_pieces.ALTERED
        changed[t] |= what
        lethal = not cell_cost[changed_cell] < INF and before[j] < INF
        if lethal:
            parent[changed_cell] = NONE
        for code in range(8):
            if leads_by(parent, offsets, changed_cell, code, lethal and not corners):
                v = changed_cell + offsets[code]
                t, _ = tile_pieces.tile_of(v, stride, across)
                changed[t] |= what
                if lethal:
                    parent[v] = NONE


@kernel(GRID, tile_pieces.TREE, tile_pieces.TILES, "i8[::1]")
def drop_cut_off(grid, tree, tiles, which):
    """Cells of these tiles that have no path lose their parent, and pieces that lead nowhere go."""
    _, _, stride, _, _ = grid
    parent, piece, root = tree.parent, tree.piece, tree.root
    total = tree.total
    exits, many, wanted, across = tiles.exits, tiles.many, tiles.wanted, tiles.across
    for n in range(which.size):
        t = which[n]
        wanted[t] &= ~tile_pieces.CUT_OFF
        origin, rows, cols = tile_pieces.corner_of(grid, across, t)
        for row in range(rows):
            for col in range(cols):
                i = t * CELLS + (row << BITS) + col
                v = origin + row * stride + col
                if not total[t * PIECES + np.int64(piece[i]), TOTAL] < np.inf and v != root:
                    parent[v] = NONE
                    piece[i] = tile_pieces.NO_PIECE
        count = 0
        for j in range(many[t]):
            name = np.int64(exits[t * PIECES + j])
            if total[t * PIECES + name, TOTAL] < np.inf:
                exits[t * PIECES + count] = name
                count += 1
        many[t] = count
        settle(t, tiles)
