"""One vehicle: its target, its route and when it asks for another. Its agent drives it."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import VehicleState
from swarm.wire.routes import RouteStatus
from vehicle_agent.driving.motion import Motion
from vehicle_agent.driving.route_follower import Follower

_RETRY_NS = NS_PER_S // 5
_LONGEST_RETRY_NS = 3 * NS_PER_S
_STRANDED_RETRY_NS = 3 * NS_PER_S
PREFETCH_CELLS = 8
"""The next part of a partial route is requested when so few cells are left."""


class Reason(enum.Enum):
    """Why a vehicle requests a route. The last three are re-route requests: its own route does not lead it on."""

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


@dataclass(frozen=True, slots=True)
class GivenRoute:
    """A route from a planner, requested or pushed.

    cells          the first is where the planner took the vehicle to be
    cost_s         its cost, in seconds
    lower_bound_s  proven lower bound of the cost of any route
    partial        whether it ends before the target
    """

    target: str
    cells: tuple[int, ...]
    cost_s: float
    lower_bound_s: float
    partial: bool
    pushed: bool = False


@dataclass(frozen=True, slots=True)
class AskRoute:
    """A vehicle needs a route from its cell. `force` asks the planner to grow its tree for it if it must."""

    vehicle: str
    target: str
    cell: int
    force: bool
    reason: Reason


@dataclass(frozen=True, slots=True)
class Follow:
    """A vehicle has begun a route, from the cell on which it stands."""

    vehicle: str
    target: str
    cells: tuple[int, ...]
    cost_s: float
    lower_bound_s: float


# --- the core -----------------------------------------------------------------------------------------------


class Vehicle:
    """State of one vehicle. Its agent drives it along `route` through `motion`, and tells it what happens.

    target        the target that it goes for, None before the first assignment
    in_reach      whether that target is within capture range
    planner_gone  whether that target's planner is dead, since `gone_since_ns`
    asked         the target of the open route request, None if there is none
    """

    def __init__(self, id: str, grid: GridSpec, cell: int) -> None:
        self.id = id
        self.state = VehicleState.IDLE
        self.target: str | None = None
        self.motion = Motion(grid, cell)
        self.route = Follower()
        self.in_reach = False
        self.planner_gone = False
        self.gone_since_ns = 0
        self.asked: str | None = None
        self._need: Reason | None = None
        """Why it needs a route; None if it needs none."""
        self._retry_ns = _RETRY_NS
        """Doubles with each unanswered request, until a route comes."""
        self._ask_due_ns = 0
        self._rest_until_ns = 0
        self._making_way = False

    @property
    def cell(self) -> int:
        return self.motion.cell

    def resting(self, now_ns: int) -> bool:
        """Whether it stays off its route so that another can pass."""
        return self._making_way or now_ns < self._rest_until_ns

    # --- targets and planners -------------------------------------------------------------------------------

    def assign(self, target: str, now_ns: int) -> None:
        """Go for this target from now on."""
        if target == self.target and self.state is not VehicleState.STRANDED:
            self._settle()
            return
        self.asked = None
        if target != self.target:
            self.target = target
            self.in_reach = self.planner_gone = False
        if self.state is VehicleState.IDLE:
            self.state = VehicleState.WAITING
        self._need_route(Reason.ASSIGNED, now_ns)

    def no_way(self) -> None:
        """Every planner has answered, and none knows a route from here."""
        if not self.in_reach and not self.route.left:
            self.state = VehicleState.STRANDED
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
        """Whether the target is within capture range."""
        self.in_reach = in_reach
        if in_reach:
            self._need = None
        self._settle()

    def target_jumped(self, now_ns: int) -> None:
        if self.in_reach:
            self._settle()
        else:
            self._need_route(Reason.JUMPED, now_ns)

    # --- routes ---------------------------------------------------------------------------------------------

    def route_request(self, now_ns: int) -> AskRoute | None:
        """The request for a route, if one is needed and the time for it has come."""
        if self.target is None or self.in_reach or self.planner_gone or self.resting(now_ns):
            return None
        if self._need is None and self.state is not VehicleState.STRANDED:
            if self.route.left == 0 and self.motion.at_rest:
                self._need = Reason.CONTINUED if self.route.partial else Reason.RAN_OUT
            elif self.route.partial and self.route.left <= PREFETCH_CELLS:
                self._need = Reason.CONTINUED
            self._settle()
        if self._need is None or self.asked is not None or now_ns < self._ask_due_ns:
            return None
        self.asked = self.target
        self._ask_due_ns = now_ns + self._retry_ns
        force = self._need is Reason.RAN_OUT
        return AskRoute(self.id, self.target, self.cell, force, self._need)

    def give_route(self, given: GivenRoute, now_ns: int) -> Follow | None:
        """Begin the route, if it leads to the target and passes the vehicle's cell."""
        if not given.pushed:
            self.asked = None
        begun = None
        if given.target == self.target and not self.resting(now_ns):
            if self.route.begin(given.cells, self.cell, given.partial):
                begun = self._begin(given)
            else:
                # It has driven on to where the new route does not pass: stop, so that the next answer fits.
                self.route.drop()
                self._turn_back()
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
        self._turn_back()
        self._need_route(Reason.CUT, now_ns)

    # --- making way -----------------------------------------------------------------------------------------

    def make_way(self) -> None:
        """Leave the route for a neighbouring cell, and do not return before `made_way`."""
        self.route.drop()
        self._making_way = True
        self._settle()

    def made_way(self, rest_until_ns: int, now_ns: int) -> None:
        """Stand aside until then, and ask for a route from here."""
        self._making_way = False
        self._rest_until_ns = rest_until_ns
        self._need_route(Reason.BLOCKED, now_ns)

    def blocked_for_long(self, now_ns: int) -> None:
        """The next cell has been occupied for long: the planner may know another route."""
        self._need_route(Reason.BLOCKED, now_ns)

    # --- inside ---------------------------------------------------------------------------------------------

    def _begin(self, given: GivenRoute) -> Follow:
        self._turn_back()
        self._need = None
        self._retry_ns = _RETRY_NS
        if self.state is VehicleState.STRANDED:
            self.state = VehicleState.FOLLOWING
        driven = (self.cell, *self.route.ahead())
        return Follow(self.id, given.target, driven, given.cost_s, given.lower_bound_s)

    def _need_route(self, reason: Reason, now_ns: int) -> None:
        self._need = reason
        self._ask_due_ns = min(self._ask_due_ns, now_ns + _RETRY_NS)
        self._settle()

    def _ask_later(self, now_ns: int) -> None:
        if self._need is not None:
            self._ask_due_ns = now_ns + self._retry_ns
            self._retry_ns = min(2 * self._retry_ns, _LONGEST_RETRY_NS)

    def _turn_back(self) -> None:
        """Turn back from a cell that is not entered yet and no longer next on the route."""
        entering = self.motion.entering
        if entering is not None and self.route.ahead(1) != [entering]:
            self.motion.turn_back()

    def _settle(self) -> None:
        """Derive the state from what is known."""
        if self.target is None:
            return
        if self.in_reach:
            self.state = VehicleState.ARRIVED
        elif self.planner_gone:
            self.state = VehicleState.LOST
        elif self.route.left:
            self.state = VehicleState.FOLLOWING
        elif self.state is not VehicleState.STRANDED:
            self.state = VehicleState.WAITING
