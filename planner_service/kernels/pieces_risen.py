"""Where totals of pieces have come apart, so that a tile is to be looked at: see `pieces`.

Where no cell was offered less, one is by a cell of another piece only if its own piece's total has risen by more
than that one's. So a tile is looked at where two pieces *meet*, have cells beside each other, and one of them has
risen by more than the other. What is known of a tile is one number, how much less a cell may be offered by all
changes since it was looked at (`falls`).

Of a piece that loses its way it is kept what it cost, and once it has one again its change is reckoned from that: a
branch behind a closed way mostly comes back as it was, at a higher cost, and is then looked at along its edge only.
What a tile's cells are offered by a piece without a way is not seen when the tile is looked at. It is `BLIND` then,
and looked at again when a piece about it has found one.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import helper
from planner_service.kernels.pieces import (
    BEFORE,
    BITS,
    BLIND,
    CELLS,
    CHANGED,
    FINEST,
    FOUND,
    INSIDE,
    LOOK,
    LOST,
    NEAR,
    NO_PIECE,
    NOTED,
    ROOM,
    SEEK,
    SIDE,
    TODO,
    TOTAL,
    WIDE,
    following,
    put_about,
)

_ONE = np.uint64(1)
_DRIFT = 4.0
"""How many times `FINEST` a tile's totals may come apart before it is looked at."""
_EVEN = 2.0**-4
"""How many times `FINEST` changes may differ and be taken for the same number: they are differences of sums."""


@helper
def settle(t, tiles):
    """Totals of a tile have not changed since they were noted."""
    many, falls = tiles[1], tiles[4]
    falls[0, t], falls[1, t] = (0.0, 0.0) if many[t] else (np.inf, -np.inf)


@helper
def _change(total, y):
    """By how much the total of a piece has changed in the last evaluation, if its tile's totals have; 0 of one that
    has no way, or never had one."""
    cost, before = total[y, TOTAL], abs(total[y, BEFORE])
    return cost - before if cost < np.inf and before < np.inf else 0.0


@helper
def note_changes(t, pieces, tiles):
    """Write `falls` and `ends` of a tile whose totals have changed, and whether pieces have lost their way or found
    one."""
    total = pieces[0]
    exits, many, _, wanted, falls, ends, _ = tiles
    least, most, near, far = np.inf, -np.inf, np.inf, 0.0
    what = np.uint8(0)
    for j in range(many[t]):
        y = t * ROOM + np.int64(exits[t * ROOM + j])
        cost, before = total[y, TOTAL], total[y, BEFORE]
        change = _change(total, y)
        had = 0.0 <= before < np.inf
        if not cost < np.inf:
            what |= LOST | (SEEK if had else np.uint8(0))
        elif not had:
            what |= FOUND
        least = min(least, change)
        most = max(most, change)
        near = min(near, cost)
        far = max(far, cost)
    wanted[t] = (wanted[t] & ~LOST) | what
    if not what & LOST:
        wanted[t] &= ~SEEK
    falls[0, t] = least
    falls[1, t] = most
    ends[0, t] = near
    ends[1, t] = far


@helper
def _differ(a, b):
    """uint8, not 0: whether two groups differ, and both are some."""
    return np.uint8((a != b) & (a != NO_PIECE) & (b != NO_PIECE))


@helper
def _meet_inside(t, labels, pieces, tiles, bench, fine):
    """Whether two pieces of a tile lie beside each other whose totals have changed by different numbers, which are
    more than `fine` apart."""
    piece, total = labels[1], pieces[0]
    exits, many = tiles[0], tiles[1]
    less, name, changes = bench[4], bench[8], bench[14]
    # Pieces are grouped by what their totals have changed by: `less` holds the group of each name.
    groups = 0
    for j in range(many[t]):
        one = np.int64(exits[t * ROOM + j])
        change = _change(total, t * ROOM + one)
        group = 0
        while group < groups and abs(change - changes[group]) > fine:
            group += 1
        if group == groups:
            if groups == changes.size:
                return True
            changes[groups] = change
            groups += 1
        less[one] = group
    less[NO_PIECE] = np.int32(NO_PIECE)
    for row in range(SIDE):
        i, at = np.uint64(t * CELLS + (row << BITS)), np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(SIDE)):
            name[at + col] = less[piece[i + col]]
    for row in range(1, SIDE + 1):
        at, s = np.uint64(row * WIDE), np.uint64(WIDE)
        other = np.uint8(0)
        for col in range(_ONE, np.uint64(SIDE) + _ONE):
            here = name[at + col]
            other |= _differ(here, name[at + col + _ONE]) | _differ(here, name[at + s + col])
            other |= _differ(here, name[at + s + col + _ONE]) | _differ(here, name[at + s + col - _ONE])
        if other:
            return True
    return False


@helper
def _meet(t, other, way, labels, pieces, turns, fine):
    """Whether along the border of a tile a piece's total has risen by more than that of one beside it, of tile
    `other`, which lies `way`, so many tiles down and to the right; by more than `fine`."""
    piece, total = labels[1], pieces[0]
    place, sets = turns[1], turns[5]
    down, right = way
    noted, other_noted = sets[NOTED, place[t]], sets[NOTED, place[other]]
    count = 1 if down and right else SIDE
    step = 1 if down else SIDE
    cell = (INSIDE << BITS if down > 0 else 0) + (INSIDE if right > 0 else 0)
    beside = (INSIDE << BITS if down < 0 else 0) + (INSIDE if right < 0 else 0)
    for n in range(count):
        one = piece[t * CELLS + cell + n * step]
        if one == NO_PIECE:
            continue
        change = (_change(total, t * ROOM + np.int64(one)) if noted else 0.0) - fine
        for k in range(max(n - 1, 0), min(n + 2, count)):
            one = piece[other * CELLS + beside + k * step]
            if one == NO_PIECE:
                continue
            if change > (_change(total, other * ROOM + np.int64(one)) if other_noted else 0.0):
                return True
    return False


@helper
def _any_meet(t, labels, pieces, tiles, bench, turns, fine):
    """Whether a piece of a tile has risen by more than one that lies beside it, in the tile or about it; by more
    than `fine`."""
    falls, across = tiles[4], tiles[6]
    row, col = t // across, t % across
    down = falls.shape[1] // across
    if falls[1, t] > falls[0, t] + fine and _meet_inside(t, labels, pieces, tiles, bench, fine):
        return True
    for i in range(max(row - 1, 0), min(row + 2, down)):
        for j in range(max(col - 1, 0), min(col + 2, across)):
            other = i * across + j
            if other == t or not falls[1, t] > falls[0, other] + fine:
                continue
            if _meet(t, other, (i - row, j - col), labels, pieces, turns, fine):
                return True
    return False


@helper
def _rise(t, tiles):
    """By how much more a piece of a tile has risen than another in it or about it, s. What is wanted of the tile is
    taken down, too."""
    wanted, falls, ends, across = tiles[3], tiles[4], tiles[5], tiles[6]
    row, col = t // across, t % across
    down = wanted.size // across
    least, near = np.inf, np.inf
    what = np.uint8(0)
    for i in range(max(row - 1, 0), min(row + 2, down)):
        for j in range(max(col - 1, 0), min(col + 2, across)):
            other = i * across + j
            least = min(least, falls[0, other])
            near = min(near, ends[0, other])
            what |= wanted[other]
    if what & FOUND:
        if wanted[t] & BLIND:
            wanted[t] |= LOOK
        if wanted[t] & LOST:
            wanted[t] |= SEEK
    if not near < np.inf:
        wanted[t] &= ~SEEK
    return falls[1, t] - least if falls[1, t] > least else 0.0


@helper
def find_risen(labels, pieces, tiles, bench, turns):
    """Put tiles into `TODO` that are to be looked at: where it is wanted, and where a piece's total has risen by
    more than that of one beside it since they were looked at. Only tiles about which totals have changed, and those
    of `NEAR`, are asked; others stay in it or out of it."""
    wanted, falls, ends, across = tiles[3], tiles[4], tiles[5], tiles[6]
    order, place, _, _, _, sets, words = turns
    n = following(CHANGED, 0, sets, words)
    while n < order.size:
        sets[CHANGED, n] = 0
        sets[NOTED, n] = 1
        note_changes(order[n], pieces, tiles)
        put_about(NEAR, order[n], across, place, sets)
        n = following(CHANGED, n + 1, sets, words)
    n = following(NEAR, 0, sets, words)
    while n < order.size:
        sets[NEAR, n] = 0
        t = order[n]
        nearest = ends[0, t] if ends[0, t] < np.inf else 0.0
        rise, fine = _rise(t, tiles), _EVEN * FINEST * nearest
        if rise > 2.0 * fine and not _any_meet(t, labels, pieces, tiles, bench, turns, fine):
            rise = 2.0 * fine
        falls[2, t] += rise
        risen = ends[0, t] < np.inf and falls[2, t] > _DRIFT * FINEST * nearest
        sets[TODO, n] = risen or wanted[t] & (LOOK | SEEK) != 0
        n = following(NEAR, n + 1, sets, words)
    n = following(NOTED, 0, sets, words)
    while n < order.size:
        sets[NOTED, n] = 0
        wanted[order[n]] &= ~FOUND
        settle(order[n], tiles)
        n = following(NOTED, n + 1, sets, words)
