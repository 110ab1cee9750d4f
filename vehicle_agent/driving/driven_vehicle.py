"""One vehicle: its target, its route and when it asks for another. Its agent drives it."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.grid import REGION_CELLS, GridSpec
from swarm.wire.messages.vehicles import VehicleState
from swarm.wire.route_columns import RouteStatus
from vehicle_agent.driving.motion import CELL, HEADING_RAD, Motion, places_m, rows_of
from vehicle_agent.driving.route_follower import Follower

_RETRY_NS = NS_PER_S // 5
_LONGEST_RETRY_NS = 3 * NS_PER_S
_STRANDED_RETRY_NS = 3 * NS_PER_S
PREFETCH_CELLS = 8
"""The next part of a partial route is requested when so few cells are left."""


PLACES = "place:"
"""Before a cell, in the name of a place as a target; no id of a target has a colon. Alone: the planner of all
places."""


def goal_name(cell: int) -> str:
    """The name of a place that a vehicle goes for like a target, which has no tracker and stays."""
    return f"{PLACES}{cell}"


def goal_of(target: str | None) -> int | None:
    """The cell of a place that a vehicle goes for like a target; None of a target."""
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

    cells          the first is where the planner took the vehicle to be
    cost_s         its cost, in seconds
    lower_bound_s  proven lower bound of the cost of any route
    partial        whether it ends before the target
    searching      whether it leads to a cell where the unseen target may be
    turns          of a pulled route the indices of the cells in which it turns, its first and last included
    """

    target: str
    cells: tuple[int, ...]
    cost_s: float
    lower_bound_s: float
    partial: bool
    pushed: bool = False
    searching: bool = False
    turns: tuple[int, ...] = ()


class Follow(msgspec.Struct, frozen=True):
    """A vehicle has begun a route, from the cell on which it stands.

    legs  of a pulled route over how many steps each of its segments goes
    """

    vehicle: str
    target: str
    cells: tuple[int, ...]
    cost_s: float
    lower_bound_s: float
    searching: bool = False
    legs: tuple[int, ...] = ()


# --- the core -----------------------------------------------------------------------------------------------


class Vehicle:
    """State of one vehicle. Its agent drives it along `route` through `motion`, and tells it what happens.

    target        the target, or the name of the place, that it goes for; None before the first assignment
    goal          the cell of that place; None of a target
    in_reach      whether that target is within capture range
    tracked       whether that target has a tracker that lives; else it was in reach, and may be anywhere
    planner_gone  whether that target's planner is dead, since `gone_since_ns`
    asked         the target of the open route request, None if there is none
    searching     whether its last route led to a cell where its unseen target may be
    decided       the path and the version of the route for which its agent has decided what it needs: nothing else,
                  while it only rolls on. None while that may change at any time
    """

    def __init__(self, id: str, grid: GridSpec, cell: int) -> None:
        self.id = id
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

    # --- targets and planners -------------------------------------------------------------------------------

    def assign(self, target: str, now_ns: int) -> None:
        """Goes for this target from now on."""
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
        """Goes for no target any more, until another is assigned."""
        self.target = self.goal = self.asked = self._need = None
        self.in_reach = self.planner_gone = self.searching = False
        self.route.drop()
        self.state = VehicleState.IDLE

    def no_way(self) -> None:
        """Every planner has answered, and none knows a route from here."""
        if not self.in_reach and not self.route.left:
            self.state = VehicleState.STRANDED
            self.searching = False
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
        """Its target is somewhere else, or is seen again."""
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
            elif left <= PREFETCH_CELLS and self.route.partial:
                self._need = Reason.CONTINUED
        if self._need is None or self.asked is not None or now_ns < self._ask_due_ns:
            return None
        self.asked = self.target
        self._ask_due_ns = now_ns + self._retry_ns
        return self._need

    @property
    def needs_nothing(self) -> bool:
        """True if no time that passes lets `route_request` return a reason, while it rolls on."""
        goes = self.target is not None and self.goal is None and not self.in_reach and self._need is None
        return goes and self.state is not VehicleState.STRANDED and self.route.left > PREFETCH_CELLS

    def give_route(self, given: GivenRoute, path: Sequence[int], now_ns: int) -> Follow | None:
        """Begins the route, if it leads to the target and passes a cell of the vehicle's path."""
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
        """The planner of a target knows no route."""
        self.asked = None
        if target == self.target:
            if status is RouteStatus.NO_TARGET:
                self._ask_later(now_ns)
            elif not self.route.left:
                self.state = VehicleState.STRANDED
                self.searching = False
                self._need = Reason.ASSIGNED
                self._ask_due_ns = now_ns + _STRANDED_RETRY_NS
        self._settle()

    def no_answer(self, now_ns: int) -> None:
        """The request ended without a usable route: ask again, later each time."""
        self.asked = None
        self._ask_later(now_ns)
        self._settle()

    def cut_route(self, now_ns: int) -> None:
        """A cell ahead is closed, and the route now ends before it."""
        self._need_route(Reason.CUT, now_ns)

    def blocked_for_long(self, now_ns: int) -> None:
        """It was pushed off its route, or has stood for long: the planner may know another route."""
        if self._need is None:
            self._need_route(Reason.BLOCKED, now_ns)

    # --- inside ---------------------------------------------------------------------------------------------

    def _begin(self, given: GivenRoute, path: Sequence[int]) -> Follow:
        self._need = None
        self._retry_ns = _RETRY_NS
        self.searching = given.searching
        if self.state is VehicleState.STRANDED:
            self.state = VehicleState.FOLLOWING
        (start,) = self.route.near(1)
        before = path[: path.index(start)]
        driven = (*before, start, *self.route.ahead())
        legs = self.route.legs_ahead()
        legs = [1] * (len(before) * bool(legs)) + legs
        return Follow(
            self.id, given.target, driven, given.cost_s, given.lower_bound_s, given.searching, tuple(legs)
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

    vehicles
    cells        int64 (n,), flat indices
    regions      int64 (n,)
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
        row, col = np.divmod(self.cells, grid.cols)
        self.regions: NDArray[np.int64] = row // REGION_CELLS * grid.region_cols + col // REGION_CELLS
