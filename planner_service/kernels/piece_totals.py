"""Costs of the pieces of a tree, and pairs of pieces whose totals have come apart, so that a tile is to be checked.

If no cell was offered less, a cell of another piece is the source of a better offer only if its own piece's total
has risen by more than that one's. A tile is therefore checked where one of its pieces has risen by more than
another piece of the tile, or than a piece of another tile which it *meets*: the two have cells beside each other.
The state of a tile is one number, the largest amount by which all changes since its check may lower an offer to a
cell (`Tiles.falls`).

A piece that loses its path keeps its last cost, and once it has a path again its change is reckoned from that: a
branch behind a closed path mostly comes back as it was, at a higher cost, and is then checked along its edge only.
Offers to a tile's cells by a piece without a path are not seen when the tile is checked. It is `CHECKED_CUT_OFF`
then, and checked again when a piece about it has found one.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels import tile_pieces
from planner_service.kernels.decorators import helper, kernel, prefetch
from planner_service.kernels.layout import GRID, NONE, check_cells
from planner_service.kernels.tile_pieces import BITS, CELLS, INSIDE, OFFSET, PIECES, SIDE, SUCCESSOR, TOTAL

_DRIFT = 4.0
"""Multiple of `FINEST` by which a tile's totals may come apart before it is checked."""
_EVEN = 2.0**-4
"""Multiple of `FINEST` by which changes may differ and count as equal: they are differences of sums."""


@helper
def settle(t, tiles):
    """Totals of a tile have not changed since they were noted."""
    many, falls = tiles.many, tiles.falls
    falls[0, t], falls[1, t] = (0.0, 0.0) if many[t] else (np.inf, -np.inf)


@helper
def _change(total, y):
    """By how much the total of a piece has changed in the last evaluation, if its tile's totals have; 0 of one that
    has no path, or never had one."""
    cost, before = total[y, TOTAL], abs(total[y, tile_pieces.BEFORE])
    return cost - before if cost < np.inf and before < np.inf else 0.0


@helper
def note_changes(t, tree, tiles):
    """Writes `falls` and `ends` of a tile whose totals have changed, and whether pieces have lost their way or
    found one."""
    total = tree.total
    exits, many, wanted, falls, ends = tiles.exits, tiles.many, tiles.wanted, tiles.falls, tiles.ends
    least, most, near, far = np.inf, -np.inf, np.inf, 0.0
    what = np.uint8(0)
    for j in range(many[t]):
        y = t * PIECES + np.int64(exits[t * PIECES + j])
        cost, before = total[y, TOTAL], total[y, tile_pieces.BEFORE]
        change = _change(total, y)
        had = 0.0 <= before < np.inf
        if not cost < np.inf:
            what |= tile_pieces.CUT_OFF | (tile_pieces.RECHECK if had else np.uint8(0))
        elif not had:
            what |= tile_pieces.RECONNECTED
        least = min(least, change)
        most = max(most, change)
        near = min(near, cost)
        far = max(far, cost)
    wanted[t] = (wanted[t] & ~tile_pieces.CUT_OFF) | what
    if not what & tile_pieces.CUT_OFF:
        wanted[t] &= ~tile_pieces.RECHECK
    falls[0, t] = least
    falls[1, t] = most
    ends[0, t] = near
    ends[1, t] = far


@helper
def _meet(t, other, across, tree, schedule, fine):
    """Returns True if along the border of a tile a piece's total has risen by more than that of one beside it, of
    tile `other`; by more than `fine`."""
    piece, total = tree.piece, tree.total
    place, sets = schedule.place, schedule.sets
    down, right = other // across - t // across, other % across - t % across
    noted, other_noted = sets[tile_pieces.NOTED, place[t]], sets[tile_pieces.NOTED, place[other]]
    count = 1 if down and right else SIDE
    step = 1 if down else SIDE
    cell = (INSIDE << BITS if down > 0 else 0) + (INSIDE if right > 0 else 0)
    beside = (INSIDE << BITS if down < 0 else 0) + (INSIDE if right < 0 else 0)
    for n in range(count):
        one = piece[t * CELLS + cell + n * step]
        if one == tile_pieces.NO_PIECE:
            continue
        change = (_change(total, t * PIECES + np.int64(one)) if noted else 0.0) - fine
        for k in range(max(n - 1, 0), min(n + 2, count)):
            one = piece[other * CELLS + beside + k * step]
            if one == tile_pieces.NO_PIECE:
                continue
            if change > (_change(total, other * PIECES + np.int64(one)) if other_noted else 0.0):
                return True
    return False


@helper
def _any_meet(t, tree, tiles, schedule, fine):
    """Returns True if a piece of a tile has risen by more than another in it, or than one beside it about the tile;
    by more than `fine`. In a tile, two such pieces are nearly always beside each other."""
    falls, across = tiles.falls, tiles.across
    if falls[1, t] > falls[0, t] + fine:
        return True
    row0, col0, row1, col1 = tile_pieces.rows_about(t, across, falls.shape[1])
    for row in range(row0, row1):
        for other in range(row * across + col0, row * across + col1):
            apart = other != t and falls[1, t] > falls[0, other] + fine
            if apart and _meet(t, other, across, tree, schedule, fine):
                return True
    return False


@helper
def _rise(t, tiles):
    """By how much more a piece of a tile has risen than another in it or about it, s. Pending work on the tile is
    noted, too."""
    wanted, falls, ends, across = tiles.wanted, tiles.falls, tiles.ends, tiles.across
    row0, col0, row1, col1 = tile_pieces.rows_about(t, across, wanted.size)
    least, near = np.inf, np.inf
    what = np.uint8(0)
    for row in range(row0, row1):
        for other in range(row * across + col0, row * across + col1):
            least = min(least, falls[0, other])
            near = min(near, ends[0, other])
            what |= wanted[other]
    if what & tile_pieces.RECONNECTED:
        if wanted[t] & tile_pieces.CHECKED_CUT_OFF:
            wanted[t] |= tile_pieces.CHECK
        if wanted[t] & tile_pieces.CUT_OFF:
            wanted[t] |= tile_pieces.RECHECK
    if not near < np.inf:
        wanted[t] &= ~tile_pieces.RECHECK
    return falls[1, t] - least if falls[1, t] > least else 0.0


@helper
def queue_checks(tree, tiles, schedule):
    """Puts tiles into `CHECKING` that are to be checked: where it is wanted, and where a piece's total has risen by
    more than that of one beside it since they were looked at. Only tiles about which totals have changed, and those
    of `NEARBY`, are asked; others stay in it or out of it."""
    wanted, falls, ends, across = tiles.wanted, tiles.falls, tiles.ends, tiles.across
    order, place, sets, words = schedule.order, schedule.place, schedule.sets, schedule.words
    n = tile_pieces.next_in(tile_pieces.CHANGED, 0, sets, words)
    while n < order.size:
        sets[tile_pieces.CHANGED, n] = 0
        sets[tile_pieces.NOTED, n] = 1
        note_changes(order[n], tree, tiles)
        tile_pieces.push_around(tile_pieces.NEARBY, order[n], across, place, sets)
        n = tile_pieces.next_in(tile_pieces.CHANGED, n + 1, sets, words)
    n = tile_pieces.next_in(tile_pieces.NEARBY, 0, sets, words)
    while n < order.size:
        sets[tile_pieces.NEARBY, n] = 0
        t = order[n]
        nearest = ends[0, t] if ends[0, t] < np.inf else 0.0
        rise, fine = _rise(t, tiles), _EVEN * tile_pieces.FINEST * nearest
        if rise > 2.0 * fine and not _any_meet(t, tree, tiles, schedule, fine):
            rise = 2.0 * fine
        falls[2, t] += rise
        risen = ends[0, t] < np.inf and falls[2, t] > _DRIFT * tile_pieces.FINEST * nearest
        sets[tile_pieces.CHECKING, n] = risen or wanted[t] & (tile_pieces.CHECK | tile_pieces.RECHECK) != 0
        n = tile_pieces.next_in(tile_pieces.NEARBY, n + 1, sets, words)
    n = tile_pieces.next_in(tile_pieces.NOTED, 0, sets, words)
    while n < order.size:
        sets[tile_pieces.NOTED, n] = 0
        wanted[order[n]] &= ~tile_pieces.RECONNECTED
        settle(order[n], tiles)
        n = tile_pieces.next_in(tile_pieces.NOTED, n + 1, sets, words)


@helper
def _forget(total, y):
    """Changes of a piece's total are reckoned from now on."""
    cost, before = total[y, TOTAL], total[y, tile_pieces.BEFORE]
    total[y, tile_pieces.BEFORE] = cost if cost < np.inf else (-abs(before) if before < np.inf else np.inf)


@helper
def _forget_all(t, tree, tiles):
    """Changes of a tile's totals are reckoned from now on."""
    for j in range(tiles.many[t]):
        _forget(tree.total, t * PIECES + np.int64(tiles.exits[t * PIECES + j]))


@helper
def _link(t, name, grid, tree, across, names):
    """Writes where a piece leads, and how far that is."""
    cell_cost, offsets, stride, rule, _ = grid
    parent, piece, rim = tree.parent, tree.piece, tree.rim
    total, successor = tree.total, tree.successor
    y = t * PIECES + name
    if name == tile_pieces.ROOT_PIECE:
        successor[y, SUCCESSOR] = -1
        total[y, OFFSET] = 0.0
        return
    origin, _, _ = tile_pieces.corner_of(grid, across, t)
    cell = np.int64(names[name])
    v = origin + (cell >> BITS) * stride + (cell & INSIDE)
    way = np.int64(parent[v])
    other, beside = tile_pieces.cell_behind(across, t, cell, way)
    successor[y, SUCCESSOR] = other * PIECES + np.int64(piece[other * CELLS + beside])
    total[y, OFFSET] = rim[other * PIECES + tile_pieces.border_index(beside)] + tile_pieces.step_cost(
        rule, cell_cost[v + offsets[way]], way
    )


@helper
def _link_all(grid, tree, tiles, names, schedule):
    """Link the pieces of tiles of `LINKING` whose parents have changed, and those that lead there."""
    successor = tree.successor
    exits, many, wanted, across = tiles.exits, tiles.many, tiles.wanted, tiles.across
    order, sets, words = schedule.order, schedule.sets, schedule.words
    n = tile_pieces.next_in(tile_pieces.LINKING, 0, sets, words)
    while n < order.size:
        t = order[n]
        anew = wanted[t] & tile_pieces.RELINK != 0
        if anew:
            sets[tile_pieces.SUMMING, n] = sets[tile_pieces.CHANGED, n] = 1
            _forget_all(t, tree, tiles)
        for j in range(many[t] if wanted[t] & (tile_pieces.RELINK | tile_pieces.RELINK_INTO) else 0):
            name = np.int64(exits[t * PIECES + j])
            y = t * PIECES + name
            next = successor[y, SUCCESSOR]
            if anew or (next >= 0 and wanted[next // PIECES] & tile_pieces.RELINK):
                _link(t, name, grid, tree, across, names)
                sets[tile_pieces.SUMMING, n] = 1
        n = tile_pieces.next_in(tile_pieces.LINKING, n + 1, sets, words)
    n = tile_pieces.next_in(tile_pieces.LINKING, 0, sets, words)
    while n < order.size:
        sets[tile_pieces.LINKING, n] = 0
        wanted[order[n]] &= ~(tile_pieces.RELINK | tile_pieces.RELINK_INTO)
        n = tile_pieces.next_in(tile_pieces.LINKING, n + 1, sets, words)


@helper
def _add_up(t, tree, tiles, first):
    """Totals of a tile := what its exits are offered. Returns whether one has changed. `first`: none of them has
    before in this evaluation."""
    total, successor, exits, many = tree.total, tree.successor, tiles.exits, tiles.many
    changed = False
    for j in range(many[t]):
        y = t * PIECES + np.int64(exits[t * PIECES + j])
        next = np.int64(successor[y, SUCCESSOR])
        cost = total[y, OFFSET] + (total[next, TOTAL] if next >= 0 else 0.0)
        if cost != total[y, TOTAL]:
            if first and not changed:
                _forget_all(t, tree, tiles)
            changed = True
            total[y, TOTAL] = cost
    return changed


@helper
def _add_up_all(tree, tiles, schedule):
    """The same for all tiles, each piece after the one that it leads into."""
    total, successor = tree.total, tree.successor
    exits, many = tiles.exits, tiles.many
    order, now, stack, sets = schedule.order, schedule.now, schedule.stack, schedule.sets
    for n in range(order.size):
        t = order[n]
        next = order[min(n + 1, order.size - 1)]
        for j in range(many[next]):
            prefetch(total, (next * PIECES + np.int64(exits[next * PIECES + j])) * 4)
        sets[tile_pieces.SUMMING, n] = sets[tile_pieces.CHANGED, n] = 0
        sets[tile_pieces.NOTED, n] = sets[tile_pieces.NEARBY, n] = 1
        for j in range(many[t]):
            y = t * PIECES + np.int64(exits[t * PIECES + j])
            steps = 0
            while y >= 0 and successor[y, tile_pieces.STAMP] != now:
                stack[steps] = y
                steps += 1
                y = np.int64(successor[y, SUCCESSOR])
            cost = total[y, TOTAL] if y >= 0 else 0.0
            for i in range(steps - 1, -1, -1):
                y = np.int64(stack[i])
                cost += total[y, OFFSET]
                _forget(total, y)
                total[y, TOTAL] = cost
                successor[y, tile_pieces.STAMP] = now
        note_changes(t, tree, tiles)


@helper
def evaluate_totals(grid, tree, tiles, names, schedule, now):
    """Sets totals to the cost driven from each exit to the root, after changes about tiles of `LINKING`.

    now    0, or a number that `now` never was: most totals are expected to have changed, as when the root has moved
    If not, tiles about one whose totals have changed are added up, those nearest the root first. That takes a tenth
    of the time if few change; if all do, each tile of 4096 x 4096 cells would be added up 7 times. Either way it
    ends, as no piece leads to itself.
    """
    across = tiles.across
    order, place, sets, words = schedule.order, schedule.place, schedule.sets, schedule.words
    _link_all(grid, tree, tiles, names, schedule)
    if now:
        _add_up_all(tree, tiles, schedule)
    n = tile_pieces.next_in(tile_pieces.SUMMING, 0, sets, words)
    while n < order.size:
        sets[tile_pieces.SUMMING, n] = 0
        if _add_up(order[n], tree, tiles, not sets[tile_pieces.CHANGED, n]):
            sets[tile_pieces.CHANGED, n] = 1
            tile_pieces.push_around(tile_pieces.SUMMING, order[n], across, place, sets)
            sets[tile_pieces.SUMMING, n] = 0
        n = tile_pieces.next_in(tile_pieces.SUMMING, n + 1, sets, words)
        if n >= order.size:
            n = tile_pieces.next_in(tile_pieces.SUMMING, 0, sets, words)


@helper
def begin(tiles, schedule):
    """Makes the sets from the pending work on tiles."""
    wanted, falls, across = tiles.wanted, tiles.falls, tiles.across
    order, place, sets = schedule.order, schedule.place, schedule.sets
    for n in range(order.size):
        t = order[n]
        if wanted[t] & tile_pieces.RELINK:
            tile_pieces.push_around(tile_pieces.LINKING, t, across, place, sets)
        sets[tile_pieces.NEARBY, n] = (
            wanted[t] & (tile_pieces.CHECK | tile_pieces.RECHECK) != 0 or falls[2, t] > 0.0
        )
        sets[tile_pieces.CHECKING, n] = 0


@kernel(GRID, tile_pieces.TREE, tile_pieces.TILES, tile_pieces.SCRATCH, tile_pieces.SCHEDULE)
def add_up(grid, tree, tiles, scratch, schedule):
    """Evaluates totals, and notes where they have risen."""
    begin(tiles, schedule)
    evaluate_totals(grid, tree, tiles, scratch.border, schedule, schedule.now)
    queue_checks(tree, tiles, schedule)


@kernel(GRID, tile_pieces.TREE, tile_pieces.SCRATCH, "i8", "i8[::1]", "f8[::1]")
def costs_at(grid, tree, scratch, across, cells, costs):
    """costs := float64, s, of padded cells; inf where there is no path. Raises ValueError where one is no cell."""
    cell_cost, offsets, stride, rule, _ = grid
    parent, piece = tree.parent, tree.piece
    total, steps_s, kept, place = tree.total, scratch.cost, scratch.kept, scratch.place
    check_cells(cells, cell_cost.size)
    for i in range(cells.size):
        v = cells[i]
        t, cell = tile_pieces.tile_of(v, stride, across)
        costs[i] = total[t * PIECES + np.int64(piece[t * CELLS + cell]), TOTAL]
        if place[t] >= 0:
            costs[i] += kept[np.int64(place[t]) * CELLS + cell]
            continue
        row, col = cell >> BITS, cell & INSIDE
        way = np.int64(parent[v])
        steps = 0
        while way != NONE:
            down, right = tile_pieces.step_of(way)
            row += down
            col += right
            if (row | col) & -SIDE:
                break
            v += offsets[way]
            steps_s[steps] = tile_pieces.step_cost(rule, cell_cost[v], way)
            steps += 1
            way = np.int64(parent[v])
        # Summed from the exit, as elsewhere: the same numbers in another order are another sum.
        inner = 0.0
        for step in range(steps - 1, -1, -1):
            inner += steps_s[step]
        costs[i] += inner
