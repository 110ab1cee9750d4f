"""A route as a vehicle drives it: points in metres, and where one is on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from swarm.client.terrain_frame import Frame, Point
from swarm.grid import walk
from swarm.wire.messages.planning import PlaceRouteReply, PushedRoute, RouteReply
from swarm.wire.route_columns import Route as WireRoute
from swarm.wire.route_columns import RouteStatus, TargetStatus


@dataclass(frozen=True)
class Route:
    """A planner's route from a vehicle's cell to its target, or the reason why there is none.

    While the target is unseen the status is "searching", and the route leads to a cell where it may be.

    target         id of the target; empty of a route between places
    status         "ok", "searching", or why there is no route: unreachable, outside, lethal_start, no_target,
                   lethal_target. Between places also growing (not known yet), lethal_goal, outside_goal
    cells          from the vehicle's cell to the target's, or as far as the planner states them
    turns          indices of the cells in which a pulled route turns, first and last included: it is straight from
                   one to the next. Empty: from cell to cell
    cost_s         seconds that it takes
    lower_bound_s  no route is quicker, on the planner's present map; proven
    remaining_s    cost-to-go from the last cell; 0 if that is the target's
    pose_age_s     age of the target's pose when the planner replied; None if it does not state it
    tracker_lost   no tracker publishes the target now: this is its last known position
    target_cell    cell of the target that the planner used: a target that has just moved may be elsewhere by now
    nearest_cell   of a lethal target the nearest cell that can be reached
    """

    frame: Frame
    target: str
    status: str
    cells: tuple[int, ...]
    cost_s: float
    lower_bound_s: float
    remaining_s: float
    pose_age_s: float | None = None
    tracker_lost: bool = False
    turns: tuple[int, ...] = ()
    target_cell: int | None = None
    nearest_cell: int | None = None

    @classmethod
    def of(cls, frame: Frame, route: WireRoute, reply: RouteReply | PlaceRouteReply | PushedRoute) -> Route:
        """A route of an answer, or one that was pushed. Raises ValueError if it leaves the terrain, or one of its
        segments leads nowhere."""
        searching = route.status is RouteStatus.SEARCHING and math.isfinite(route.cost_s)
        led = searching or route.status is RouteStatus.OK
        cells = tuple(walk(frame.grid, route.start, route.directions)) if led else ()
        turns = route.turns if led else ()
        if any(cells[start] == cells[end] for start, end in pairwise(turns)):
            raise ValueError("a segment of the route ends where it begins")
        status, age_s, lost, nearest = str(route.status), None, False, None
        if isinstance(reply, RouteReply):
            age_s, lost, nearest = reply.pose_age_s, reply.tracker_lost, reply.nearest_cell
            if reply.lethal_target is not None and route.status is RouteStatus.NO_TARGET:
                status = str(TargetStatus.LETHAL)
        if isinstance(reply, PlaceRouteReply):
            status = status if reply.status == "ok" else reply.status
            return cls(
                frame, "", status, cells, route.cost_s, route.lower_bound_s, route.remaining_s,
                target_cell=reply.to_cell, nearest_cell=reply.nearest_cell,
            )  # fmt: skip
        return cls(
            frame, reply.target or "", status, cells, route.cost_s, route.lower_bound_s, route.remaining_s,
            age_s, lost, turns, reply.target_cell, nearest,
        )  # fmt: skip

    @property
    def ok(self) -> bool:
        """True if the route leads to the target."""
        return self.status == RouteStatus.OK

    @property
    def searching(self) -> bool:
        """True if it leads to a cell where the unseen target may be: request another route at its end. It has no
        cells while no such place is known yet."""
        return self.status == RouteStatus.SEARCHING

    @property
    def arrived(self) -> bool:
        """True if it is at the target already, or no more than one step away."""
        return self.ok and len(self.cells) <= 2 and self.remaining_s == 0

    @cached_property
    def points_m(self) -> tuple[Point, ...]:
        """(x_m, y_m) of the middles of its cells; of a pulled route, of those in which it turns."""
        turns = (self.cells[turn] for turn in self.turns) if self.turns else self.cells
        return tuple(map(self.frame.centre_m, turns))

    @property
    def length_m(self) -> float:
        """Length of its polyline (m)."""
        return sum(math.dist(a, b) for a, b in pairwise(self.points_m))

    def is_rest_of(self, before: Route) -> bool:
        """Returns True if it is only the remainder of the previous route, of which the vehicle has driven a
        part."""
        if (self.status, self.arrived, self.tracker_lost) != (before.status, before.arrived, before.tracker_lost):
            return False
        if not (self.ok or self.searching) or self.cells == before.cells:
            return True
        if not self.cells:
            return False
        if self.cells[0] not in before.cells:
            return False
        rest = before.cells[before.cells.index(self.cells[0]) :]
        return rest == self.cells and (self.remaining_s == 0) == (before.remaining_s == 0)

    def ahead(self, x_m: float, y_m: float, distance_m: float) -> tuple[float, float, float]:
        """Returns the position after driving `distance_m` along the route from its point nearest to a location:
        (x_m, y_m, heading_rad), the heading clockwise from north. At its end it stays there; without a route the
        location itself is returned."""
        points = self.points_m
        if not points:
            return x_m, y_m, 0.0
        if len(points) == 1:
            return *points[0], 0.0
        at, share = along(points, (x_m, y_m), distance_m)
        a, b = points[at], points[at + 1]
        return *between(a, b, share), math.atan2(b[0] - a[0], b[1] - a[1])


def along(points: Sequence[Point], place: Point, distance_m: float) -> tuple[int, float]:
    """Returns the position on a polyline of at least two points after driving `distance_m` from its point nearest
    to a location: the number of the step, and the fraction of that step, 0 ... 1. It is 1 at the end of the
    line."""
    nearest, at, share = math.inf, 0, 0.0
    for number, (a, b) in enumerate(pairwise(points)):
        there = _share(a, b, place)
        distance = math.dist(between(a, b, there), place)
        if distance < nearest:
            nearest, at, share = distance, number, there
    while True:
        step_m = math.dist(points[at], points[at + 1])
        left_m = step_m * (1 - share)
        if distance_m < left_m:
            return at, share + distance_m / step_m
        if at + 2 == len(points):
            return at, 1.0
        distance_m, at, share = distance_m - left_m, at + 1, 0.0


def _share(a: Point, b: Point, place: Point) -> float:
    """Returns the fraction of a step, 0 ... 1, at the point nearest to a location."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    long = dx * dx + dy * dy
    return min(1.0, max(0.0, ((place[0] - a[0]) * dx + (place[1] - a[1]) * dy) / long)) if long else 0.0


def between(a: Point, b: Point, share: float) -> Point:
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])
