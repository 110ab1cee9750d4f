"""One vehicle: its target, its route, how far along it the vehicle is, and when it asks for another. Its agent
drives it."""

from __future__ import annotations

import enum
from array import array
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate, groupby, pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.grid import REGION_CELLS, GridSpec, bounds_of
from swarm.wire.fields import pack_column
from swarm.wire.messages.vehicles import Followed, VehicleState
from swarm.wire.route_columns import RouteStatus, directions_of
from vehicle_agent.driving.motion import CELL, HEADING_RAD, Motion, places_m, rows_of

_NOWHERE = (9, 9, 0, 0)
"""A rectangle that holds nothing, nor does the one that is a cell wider on each side."""
_SKIPPED_CELLS = 24
"""A vehicle that others push may come back to its route so far on."""
_LEAST_PART = 1e-9
"""Share of a segment below which it only touches a cell."""


class Follower:
    """The cells of a vehicle's route and how far along it the vehicle is. Without a route no cell is ahead.
    `Follower` of `planner_service.followers` is another class: a vehicle as its planner knows it.

    left     how many cells are ahead
    changes  how often the route was begun, dropped or cut
    version  number of changes of the route or of the vehicle's progress
    """

    def __init__(self) -> None:
        self._cells = array("q")
        """Not a list: a thousand routes of ten thousand cells would take a third of a GB."""
        self._at = 0
        self._turns: Sequence[int] = ()
        """For an any-angle route the indices of the cells in which it turns, its first and last included; and
        these cells."""
        self._turn_cells: Sequence[int] = ()
        self._bounds: tuple[int, int, int, int] | None = None
        self.left = self.changes = self.version = 0
        self.partial = False
        """True if the route ends before its target, because the planner gave a part of it."""

    def begin(
        self, cells: Sequence[int], path: Sequence[int], partial: bool = False, turns: Sequence[int] = ()
    ) -> bool:
        """Follows a route from the first cell of the vehicle's path that lies on the route. Returns False, and
        changes nothing, if none does.

        turns  for an any-angle route: indices of the cells in which it turns, first and last included
        """
        at = next((cells.index(cell) for cell in path if cell in cells), None)
        if at is None:
            return False
        self._set(array("q", cells), at)
        self.partial = partial
        self._turns, self._turn_cells = turns, [cells[turn] for turn in turns]
        return True

    def drop(self) -> None:
        self._set(array("q"), 0)
        self._turns = self._turn_cells = ()
        self.partial = False

    def _set(self, cells: array[int], at: int) -> None:
        self._cells, self._at, self._bounds = cells, at, None
        self.left = max(len(cells) - at - 1, 0)
        self.changes += 1
        self.version += 1

    def bounds(self, cols: int) -> tuple[int, int, int, int]:
        """Returns the smallest (row, col) and the greatest of all its cells in a grid with `cols` columns;
        without cells an empty rectangle. Kept, as a route changes seldom and the map all the time."""
        if self._bounds is None:
            self._bounds = bounds_of(self._cells, cols) if self._cells else _NOWHERE
        return self._bounds

    def moved(self, cell: int) -> None:
        """Notes the cell that the vehicle has entered: the next one of its route, one further on, or none of it."""
        index = self._find(cell)
        if index is not None:
            self._at = index
            self.left = len(self._cells) - self._at - 1
            self.version += 1

    def after(self, cell: int, count: int) -> list[int]:
        """The next `count` cells after a cell of the route; none if the cell is not on it."""
        index = self._find(cell)
        return [] if index is None else self._cells[index + 1 : index + 1 + max(count, 0)].tolist()

    def _find(self, cell: int) -> int | None:
        """Returns the index on the route of a cell that the vehicle may enter next; None if the cell is not such a
        cell."""
        try:
            return self._cells.index(cell, self._at, self._at + _SKIPPED_CELLS)
        except ValueError:
            return None

    def point(self, cell: int, cols: int) -> tuple[float, float] | None:
        """Returns the point where an any-angle route passes one of its next cells, as row and col: the midpoint of
        the segment within the cell. None if it is the middle of the cell.

        A cell that the segment does not cross, whatever a planner states, is driven through its middle.
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
        return self._cells[self._at : self._at + count].tolist()

    def ahead(self, count: int | None = None) -> list[int]:
        """The next `count` cells, or all that are left, without the one on which the vehicle is."""
        first = self._at + 1
        last = len(self._cells) if count is None else first + count
        return self._cells[first:last].tolist()

    def cut(self, passable: Callable[[Sequence[int]], int]) -> bool:
        """Ends the route before the first step ahead that is not passable; True if there is one.

        passable  returns how many first steps of a cell list are passable
        """
        keep = self._at + 1 + passable(self._cells[self._at :])
        if keep >= len(self._cells):
            return False
        self._set(self._cells[:keep], self._at)
        self.partial = False
        return True


_RETRY_NS = NS_PER_S // 5
"""First interval between two requests of a vehicle that needs a route. Chosen, not measured."""
_LONGEST_RETRY_NS = 3 * NS_PER_S
"""It doubles up to this one. Chosen, not measured."""
STRANDED_RETRY_NS = 3 * NS_PER_S
"""Vehicles without a path ask again so soon: only a changed map gives them one."""
PREFETCH_CELLS = 8
"""The next part of a partial route is requested when so few cells of the terrain are left."""


PLACES = "place:"
"""Before a cell, in the name of a place as a target; no id of a target has a colon. Alone: the planner of all
places."""
_PLACE = "place"
"""The target of a route to a place, for those who watch."""


def goal_name(cell: int) -> str:
    """The name of a place that a vehicle goes for like a target, which has no tracker and stays."""
    return f"{PLACES}{cell}"


def goal_of(target: str | None) -> int | None:
    """The cell of a place to which a vehicle was sent; None for a target."""
    return int(target.removeprefix(PLACES)) if target is not None and target.startswith(PLACES) else None


class Reason(enum.Enum):
    """Reason why a vehicle requests a route. The last three are re-route requests: its own route does not lead it
    on."""

    ASSIGNED = "assigned"
    CONTINUED = "continued"
    PLANNER_BACK = "planner back"
    JUMPED = "target jumped"
    RAN_OUT = "ran out"
    CUT = "cut"
    BLOCKED = "blocked"

    @property
    def is_reroute(self) -> bool:
        return self in (Reason.RAN_OUT, Reason.CUT, Reason.BLOCKED)


# --- what passes between a vehicle and its agent -------------------------------------------------------------


class GivenRoute(msgspec.Struct, frozen=True):
    """A route from a planner, requested or pushed.

    cells          of right of way, from the cell in which the planner assumed the vehicle
    cost_s         its cost, in seconds
    lower_bound_s  proven lower bound of the cost of any route
    partial        whether it ends before the target
    searching      whether it leads to a cell where the unseen target may be
    turns          for an any-angle route: indices of the cells in which it turns, first and last included
    """

    target: str
    cells: tuple[int, ...]
    cost_s: float
    lower_bound_s: float
    partial: bool
    pushed: bool = False
    searching: bool = False
    turns: tuple[int, ...] = ()


# --- the core -----------------------------------------------------------------------------------------------


class Vehicle:
    """State of one vehicle. Its agent drives it along `route` through `motion`, and tells it what happens.

    target        the target, or the name of the place, that it goes for; None before the first assignment
    goal          the terrain's cell of that place; None of a target
    in_reach      whether that target is within capture range
    tracked       whether that target has a living tracker; if not, `in_reach` refers to its last pose
    planner_gone  whether that target's planner is dead, since `gone_since_ns`
    asked         the target of the open route request, None if there is none
    searching     whether its last route led to a cell where its unseen target may be
    decided       path and route version of the agent's last decision: while both are unchanged, the vehicle needs
                  nothing new. None while that may change at any time
    """

    def __init__(self, id: str, grid: GridSpec, cell: int) -> None:
        self.id = id
        self._grid = grid
        self._prefetch_cells = PREFETCH_CELLS * grid.parts
        self.state = VehicleState.IDLE
        self.target: str | None = None
        self.goal: int | None = None
        self.motion = Motion(grid, cell)
        self.route = Follower()
        self.in_reach = False
        self.tracked = True
        self.planner_gone = False
        self.gone_since_ns = 0
        self.asked: str | None = None
        self.searching = False
        self.decided: tuple[Sequence[int], int] | None = None
        self._need: Reason | None = None
        """Reason why it needs a route; None if it needs none."""
        self._retry_ns = _RETRY_NS
        """Doubles with each unanswered request, until a route comes."""
        self._ask_due_ns = 0

    @property
    def cell(self) -> int:
        return self.motion.cell

    @property
    def terrain_cell(self) -> int:
        """The cell of the terrain in which it is."""
        return self._grid.terrain_cell(self.motion.cell)

    # --- targets and planners -------------------------------------------------------------------------------

    def assign(self, target: str, now_ns: int) -> None:
        """Makes the vehicle chase this target, or drive to this place, from now on."""
        if target == self.target and self.state is not VehicleState.STRANDED:
            self._settle()
            return
        self.asked = None
        if target != self.target:
            self.target, self.goal = target, goal_of(target)
            self.in_reach = self.planner_gone = self.searching = False
        if self.state is VehicleState.IDLE:
            self.state = VehicleState.WAITING
        self._need_route(Reason.ASSIGNED, now_ns)

    def release(self) -> None:
        """Leaves the vehicle without a target until another is assigned."""
        self.target = self.goal = self.asked = self._need = None
        self.in_reach = self.planner_gone = self.searching = False
        self.route.drop()
        self.state = VehicleState.IDLE

    def no_way(self) -> None:
        """Notes that all planners have replied, and none has a route from here."""
        if not self.in_reach and self._strands():
            self._need = None
        self._settle()

    def lose_planner(self, now_ns: int) -> None:
        self.planner_gone = True
        self.gone_since_ns = now_ns
        self.asked = None
        self._settle()

    def regain_planner(self, now_ns: int) -> None:
        self.planner_gone = False
        self._need_route(Reason.PLANNER_BACK, now_ns)

    def set_in_reach(self, in_reach: bool) -> None:
        """Sets whether the target is within capture range."""
        self.in_reach = in_reach
        if in_reach:
            self._need = None
            self.searching = False
        self._settle()

    def set_tracked(self, tracked: bool) -> None:
        """Sets whether its target has a living tracker: without one it goes on, by an old pose."""
        self.tracked = tracked
        self._settle()

    def target_jumped(self, now_ns: int) -> None:
        """Notes that its target is suddenly elsewhere, or is seen again."""
        self.searching = False
        if self.in_reach:
            self._settle()
        else:
            self._need_route(Reason.JUMPED, now_ns)

    # --- routes ---------------------------------------------------------------------------------------------

    def route_request(self, now_ns: int) -> Reason | None:
        """Reason why it asks its target's planner for a route, if it needs one and the time for it has come."""
        if self.target is None or self.in_reach or self.planner_gone:
            return None
        if self._need is None and self.state is not VehicleState.STRANDED:
            left = self.route.left
            if left == 0:
                if self.motion.at_rest:
                    continues = self.route.partial or self.searching
                    self._need = Reason.CONTINUED if continues else Reason.RAN_OUT
                elif self.route.partial:
                    self._need = Reason.CONTINUED
                self._settle()  # of all that the state follows from, only this changes by driving
            elif left <= self._prefetch_cells and self.route.partial:
                self._need = Reason.CONTINUED
        if self._need is None or self.asked is not None or now_ns < self._ask_due_ns:
            return None
        self.asked = self.target
        self._ask_due_ns = now_ns + self._retry_ns
        return self._need

    @property
    def needs_nothing(self) -> bool:
        """True if the vehicle chases a target and has more than `PREFETCH_CELLS` cells of route left:
        `route_request` then returns None, and need not be called."""
        goes = self.target is not None and self.goal is None and not self.in_reach and self._need is None
        return goes and self.state is not VehicleState.STRANDED and self.route.left > self._prefetch_cells

    def give_route(self, given: GivenRoute, path: Sequence[int], now_ns: int) -> Followed | None:
        """Begins the route, if it leads to the target and passes a cell of the vehicle's path. Returns what to tell
        of it."""
        if not given.pushed:
            self.asked = None
        begun = None
        if given.target == self.target:
            if self.route.begin(given.cells, path, given.partial, given.turns):
                begun = self._begin(given, path)
            else:
                # It has driven on to where the new route does not pass: stop, so that the next answer fits.
                self.route.drop()
                self._need_route(Reason.ASSIGNED, now_ns)
        self._settle()
        return begun

    def refuse_route(self, target: str, status: RouteStatus, now_ns: int) -> None:
        """Notes that the planner of a target has no route, and why."""
        self.asked = None
        if target == self.target:
            if status is RouteStatus.NO_TARGET:
                self._ask_later(now_ns)
            elif self._strands():
                self._need = Reason.ASSIGNED
                self._ask_due_ns = now_ns + STRANDED_RETRY_NS
        self._settle()

    def no_answer(self, now_ns: int) -> None:
        """Notes that a request ended without a usable route. The wait before the next one grows each time."""
        self.asked = None
        self._ask_later(now_ns)
        self._settle()

    def cut_route(self, now_ns: int) -> None:
        """Notes that the route now ends before a closed cell."""
        self._need_route(Reason.CUT, now_ns)

    def blocked_for_long(self, now_ns: int) -> None:
        """Notes that it was pushed off its route, or has not moved for long: the planner may know another route."""
        if self._need is None:
            self._need_route(Reason.BLOCKED, now_ns)

    # --- inside ---------------------------------------------------------------------------------------------

    def _strands(self) -> bool:
        """Gives up its route unless it drives on along one: a route on which it stands, to where no way leads any
        more, would hide that."""
        strands = not self.route.left or self.motion.at_rest
        if strands:
            self.route.drop()
            self.state = VehicleState.STRANDED
            self.searching = False
        return strands

    def _begin(self, given: GivenRoute, path: Sequence[int]) -> Followed:
        self._need = None
        self._retry_ns = _RETRY_NS
        self.searching = given.searching
        if self.state is VehicleState.STRANDED:
            self.state = VehicleState.FOLLOWING
        (start,) = self.route.near(1)
        before = path[: path.index(start)]
        cells = list(map(self._grid.terrain_cell, (*before, start, *self.route.ahead())))
        steps = list(accumulate((tail != head for tail, head in pairwise(cells)), initial=0))
        legs = self.route.legs_ahead()
        ends = list(accumulate([1] * (len(before) * bool(legs)) + legs, initial=0))
        legs = [steps[end] - steps[begin] for begin, end in pairwise(ends) if steps[end] > steps[begin]]
        return Followed(
            vehicle=self.id,
            target=given.target if self.goal is None else _PLACE,
            start=cells[0],
            directions=directions_of([cell for cell, _ in groupby(cells)], self._grid.cols // self._grid.parts),
            cost_s=given.cost_s,
            lower_bound_s=given.lower_bound_s,
            legs=pack_column(legs, "<u4"),
        )

    def _need_route(self, reason: Reason, now_ns: int) -> None:
        self._need = reason
        self._ask_due_ns = min(self._ask_due_ns, now_ns + _RETRY_NS)
        self._settle()

    def _ask_later(self, now_ns: int) -> None:
        if self._need is not None:
            self._ask_due_ns = now_ns + self._retry_ns
            self._retry_ns = min(2 * self._retry_ns, _LONGEST_RETRY_NS)

    def _settle(self) -> None:
        """Derives the state from known facts, one of which has changed."""
        self.decided = None
        if self.target is None:
            return
        if self.in_reach:
            self.state = VehicleState.ARRIVED if self.tracked else VehicleState.OUTDATED
        elif self.planner_gone:
            self.state = VehicleState.LOST
        elif self.searching:
            self.state = VehicleState.SEARCHING
        elif self.route.left:
            self.state = VehicleState.FOLLOWING if self.tracked else VehicleState.OUTDATED
        elif self.state is not VehicleState.STRANDED:
            self.state = VehicleState.WAITING


class Places:
    """Vehicles and their places at one instant, in one order.

    vehicles     in the order of all arrays
    cells        int64 (n,), flat indices of cells of right of way
    regions      int64 (n,), of the terrain
    east_m       float64 (n,), from the grid's west border
    south_m      float64 (n,), from its north border
    heading_rad  float64 (n,), clockwise from north
    """

    def __init__(self, grid: GridSpec, vehicles: Iterable[Vehicle]) -> None:
        self.vehicles = list(vehicles)
        rows = rows_of([vehicle.motion for vehicle in self.vehicles])
        self.east_m, self.south_m = places_m(rows, grid)
        self.heading_rad: NDArray[np.float64] = rows[:, HEADING_RAD]
        self.cells: NDArray[np.int64] = rows[:, CELL].astype(np.int64)
        (row, col), side = np.divmod(self.cells, grid.cols), REGION_CELLS * grid.parts
        self.regions: NDArray[np.int64] = row // side * -(-grid.cols // side) + col // side
