"""What a planner is told and what it wants done: frozen values, so that a test is equality and a log a replay."""

from __future__ import annotations

from dataclasses import dataclass

from planner_service.target_tree import GrownTree
from swarm.wire.messages.planning import (
    CostReply,
    CostRequest,
    PlannerStatus,
    PushedRoute,
    RouteReply,
    RouteRequest,
)
from swarm.wire.messages.targets import TargetPose
from swarm.wire.messages.vehicles import Fleet

# --- events ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PoseHeard:
    pose: TargetPose


@dataclass(frozen=True, slots=True)
class FleetHeard:
    fleet: Fleet


@dataclass(frozen=True, slots=True)
class RoutesAsked:
    """`ask` names the query for the answer."""

    ask: int
    request: RouteRequest


@dataclass(frozen=True, slots=True)
class CostsAsked:
    ask: int
    request: CostRequest


@dataclass(frozen=True, slots=True, eq=False)
class TreeGrown:
    """The worker is done with the last `GrowTree`."""

    grown: GrownTree
    took_ns: int


Event = PoseHeard | FleetHeard | RoutesAsked | CostsAsked | TreeGrown


# --- actions --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class GrowTree:
    """Give `Planner.growth(action)` to a worker, at once, and bring back what it returns as `TreeGrown`."""

    target_cell: int
    map_version: int


@dataclass(frozen=True, slots=True)
class AnswerRoutes:
    ask: int
    reply: RouteReply


@dataclass(frozen=True, slots=True)
class AnswerCosts:
    ask: int
    reply: CostReply


@dataclass(frozen=True, slots=True)
class Refuse:
    ask: int
    reason: str


@dataclass(frozen=True, slots=True)
class Push:
    pushed: PushedRoute


@dataclass(frozen=True, slots=True)
class Tell:
    status: PlannerStatus


Action = GrowTree | AnswerRoutes | AnswerCosts | Refuse | Push | Tell
