"""Draws vehicles and guests, who they are, their trails and routes, as they are due.

Few entities with many instances each; of each only what has changed: see docs/decisions/0053-what-moves.md.

rerun's viewer tells of the instance under the pointer what its components say, if they are three at most, else how
many there are. So a vehicle has three: a place, a colour, and a sentence. Radii are in the blueprint.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.movers.details import vehicle_details
from launch_scripts.monitor.movers.map_lines import RouteLines, RouteNow, Strips, Trails, cell_at, cells_along
from launch_scripts.monitor.movers.styles import LABEL_COLOUR, Level, Looks, RateLimit, dimmed
from launch_scripts.monitor.sinks import Streams
from launch_scripts.observe.latest_state import VehicleColumns
from swarm.config.agents import plan_agents
from swarm.config.classes import GROUND
from swarm.config.scenario import Scenario
from swarm.wire.messages.vehicles import Followed

_ROUTES_KEPT = 1 << 15
"""Vehicles whose routes are remembered. Beyond that all are forgotten: their agents never had so many."""
_TARGET_PX = 8.5
_Rows = NDArray[np.intp]


def screen(radius: float) -> float:
    """A radius in points of the viewer's window, the same at every zoom: rerun takes negative radii so."""
    return -radius


def log_lines(rec: rr.RecordingStream | Streams, entity: str, strips: Strips, colours: Bytes | None = None) -> None:
    """Logs lines; colours are those of each, uint8 (n, 3), or stay as they are. In rerun's own layout, without an
    array for each line."""
    wanted = rr.components.LineStrip3DBatch._ARROW_DATATYPE
    points = pa.array(np.ascontiguousarray(strips.points, np.float32).reshape(-1))
    triples = pa.FixedSizeListArray.from_arrays(points, type=wanted.value_type)
    lines = pa.ListArray.from_arrays(pa.array(strips.offsets), triples, type=wanted)
    rec.log(entity, rr.LineStrips3D.from_fields(strips=lines, colors=colours))


def log_style(
    rec: rr.RecordingStream | Streams, entity: str, radius: float, colour: tuple[int, ...] | None = None
) -> None:
    """Logs how lines look, which never changes."""
    colours = None if colour is None else [colour]
    rec.log(entity, rr.LineStrips3D.from_fields(colors=colours, radii=[screen(radius)]), static=True)


def log_label_style(rec: rr.RecordingStream | Streams, entity: str) -> None:
    """Logs that an entity is labels which are always shown."""
    style = rr.Points3D.from_fields(colors=[LABEL_COLOUR], radii=[screen(0.1)], show_labels=True)
    rec.log(entity, style, static=True)


def mover_overrides(level: Level) -> dict[Any, Any]:
    """For the blueprint of each 3D view: sizes, and how long trails are seen."""
    trail = rr.VisibleTimeRange(
        "sim_time",
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-level.trail_s),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    radii = {
        "/world/vehicles": level.radius_px,
        "/world/guests": 0.8 * level.radius_px,
        "/world/targets/balls": _TARGET_PX,
        "/world/bodies/names": 3.0,
    }
    return {
        **{entity: rr.Points3D.from_fields(radii=[screen(px)]) for entity, px in radii.items()},
        "/world/trails/vehicles": rrb.VisibleTimeRanges([trail]),
        "/world/trails/targets": rrb.VisibleTimeRanges([trail]),
    }


def trails_of(scenario: Scenario, mesh: TerrainMesh, level: Level) -> Trails:
    """Trails that break where something jumped further than anything drives."""
    blown = scenario.wind.speed_m_per_s
    flown = (each.air.speed_m_per_s + blown for each in scenario.classes if each.air is not None)
    quickest_m_per_s = scenario.time_scale * max(scenario.cost.road_speed_m_per_s, 1.0, *flown)
    return Trails(max(8 * level.trail_every_s * quickest_m_per_s, 4 * mesh.grid.resolution_m))


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
    aloft: tuple[tuple[_Rows, Floats], ...] = ()


class VehiclesView:
    """Vehicles of the scenario as balls, guests as balls in boxes."""

    def __init__(
        self,
        rec: rr.RecordingStream | Streams,
        mesh: TerrainMesh,
        scenario: Scenario,
        level: Level,
        looks: Looks,
    ) -> None:
        self._rec, self._mesh, self._level, self._looks = rec, mesh, level, looks
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
        routes_s = level.routes_s / max(len(self._target_ids), 1)
        self._limit = RateLimit({"trails": level.trail_every_s, "details": level.details_s, "routes": routes_s})

    def begin(self) -> None:
        """Logs the styles, which never change."""
        px = self._level.line_px
        for id in self._looks.target_ids:
            log_style(self._rec, f"world/routes/{id}", px, self._looks.route(id))
        log_style(self._rec, "world/trails/vehicles", 0.8 * px)
        log_label_style(self._rec, "world/vehicles/names")

    def draw_anew(self) -> None:
        """What is drawn on change only is drawn once more, when it is due."""
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
        trails_due = self._limit.due("trails", now_ns)
        if self._frame % self._level.frames and not trails_due:
            return
        if vehicles.ids != self._roll.ids:
            self._colours, self._roll = None, self._enrolled(vehicles.ids, groups(), classes())
        positions = self._mesh.place(vehicles.east_m, vehicles.south_m, 0.15 * self._mesh.scale_m)
        for rows, over_m in self._roll.aloft:
            cells = [self._cell(vehicles, n) for n in rows.tolist()]
            positions[rows, 2] += over_m.reshape(-1)[cells]
        rows = self._roll.rows
        if self._looks.by_target:
            rows = np.array([*self._looks.rows(vehicles.target_ids), -1], np.intp)[vehicles.targets]
        colours = self._looks.vehicles(rows, vehicles.states)
        self._draw_balls(vehicles, positions, colours, now_ns, slower)
        if trails_due:
            strips, moved = self._trails.advance(vehicles.ids, positions)
            if len(strips):
                log_lines(self._rec, "world/trails/vehicles", strips, dimmed(colours[moved]))
        if self._limit.due("routes", now_ns, slower):
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

    def _draw_balls(
        self, vehicles: VehicleColumns, positions: Floats, colours: Bytes, now_ns: int, slower: int
    ) -> None:
        roll, whole = self._roll, self._colours is None
        changed = colours if self._colours is None or not np.array_equal(colours, self._colours) else None
        moved = self._positions is None or not np.array_equal(positions, self._positions)
        self._colours, self._positions = colours, positions
        details = None
        if self._limit.due("details", now_ns, slower) or whole:
            details = vehicle_details(vehicles, roll.who, self._routes, now_ns)
        if not moved and changed is None and details is None:
            return
        for entity, members in (("world/vehicles", roll.own), ("world/guests", roll.guests)):
            if not len(members) and not whole:
                continue
            its = None if changed is None else changed[members]
            parts: list[rr.AsComponents] = [rr.Points3D.from_fields(positions=positions[members], colors=its)]
            if details is not None:
                told = pa.array([details[n] for n in members.tolist()], pa.string())
                parts.append(rr.AnyValues(vehicle=told))
            self._rec.log(entity, *parts)
        if len(roll.guests) or whole:
            sides = np.full((len(roll.guests), 3), 0.5 * self._mesh.scale_m, np.float32)
            boxes = rr.Boxes3D(
                centers=positions[roll.guests], half_sizes=sides, colors=[LABEL_COLOUR], radii=[screen(1.0)]
            )
            self._rec.log("world/guests/frames", boxes)
        if self._level.names and len(positions) <= self._level.most:
            above = np.array([0, 0, 0.8 * self._mesh.scale_m], np.float32)
            names = pa.array(vehicles.ids, pa.string())
            self._rec.log(
                "world/vehicles/names", rr.Points3D.from_fields(positions=positions + above, labels=names)
            )

    def _draw_routes(self, vehicles: VehicleColumns) -> None:
        """Draws what is left of the routes to one target; the next time those to the next."""
        if not self._target_ids:
            return
        target = self._target_ids[self._next_target % len(self._target_ids)]
        self._next_target += 1
        ahead, pulled = [], []
        for n in vehicles.chasing(target).tolist():
            route = self._routes.get(vehicles.ids[n])
            if route is not None and route.target == target:
                if route.turns is None:
                    ahead.append(route.ahead_of(self._cell(vehicles, n)))
                else:
                    place_m = float(vehicles.east_m[n]), float(vehicles.south_m[n])
                    pulled.append(route.corners_ahead(self._mesh.grid, *place_m))
        strips = self._route_lines.lines(ahead, pulled)
        if self._routes_drawn.get(target) != strips:
            self._routes_drawn[target] = strips
            log_lines(self._rec, f"world/routes/{target}", strips)

    def _cell(self, vehicles: VehicleColumns, n: int) -> int:
        return cell_at(self._mesh.grid, float(vehicles.east_m[n]), float(vehicles.south_m[n]))
