"""A route while it is driven: which cells come next."""

from __future__ import annotations

from collections.abc import Callable, Sequence

_SKIPPED_CELLS = 24
"""A vehicle that others push may come back to its route so far on."""


class Follower:
    """The cells of a route and how far along it the vehicle is. Without a route no cell is ahead.

    changes  how often it has been another route: begun, dropped or cut
    version  how often it, or how far along it the vehicle is, has changed
    """

    __slots__ = ("_at", "_bounds", "_cells", "changes", "partial", "version")

    def __init__(self) -> None:
        self._cells: list[int] = []
        self._at = 0
        self._bounds: tuple[int, int, int, int] | None = None
        self.changes = self.version = 0
        self.partial = False
        """Whether the route ends before its target, because the planner gave a part of it."""

    def begin(self, cells: Sequence[int], path: Sequence[int], partial: bool = False) -> bool:
        """Follow a route from the first cell of a vehicle's path that it passes. False if it passes none; then
        nothing changes."""
        at = next((cells.index(cell) for cell in path if cell in cells), None)
        if at is None:
            return False
        self._set(list(cells), at)
        self.partial = partial
        return True

    def drop(self) -> None:
        self._set([], 0)
        self.partial = False

    def _set(self, cells: list[int], at: int) -> None:
        self._cells, self._at, self._bounds = cells, at, None
        self.changes += 1
        self.version += 1

    def bounds(self, cols: int) -> tuple[int, int, int, int]:
        """The smallest (row, col) and the greatest of all its cells in a grid of so many columns; of no cells a
        rectangle that holds nothing."""
        if self._bounds is None:
            rows = [cell // cols for cell in self._cells or (0,)]
            east = [cell % cols for cell in self._cells or (0,)]
            self._bounds = (min(rows), min(east), max(rows), max(east))
        return self._bounds if self._cells else (1, 1, 0, 0)

    def moved(self, cell: int) -> None:
        """The vehicle has entered a cell: the next one of its route, or one further on, or none."""
        if cell in self._cells[self._at : self._at + _SKIPPED_CELLS]:
            self._at = self._cells.index(cell, self._at)
            self.version += 1

    def after(self, cell: int, count: int) -> list[int]:
        """The next `count` cells behind a cell of the route; none if the cell is not on it."""
        if cell not in self._cells[self._at : self._at + _SKIPPED_CELLS]:
            return []
        first = self._cells.index(cell, self._at) + 1
        return self._cells[first : first + max(count, 0)]

    def near(self, count: int) -> list[int]:
        """The cell of the route that the vehicle passed last, and the next ones."""
        return self._cells[self._at : self._at + count]

    def ahead(self, count: int | None = None) -> list[int]:
        """The next `count` cells, or all that are left, without the one on which the vehicle is."""
        first = self._at + 1
        return self._cells[first:] if count is None else self._cells[first : first + count]

    @property
    def left(self) -> int:
        """How many cells are ahead."""
        left = len(self._cells) - self._at - 1
        return left if left > 0 else 0

    def cut(self, passable: Callable[[Sequence[int]], int]) -> bool:
        """End the route before the first step ahead that is not passable; True if there is one.

        passable  how many steps from the first of some cells on are
        """
        keep = self._at + 1 + passable(self._cells[self._at :])
        if keep >= len(self._cells):
            return False
        self._set(self._cells[:keep], self._at)
        self.partial = False
        return True
