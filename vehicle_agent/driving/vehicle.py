"""One vehicle: what it makes of routes, refusals and silence. Events in, actions out; driving is the agent's."""

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
"""A route that was given in parts is asked for again when so few cells are left."""


class Reason(enum.Enum):
    """Why a vehicle asks for a route. The last three are re-route requests: its own route does not lead it on."""

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


# --- events -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Assigned:
    target: str


@dataclass(frozen=True, slots=True)
class NoWay:
    """Every planner has answered, and none knows a way from here."""


@dataclass(frozen=True, slots=True)
class RouteGiven:
    """A route, asked for or pushed. `cells` begins where the planner took the vehicle to be."""

    target: str
    cells: tuple[int, ...]
    cost_s: float
    lower_bound_s: float
    partial: bool
    pushed: bool = False


@dataclass(frozen=True, slots=True)
class RouteRefused:
    target: str
    status: RouteStatus


@dataclass(frozen=True, slots=True)
class NoAnswer:
    """Nobody answered the request, or too late: normal, ask again."""


@dataclass(frozen=True, slots=True)
class PlannerGone:
    pass


@dataclass(frozen=True, slots=True)
class PlannerBack:
    pass


@dataclass(frozen=True, slots=True)
class TargetReached:
    pass


@dataclass(frozen=True, slots=True)
class TargetLeft:
    pass


@dataclass(frozen=True, slots=True)
class TargetJumped:
    pass


@dataclass(frozen=True, slots=True)
class RouteCut:
    """A cell ahead is closed; the route now ends before it."""


@dataclass(frozen=True, slots=True)
class MakesWay:
    """Leaves its route for a neighbouring cell."""


@dataclass(frozen=True, slots=True)
class MadeWay:
    """Stands aside, and rests there until a given time."""

    rest_until_ns: int


@dataclass(frozen=True, slots=True)
class StillBlocked:
    """Somebody has stood in the way for long; perhaps the planner knows another."""


VehicleEvent = (
    Assigned
    | NoWay
    | RouteGiven
    | RouteRefused
    | NoAnswer
    | PlannerGone
    | PlannerBack
    | TargetReached
    | TargetLeft
    | TargetJumped
    | RouteCut
    | MakesWay
    | MadeWay
    | StillBlocked
)


# --- actions ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class AskRoute:
    vehicle: str
    target: str
    cell: int
    force: bool
    reason: Reason


@dataclass(frozen=True, slots=True)
class Follow:
    """It has begun a route, from the cell on which it stands."""

    vehicle: str
    target: str
    cells: tuple[int, ...]
    cost_s: float
    lower_bound_s: float


VehicleAction = AskRoute | Follow


# --- the core -----------------------------------------------------------------------------------------------


class Vehicle:
    """State of one vehicle. The agent drives it along `route` through `motion`, and tells it what happens."""

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
        self._retry_ns = _RETRY_NS
        self._ask_due_ns = 0
        self._rest_until_ns = 0
        self._making_way = False

    @property
    def cell(self) -> int:
        return self.motion.cell

    def resting(self, now_ns: int) -> bool:
        """Whether it keeps off its way for somebody else's sake."""
        return self._making_way or now_ns < self._rest_until_ns

    def handle(self, event: VehicleEvent, now_ns: int) -> list[VehicleAction]:
        actions: list[VehicleAction] = []
        match event:
            case Assigned(target):
                self._assigned(target, now_ns)
            case NoWay():
                if not self.in_reach and not self.route.left:
                    self.state = VehicleState.STRANDED
                    self._need = None
            case RouteGiven():
                actions = self._given(event, now_ns)
            case RouteRefused(target, status):
                self._refused(target, status, now_ns)
            case NoAnswer():
                self.asked = None
                self._again(now_ns)
            case PlannerGone():
                self.planner_gone = True
                self.gone_since_ns = now_ns
                self.asked = None
            case PlannerBack():
                self.planner_gone = False
                self._want(Reason.PLANNER_BACK, now_ns)
            case TargetReached():
                self.in_reach = True
                self._need = None
            case TargetLeft():
                self.in_reach = False
            case TargetJumped():
                if not self.in_reach:
                    self._want(Reason.JUMPED, now_ns)
            case RouteCut():
                self._align()
                self._want(Reason.CUT, now_ns)
            case MakesWay():
                self.route.drop()
                self._making_way = True
            case MadeWay(rest_until_ns):
                self._making_way = False
                self._rest_until_ns = rest_until_ns
                self._want(Reason.BLOCKED, now_ns)
            case StillBlocked():
                self._want(Reason.BLOCKED, now_ns)
        self._settle()
        return actions

    def tick(self, now_ns: int) -> list[VehicleAction]:
        """Ask for a route where one is needed and the time has come."""
        if self.target is None or self.in_reach or self.planner_gone or self.resting(now_ns):
            return []
        if self._need is None and self.state is not VehicleState.STRANDED:
            if self.route.left == 0 and self.motion.at_rest:
                self._need = Reason.CONTINUED if self.route.partial else Reason.RAN_OUT
            elif self.route.partial and self.route.left <= PREFETCH_CELLS:
                self._need = Reason.CONTINUED
            self._settle()
        if self._need is None or self.asked is not None or now_ns < self._ask_due_ns:
            return []
        self.asked = self.target
        self._ask_due_ns = now_ns + self._retry_ns
        force = self._need is Reason.RAN_OUT
        return [AskRoute(self.id, self.target, self.cell, force, self._need)]

    def _assigned(self, target: str, now_ns: int) -> None:
        if target == self.target and self.state is not VehicleState.STRANDED:
            return
        self.asked = None
        if target != self.target:
            self.target = target
            self.in_reach = self.planner_gone = False
        if self.state is VehicleState.IDLE:
            self.state = VehicleState.WAITING
        self._want(Reason.ASSIGNED, now_ns)

    def _given(self, given: RouteGiven, now_ns: int) -> list[VehicleAction]:
        if not given.pushed:
            self.asked = None
        if given.target != self.target or self.resting(now_ns):
            return []
        if not self.route.begin(given.cells, self.cell, given.partial):
            # It has driven on to where the new route does not pass: stop, so that the next answer fits.
            self.route.drop()
            self._align()
            self._want(Reason.ASSIGNED, now_ns)
            return []
        self._align()
        self._need = None
        self._retry_ns = _RETRY_NS
        if self.state is VehicleState.STRANDED:
            self.state = VehicleState.FOLLOWING
        driven = (self.cell, *self.route.ahead())
        return [Follow(self.id, given.target, driven, given.cost_s, given.lower_bound_s)]

    def _refused(self, target: str, status: RouteStatus, now_ns: int) -> None:
        self.asked = None
        if target != self.target:
            return
        if status is RouteStatus.NO_TARGET:
            self._again(now_ns)
        elif not self.route.left:
            self.state = VehicleState.STRANDED
            self._need = Reason.ASSIGNED
            self._ask_due_ns = now_ns + _STRANDED_RETRY_NS

    def _want(self, reason: Reason, now_ns: int) -> None:
        self._need = reason
        self._ask_due_ns = min(self._ask_due_ns, now_ns + _RETRY_NS)

    def _again(self, now_ns: int) -> None:
        if self._need is not None:
            self._ask_due_ns = now_ns + self._retry_ns
            self._retry_ns = min(2 * self._retry_ns, _LONGEST_RETRY_NS)

    def _align(self) -> None:
        """Turn back from a cell that is not entered yet and no longer next."""
        entering = self.motion.entering
        if entering is not None and self.route.ahead(1) != [entering]:
            self.motion.turn_back()

    def _settle(self) -> None:
        """The state that follows from what is known."""
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
