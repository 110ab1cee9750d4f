"""Draws targets, where hidden ones were seen, and bodies, as they are due."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from launch_scripts.monitor.movers.details import MOST_LABELS, body_details, target_labels
from launch_scripts.monitor.movers.due import Due
from launch_scripts.monitor.movers.looks import Looks
from launch_scripts.monitor.movers.mover_drawing import MoverDrawing
from launch_scripts.monitor.movers.points import (
    Places,
    body_points,
    label_places,
    sighting_points,
    target_points,
)
from launch_scripts.monitor.movers.strips import Trails, feet, poles, rings
from swarm.clock import NS_PER_S
from swarm.wire.messages.planning import Sighted
from swarm.wire.messages.vehicles import Body


class TargetsView:
    """Targets as pins with a label, sightings as rings, bodies as discs."""

    def __init__(self, drawing: MoverDrawing, mesh: TerrainMesh, looks: Looks, trails: Trails) -> None:
        self._drawing = drawing
        self._mesh = mesh
        self._looks = looks
        self._trails = trails
        self._seen: Mapping[str, Sighted] = {}
        self._seen_ns: dict[str, int] = {}
        """Target -> when its newest sighting was heard."""
        self._shown: Mapping[str, Sighted] | None = None
        """Sightings as drawn last; as of `_pins` and `_bodies`, None if they are to be drawn anew."""
        self._pins: object = None
        self._places: Floats | None = None
        """Of pins, as drawn last."""
        self._bodies: Sequence[Body] | None = None
        self._due = Due({"pins": 0.2, "details": 1.0, "trails": 0.5, "ages": 2.0, "bodies": 0.2})

    def draw_anew(self) -> None:
        self._shown = self._pins = self._bodies = None

    def draw(
        self,
        places_m: Places,
        lost: Collection[str],
        seen: Mapping[str, Sighted],
        details: Mapping[str, str],
        now_ns: int,
        slower: int,
    ) -> None:
        """Draws what is due; once a frame.

        places_m  of targets whose trackers told them; `lost` are those that nobody tracks now
        seen      target -> its newest sighting
        details   target -> a sentence about it
        slower    by how many times as seldom as for somebody who looks
        """
        if not self._due.now("pins", now_ns, slower):
            return
        self._seen_ns = {
            id: self._seen_ns[id] if self._seen.get(id) == sighted else now_ns for id, sighted in seen.items()
        }
        self._seen = seen
        ages_s = {id: (now_ns - heard_ns) / NS_PER_S for id, heard_ns in self._seen_ns.items()}
        pins, sightings = target_labels(places_m, lost, ages_s)
        shown = {id: sighted for id, sighted in seen.items() if id in sightings}
        ages_due = bool(shown) and self._due.now("ages", now_ns)
        if shown != self._shown or ages_due:
            self._shown = shown
            self._draw_sightings(shown, sightings)
        self._draw_pins(places_m, lost, pins, details, now_ns, slower)

    def _draw_sightings(self, shown: Mapping[str, Sighted], labels: Mapping[str, str]) -> None:
        points, radii_m = sighting_points(self._mesh, shown)
        self._drawing.lines("world/targets/sighted", rings(self._mesh, points.positions, radii_m))
        few = points.ids[:MOST_LABELS]
        names = points.positions[: len(few)] + np.array([0, 0, self._mesh.scale_m], np.float32)
        self._drawing.names("world/targets/sighted/names", names, [labels[id] for id in few])

    def _draw_pins(
        self,
        places_m: Places,
        lost: Collection[str],
        labels: Mapping[str, str],
        details: Mapping[str, str],
        now_ns: int,
        slower: int,
    ) -> None:
        points = target_points(self._mesh, places_m)
        colours = [self._looks.target(id, id in lost) for id in points.ids]
        pins = (points.ids, colours, labels)
        whole = pins != self._pins
        self._pins = pins
        told = None
        if self._due.now("details", now_ns, slower) or whole:
            told = [details.get(id, id) for id in points.ids]
        moved = self._places is None or not np.array_equal(points.positions, self._places)
        self._places = points.positions
        if moved or whole or told is not None:
            self._drawing.targets(points.positions, poles(self._mesh, points), colours if whole else None, told)
        named = [n for n, id in enumerate(points.ids) if id in labels][:MOST_LABELS]
        texts = [labels[points.ids[n]] for n in named] if whole else None
        if (named and moved) or whole:
            self._drawing.names("world/targets/names", label_places(self._mesh, points)[named], texts)
        if self._due.now("trails", now_ns):
            trails, drawn = self._trails.advance(points.ids, feet(self._mesh, points.positions))
            if len(trails):
                self._drawing.lines("world/trails/targets", trails, np.array(colours, np.uint8)[drawn])

    def draw_bodies(self, bodies: Sequence[Body], now_ns: int) -> None:
        """Draws bodies if something about them is new."""
        if bodies != self._bodies and self._due.now("bodies", now_ns):
            self._bodies = bodies
            points, radii_m = body_points(self._mesh, bodies)
            self._drawing.bodies(points.positions, radii_m, list(map(body_details, bodies)))
