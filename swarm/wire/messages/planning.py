"""Messages about targets: poses and sightings of them, and what their planners are asked, push and tell."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from msgspec import Meta

from swarm.wire import fields
from swarm.wire.messages import Message, schema_of
from swarm.wire.route_columns import Route, Routes

GROUND = "ground"
"""The class of vehicles that a request means which names none."""


class RouteRequest(Message, frozen=True, kw_only=True, tag=schema_of("route-request")):
    """Asks for routes from cells to the planner's target. A person may give `row` and `col` instead of `cells`.

    vehicles   ids in the order of `cells`; newer routes are pushed to these until they ask another planner
    max_cells  most steps of a returned route; 0: all that fit into one message
    force      true if a vehicle has reached the end of its route without the target: the planner extends its search
               window to these cells
    """

    cells: Annotated[list[fields.Cell], fields.LARGE] = []
    vehicles: Annotated[list[fields.VehicleId], fields.SMALL] = []
    max_cells: fields.Count = 0
    force: bool = False
    row: fields.Cell | None = None
    col: fields.Cell | None = None
    vehicle_class: fields.Id = GROUND

    def relate(self) -> None:
        if self.vehicles and len(self.vehicles) != len(self.cells):
            raise ValueError(f"{len(self.vehicles)} vehicles for {len(self.cells)} cells")
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class RouteReply(Message, frozen=True, kw_only=True, tag=schema_of("route")):
    """A planner's reply, with a route from each start.

    incarnation    of the planner
    map_version    number of changes of its replica
    tree_age_ms    since the last full growth
    pose_age_s     since the pose arrived to which the route leads; None before the first
    tracker_lost   no tracker publishes the target now: this is its last known position
    lethal_target  the lethal cell where the target is, to which no route leads: the status is NO_TARGET
    nearest_cell   reachable cell nearest to it; None if none is near
    """

    target: fields.Id
    incarnation: fields.Incarnation
    target_cell: fields.Cell | None
    map_version: fields.Count
    tree_age_ms: fields.AgeMillis
    rows: fields.GridSide
    cols: fields.GridSide
    routes: Routes
    pose_age_s: fields.AgeSeconds | None = None
    tracker_lost: bool = False
    vehicle_class: fields.Id = GROUND
    lethal_target: fields.Cell | None = None
    nearest_cell: fields.Cell | None = None

    def check(self) -> None:
        self.routes.check_bounds()


class PlaceRouteRequest(Message, frozen=True, kw_only=True, tag=schema_of("place-route-request")):
    """Asks for routes from cells to a place. Else as in `RouteRequest`.

    to  cell of the place
    """

    to: fields.Cell
    cells: Annotated[list[fields.Cell], fields.LARGE] = []
    vehicles: Annotated[list[fields.VehicleId], fields.SMALL] = []
    max_cells: fields.Count = 0
    vehicle_class: fields.Id = GROUND


PlaceStatus = Literal["ok", "growing", "lethal_goal", "outside_goal"]


class PlaceRouteReply(Message, frozen=True, kw_only=True, tag=schema_of("place-route")):
    """Routes to a place. Else as in `RouteReply`.

    status        lethal_goal, outside_goal: there is no route; growing: some are not known yet, and their status
                  is NO_TARGET: ask again
    nearest_cell  open cell nearest to a lethal goal; None if none is near
    """

    to_cell: fields.Cell
    incarnation: fields.Incarnation
    map_version: fields.Count
    routes: Routes
    status: PlaceStatus = "ok"
    vehicle_class: fields.Id = GROUND
    nearest_cell: fields.Cell | None = None

    def check(self) -> None:
        self.routes.check_bounds()


class PushedRoute(Message, frozen=True, kw_only=True, tag=schema_of("pushed-route")):
    """A newer route for a vehicle that follows this target, or goes to a place.

    target       None if it goes to a place
    target_cell  cell of target or place
    """

    vehicle: fields.VehicleId
    target: fields.Id | None
    incarnation: fields.Incarnation
    target_cell: fields.Cell
    map_version: fields.Count
    route: Route


class CostRequest(Message, frozen=True, kw_only=True, tag=schema_of("cost-request")):
    """Asks for the cost from each of these cells to the planner's target. Else as in `RouteRequest`."""

    cells: Annotated[list[fields.Cell], fields.LARGE] = []
    row: fields.Cell | None = None
    col: fields.Cell | None = None
    vehicle_class: fields.Id = GROUND

    def relate(self) -> None:
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class CostReply(Message, frozen=True, kw_only=True, tag=schema_of("cost")):
    """A planner's reply. Else as in `RouteReply`.

    cost_to_go_s  per asked cell; inf where there is no way or the cell is outside
    """

    target: fields.Id
    incarnation: fields.Incarnation
    target_cell: fields.Cell | None
    map_version: fields.Count
    tree_age_ms: fields.AgeMillis
    cost_to_go_s: Annotated[bytes, Meta(max_length=4 * 100_001), fields.Column("<f4", least=0, most=math.inf)]
    pose_age_s: fields.AgeSeconds | None = None
    tracker_lost: bool = False
    vehicle_class: fields.Id = GROUND
    lethal_target: fields.Cell | None = None
    nearest_cell: fields.Cell | None = None


MOST_BELIEVED = 512
"""Places in one `Believed`."""


class Believed(Message, frozen=True, kw_only=True, tag=schema_of("believed")):
    """A planner's belief about the position of its unseen target, by square blocks of ground. The newest replaces
    the older; without cells the search is over.

    side_m  of a block
    cells   near the middle of each block, the likeliest first
    shares  probability of each
    """

    target: fields.Id
    incarnation: fields.Incarnation
    stamp_ns: fields.StampNs
    side_m: fields.Distance
    cells: Annotated[list[fields.Cell], Meta(max_length=MOST_BELIEVED)]
    shares: Annotated[bytes, fields.Column("<f4", per="cells", least=0, most=1)]


class PlannerStatus(Message, frozen=True, kw_only=True, tag=schema_of("planner-status")):
    """State of a planner. Else as in `RouteReply`.

    window                      [row0, col0, row1, col1] of the part grown last
    tracker                     sender of the newest pose; None if it has no name
    gap_mean, gap_p95, gap_max  driven cost over optimum of the vehicles that follow, at the last full growth; None
                                before the first
    """

    target: fields.Id
    incarnation: fields.Incarnation
    stamp_ns: fields.StampNs
    strategy: fields.Word
    target_cell: fields.Cell | None
    map_version: fields.Count
    tree_age_ms: fields.AgeMillis
    window: Annotated[list[fields.Cell], Meta(max_length=4)]
    growths: fields.Count
    window_growths: fields.Count
    growth_ms: fields.Millis
    routes_served: fields.Count
    following: fields.Count
    tracker: fields.Id | None = None
    pose_age_s: fields.AgeSeconds | None = None
    tracker_lost: bool = False
    gap_mean: fields.Gap | None = None
    gap_p95: fields.Gap | None = None
    gap_max: fields.Gap | None = None

    def relate(self) -> None:
        if len(self.window) not in (0, 4):
            raise ValueError(f"window has {len(self.window)} numbers, expected [row0, col0, row1, col1]")


CELL_OF_PLACE = -1
"""In a pose: the sender knows no grid, and each receiver finds the cell by its own."""
POSE_LEASE_S = 2.0
"""Lease of a tracker that publishes at least twice a second, as simulated targets do."""


class TargetPose(Message, frozen=True, kw_only=True, tag=schema_of("pose")):
    """Position of a target, by one of its trackers (docs/vehicle/tracker.md).

    tracker      name of the tracker; a later incarnation of the same name takes over at once. Without a name each
                 incarnation is a tracker of its own
    incarnation  when the tracker began to track this target, by the clock of `stamp_ns`
    seq          grows within an incarnation
    lease_s      the tracker counts as lost when no pose of it has arrived for this time; 0 hands the target over
    cell         -1: that of `x_m`, `y_m`
    jumps        how often it was put somewhere else, as after a capture
    """

    target: fields.Id
    tracker: fields.Id | None = None
    incarnation: fields.Incarnation
    seq: fields.Natural
    lease_s: fields.LeaseSeconds = POSE_LEASE_S
    stamp_ns: fields.StampNs
    cell: fields.Cell = CELL_OF_PLACE
    x_m: fields.Metres
    y_m: fields.Metres
    captures: fields.Count = 0
    jumps: fields.Count = 0


class Sighted(Message, frozen=True, kw_only=True, tag=schema_of("sighted")):
    """A sighting: a vehicle of this author saw a target within `uncertainty_m` of the place. It expires at
    `until_ns`; the author's next one of the target replaces it."""

    author: fields.Id
    group: fields.Id
    target: fields.Id
    seq: fields.Natural
    stamp_ns: fields.StampNs
    until_ns: fields.StampNs
    cell: fields.Cell
    x_m: fields.Metres
    y_m: fields.Metres
    uncertainty_m: fields.Distance
