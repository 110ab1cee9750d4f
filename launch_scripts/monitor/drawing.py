"""Logs to rerun what moves, figures and notes: takes the scene's arrays. What lies still is logged in `ground/`.

Few entities with many instances each, arrays instead of lists, style logged once: see what was measured in
docs/decisions/0008-the-live-view.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats
from launch_scripts.monitor.movers.points import ROUTE_COLOUR, STATE_COLOURS, TRAIL_COLOUR, Points
from launch_scripts.monitor.serving.sinks import Streams
from launch_scripts.report.pictures import palette
from launch_scripts.report.samples import Sample
from swarm.wire.messages.vehicles import VehicleState

_NAMES_SHOWN = 40
_TARGET_TRAIL_COLOUR = (255, 70, 70)
_PLOT_COLOURS = [
    tuple(int(colour[n : n + 2], 16) for n in (1, 3, 5))
    for colour in (
        *(palette.SKY, palette.ORANGE, palette.GREEN, "#F0E442", palette.PINK, "#D55E00", "#8DA0CB", "#66C2A5"),
        *("#E5C494", "#B3B3B3", "#A6D854", "#FC8D62"),
    )
]


class Drawing:
    """Logs the scene to one recording stream."""

    def __init__(self, rec: rr.RecordingStream | Streams, target_ids: Sequence[str]) -> None:
        self._rec = rec
        self._target_ids = list(target_ids)
        self._vehicle_ids: list[str] = []
        self._vehicle_colours: Bytes = np.empty((0, 3), np.uint8)
        self._target_ids_drawn: list[str] = []
        self._target_colours: Bytes = np.empty((0, 3), np.uint8)

    def set_time(self, frame: int, seconds: float) -> None:
        """Sets the time of all that follows. What is logged before the first call is on no timeline."""
        self._rec.set_time("tick", sequence=frame)
        self._rec.set_time("sim_time", duration=seconds)

    def begin(self) -> None:
        """Logs what never changes: the styles."""
        rec = self._rec
        thin, line, thick = _screen_points(0.5), _screen_points(1.3), _screen_points(2.2)
        rec.log("world/trails/vehicles", _style(rr.LineStrips3D, [TRAIL_COLOUR], [line]), static=True)
        rec.log(
            "world/trails/targets",
            _style(rr.LineStrips3D, [_TARGET_TRAIL_COLOUR], [thick]),
            static=True,
        )
        rec.log("world/targets/poles", _style(rr.LineStrips3D, [_TARGET_TRAIL_COLOUR], [line]), static=True)
        for id in self._target_ids:
            rec.log(f"world/routes/{id}", _style(rr.LineStrips3D, [ROUTE_COLOUR], [thin]), static=True)
        states = [state.name.lower() for state in VehicleState]
        self._series("states", states, list(STATE_COLOURS.values()))
        self._series("captures_and_marks", ["captures", "marks / 100"], [(255, 210, 31), (170, 110, 240)])
        for chart in ("gap", "growth_ms"):
            self._series(chart, self._target_ids, self._colours())
        self._series("messages", ["all processes"], [(86, 180, 233)])

    def _colours(self) -> list[tuple[int, ...]]:
        return [_PLOT_COLOURS[n % len(_PLOT_COLOURS)] for n in range(len(self._target_ids))]

    def _series(self, chart: str, names: list[str], colours: Sequence[tuple[int, ...]]) -> None:
        self._rec.log(f"plots/{chart}", rr.SeriesLines(names=names, colors=colours, widths=1.5), static=True)

    def vehicles(self, points: Points) -> None:
        """Logs places each time, colours and ids only when they have changed."""
        same = points.ids == self._vehicle_ids
        if same and np.array_equal(points.colours, self._vehicle_colours):
            self._rec.log("world/vehicles", rr.Points3D.from_fields(positions=points.positions))
            return
        self._vehicle_ids, self._vehicle_colours = points.ids, points.colours
        radii = None if same else [_screen_points(5.0)]
        self._rec.log(
            "world/vehicles",
            rr.Points3D.from_fields(positions=points.positions, colors=points.colours, radii=radii),
        )

    def targets(self, points: Points, poles: Floats, names: Floats) -> None:
        """Logs balls on poles, each with its name at `names`."""
        rec = self._rec
        rec.log("world/targets/poles", rr.LineStrips3D.from_fields(strips=poles))
        if points.ids == self._target_ids_drawn and np.array_equal(points.colours, self._target_colours):
            rec.log("world/targets/balls", rr.Points3D.from_fields(positions=points.positions))
            rec.log("world/targets/names", rr.Points3D.from_fields(positions=names))
            return
        self._target_ids_drawn, self._target_colours = points.ids, points.colours
        radius = _screen_points(6.5)
        rec.log("world/targets/balls", rr.Points3D(points.positions, colors=points.colours, radii=radius))
        if len(points.ids) <= _NAMES_SHOWN:
            labels = rr.Points3D(
                names, colors=(255, 205, 200), radii=_screen_points(0.1), labels=points.ids, show_labels=True
            )
            rec.log("world/targets/names", labels)

    def sightings(self, points: Points, within_m: Floats) -> None:
        """Logs balls as large as the uncertainty of the sightings."""
        balls = rr.Points3D(points.positions, colors=points.colours, radii=within_m, labels=points.ids)
        self._rec.log("world/targets/sighted", balls)

    def bodies(self, points: Points, radii_m: Floats) -> None:
        """Logs balls as large as the bodies."""
        labels = points.ids if len(points.ids) <= _NAMES_SHOWN else None
        balls = rr.Points3D(
            points.positions, colors=points.colours, radii=radii_m, labels=labels, show_labels=False
        )
        self._rec.log("world/bodies", balls)

    def trails(self, who: str, strips: Floats) -> None:
        """Logs the newest piece of each trail; the view shows those of the last seconds together."""
        if len(strips):
            self._rec.log(f"world/trails/{who}", rr.LineStrips3D.from_fields(strips=strips))

    def routes(self, target: str, strips: Floats) -> None:
        self._rec.log(f"world/routes/{target}", rr.LineStrips3D.from_fields(strips=strips))

    def plots(self, sample: Sample, messages_per_s: float | None) -> None:
        log = self._scalars
        log("states", [float(n) for n in sample.states])
        marks = None if sample.marks is None else sample.marks / 100
        log("captures_and_marks", [sample.captures, marks])
        excess = {id: (gap - 1) * 100 for id, gap in sample.gaps.items()}
        log("gap", [excess.get(id) for id in self._target_ids])
        log("growth_ms", [sample.growth_ms.get(id) for id in self._target_ids])
        log("messages", [messages_per_s])

    def _scalars(self, chart: str, values: Sequence[float | None]) -> None:
        if any(value is not None for value in values):
            numbers = np.array([math.nan if value is None else value for value in values])
            self._rec.log(f"plots/{chart}", rr.Scalars(numbers))

    def summary(self, markdown: str) -> None:
        self._rec.log("summary", rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def note(self, text: str, level: str) -> None:
        self._rec.log("log", rr.TextLog(text, level=level))


def _style(archetype: type[rr.LineStrips3D], colours: list[tuple[int, ...]], radii: list[float]) -> rr.LineStrips3D:
    return archetype.from_fields(colors=colours, radii=radii)


def _screen_points(radius: float) -> float:
    """A radius in points of the viewer's window, the same at every zoom: rerun takes negative radii so."""
    return -radius
