"""Moving half of the view: receives positions, and draws them frame by frame.

Vehicles are balls with a sentence each, with trails and routes. Targets are pins with a label, hidden ones rings
where they were seen, obstacles discs, beliefs balls that are the more opaque the likelier a target is there, alarms
poles with their words.

Few entities with many instances each; of each only changes: see docs/design/live-view.md.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from launch_scripts.monitor import styles
from launch_scripts.monitor.rerun_outputs import LABEL_COLOUR, Pen, RateLimit, Strips, even, inline, ragged, screen
from launch_scripts.monitor.styles import ALARM_COLOUR, FOLLOWED_ENTITY, Colours, Level, dimmed
from launch_scripts.monitor.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.observe.alarms import Alarm
from launch_scripts.observe.latest_messages import LatestState, VehicleColumns
from launch_scripts.observe.run_state import RunState
from launch_scripts.observe.summed_counts import percent
from launch_scripts.plain_text import first_of
from shared_map.replication.interest import MarkFilter
from shared_map.sightings import Sightings
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND
from swarm.grid import GridSpec, walk
from swarm.runtime.stats import Counters
from swarm.wire.fields import column
from swarm.wire.messages import Message
from swarm.wire.messages.orders import GoalState
from swarm.wire.messages.planning import Believed, Sighted
from swarm.wire.messages.vehicles import Fleet, Followed, Obstacle, VehicleState
from vehicle_agent.traffic.obstacles import Obstacles

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


def route_lines(mesh: TerrainMesh, stride: int, routes: Iterable[RouteNow]) -> Strips:
    """Routes to one target as lines in which no part of the ground is drawn twice: each up to where it meets one
    that is drawn already, the longest first.

    Routes to one target join, as the branches of its tree do: a thousand of them have few cells more than the tree.

    stride  number of cells between two points of a line
    """
    parts, drawn = [np.empty((0, 2), np.float32)], np.zeros(mesh.grid.cells, np.bool_)
    for route in sorted(routes, key=lambda route: len(route.cells), reverse=True):
        met = np.flatnonzero(drawn[route.cells])
        end = int(met[0]) if len(met) else len(route.cells) - 1
        if end > 0:
            drawn[route.cells[: end + 1]] = True
            parts.append(route.places[np.append(np.arange(0, end, stride), end)])
    south_m, east_m = ((np.concatenate(parts) + 0.5) * mesh.grid.resolution_m).astype(np.float32).T
    return ragged(mesh.place(east_m, south_m, 0.2 * mesh.scale_m), [len(part) for part in parts[1:]])


def trails_of(scenario: Scenario, mesh: TerrainMesh, level: Level) -> Trails:
    """Trails that break where something jumped further than anything drives."""
    blown = scenario.wind.speed_m_per_s
    flown = (each.air.speed_m_per_s + blown for each in scenario.classes if each.air is not None)
    quickest_m_per_s = scenario.time_scale * max(scenario.cost.road_speed_m_per_s, 1.0, *flown)
    return Trails(max(8 * level.trail_every_s * quickest_m_per_s, 4 * mesh.grid.resolution_m))


class VehiclesView:
    """Vehicles as balls with a sentence each, their trails and routes."""

    def __init__(self, pen: Pen, scenario: Scenario, level: Level, colours: Colours) -> None:
        self._pen, self._mesh, self._level, self._colours = pen, pen.mesh, level, colours
        self._target_ids = scenario.target_ids
        self._ids: list[str] = []
        """Vehicles that were drawn last, and their metadata. Rebuilt when a vehicle joins or leaves."""
        self._who: dict[str, str] = {}
        """Vehicle -> its group, and its class where that is not "ground"."""
        self._rows = np.empty(0, np.intp)
        """Rows of `Colours.vehicles`, by group."""
        self._aloft: list[tuple[NDArray[np.intp], Floats]] = []
        """For each flying class the indices of its vehicles in `_ids`, and `TerrainMesh.aloft_m`."""
        self._routes: dict[str, RouteNow] = {}
        self._next_target = 0
        self._trails = trails_of(scenario, self._mesh, level)
        self._frame = 0
        routes_s = level.routes_s / max(len(self._target_ids), 1)
        self._limit = RateLimit({"trails": level.trail_every_s, "details": level.details_s, "routes": routes_s})

    def begin(self) -> None:
        """Logs the styles, which never change."""
        for id in self._colours.target_ids:
            self._pen.style(f"world/routes/{id}", self._level.line_px, self._colours.route(id))
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
        if self._colours.by_target:
            rows = np.array([*self._colours.rows(vehicles.target_ids), -1], np.intp)[vehicles.targets]
        colours, details = self._colours.vehicles(rows, vehicles.states), None
        if self._limit.due("details", now_ns, slower):
            details = vehicle_details(vehicles, self._who, self._routes, now_ns)
        self._pen.points("world/vehicles", {"vehicle": details}, positions=positions, colors=colours)
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
        self._rows = np.array(self._colours.rows([groups.get(id) for id in ids]), np.intp)
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
        self._pen.lines(f"world/routes/{target}", route_lines(self._mesh, self._level.route_stride, ahead))


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


# --- all that moves -----------------------------------------------------------------------------------------------

MOST_LABELS = 40
"""With more labels nothing can be read."""
OVER_S = 8.0
"""An alarm that is over is shown for this time."""
_SHOWN = 256
"""Targets whose searches are shown, as names cost a sender nothing."""
_MOST_MARKS = 24
"""The serious come first, as in the list of alarms."""
_UNSEEN = 2
"""Factor by which pins, routes and sentences are drawn less often without viewers, for the recording."""
SILENT_NS = 5 * NS_PER_S
"""A planner that searches publishes its belief once a second: an older belief is drawn no more."""
_FAINT, _FULL = 40, 235
"""Opacity of the least and of the likeliest place of a belief."""
_CIRCLE_POINTS = 33
"""The last point is the first: 32 sides. Chosen, not measured."""
_SMALLEST = 0.45
"""Radius below which nothing is drawn, as a share of `TerrainMesh.scale_m`: a rover of 2 m is seen on 10 km."""
_PIN, _LABEL, _ALARM, _FLAG = 2.2, 5.4, 4.6, 1.8
"""Heights of pins, of their labels, of alarms and of flags over the ground, in `TerrainMesh.scale_m`."""


Place = tuple[float, float]
"""East and south in metres from the grid's north-west corner."""


class MoversView:
    """Vehicles, targets, sightings, obstacles, routes and trails.

    observed  has heard each message before `on_observed`
    filter    whose sightings count
    """

    def __init__(
        self, pen: Pen, scenario: Scenario, observed: LatestState, counters: Counters, filter: MarkFilter
    ) -> None:
        self._pen, self._mesh, self._observed, self._counters = pen, pen.mesh, observed, counters
        self._level = level = styles.level_for(scenario.vehicle_count)
        self.colours = styles.Colours([group.name for group in scenario.groups], scenario.target_ids)
        self._vehicles = VehiclesView(self._pen, scenario, level, self.colours)
        self._follow = scenario.monitor.follow
        self._trails = trails_of(scenario, pen.mesh, level)
        self._sightings = Sightings(filter)
        self._believed: dict[str, tuple[Believed, int]] = {}
        """Unseen target -> its believed position, and the time of that belief."""
        self._obstacles = Obstacles(pen.mesh.grid)
        """Taken in as vehicles do: what they avoid is drawn, and nothing else."""
        self._targets: set[str] = set()
        """Those of the table of figures: one that an operator removed is not there."""
        self._crew: frozenset[tuple[str, str]] = frozenset()
        """(role, id) of the processes that the run needs; of others that went, vehicles have left."""
        self._fleets_new = False
        self._limit = RateLimit({"pins": 0.2, "trails": 0.5, "obstacles": 0.2, "beliefs": 0.5})

    def begin(self) -> None:
        """Logs styles, and starts all drawings from scratch."""
        self._vehicles.begin()
        self._pen.style("world/goals/poles", 1.4)
        self._pen.style("world/goals/ways", 0.6)
        self._pen.style("world/trails/targets", 1.6 * self._level.line_px)
        self._pen.style("world/targets/poles", 2.2)
        self._pen.style("world/targets/sighted", 1.2, styles.SIGHTED_COLOUR)
        self._pen.style("world/alarms/poles", 1.8, ALARM_COLOUR)
        balls = rr.Points3D.from_fields(radii=[screen(5.0)], colors=[ALARM_COLOUR], show_labels=True)
        self._pen.log("world/alarms/marks", balls, static=True)
        for entity in ("world/targets/names", "world/targets/sighted/names", "world/goals/names"):
            self._pen.label_style(entity)
        self.draw_anew()
        if self._follow is not None:  # the middle, until it is known: the world's origin is a corner off the ground
            px = self._level.radius_px + 2.5
            halo = rr.Points3D([(0, 0, 0)], colors=[LABEL_COLOUR], radii=[screen(px)])
            self._pen.log(f"{FOLLOWED_ENTITY}/halo", halo, static=True)
            self._log_followed((self._mesh.width_m / 2, self._mesh.depth_m / 2))

    def draw_anew(self) -> None:
        """All is drawn once more when it is due, as the pen has forgotten it."""
        self._vehicles.draw_anew()
        self._limit.all_due()

    def on_observed(self, message: Message, now_ns: int) -> None:
        """Takes a message in."""
        match message:
            case Fleet():
                self._fleets_new = True
            case Sighted() as sighted:
                self._sightings.receive(sighted, now_ns)
            case Believed(target=target) as believed if target in self._believed or len(self._believed) < _SHOWN:
                self._believed[believed.target] = believed, now_ns
            case Obstacle() as obstacle:
                self._obstacles.take_report(obstacle, now_ns)
            case Followed() as followed:
                try:
                    self._vehicles.begun(followed, now_ns)
                except ValueError:
                    self._counters.count("routes_unreadable")

    def summarised(self, summary: RunState) -> None:
        """Takes what the figures say, so that all places say the same; draws alarms where they are."""
        self._targets = {line.id for line in summary.targets}
        observed = self._observed
        self._crew = frozenset(observed.plan.crew_now(observed.plan.targets_now(observed.book)))
        marks = alarm_marks(summary.alarms, summary.elapsed_s, observed.targets(), self._mesh.grid.resolution_m)
        tops = self._pen.placed(list(marks), _ALARM)
        self._pen.lines("world/alarms/poles", poles(self._mesh, tops))
        self._pen.points("world/alarms/marks", positions=tops, labels=[inline(text, 60) for text in marks.values()])

    def tick(self, now_ns: int, watched: bool) -> None:
        """Draws one frame's due parts."""
        slower = 1 if watched else _UNSEEN
        observed = self._observed
        if self._fleets_new:
            self._fleets_new = False
            vehicles = observed.driven(self._crew, now_ns)
            self._vehicles.draw(vehicles, observed, now_ns, slower)
            self._draw_followed(vehicles)
        self._sightings.expire(now_ns)
        if self._limit.due("pins", now_ns, slower):
            places_m = {id: place_m for id, place_m in observed.targets().items() if id in self._targets}
            self._draw_targets(places_m, observed.lost(now_ns), now_ns)
            self._draw_goals(observed.goals(), observed.vehicles())
        if self._limit.due("beliefs", now_ns):
            self._draw_beliefs(now_ns)
        self._obstacles.tick(now_ns)
        self._obstacles.take_changed()
        self._obstacles.complaints.clear()
        self._draw_obstacles(self._obstacles.reports, now_ns)

    def _draw_targets(self, places_m: Mapping[str, Place], lost: Collection[str], now_ns: int) -> None:
        """Draws the targets with published positions, of which those in `lost` have no tracker now, and those that
        vehicles saw."""
        seen = self._sightings.best(now_ns)
        pins, labels = target_labels(places_m, lost, seen)
        rings_of = [seen[id] for id in labels]
        centres, radii_m = self._discs(rings_of, [each.uncertainty_m for each in rings_of], 0.3)
        self._pen.lines("world/targets/sighted", rings(self._mesh, centres, radii_m))
        self._draw_labels("world/targets/sighted/names", centres, 1.0, list(labels.values()))
        ids, tops = list(places_m), self._pen.placed(list(places_m.values()), _PIN)
        colours = np.array([self.colours.target(id, id in lost) for id in ids], np.uint8).reshape(-1, 3)
        self._pen.points("world/targets/balls", {"target": ids}, positions=tops, colors=colours)
        self._pen.lines("world/targets/poles", poles(self._mesh, tops), colours)
        named = [n for n, id in enumerate(ids) if id in pins]
        self._draw_labels("world/targets/names", tops[named], _LABEL - _PIN, [pins[ids[n]] for n in named])
        if self._limit.due("trails", now_ns):
            trails, drawn = self._trails.advance(ids, feet(self._mesh, tops))
            if drawn.any():
                self._pen.trail("world/trails/targets", trails, colours[drawn])

    def _draw_goals(self, goals: Sequence[GoalState], vehicles: VehicleColumns) -> None:
        """Draws a flag at each place to which a vehicle was sent, and a line from the vehicle to it."""
        grid, row = self._mesh.grid, {id: n for n, id in enumerate(vehicles.ids)}
        sent = [(goal, row[goal.name], goal.cell) for goal in goals if goal.name in row and goal.cell is not None]
        sent = [each for each in sent if each[2] < grid.cells]
        cells = np.array([cell for _, _, cell in sent], np.int64)
        tops = self._mesh.place_cells(cells, _FLAG * self._mesh.scale_m)
        hues = [ALARM_COLOUR if goal.state == "blocked" else styles.FLAG_COLOUR for goal, _, _ in sent]
        colours: Bytes = np.array(hues, np.uint8).reshape(-1, 3)
        states = [f"{goal.name}: {goal.state}" for goal, _, _ in sent]
        self._pen.points("world/goals/flags", {"goal": states}, positions=tops, colors=colours)
        self._pen.lines("world/goals/poles", poles(self._mesh, tops), colours)
        starts = self._pen.placed(
            [(float(vehicles.east_m[n]), float(vehicles.south_m[n])) for _, n, _ in sent], 0.2
        )
        ends = feet(self._mesh, tops)
        self._pen.lines("world/goals/ways", even(np.stack([starts, ends], axis=1)), colours)
        names: dict[int, list[str]] = {}  # one label a place: that of a vehicle alone would read like the vehicle
        for goal, _, cell in sent:
            names.setdefault(cell, []).append(goal.name)
        _, first = np.unique(cells, return_index=True)
        texts = [f"place of {first_of(names[int(cells[n])])}" for n in first]
        self._draw_labels("world/goals/names", tops[first], 1.0, texts)

    def _draw_labels(self, entity: str, places: Floats, above: float, texts: list[str]) -> None:
        """Draws as many labels as can be read, at this height (`scale_m`) above their positions."""
        above_m = np.array([0, 0, above * self._mesh.scale_m], np.float32)
        self._pen.points(entity, positions=places[:MOST_LABELS] + above_m, labels=texts[:MOST_LABELS])

    def _draw_obstacles(self, obstacles: Sequence[Obstacle], now_ns: int) -> None:
        """Draws discs as large as the obstacles, if something about them is new."""
        if not self._limit.due("obstacles", now_ns):
            return
        centres, radii_m = self._discs(obstacles, [each.radius_m for each in obstacles], 0.2)
        sizes = np.stack([radii_m, radii_m, 0.35 * radii_m], axis=1)
        if self._pen.news("world/obstacles", centres=centres, sizes=sizes):
            discs = rr.Ellipsoids3D(
                centers=centres, half_sizes=sizes, colors=[styles.OBSTACLE_COLOUR], fill_mode="solid",
                labels=[f"{each.id} of {each.group}" for each in obstacles],
                show_labels=len(obstacles) <= MOST_LABELS,
            )  # fmt: skip
            self._pen.log("world/obstacles", discs)

    def _draw_beliefs(self, now_ns: int) -> None:
        """Draws where targets are believed to be; one without cells is no longer searched."""
        received = self._believed.items()
        self._believed = {id: each for id, each in received if each[0].cells and now_ns - each[1] < SILENT_NS}
        beliefs = [believed for believed, _ in self._believed.values()]
        places, colours, radii_m, sentences = searched_points(self._mesh, beliefs)
        its = {"positions": places, "colors": colours, "radii": radii_m}
        self._pen.points("world/searched", {"searched": sentences}, **its)

    def _draw_followed(self, vehicles: VehicleColumns) -> None:
        """Draws the vehicle or target that the camera follows at its current position; nothing while that is
        unknown."""
        if self._follow is None:
            return
        place_m = self._observed.targets().get(self._follow)
        if self._follow in vehicles.ids:
            n = vehicles.ids.index(self._follow)
            place_m = float(vehicles.east_m[n]), float(vehicles.south_m[n])
        if place_m is not None:
            self._log_followed(place_m)

    def _log_followed(self, place_m: Place) -> None:
        [place] = self._pen.placed([place_m], 0.1)
        self._pen.log(FOLLOWED_ENTITY, rr.Transform3D.from_fields(translation=place))

    def _discs(
        self, there: Sequence[Sighted | Obstacle], radii_m: list[float], above: float
    ) -> tuple[Floats, Floats]:
        """Centres float32 (n, 3), and radii float32 (n,), m, that are seen."""
        grid = self._mesh.grid
        centres = self._pen.placed([(each.x_m - grid.west_m, grid.north_m - each.y_m) for each in there], above)
        return centres, np.maximum(np.array(radii_m, np.float32), np.float32(_SMALLEST * self._mesh.scale_m))


def searched_points(mesh: TerrainMesh, beliefs: Sequence[Believed]) -> tuple[Floats, Bytes, Floats, list[str]]:
    """Places float32 (n, 3), colours uint8 (n, 4), the likelier the less transparent, radii float32 (n,), m, and a
    sentence about each. Cells outside of the map are left out."""
    cells, opacities, radii_m = [np.empty(0, np.int64)], [np.empty(0)], [np.empty(0, np.float32)]
    sentences: list[str] = []
    for believed in beliefs:
        its_cells, shares = np.array(believed.cells, np.int64), column(believed.shares, "<f4")
        on_map = (its_cells >= 0) & (its_cells < mesh.grid.cells)
        shares = shares[on_map]
        cells.append(its_cells[on_map])
        opacities.append(np.sqrt(shares / max(float(shares.max(initial=0.0)), 1e-12)))
        sentences += [f"{believed.target} may be here: {share:.1%}" for share in shares.tolist()]
        radii_m.append(np.full(len(shares), 0.4 * believed.side_m, np.float32))
    opaque = _FAINT + (_FULL - _FAINT) * np.concatenate(opacities)
    colours = np.column_stack([np.tile(styles.SEARCHED_COLOUR, (len(opaque), 1)), opaque]).astype(np.uint8)
    return mesh.place_cells(np.concatenate(cells), 0.1 * mesh.scale_m), colours, np.concatenate(radii_m), sentences


def target_labels(
    posed: Iterable[str], lost: Collection[str], seen: Iterable[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Labels at pins and at sightings, by target. No target has two, and none that is drawn has none.

    posed  targets whose position a tracker published
    lost   those of them that no tracker publishes now
    seen   targets that vehicles saw
    """
    tracked = {id for id in posed if id not in lost}
    sightings = {id: f"{id} seen" for id in seen if id not in tracked}
    pins = {id: f"{id} lost" if id in lost else id for id in posed if id not in sightings}
    return pins, sightings


def alarm_marks(
    alarms: Iterable[Alarm], now_s: float, places_m: Mapping[str, Place], resolution_m: float
) -> dict[Place, str]:
    """The alarms that are at a place, or about a target that has one: place -> words, one at a place. One that is
    over is seen a little longer."""
    marks: dict[Place, str] = {}
    for alarm in alarms:
        place_m = places_m.get(alarm.target or "")
        if alarm.row is not None and alarm.col is not None:
            place_m = (alarm.col + 0.5) * resolution_m, (alarm.row + 0.5) * resolution_m
        seen = alarm.over_s is None or now_s - alarm.over_s <= OVER_S
        if place_m is not None and seen and len(marks) < _MOST_MARKS:
            marks.setdefault(place_m, f"{alarm.label}: {alarm.about}")
    return marks


def feet(mesh: TerrainMesh, positions: Floats) -> Floats:
    """Places on the terrain below these."""
    return mesh.place(positions[:, 0], -positions[:, 1])


def poles(mesh: TerrainMesh, tops: Floats) -> Strips:
    """A line from each point, float32 (n, 3), down to the terrain."""
    return even(np.stack([feet(mesh, tops), tops], axis=1))


def rings(mesh: TerrainMesh, centres: Floats, radii_m: Floats) -> Strips:
    """A circle on the terrain around each place."""
    angle = np.linspace(0, 2 * np.pi, _CIRCLE_POINTS, dtype=np.float32)
    east_m = centres[:, :1] + radii_m[:, None] * np.cos(angle)
    south_m = -centres[:, 1:2] + radii_m[:, None] * np.sin(angle)
    return even(mesh.place(east_m, south_m, 0.25 * mesh.scale_m))
