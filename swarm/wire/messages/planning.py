"""Messages of planners: route and cost queries, pushed routes, status."""

from __future__ import annotations

import numpy as np

from swarm.wire.fields import Cell, Natural, check_id, column
from swarm.wire.messages.base import Message, schema_of
from swarm.wire.routes import Route, Routes


class RouteRequest(Message, frozen=True, kw_only=True, tag=schema_of("route-request")):
    """Asks for routes from cells to the planner's target. A person may give `row` and `col` instead of `cells`.

    vehicles   ids in the order of `cells`; newer routes are pushed to these until they ask another planner
    max_cells  most steps of each route; 0 is the whole route
    force      a route ran out: the planner extends its window to these cells
    """

    cells: list[Cell] = []
    vehicles: list[str] = []
    max_cells: Natural = 0
    force: bool = False
    row: Cell | None = None
    col: Cell | None = None

    def __post_init__(self) -> None:
        if len(self.cells) > 100_000:
            raise ValueError(f"{len(self.cells)} cells in one request, at most 100000")
        if self.vehicles and len(self.vehicles) != len(self.cells):
            raise ValueError(f"{len(self.vehicles)} vehicles for {len(self.cells)} cells")
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class RouteReply(Message, frozen=True, kw_only=True, tag=schema_of("route")):
    """A planner's answer.

    incarnation  of the planner
    map_version  number of changes of its replica
    tree_age_ms  time since the last full growth
    """

    target: str
    incarnation: Natural
    target_cell: Cell | None
    map_version: Natural
    tree_age_ms: float
    rows: Natural
    cols: Natural
    routes: Routes


class PushedRoute(Message, frozen=True, kw_only=True, tag=schema_of("pushed-route")):
    """A newer route for a vehicle that follows this target."""

    vehicle: str
    target: str
    incarnation: Natural
    target_cell: Cell
    map_version: Natural
    route: Route


class CostRequest(Message, frozen=True, kw_only=True, tag=schema_of("cost-request")):
    """Asks what it costs to reach the planner's target from each of these cells."""

    cells: list[Cell] = []
    row: Cell | None = None
    col: Cell | None = None

    def __post_init__(self) -> None:
        if len(self.cells) > 100_000:
            raise ValueError(f"{len(self.cells)} cells in one request, at most 100000")
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class CostReply(Message, frozen=True, kw_only=True, tag=schema_of("cost")):
    """cost_to_go_s  float32 per asked cell, inf where there is no way or the cell is outside."""

    target: str
    incarnation: Natural
    target_cell: Cell | None
    map_version: Natural
    tree_age_ms: float
    cost_to_go_s: bytes

    def __post_init__(self) -> None:
        check_id("target", self.target)
        if len(self.cost_to_go_s) % 4 or np.isnan(column(self.cost_to_go_s, "<f4")).any():
            raise ValueError("cost_to_go_s is not a column of float32 without NaN")


class PlannerStatus(Message, frozen=True, kw_only=True, tag=schema_of("planner-status")):
    """State of a planner.

    window  [row0, col0, row1, col1] of the part grown last
    gap_*   driven cost over optimum of the vehicles that follow, at the last full growth; None before the first
    """

    target: str
    incarnation: Natural
    stamp_ns: Natural
    strategy: str
    target_cell: Cell | None
    map_version: Natural
    tree_age_ms: float
    window: list[Cell]
    growths: Natural
    window_growths: Natural
    growth_ms: float
    routes_served: Natural
    following: Natural
    gap_mean: float | None = None
    gap_p95: float | None = None
    gap_max: float | None = None

    def __post_init__(self) -> None:
        check_id("target", self.target)
        if len(self.window) not in (0, 4):
            raise ValueError(f"window has {len(self.window)} numbers, expected [row0, col0, row1, col1]")
