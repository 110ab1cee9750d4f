"""Draws vehicles and guests, who they are, their trails and routes, as they are due."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.movers.details import vehicle_details
from launch_scripts.monitor.movers.due import Due
from launch_scripts.monitor.movers.levels import Level
from launch_scripts.monitor.movers.looks import Looks, dimmed
from launch_scripts.monitor.movers.mover_drawing import MoverDrawing
from launch_scripts.monitor.movers.points import Points, cell_at, vehicle_points
from launch_scripts.monitor.movers.routes import RouteLines, RouteNow, cells_along
from launch_scripts.monitor.movers.strips import Strips, Trails
from launch_scripts.observe.latest_state import VehicleColumns
from swarm.config.agents import plan_agents
from swarm.config.classes import GROUND
from swarm.config.scenario import Scenario
from swarm.wire.messages.vehicles import Followed

_ROUTES_KEPT = 1 << 15
"""Vehicles whose routes are remembered. Beyond that all are forgotten: their agents never had so many."""
_Rows = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class _Roll:
    """What is looked up anew only when vehicles come or go.

    who     vehicle -> group, and class where that is not "ground"
    rows    of `Looks.vehicles`, by group
    own     places in `ids` of the scenario's vehicles; `guests` those of all others
    aloft   of each class that flies the places of its vehicles in `ids`, and `TerrainMesh.aloft_m`
    """

    ids: list[str]
    who: Mapping[str, str]
    rows: _Rows
    own: _Rows
    guests: _Rows
    aloft: tuple[tuple[_Rows, NDArray[np.float32]], ...] = ()


def trails_of(scenario: Scenario, mesh: TerrainMesh, level: Level) -> Trails:
    """Trails that break where something jumped further than anything drives."""
    blown = scenario.wind.speed_m_per_s
    flown = (each.air.speed_m_per_s + blown for each in scenario.classes if each.air is not None)
    quickest_m_per_s = scenario.time_scale * max(scenario.cost.road_speed_m_per_s, 1.0, *flown)
    return Trails(max(8 * level.trail_every_s * quickest_m_per_s, 4 * mesh.grid.resolution_m))


class VehiclesView:
    """Vehicles of the scenario as balls, guests as balls in boxes."""

    def __init__(
        self, drawing: MoverDrawing, mesh: TerrainMesh, scenario: Scenario, level: Level, looks: Looks
    ) -> None:
        self._drawing = drawing
        self._mesh = mesh
        self._level = level
        self._looks = looks
        self._target_ids = scenario.target_ids
        self._own_ids = frozenset(id for plan in plan_agents(scenario) for id in plan.vehicle_ids)
        self._roll = self._enrolled([], {}, {})
        self._colours: Bytes | None = None
        """As drawn last; None if all is to be drawn anew."""
        self._positions: Floats | None = None
        """As drawn last."""
        self._routes: dict[str, RouteNow] = {}
        self._route_lines = RouteLines(mesh, level.route_stride)
        self._routes_drawn: dict[str, Strips] = {}
        self._next_target = 0
        self._trails = trails_of(scenario, mesh, level)
        self._frame = 0
        self._due = Due(
            {
                "trails": level.trail_every_s,
                "details": level.details_s,
                "routes": level.routes_s / max(len(self._target_ids), 1),
            }
        )

    def draw_anew(self) -> None:
        self._colours = None
        self._routes_drawn.clear()

    def begun(self, followed: Followed, now_ns: int) -> bool:
        """A vehicle begins a route. False if it leaves the grid: its sender's bug."""
        cells = cells_along(self._mesh.grid, followed.start, followed.directions)
        if cells is None:
            return False
        if len(self._routes) >= _ROUTES_KEPT:
            self._routes.clear()
        gap = followed.cost_s / followed.lower_bound_s if followed.lower_bound_s > 0 else None
        legs = np.frombuffer(followed.legs, "<u4").astype(np.int64)
        turns = np.concatenate([[0], np.cumsum(legs)]) if len(legs) else None
        self._routes[followed.vehicle] = RouteNow(followed.target, cells, gap, now_ns, turns)
        return True

    def draw(
        self,
        vehicles: VehicleColumns,
        groups: Callable[[], Mapping[str, str]],
        classes: Callable[[], Mapping[str, str]],
        now_ns: int,
        slower: int,
    ) -> None:
        """Draws what is due; once for each frame in which something is new.

        slower  by how many times as seldom as for somebody who looks routes and sentences are drawn
        """
        self._frame += 1
        trails_due = self._due.now("trails", now_ns)
        if self._frame % self._level.frames and not trails_due:
            return
        if vehicles.ids != self._roll.ids:
            self._colours, self._roll = None, self._enrolled(vehicles.ids, groups(), classes())
        points = vehicle_points(self._mesh, vehicles)
        for rows, over_m in self._roll.aloft:
            cells = [cell_at(self._mesh.grid, *place) for place in _places(vehicles, rows)]
            points.positions[rows, 2] += over_m.reshape(-1)[cells]
        colours = self._coloured(vehicles)
        self._draw_balls(vehicles, points, colours, now_ns, slower)
        if trails_due:
            strips, moved = self._trails.advance(points.ids, points.positions)
            if len(strips):
                self._drawing.lines("world/trails/vehicles", strips, dimmed(colours[moved]))
        if self._due.now("routes", now_ns, slower):
            self._draw_routes(vehicles)

    def _enrolled(self, ids: list[str], groups: Mapping[str, str], classes: Mapping[str, str]) -> _Roll:
        who = {id: group if classes[id] == GROUND else f"{group}, {classes[id]}" for id, group in groups.items()}
        own = np.array([id in self._own_ids for id in ids], np.bool_)
        rows = np.array(self._looks.rows([groups.get(id) for id in ids]), np.intp)
        aloft = tuple(
            (np.flatnonzero([classes.get(id) == name for id in ids]), over_m)
            for name, over_m in self._mesh.aloft_m.items()
        )
        return _Roll(ids, who, rows, np.flatnonzero(own), np.flatnonzero(~own), aloft)

    def _coloured(self, vehicles: VehicleColumns) -> Bytes:
        rows = self._roll.rows
        if self._looks.by_target:
            rows = np.array([*self._looks.rows(vehicles.target_ids), -1], np.intp)[vehicles.targets]
        return self._looks.vehicles(rows, vehicles.states)

    def _draw_balls(
        self, vehicles: VehicleColumns, points: Points, colours: Bytes, now_ns: int, slower: int
    ) -> None:
        roll, whole = self._roll, self._colours is None
        changed = colours if self._colours is None or not np.array_equal(colours, self._colours) else None
        self._colours = colours
        details = None
        if self._due.now("details", now_ns, slower) or whole:
            details = vehicle_details(vehicles, roll.who, self._routes, now_ns)
        moved = self._positions is None or not np.array_equal(points.positions, self._positions)
        self._positions = points.positions
        if not moved and changed is None and details is None:
            return
        for entity, members in (("world/vehicles", roll.own), ("world/guests", roll.guests)):
            if not len(members) and not whole:
                continue
            if len(members) == len(points):  # as usual: nothing is copied
                self._drawing.vehicles(entity, points.positions, changed, details)
                continue
            self._drawing.vehicles(
                entity,
                points.positions[members],
                None if changed is None else changed[members],
                None if details is None else [details[n] for n in members.tolist()],
            )
        if len(roll.guests) or whole:
            self._drawing.frames(points.positions[roll.guests], 0.5 * self._mesh.scale_m)
        if self._level.names and len(points) <= self._level.most:
            above = np.array([0, 0, 0.8 * self._mesh.scale_m], np.float32)
            self._drawing.names("world/vehicles/names", points.positions + above, points.ids)

    def _draw_routes(self, vehicles: VehicleColumns) -> None:
        """Draws what is left of the routes to one target; the next time those to the next."""
        if not self._target_ids:
            return
        target = self._target_ids[self._next_target % len(self._target_ids)]
        self._next_target += 1
        ahead, pulled = [], []
        grid = self._mesh.grid
        for n in vehicles.chasing(target).tolist():
            route = self._routes.get(vehicles.ids[n])
            if route is not None and route.target == target:
                place = float(vehicles.east_m[n]), float(vehicles.south_m[n])
                if route.turns is None:
                    ahead.append(route.ahead_of(cell_at(grid, *place)))
                else:
                    pulled.append(route.corners_ahead(grid, *place))
        strips = self._route_lines.lines(ahead, pulled)
        if self._routes_drawn.get(target) != strips:
            self._routes_drawn[target] = strips
            self._drawing.lines(f"world/routes/{target}", strips)


def _places(vehicles: VehicleColumns, rows: _Rows) -> Iterator[tuple[float, float]]:
    return zip(vehicles.east_m[rows].tolist(), vehicles.south_m[rows].tolist(), strict=True)
