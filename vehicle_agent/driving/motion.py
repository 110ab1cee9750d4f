"""The motion of one vehicle: where it is between two cells, and how far it gets in a given time."""

from __future__ import annotations

import math
from typing import NamedTuple

from swarm.grid import GridSpec

_BEFORE_BORDER = 1.0 - 1e-9
"""Share of the way to a border at which one stops that must not pass it."""
Point = tuple[float, float]
"""Row and col, whole numbers in the middles of cells."""
Stop = tuple[int, Point]
"""Beginning or end of a step: a cell, and a point in it."""


class Motion:
    """A step from a point of cell `tail` to a point of cell `head`: their middles, but on a pulled route. At rest
    both are the same cell.

    The vehicle is a point. It occupies `tail` up to their border, or the corner that they share, and `head` from
    there on.

    cell         the one cell that the vehicle occupies
    at_rest      whether it stands where a step ends, so that it may set out in any direction
    done_m       metres driven of the step
    length_m     metres of the step; 0 at rest
    border_m     metres of it up to the border
    heading_rad  clockwise from north
    """

    def __init__(self, grid: GridSpec, cell: int) -> None:
        self._grid = grid
        self.heading_rad = 0.0
        self._via: Point | None = None
        """Point where it passes the border, if the step is not from middle to middle."""
        self.put(cell)

    def put(self, cell: int) -> None:
        """At rest in the middle of a cell."""
        self.tail = self.head = self.cell = cell
        self._at = self._to = middle_of(self._grid, cell)
        self.done_m = self.length_m = self.border_m = 0.0
        self.at_rest = True

    def _settle(self) -> None:
        """Updates the cell. Like the state of rest, it is read far more often than it changes."""
        self.cell = self.tail if self.done_m < self.border_m else self.head

    @property
    def goal(self) -> Stop:
        """End of the step."""
        return self.head, self._to

    @property
    def left_m(self) -> float:
        """Metres of the step that are not driven yet."""
        return self.length_m - self.done_m

    @property
    def entering(self) -> int | None:
        """The cell that it drives towards and does not occupy yet; None if there is none."""
        return None if self.cell == self.head else self.head

    def set_out(self, cell: int, to: Point | None = None) -> None:
        """Begins a step to a neighbour cell. Raises ValueError if it is not at rest or the cell is no neighbour.

        to  the point inside that cell where the step ends, as row and col; None is its middle
        """
        rows = cell // self._grid.cols - self.head // self._grid.cols
        cols = cell % self._grid.cols - self.head % self._grid.cols
        if not self.at_rest or max(abs(rows), abs(cols)) != 1:
            raise ValueError(f"no step from cell {self.head} to {cell}")
        self._to = middle_of(self._grid, cell) if to is None else to
        way = way_of(self._grid, (self.head, self._at), (cell, self._to))
        self._via, self.border_m, self.length_m = way.via, way.border_m, way.length_m
        self.head = cell
        self.at_rest = False
        self.done_m = 0.0
        self.heading_rad = way.heading_rad
        self._settle()

    def turn_back(self) -> None:
        """Returns to where the step began, if it has not entered the next cell."""
        if self.entering is not None:
            self.tail, self.head = self.head, self.tail
            self._at, self._to = self._to, self._at
            self.done_m = self.length_m - self.done_m
            self.border_m = self.length_m - self.border_m
            self.heading_rad = (self.heading_rad + math.pi) % math.tau
            self._settle()

    def advance(self, seconds: float, pace_s_per_m: float, *, enters: bool = True) -> float:
        """Drive for some seconds at a pace in s/m, at most to the border of `head` or, behind it, to the end.

        enters  whether it may enter `head`; else it stops before the border

        Returns the seconds that are left.
        """
        goal_m = self.border_m if self.done_m < self.border_m else self.length_m
        if not enters and self.entering is not None:
            goal_m = max(goal_m * _BEFORE_BORDER, self.done_m)
            needed_s = (goal_m - self.done_m) * pace_s_per_m
            if needed_s <= seconds:
                self.done_m = goal_m
                return seconds - needed_s
        needed_s = (goal_m - self.done_m) * pace_s_per_m
        if needed_s > seconds:
            self.done_m += seconds / pace_s_per_m
            if self.done_m >= self.border_m:  # rounding may take it there
                self.cell = self.head
            return 0.0
        self.done_m = goal_m
        if goal_m == self.length_m:
            self.tail, self._at = self.head, self._to
            self.done_m = self.length_m = self.border_m = 0.0
            self.at_rest = True
        self._settle()
        return seconds - needed_s

    def stretch(self) -> tuple[Point, Point, float]:
        """Beginning and end of the current straight stretch, and the share of it that is driven, 0 to 1."""
        if self._via is None or not self.length_m:
            return self._at, self._to, self.done_m / self.length_m if self.length_m else 0.0
        if self.done_m < self.border_m:
            return self._at, self._via, self.done_m / self.border_m
        return self._via, self._to, (self.done_m - self.border_m) / (self.length_m - self.border_m)

    def place_m(self) -> tuple[float, float]:
        """(east, south) in metres from the north-west corner of the grid."""
        row, col = self._at
        if self.length_m:
            (row, col), (row1, col1), share = self.stretch()
            row, col = row + share * (row1 - row), col + share * (col1 - col)
        return (col + 0.5) * self._grid.resolution_m, (row + 0.5) * self._grid.resolution_m


class Way(NamedTuple):
    """A step from a point of a cell to a point of a neighbour.

    via          where it passes their border; None if it leads from middle to middle
    border_m     metres up to there; length_m: of the whole
    heading_rad  clockwise from north
    """

    via: Point | None
    border_m: float
    length_m: float
    heading_rad: float


def way_of(grid: GridSpec, start: Stop, goal: Stop) -> Way:
    """The step between two neighbours: straight, or over their corner, so that it touches no other cell."""
    (tail, begin), (head, end) = start, goal
    middle = middle_of(grid, tail)
    rows, cols = head // grid.cols - tail // grid.cols, head % grid.cols - tail % grid.cols
    heading_rad = math.atan2(end[1] - begin[1], begin[0] - end[0]) % math.tau
    if begin == middle and end == middle_of(grid, head):
        length_m = math.hypot(rows, cols) * grid.resolution_m
        return Way(None, 0.5 * length_m, length_m, heading_rad)
    via = _via(begin, end, (middle[0] + 0.5 * rows, middle[1] + 0.5 * cols), rows, cols)
    border_m = math.dist(begin, via) * grid.resolution_m
    return Way(via, border_m, border_m + math.dist(via, end) * grid.resolution_m, heading_rad)


def middle_of(grid: GridSpec, cell: int) -> Point:
    """The middle of a cell."""
    return float(cell // grid.cols), float(cell % grid.cols)


def _via(begin: Point, end: Point, shared: Point, rows: int, cols: int) -> Point:
    """Returns the point where a step passes from its cell into the next. For a straight step it lies on the common
    edge, and `shared` is the middle of that edge. For a diagonal step it is the common corner, and `shared` is that
    corner."""
    if rows and cols:
        return shared
    if rows:
        share = (shared[0] - begin[0]) / (end[0] - begin[0])
        return shared[0], begin[1] + share * (end[1] - begin[1])
    share = (shared[1] - begin[1]) / (end[1] - begin[1])
    return begin[0] + share * (end[0] - begin[0]), shared[1]
