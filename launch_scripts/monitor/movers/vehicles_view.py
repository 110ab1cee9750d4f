"""Draws vehicles and guests, who they are, their trails and routes, as they are due.

Few entities with many instances each; of each only what has changed: see docs/decisions/0053-what-moves.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.movers import map_lines
from launch_scripts.monitor.movers.map_lines import RouteNow, Trails
from launch_scripts.monitor.movers.styles import Level, Looks, RateLimit, dimmed
from launch_scripts.monitor.sinks import LABEL_COLOUR, Pen, screen
from launch_scripts.observe.counts import percent
from launch_scripts.observe.latest_state import LatestState, VehicleColumns
from swarm.clock import NS_PER_S
from swarm.config.agents import plan_agents
from swarm.config.classes import GROUND
from swarm.config.scenario import Scenario
from swarm.wire.messages.vehicles import Followed, VehicleState

_ROUTES_KEPT = 1 << 15
"""Vehicles whose routes are remembered. Beyond that all are forgotten: their agents never had so many."""
_DOES = {
    VehicleState.IDLE: "idle",
    VehicleState.WAITING: "waits for a route",
    VehicleState.FOLLOWING: "on its way",
    VehicleState.ARRIVED: "arrived",
    VehicleState.STRANDED: "stranded",
    VehicleState.LOST: "goes on without its planner",
    VehicleState.OUTDATED: "goes by an old pose",
    VehicleState.SEARCHING: "looks for its target",
}
_Rows = NDArray[np.intp]


class _Roll(NamedTuple):
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
    aloft: list[tuple[_Rows, Floats]]


def trails_of(scenario: Scenario, mesh: TerrainMesh, level: Level) -> Trails:
    """Trails that break where something jumped further than anything drives."""
    blown = scenario.wind.speed_m_per_s
    flown = (each.air.speed_m_per_s + blown for each in scenario.classes if each.air is not None)
    quickest_m_per_s = scenario.time_scale * max(scenario.cost.road_speed_m_per_s, 1.0, *flown)
    return Trails(max(8 * level.trail_every_s * quickest_m_per_s, 4 * mesh.grid.resolution_m))


class VehiclesView:
    """Vehicles of the scenario as balls, guests as balls in boxes."""

    def __init__(self, pen: Pen, scenario: Scenario, level: Level, looks: Looks) -> None:
        self._pen, self._mesh, self._level, self._looks = pen, pen.mesh, level, looks
        self._target_ids = scenario.target_ids
        self._own_ids = frozenset(id for plan in plan_agents(scenario) for id in plan.vehicle_ids)
        self._roll = self._enrolled([], {}, {})
        self._anew = True
        """True if all is to be drawn, whatever is due."""
        self._routes: dict[str, RouteNow] = {}
        self._route_lines = map_lines.RouteLines(self._mesh, level.route_stride)
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
        self._anew = True

    def begun(self, followed: Followed, now_ns: int) -> bool:
        """A vehicle begins a route. False if it leaves the grid: its sender's bug."""
        cells = map_lines.cells_along(self._mesh.grid, followed.start, followed.directions)
        if cells is None:
            return False
        if len(self._routes) >= _ROUTES_KEPT:
            self._routes.clear()
        gap = followed.cost_s / followed.lower_bound_s if followed.lower_bound_s > 0 else None
        legs = np.frombuffer(followed.legs, "<u4").astype(np.int64)
        turns = np.concatenate([[0], np.cumsum(legs)]) if len(legs) else None
        self._routes[followed.vehicle] = RouteNow(followed.target, cells, gap, now_ns, turns)
        return True

    def draw(self, vehicles: VehicleColumns, observed: LatestState, now_ns: int, slower: int) -> None:
        """Draws what is due; once for each frame in which something is new.

        observed  says of which group and class they are
        slower    by how many times as seldom as for somebody who looks routes and sentences are drawn
        """
        self._frame += 1
        trails_due = self._limit.due("trails", now_ns)
        if self._frame % self._level.frames and not trails_due:
            return
        if vehicles.ids != self._roll.ids:
            self._roll = self._enrolled(vehicles.ids, observed.groups(), observed.classes())
            self._anew = True
        roll, looks = self._roll, self._looks
        positions = self._mesh.place(vehicles.east_m, vehicles.south_m, 0.15 * self._mesh.scale_m)
        for flying, over_m in roll.aloft:
            positions[flying, 2] += over_m.reshape(-1)[[self._cell(vehicles, n) for n in flying.tolist()]]
        rows = roll.rows
        if looks.by_target:
            rows = np.array([*looks.rows(vehicles.target_ids), -1], np.intp)[vehicles.targets]
        colours = looks.vehicles(rows, vehicles.states)
        self._draw_balls(vehicles, positions, colours, now_ns, slower)
        if trails_due:
            strips, moved = self._trails.advance(vehicles.ids, positions)
            if len(strips):
                self._pen.trail("world/trails/vehicles", strips, dimmed(colours[moved]))
        if self._limit.due("routes", now_ns, slower) and self._target_ids:
            self._draw_routes(vehicles, self._target_ids[self._next_target % len(self._target_ids)])
            self._next_target += 1

    def _enrolled(self, ids: list[str], groups: Mapping[str, str], classes: Mapping[str, str]) -> _Roll:
        who = {id: group if classes[id] == GROUND else f"{group}, {classes[id]}" for id, group in groups.items()}
        own = np.array([id in self._own_ids for id in ids], np.bool_)
        rows = np.array(self._looks.rows([groups.get(id) for id in ids]), np.intp)
        aloft = [
            (np.flatnonzero([classes.get(id) == name for id in ids]), over_m)
            for name, over_m in self._mesh.aloft_m.items()
        ]
        return _Roll(ids, who, rows, np.flatnonzero(own), np.flatnonzero(~own), aloft)

    def _draw_balls(
        self, vehicles: VehicleColumns, positions: Floats, colours: Bytes, now_ns: int, slower: int
    ) -> None:
        roll, details = self._roll, None
        if self._limit.due("details", now_ns, slower) or self._anew:
            details = vehicle_details(vehicles, roll.who, self._routes, now_ns)
        for entity, members in (("world/vehicles", roll.own), ("world/guests", roll.guests)):
            if len(members) or self._anew:
                told = None if details is None else [details[n] for n in members.tolist()]
                its = {"positions": positions[members], "colors": colours[members]}
                self._pen.points(entity, {"vehicle": told}, **its)
        guests = positions[roll.guests]
        if self._pen.news("world/guests/frames", centres=guests):
            sides, radii = np.full(guests.shape, 0.5 * self._mesh.scale_m, np.float32), [screen(1.0)]
            boxes = rr.Boxes3D(centers=guests, half_sizes=sides, colors=[LABEL_COLOUR], radii=radii)
            self._pen.log("world/guests/frames", boxes)
        if self._level.names and len(positions) <= self._level.most:
            above = np.array([0, 0, 0.8 * self._mesh.scale_m], np.float32)
            self._pen.points("world/vehicles/names", positions=positions + above, labels=vehicles.ids)
        self._anew = False

    def _draw_routes(self, vehicles: VehicleColumns, target: str) -> None:
        """Draws what is left of the routes to a target."""
        ahead, pulled = [], []
        for n in vehicles.chasing(target).tolist():
            route = self._routes.get(vehicles.ids[n])
            if route is None or route.target != target:
                continue
            if route.turns is None:
                ahead.append(route.ahead_of(self._cell(vehicles, n)))
            else:
                place_m = float(vehicles.east_m[n]), float(vehicles.south_m[n])
                pulled.append(route.corners_ahead(self._mesh.grid, *place_m))
        self._pen.lines(f"world/routes/{target}", self._route_lines.lines(ahead, pulled))

    def _cell(self, vehicles: VehicleColumns, n: int) -> int:
        return map_lines.cell_at(self._mesh.grid, float(vehicles.east_m[n]), float(vehicles.south_m[n]))


def vehicle_details(
    vehicles: VehicleColumns, who: Mapping[str, str], routes: Mapping[str, RouteNow], now_ns: int
) -> list[str]:
    """As `a0-04 to t3: on its way, route 2 s old, certified gap 1.20%; scouts, walker`. What matters comes first: a
    viewer may cut off the end.

    who  vehicle -> what is said of whose it is
    """
    target_ids = vehicles.target_ids
    lines = []
    for id, state, target in zip(vehicles.ids, vehicles.states.tolist(), vehicles.targets.tolist(), strict=True):
        chased = target_ids[target] if target >= 0 else None
        line = f"{id}: {_DOES[state]}" if chased is None else f"{id} to {chased}: {_DOES[state]}"
        route = routes.get(id)
        if route is not None and route.target == chased and state != VehicleState.ARRIVED:
            proven = "gap not proven" if route.gap is None else f"certified gap {percent(route.gap)}"
            line += f", route {(now_ns - route.begun_ns) / NS_PER_S:.0f} s old, {proven}"
        lines.append(f"{line}; {who.get(id, '?')}")
    return lines
