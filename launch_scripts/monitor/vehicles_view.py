"""Draws vehicles, who they are, their trails and routes, as they are due.

Few entities with many instances each; of each only changes: see docs/design/live-view.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.rerun_outputs import Pen, RateLimit, Strips, even, ragged
from launch_scripts.monitor.styles import Level, Looks, dimmed
from launch_scripts.monitor.terrain_mesh import Floats, TerrainMesh
from launch_scripts.observe.latest_messages import LatestState, VehicleColumns
from launch_scripts.observe.summed_counts import percent
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND
from swarm.grid import GridSpec, walk
from swarm.wire.messages.vehicles import Followed, VehicleState

Cells = NDArray[np.int64]
_ROUTES_KEPT = 1 << 15
"""Vehicles whose routes are remembered. Beyond this number all are forgotten: their agents never had as many."""


class Trails:
    """Trails since the last drawing: one line per id, which joins the one before.

    longest_m  what jumped further leaves no trail
    """

    def __init__(self, longest_m: float) -> None:
        self._longest_m = longest_m
        self._last: dict[str, Floats] = {}
        """Position of each at the end of its trail, float32 (3,)."""

    def advance(self, ids: list[str], positions: Floats) -> tuple[Strips, NDArray[np.bool_]]:
        """Lines from the last places to these, and whose they are; none for ids which stand still, are new, or
        jumped."""
        known = zip(ids, positions, strict=True)
        last = np.array([self._last.get(id, place) for id, place in known], np.float32).reshape(-1, 3)
        moved_m = np.hypot(*(positions - last)[:, :2].T)
        self._last = dict(zip(ids, np.where(moved_m[:, None] > 0, positions, last), strict=True))
        drawn = (moved_m > 0) & (moved_m <= self._longest_m)
        return even(np.stack([last[drawn], positions[drawn]], axis=1)), drawn


def cells_at(grid: GridSpec, east_m: Floats, south_m: Floats) -> Cells:
    """The cells at places, the nearest ones if they are outside."""
    rows, cols = np.floor_divide((south_m, east_m), grid.resolution_m).astype(np.int64)
    cells: Cells = np.clip(rows, 0, grid.rows - 1) * grid.cols + np.clip(cols, 0, grid.cols - 1)
    return cells


@dataclass(frozen=True, slots=True, eq=False)
class RouteNow:
    """A route that a vehicle has begun, or the remainder of it.

    cells     int32 (n,)
    places    float32 (n, 2)  rows and columns that it leads over, whole numbers in the middles of cells; those of a
              pulled route lie on the straight lines between the cells in which it turns
    gap       its cost over its proven lower bound; None if nothing is proven
    begun_ns  when that was heard
    """

    target: str
    cells: NDArray[np.int32]
    places: Floats
    gap: float | None = None
    begun_ns: int = 0

    @classmethod
    def of(cls, followed: Followed, grid: GridSpec, now_ns: int) -> RouteNow:
        """Builds the route that a vehicle published. Raises ValueError or OutsideGridError where it leaves the
        grid."""
        cells = np.array(walk(grid, followed.start, followed.directions), np.int32)
        places = np.stack(np.divmod(cells, grid.cols), axis=1).astype(np.float32)
        turns = np.cumsum([0, *np.frombuffer(followed.legs, "<u4")])
        if turns[-1] == len(cells) - 1:
            at = np.arange(len(cells))
            straight = [np.interp(at, turns, places[turns, axis]) for axis in (0, 1)]
            places = np.stack(straight, axis=1).astype(np.float32)
        gap = followed.cost_s / followed.lower_bound_s if followed.lower_bound_s > 0 else None
        return cls(followed.target, cells, places, gap, now_ns)

    def ahead_of(self, cell: int) -> RouteNow:
        """The route from a cell on; the whole route if the cell is not on it."""
        found = np.flatnonzero(self.cells == cell)
        first = int(found[-1]) if len(found) else 0
        return replace(self, cells=self.cells[first:], places=self.places[first:])


class RouteLines:
    """Routes to one target as lines in which no part of the ground is drawn twice.

    Routes to one target join, as the branches of its tree do: a thousand of them have few cells more than the tree.
    """

    def __init__(self, mesh: TerrainMesh, stride: int) -> None:
        """stride  number of cells between two points of a line"""
        self._mesh = mesh
        self._stride = stride
        self._drawn = np.zeros(mesh.grid.cells, np.bool_)

    def lines(self, routes: Iterable[RouteNow]) -> Strips:
        """Each route up to where it meets one that is drawn already, the longest first."""
        parts, drawn = [np.empty((0, 2), np.float32)], self._drawn
        longest_first = sorted(routes, key=lambda route: len(route.cells), reverse=True)
        for route in longest_first:
            met = np.flatnonzero(drawn[route.cells])
            end = int(met[0]) if len(met) else len(route.cells) - 1
            if end > 0:
                drawn[route.cells[: end + 1]] = True
                parts.append(route.places[np.append(np.arange(0, end, self._stride), end)])
        for route in longest_first:
            drawn[route.cells] = False
        south_m, east_m = ((np.concatenate(parts) + 0.5) * self._mesh.grid.resolution_m).astype(np.float32).T
        lengths = [len(part) for part in parts[1:]]
        return ragged(self._mesh.place(east_m, south_m, 0.2 * self._mesh.scale_m), lengths)


def trails_of(scenario: Scenario, mesh: TerrainMesh, level: Level) -> Trails:
    """Trails that break where something jumped further than anything drives."""
    blown = scenario.wind.speed_m_per_s
    flown = (each.air.speed_m_per_s + blown for each in scenario.classes if each.air is not None)
    quickest_m_per_s = scenario.time_scale * max(scenario.cost.road_speed_m_per_s, 1.0, *flown)
    return Trails(max(8 * level.trail_every_s * quickest_m_per_s, 4 * mesh.grid.resolution_m))


class VehiclesView:
    """Vehicles as balls with a sentence each, their trails and routes."""

    def __init__(self, pen: Pen, scenario: Scenario, level: Level, looks: Looks) -> None:
        self._pen, self._mesh, self._level, self._looks = pen, pen.mesh, level, looks
        self._target_ids = scenario.target_ids
        self._ids: list[str] = []
        """Vehicles that were drawn last, and their metadata. Rebuilt when a vehicle joins or leaves."""
        self._who: dict[str, str] = {}
        """Vehicle -> its group, and its class where that is not "ground"."""
        self._rows = np.empty(0, np.intp)
        """Rows of `Looks.vehicles`, by group."""
        self._aloft: list[tuple[NDArray[np.intp], Floats]] = []
        """For each flying class the indices of its vehicles in `_ids`, and `TerrainMesh.aloft_m`."""
        self._routes: dict[str, RouteNow] = {}
        self._route_lines = RouteLines(self._mesh, level.route_stride)
        self._next_target = 0
        self._trails = trails_of(scenario, self._mesh, level)
        self._frame = 0
        routes_s = level.routes_s / max(len(self._target_ids), 1)
        self._limit = RateLimit({"trails": level.trail_every_s, "details": level.details_s, "routes": routes_s})

    def begin(self) -> None:
        """Logs the styles, which never change."""
        for id in self._looks.target_ids:
            self._pen.style(f"world/routes/{id}", self._level.line_px, self._looks.route(id))
        self._pen.style("world/trails/vehicles", 0.8 * self._level.line_px)
        self._pen.label_style("world/vehicles/names")

    def draw_anew(self) -> None:
        """All is drawn once more, as the pen has forgotten it."""
        self._limit.all_due()

    def begun(self, followed: Followed, now_ns: int) -> None:
        """A vehicle begins a route. Raises ValueError if it leaves the grid: its sender's bug."""
        if len(self._routes) >= _ROUTES_KEPT:
            self._routes.clear()
        self._routes[followed.vehicle] = RouteNow.of(followed, self._mesh.grid, now_ns)

    def draw(self, vehicles: VehicleColumns, observed: LatestState, now_ns: int, slower: int) -> None:
        """Draws due parts; once for each frame with a change.

        observed  says of which group and class they are
        slower    factor by which routes and sentences are drawn less often than for viewers
        """
        self._frame += 1
        if vehicles.ids != self._ids:
            self._enrol(vehicles.ids, observed.groups(), observed.classes())
        trails_due = self._limit.due("trails", now_ns)
        if self._frame % self._level.frames and not trails_due:
            return
        cells = cells_at(self._mesh.grid, vehicles.east_m, vehicles.south_m)
        positions = self._mesh.place(vehicles.east_m, vehicles.south_m, 0.15 * self._mesh.scale_m)
        for flying, over_m in self._aloft:
            positions[flying, 2] += over_m.reshape(-1)[cells[flying]]
        rows = self._rows
        if self._looks.by_target:
            rows = np.array([*self._looks.rows(vehicles.target_ids), -1], np.intp)[vehicles.targets]
        colours, told = self._looks.vehicles(rows, vehicles.states), None
        if self._limit.due("details", now_ns, slower):
            told = vehicle_details(vehicles, self._who, self._routes, now_ns)
        self._pen.points("world/vehicles", {"vehicle": told}, positions=positions, colors=colours)
        if self._level.names and len(positions) <= self._level.most:
            above = np.array([0, 0, 0.8 * self._mesh.scale_m], np.float32)
            self._pen.points("world/vehicles/names", positions=positions + above, labels=vehicles.ids)
        if trails_due:
            strips, moved = self._trails.advance(vehicles.ids, positions)
            if moved.any():
                self._pen.trail("world/trails/vehicles", strips, dimmed(colours[moved]))
        if self._limit.due("routes", now_ns, slower) and self._target_ids:
            self._draw_routes(vehicles, cells, self._target_ids[self._next_target % len(self._target_ids)])
            self._next_target += 1

    def _enrol(self, ids: list[str], groups: Mapping[str, str], classes: Mapping[str, str]) -> None:
        self._ids = ids
        self._who = {
            id: group if classes[id] == GROUND else f"{group}, {classes[id]}" for id, group in groups.items()
        }
        self._rows = np.array(self._looks.rows([groups.get(id) for id in ids]), np.intp)
        self._aloft = [
            (np.flatnonzero([classes.get(id) == name for id in ids]), over_m)
            for name, over_m in self._mesh.aloft_m.items()
        ]
        self._limit.all_due()

    def _draw_routes(self, vehicles: VehicleColumns, cells: Cells, target: str) -> None:
        """Draws the remainder of the routes to a target."""
        chasing = vehicles.chasing(target).tolist()
        begun = ((n, self._routes.get(vehicles.ids[n])) for n in chasing)
        ahead = [
            route.ahead_of(int(cells[n])) for n, route in begun if route is not None and route.target == target
        ]
        self._pen.lines(f"world/routes/{target}", self._route_lines.lines(ahead))


def vehicle_details(
    vehicles: VehicleColumns, who: Mapping[str, str], routes: Mapping[str, RouteNow], now_ns: int
) -> list[str]:
    """Text such as `a0-04 to t3: following, route 2 s old, certified gap 1.20%; scouts, walker`. The most
    important comes first: a viewer may cut off the end.

    who  vehicle -> what is said of whose it is
    """
    target_ids = vehicles.target_ids
    lines = []
    for id, state, target in zip(vehicles.ids, vehicles.states.tolist(), vehicles.targets.tolist(), strict=True):
        chased = target_ids[target] if target >= 0 else None
        line = f"{id if chased is None else f'{id} to {chased}'}: {VehicleState(state).name.lower()}"
        route = routes.get(id)
        if route is not None and route.target == chased and state != VehicleState.ARRIVED:
            proven = "gap not proven" if route.gap is None else f"certified gap {percent(route.gap)}"
            line += f", route {(now_ns - route.begun_ns) / NS_PER_S:.0f} s old, {proven}"
        lines.append(f"{line}; {who.get(id, '?')}")
    return lines
