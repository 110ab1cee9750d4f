"""Where a vehicle is between two cells, and how far it gets in a while."""

from __future__ import annotations

import math

from swarm.grid import GridSpec


class Motion:
    """A vehicle on its way from the middle of cell `tail` to the middle of cell `head`; at rest they are one cell.

    It occupies the cell that its point is in: `tail` up to half way, `head` from there on.
    """

    __slots__ = ("_grid", "_length_m", "done_m", "head", "heading_rad", "tail")

    def __init__(self, grid: GridSpec, cell: int) -> None:
        self._grid = grid
        self.tail = cell
        self.head = cell
        self.done_m = 0.0
        self._length_m = 0.0
        self.heading_rad = 0.0

    @property
    def cell(self) -> int:
        """The one cell that the vehicle occupies."""
        return self.tail if 2.0 * self.done_m < self._length_m else self.head

    @property
    def at_rest(self) -> bool:
        """Whether it stands in the middle of a cell, free to go anywhere."""
        return self.tail == self.head

    @property
    def entering(self) -> int | None:
        """The cell that it moves towards and does not occupy yet."""
        return None if self.cell == self.head else self.head

    def set_out(self, cell: int) -> None:
        """Begin a step to a neighbour of the cell in whose middle it stands."""
        rows = cell // self._grid.cols - self.head // self._grid.cols
        cols = cell % self._grid.cols - self.head % self._grid.cols
        if not self.at_rest or max(abs(rows), abs(cols)) != 1:
            raise ValueError(f"no step from cell {self.head} to {cell}")
        self.head = cell
        self.done_m = 0.0
        self._length_m = math.hypot(rows, cols) * self._grid.resolution_m
        self.heading_rad = math.atan2(cols, -rows) % math.tau

    def turn_back(self) -> None:
        """Go back to the middle of the cell that it occupies, if it has not left it."""
        if self.entering is not None:
            self.tail, self.head = self.head, self.tail
            self.done_m = self._length_m - self.done_m
            self.heading_rad = (self.heading_rad + math.pi) % math.tau

    def advance(self, seconds: float, pace_s_per_m: float) -> float:
        """Drive at a pace, at most to the border into `head` or to its middle, whichever comes first.

        Returns the seconds that are left.
        """
        border_m = 0.5 * self._length_m
        goal_m = border_m if self.done_m < border_m else self._length_m
        needed_s = (goal_m - self.done_m) * pace_s_per_m
        if needed_s > seconds:
            self.done_m += seconds / pace_s_per_m
            return 0.0
        self.done_m = goal_m
        if goal_m == self._length_m:
            self.tail = self.head
            self.done_m = self._length_m = 0.0
        return seconds - needed_s

    def place_m(self) -> tuple[float, float]:
        """(east, south) metres from the grid's north-west corner."""
        cols, resolution_m = self._grid.cols, self._grid.resolution_m
        share = self.done_m / self._length_m if self._length_m else 0.0
        row0, col0 = divmod(self.tail, cols)
        row1, col1 = divmod(self.head, cols)
        row = row0 + share * (row1 - row0)
        col = col0 + share * (col1 - col0)
        return (col + 0.5) * resolution_m, (row + 0.5) * resolution_m
