"""The moving half of the view: hears who is where, and has it drawn frame by frame."""

from __future__ import annotations

from bisect import bisect_left

import rerun as rr

from launch_scripts.monitor.ground.terrain_mesh import TerrainMesh
from launch_scripts.monitor.movers.alarms import alarm_marks
from launch_scripts.monitor.movers.details import target_details
from launch_scripts.monitor.movers.levels import level_for
from launch_scripts.monitor.movers.looks import Looks
from launch_scripts.monitor.movers.mover_drawing import MoverDrawing
from launch_scripts.monitor.movers.points import Points, alarm_tops, followed_point
from launch_scripts.monitor.movers.searches import Searches, searched_points
from launch_scripts.monitor.movers.strips import poles
from launch_scripts.monitor.movers.targets_view import TargetsView
from launch_scripts.monitor.movers.vehicles_view import VehiclesView, trails_of
from launch_scripts.monitor.serving.sinks import Streams
from launch_scripts.observe.latest_state import VehicleColumns
from launch_scripts.observe.recorder import RunFigures
from launch_scripts.observe.state import RunState
from shared_map.replication.filter import MarkFilter
from shared_map.sightings import Sightings
from swarm.config.scenario import Scenario
from swarm.runtime.stats import Counters
from swarm.wire.messages import Message
from swarm.wire.messages.planning import Believed, Sighted
from swarm.wire.messages.vehicles import Body, Fleet, Followed
from vehicle_agent.bodies import Bodies

_UNSEEN = 2
"""While nobody looks pins, routes and sentences are drawn so many times as seldom, for the recording."""


class MoversView:
    """Vehicles, guests, targets, sightings, bodies, routes and trails.

    figures  have heard each message before `hear`
    filter   whose sightings count
    """

    def __init__(
        self,
        rec: rr.RecordingStream | Streams,
        mesh: TerrainMesh,
        scenario: Scenario,
        figures: RunFigures,
        counters: Counters,
        filter: MarkFilter,
    ) -> None:
        self._figures = figures
        self._mesh = mesh
        self._counters = counters
        level = level_for(scenario.vehicle_count)
        self.looks = looks = Looks([group.name for group in scenario.groups], scenario.target_ids)
        self._drawing = MoverDrawing(rec, looks, level, scenario.monitor.follow is not None)
        self._vehicles = VehiclesView(self._drawing, mesh, scenario, level, looks)
        self._follow = scenario.monitor.follow
        self._targets = TargetsView(self._drawing, mesh, looks, trails_of(scenario, mesh, level))
        self._sightings = Sightings(filter)
        self._searches = Searches()
        self._bodies = Bodies(mesh.grid)
        """Taken in as vehicles do: what they avoid is drawn, and nothing else."""
        self._details: dict[str, str] = {}
        """Target -> a sentence about it."""
        self._crew: frozenset[tuple[str, str]] = frozenset()
        """(role, id) of the processes that the run needs; of others that went, vehicles have left."""
        self._alarmed = False
        """Whether any alarm is drawn."""
        self._fleets_new = False

    def begin(self) -> None:
        """Logs styles; all else is drawn anew."""
        self._drawing.begin()
        self.draw_anew()
        if self._follow is not None:  # the middle, until it is known: the world's origin is a corner off the ground
            middle = self._mesh.width_m / 2, self._mesh.depth_m / 2
            self._drawing.followed(followed_point(self._mesh, middle))

    def draw_anew(self) -> None:
        """What is drawn on change only is drawn once more, when it is due."""
        self._vehicles.draw_anew()
        self._targets.draw_anew()
        self._searches.draw_anew()

    def hear(self, message: Message, now_ns: int) -> None:
        match message:
            case Fleet():
                self._fleets_new = True
            case Sighted() as sighted:
                self._sightings.hear(sighted, now_ns)
            case Believed() as believed:
                self._searches.hear(believed, now_ns)
            case Body() as body:
                self._bodies.hear(body, now_ns)
            case Followed() as followed:
                if not self._vehicles.begun(followed, now_ns):
                    self._counters.count("routes_unreadable")

    def summarised(self, summary: RunState) -> None:
        """Takes what the figures say, so that all places say the same; draws alarms where they are."""
        self._details = {line.id: target_details(line) for line in summary.targets}
        observed = self._figures.observed
        self._crew = frozenset(observed.plan.crew_now(observed.plan.targets_now(observed.book)))
        marks = alarm_marks(
            summary.alarms, summary.elapsed_s, observed.targets(), observed.vehicles(), self._mesh.grid
        )
        if marks or self._alarmed:
            self._alarmed = bool(marks)
            places_m = {str(n): (mark.east_m, mark.south_m) for n, mark in enumerate(marks)}
            points = Points(list(places_m), alarm_tops(self._mesh, places_m))
            strips = poles(self._mesh, points)
            texts = [mark.text for mark in marks]
            self._drawing.alarms(points.positions, strips, [mark.colour for mark in marks], texts)

    def tick(self, now_ns: int, watched: bool) -> None:
        """Draws what is due in one frame."""
        slower = 1 if watched else _UNSEEN
        observed = self._figures.observed
        if self._fleets_new:
            self._fleets_new = False
            vehicles = observed.driven(self._crew, now_ns)
            self._vehicles.draw(vehicles, observed.groups, observed.classes, now_ns, slower)
            self._draw_followed(vehicles)
        self._sightings.expire(now_ns)
        lost = self._figures.observed.lost(now_ns)
        # A target that an operator removed is in no table either.
        places_m = {id: place_m for id, place_m in observed.targets().items() if id in self._details}
        self._targets.draw(places_m, lost, self._sightings.best(now_ns), self._details, now_ns, slower)
        if (beliefs := self._searches.take_changed(now_ns)) is not None:
            self._drawing.searched(*searched_points(self._mesh, beliefs))
        self._bodies.tick(now_ns)
        self._bodies.take_changed()
        self._bodies.complaints.clear()
        self._targets.draw_bodies(self._bodies.reports, now_ns)

    def _draw_followed(self, vehicles: VehicleColumns) -> None:
        """Draws the vehicle or target that the camera follows, where it is now; nothing while nobody knows."""
        if self._follow is None:
            return
        place_m = self._figures.observed.targets().get(self._follow)
        n = bisect_left(vehicles.ids, self._follow)
        if n < len(vehicles) and vehicles.ids[n] == self._follow:
            place_m = float(vehicles.east_m[n]), float(vehicles.south_m[n])
        if place_m is not None:
            self._drawing.followed(followed_point(self._mesh, place_m))
