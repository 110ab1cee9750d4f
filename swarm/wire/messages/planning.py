"""Messages about targets: poses and sightings of them, and what their planners are asked, push and tell."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from msgspec import Meta

from swarm.wire.fields import (
    LARGE,
    SMALL,
    AgeMillis,
    AgeSeconds,
    Cell,
    Column,
    Count,
    Distance,
    Gap,
    GridSide,
    Id,
    Incarnation,
    LeaseSeconds,
    Metres,
    Millis,
    Natural,
    StampNs,
    VehicleId,
    Word,
)
from swarm.wire.messages import Message, schema_of
from swarm.wire.route_columns import Route, Routes

GROUND = "ground"
"""The class of vehicles that a request means which names none."""


class RouteRequest(Message, frozen=True, kw_only=True, tag=schema_of("route-request")):
    """Asks for routes from cells to the planner's target. A person may give `row` and `col` instead of `cells`.

    vehicles   ids in the order of `cells`; newer routes are pushed to these until they ask another planner
    max_cells  largest number of steps of each returned route; 0: the whole route, or as much as fits into one
               message
    force      True if a vehicle has reached the end of its route without the target: the planner extends its search
               window to these cells
    vehicle_class  class of the vehicles; each class has its own tree, so its own routes
    """

    cells: Annotated[list[Cell], LARGE] = []
    vehicles: Annotated[list[VehicleId], SMALL] = []
    max_cells: Count = 0
    force: bool = False
    row: Cell | None = None
    col: Cell | None = None
    vehicle_class: Id = GROUND

    def relate(self) -> None:
        if self.vehicles and len(self.vehicles) != len(self.cells):
            raise ValueError(f"{len(self.vehicles)} vehicles for {len(self.cells)} cells")
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class RouteReply(Message, frozen=True, kw_only=True, tag=schema_of("route")):
    """A planner's answer.

    incarnation  of the planner
    map_version  number of changes of its replica
    tree_age_ms  time since the last full growth
    pose_age_s   time since the pose arrived that the route leads to; None before the first
    tracker_lost  no tracker publishes the target now: this is its last known position
    vehicle_class  whose routes these are
    lethal_target  the lethal cell where the target is, to which no route leads: the status is NO_TARGET
    nearest_cell   the cell nearest to it which can be reached; None if none is near
    """

    target: Id
    incarnation: Incarnation
    target_cell: Cell | None
    map_version: Count
    tree_age_ms: AgeMillis
    rows: GridSide
    cols: GridSide
    routes: Routes
    pose_age_s: AgeSeconds | None = None
    tracker_lost: bool = False
    vehicle_class: Id = GROUND
    lethal_target: Cell | None = None
    nearest_cell: Cell | None = None

    def check(self) -> None:
        self.routes.check_bounds()


class PlaceRouteRequest(Message, frozen=True, kw_only=True, tag=schema_of("place-route-request")):
    """Asks for routes from cells to a place. Else as in `RouteRequest`.

    to  the cell of the place
    """

    to: Cell
    cells: Annotated[list[Cell], LARGE] = []
    vehicles: Annotated[list[VehicleId], SMALL] = []
    max_cells: Count = 0
    vehicle_class: Id = GROUND


PlaceStatus = Literal["ok", "growing", "lethal_goal", "outside_goal"]


class PlaceRouteReply(Message, frozen=True, kw_only=True, tag=schema_of("place-route")):
    """Routes to a place, each with a proven lower bound.

    incarnation  of the process that plans
    map_version  number of changes of its replica
    status       "lethal_goal", "outside_goal": there is no route; "growing": some are not known yet, and their
                 status is NO_TARGET: ask again
    """

    to_cell: Cell
    incarnation: Incarnation
    map_version: Count
    routes: Routes
    status: PlaceStatus = "ok"
    vehicle_class: Id = GROUND

    def check(self) -> None:
        self.routes.check_bounds()


class PushedRoute(Message, frozen=True, kw_only=True, tag=schema_of("pushed-route")):
    """A newer route for a vehicle that follows this target, or goes to a place.

    target       None if it goes to a place
    target_cell  of the target or of the place
    """

    vehicle: VehicleId
    target: Id | None
    incarnation: Incarnation
    target_cell: Cell
    map_version: Count
    route: Route


class CostRequest(Message, frozen=True, kw_only=True, tag=schema_of("cost-request")):
    """Asks what it costs to reach the planner's target from each of these cells, in a vehicle of a class."""

    cells: Annotated[list[Cell], LARGE] = []
    row: Cell | None = None
    col: Cell | None = None
    vehicle_class: Id = GROUND

    def relate(self) -> None:
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class CostReply(Message, frozen=True, kw_only=True, tag=schema_of("cost")):
    """A planner's answer: `cost_to_go_s` per asked cell, inf where there is no way or the cell is outside. Else as
    `RouteReply`."""

    target: Id
    incarnation: Incarnation
    target_cell: Cell | None
    map_version: Count
    tree_age_ms: AgeMillis
    cost_to_go_s: Annotated[bytes, Meta(max_length=4 * 100_001), Column("<f4", least=0, most=math.inf)]
    pose_age_s: AgeSeconds | None = None
    tracker_lost: bool = False
    vehicle_class: Id = GROUND
    lethal_target: Cell | None = None
    nearest_cell: Cell | None = None


MOST_BELIEVED = 512
"""Places in one `Believed`."""


class Believed(Message, frozen=True, kw_only=True, tag=schema_of("believed")):
    """A planner's belief about the position of its unseen target. The newest replaces the older; without cells the
    search is over.

    side_m  of the square blocks of ground that it tells of
    cells   near the middle of each block, the likeliest blocks first
    shares  probability of each
    """

    target: Id
    incarnation: Incarnation
    stamp_ns: StampNs
    side_m: Distance
    cells: Annotated[list[Cell], Meta(max_length=MOST_BELIEVED)]
    shares: Annotated[bytes, Column("<f4", per="cells", least=0, most=1)]


class PlannerStatus(Message, frozen=True, kw_only=True, tag=schema_of("planner-status")):
    """State of a planner.

    window   [row0, col0, row1, col1] of the part grown last
    tracker  whose pose the target was placed by last; None if that tracker has no name. Ages as in `RouteReply`
    gap_*    driven cost over optimum of the vehicles that follow, at the last full growth; None before the first
    """

    target: Id
    incarnation: Incarnation
    stamp_ns: StampNs
    strategy: Word
    target_cell: Cell | None
    map_version: Count
    tree_age_ms: AgeMillis
    window: Annotated[list[Cell], Meta(max_length=4)]
    growths: Count
    window_growths: Count
    growth_ms: Millis
    routes_served: Count
    following: Count
    tracker: Id | None = None
    pose_age_s: AgeSeconds | None = None
    tracker_lost: bool = False
    gap_mean: Gap | None = None
    gap_p95: Gap | None = None
    gap_max: Gap | None = None

    def relate(self) -> None:
        if len(self.window) not in (0, 4):
            raise ValueError(f"window has {len(self.window)} numbers, expected [row0, col0, row1, col1]")


CELL_OF_PLACE = -1
"""In a pose: the sender knows no grid, and each receiver finds the cell by its own."""
POSE_LEASE_S = 2.0
"""Lease of a tracker that publishes at least twice a second, as simulated targets do."""


class TargetPose(Message, frozen=True, kw_only=True, tag=schema_of("pose")):
    """Position of a target, by one of its trackers. `swarm.runtime.tracker_ownership` decides which poses count.

    tracker      name of the tracker; a later incarnation of the same name takes over at once. Without a name each
                 incarnation is a tracker of its own
    incarnation  when the tracker began to track this target, by the clock of `stamp_ns`
    seq          grows within an incarnation
    lease_s      the tracker counts as lost when no pose of it has arrived for this time; 0 hands the target over
    cell         the cell of the place; left out it is that of `x_m`, `y_m`
    captures     how often it was captured
    jumps        how often it was put somewhere else, as after a capture
    """

    target: Id
    tracker: Id | None = None
    incarnation: Incarnation
    seq: Natural
    lease_s: LeaseSeconds = POSE_LEASE_S
    stamp_ns: StampNs
    cell: Cell = CELL_OF_PLACE
    x_m: Metres
    y_m: Metres
    captures: Count = 0
    jumps: Count = 0


class Sighted(Message, frozen=True, kw_only=True, tag=schema_of("sighted")):
    """A sighting: a vehicle of this author saw a target within `uncertainty_m` of the place. It expires at
    `until_ns`, and the author's next sighting of the target replaces it."""

    author: Id
    group: Id
    target: Id
    seq: Natural
    stamp_ns: StampNs
    until_ns: StampNs
    cell: Cell
    x_m: Metres
    y_m: Metres
    uncertainty_m: Distance
