"""A route while it is driven: which cells come next."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from itertools import pairwise

from swarm.grid import bounds_of

_NOWHERE = (9, 9, 0, 0)
"""A rectangle that holds nothing, nor does the one that is a cell wider on each side."""
_SKIPPED_CELLS = 24
"""A vehicle that others push may come back to its route so far on."""
_LEAST_PART = 1e-9
"""Share of a segment below which it only touches a cell."""


class Follower:
    """The cells of a route and how far along it the vehicle is. Without a route no cell is ahead.

    left     how many cells are ahead
    changes  how often it has been another route: begun, dropped or cut
    version  how often it, or how far along it the vehicle is, has changed
    """

    def __init__(self) -> None:
        self._cells: list[int] = []
        self._at = 0
        self._turns: Sequence[int] = ()
        """For an any-angle route the indices of the cells in which it turns, its first and last included; and
        those."""
        self._turn_cells: Sequence[int] = ()
        self._bounds: tuple[int, int, int, int] | None = None
        self.left = self.changes = self.version = 0
        self.partial = False
        """True if the route ends before its target, because the planner gave a part of it."""

    def begin(
        self, cells: Sequence[int], path: Sequence[int], partial: bool = False, turns: Sequence[int] = ()
    ) -> bool:
        """Follows a route from the first cell of a vehicle's path that it passes. False if it passes none; then
        nothing changes.

        turns  of a pulled route the indices of the cells in which it turns, its first and last included
        """
        at = next((cells.index(cell) for cell in path if cell in cells), None)
        if at is None:
            return False
        self._set(list(cells), at)
        self.partial = partial
        self._turns, self._turn_cells = turns, [cells[turn] for turn in turns]
        return True

    def drop(self) -> None:
        self._set([], 0)
        self._turns = self._turn_cells = ()
        self.partial = False

    def _set(self, cells: list[int], at: int) -> None:
        self._cells, self._at, self._bounds = cells, at, None
        self.left = max(len(cells) - at - 1, 0)
        self.changes += 1
        self.version += 1

    def bounds(self, cols: int) -> tuple[int, int, int, int]:
        """Returns the smallest (row, col) and the greatest of all its cells in a grid with `columns` columns;
        without cells an empty rectangle. Kept, as a route changes seldom and the map all the time."""
        if self._bounds is None:
            self._bounds = bounds_of(self._cells, cols) if self._cells else _NOWHERE
        return self._bounds

    def moved(self, cell: int) -> None:
        """The vehicle has entered a cell: the next one of its route, or one further on, or none."""
        index = self._find(cell)
        if index is not None:
            self._at = index
            self.left = len(self._cells) - self._at - 1
            self.version += 1

    def after(self, cell: int, count: int) -> list[int]:
        """The next `count` cells behind a cell of the route; none if the cell is not on it."""
        index = self._find(cell)
        return [] if index is None else self._cells[index + 1 : index + 1 + max(count, 0)]

    def _find(self, cell: int) -> int | None:
        """Returns the index on the route of a cell that the vehicle may enter next; None if it is not one of
        those."""
        try:
            return self._cells.index(cell, self._at, self._at + _SKIPPED_CELLS)
        except ValueError:
            return None

    def point(self, cell: int, cols: int) -> tuple[float, float] | None:
        """Returns the point where an any-angle route passes one of its next cells, as row and col: the middle of
        its segment's part in it. None where it is the middle of the cell.

        A cell that the segment does not cross, whatever a planner says, is driven through its middle.
        """
        index = self._find(cell) if self._turns else None
        if index is None:
            return None
        leg = bisect_left(self._turns, index)
        if leg == len(self._turns) or self._turns[leg] == index:
            return None
        (row, col), start, end = (
            divmod(cell, cols),
            *(divmod(each, cols) for each in self._turn_cells[leg - 1 : leg + 1]),
        )
        first, last = 0.0, 1.0
        for at, begin, until in zip((row, col), start, end, strict=True):
            if begin != until:
                borders = sorted(((at - 0.5 - begin) / (until - begin), (at + 0.5 - begin) / (until - begin)))
                first, last = max(first, borders[0]), min(last, borders[1])
            elif at != begin:
                return None
        if last - first < _LEAST_PART:
            return None
        share = 0.5 * (first + last)
        return start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])

    def legs_ahead(self) -> list[int]:
        """Returns for an any-angle route the number of steps of each of its segments, from the cell passed last
        on."""
        last = len(self._cells) - 1
        ends = [turn for turn in self._turns if self._at < turn < last] + [last] * (last > self._at)
        return [end - begin for begin, end in pairwise((self._at, *ends))] if self._turns else []

    def near(self, count: int) -> list[int]:
        """The cell of the route that the vehicle passed last, and the next ones."""
        return self._cells[self._at : self._at + count]

    def ahead(self, count: int | None = None) -> list[int]:
        """The next `count` cells, or all that are left, without the one on which the vehicle is."""
        first = self._at + 1
        return self._cells[first:] if count is None else self._cells[first : first + count]

    def cut(self, passable: Callable[[Sequence[int]], int]) -> bool:
        """Ends the route before the first step ahead that is not passable; True if there is one.

        passable  how many steps from the first of some cells on are
        """
        keep = self._at + 1 + passable(self._cells[self._at :])
        if keep >= len(self._cells):
            return False
        self._set(self._cells[:keep], self._at)
        self.partial = False
        return True
