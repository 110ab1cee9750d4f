"""Logs to rerun what moves. Takes arrays, decides nothing.

Few entities with many instances each; of each only what has changed: see docs/decisions/0053-what-moves.md.

rerun's viewer tells of the instance under the pointer what its components say, if they are three at most, else how
many there are. So vehicles and targets have three: a place, a colour, and a sentence. Radii are in the blueprint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats
from launch_scripts.monitor.movers.levels import Level
from launch_scripts.monitor.movers.looks import BODY_COLOUR, SIGHTED_COLOUR, Colour, Looks
from launch_scripts.monitor.movers.strips import Strips
from launch_scripts.monitor.serving.sinks import Streams
from launch_scripts.monitor.shown_text import shown

_LABEL_COLOUR: Colour = (240, 243, 246)
FOLLOWED_ENTITY = "world/followed"
_TARGET_PX = 8.5


def mover_overrides(level: Level) -> dict[Any, Any]:
    """For the blueprint of each 3D view: sizes, and how long trails are seen."""
    trail = rr.VisibleTimeRange(
        "sim_time",
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-level.trail_s),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    return {
        "/world/vehicles": rr.Points3D.from_fields(radii=[_screen(level.radius_px)]),
        "/world/guests": rr.Points3D.from_fields(radii=[_screen(0.8 * level.radius_px)]),
        "/world/targets/balls": rr.Points3D.from_fields(radii=[_screen(_TARGET_PX)]),
        "/world/bodies/names": rr.Points3D.from_fields(radii=[_screen(3.0)]),
        "/world/trails/vehicles": rrb.VisibleTimeRanges([trail]),
        "/world/trails/targets": rrb.VisibleTimeRanges([trail]),
    }


class MoverDrawing:
    """Logs all that moves to one recording stream."""

    def __init__(self, rec: rr.RecordingStream | Streams, looks: Looks, level: Level, follows: bool) -> None:
        self._follows = follows
        self._rec = rec
        self._looks = looks
        self._level = level

    def begin(self) -> None:
        """Logs the styles, which never change."""
        line = _screen(self._level.line_px)
        for id in self._looks.target_ids:
            self._style(f"world/routes/{id}", self._looks.route(id), line)
        self._style("world/trails/vehicles", None, _screen(0.8 * self._level.line_px))
        self._style("world/trails/targets", None, _screen(1.6 * self._level.line_px))
        self._style("world/targets/poles", None, _screen(2.2))
        self._style("world/targets/sighted", SIGHTED_COLOUR, _screen(1.2))
        self._style("world/alarms/poles", None, _screen(1.8))
        halo = rr.Points3D([(0, 0, 0)], colors=[_LABEL_COLOUR], radii=[_screen(self._level.radius_px + 2.5)])
        if self._follows:
            self._rec.log(FOLLOWED_ENTITY + "/halo", halo, static=True)
        for entity in ("world/vehicles/names", "world/targets/names", "world/targets/sighted/names"):
            shown = rr.Points3D.from_fields(colors=[_LABEL_COLOUR], radii=[_screen(0.1)], show_labels=True)
            self._rec.log(entity, shown, static=True)

    def _style(self, entity: str, colour: Colour | None, radius: float) -> None:
        colours = None if colour is None else [colour]
        self._rec.log(entity, rr.LineStrips3D.from_fields(colors=colours, radii=[radius]), static=True)

    def vehicles(self, entity: str, positions: Floats, colours: Bytes | None, details: list[str] | None) -> None:
        """Places, and of the rest what is not None; all of it where vehicles have come or gone."""
        parts: list[rr.AsComponents] = [rr.Points3D.from_fields(positions=positions, colors=colours)]
        if details is not None:
            parts.append(rr.AnyValues(vehicle=pa.array(details, pa.string())))
        self._rec.log(entity, *parts)

    def frames(self, positions: Floats, half_m: float) -> None:
        """Boxes around guests."""
        boxes = rr.Boxes3D(
            centers=positions,
            half_sizes=np.full((len(positions), 3), half_m, np.float32),
            colors=[_LABEL_COLOUR],
            radii=[_screen(1.0)],
        )
        self._rec.log("world/guests/frames", boxes)

    def names(self, entity: str, positions: Floats, names: list[str] | None) -> None:
        """Labels that are always shown; their texts if they are not None."""
        labels = None if names is None else pa.array(names, pa.string())
        self._rec.log(entity, rr.Points3D.from_fields(positions=positions, labels=labels))

    def targets(
        self, positions: Floats, poles: Strips, colours: Sequence[Colour] | None, details: list[str] | None
    ) -> None:
        """Balls on poles; of colours and details what is not None."""
        told = None if colours is None else np.array(colours, np.uint8).reshape(-1, 3)
        parts: list[rr.AsComponents] = [rr.Points3D.from_fields(positions=positions, colors=told)]
        if details is not None:
            parts.append(rr.AnyValues(target=pa.array(details, pa.string())))
        self._rec.log("world/targets/balls", *parts)
        self.lines("world/targets/poles", poles, told)

    def searched(self, positions: Floats, colours: Bytes, radii_m: Floats, details: list[str]) -> None:
        """Balls, the more opaque the likelier a target is there."""
        balls = rr.Points3D(positions, colors=colours, radii=radii_m)
        self._rec.log("world/searched", balls, rr.AnyValues(searched=pa.array(details, pa.string())))

    def bodies(self, positions: Floats, radii_m: Floats, details: list[str]) -> None:
        """Discs as large as the bodies."""
        discs = rr.Ellipsoids3D(
            centers=positions,
            half_sizes=np.stack([radii_m, radii_m, 0.35 * radii_m], axis=1),
            colors=[BODY_COLOUR],
            fill_mode="solid",
        )
        self._rec.log("world/bodies/discs", discs)
        tops = positions + np.array([0, 0, 0.35], np.float32) * radii_m[:, None]
        points = rr.Points3D.from_fields(positions=tops, colors=np.full((len(tops), 3), 225, np.uint8))
        self._rec.log("world/bodies/names", points, rr.AnyValues(body=pa.array(details, pa.string())))

    def lines(self, entity: str, strips: Strips, colours: Bytes | None = None) -> None:
        """Lines; colours are those of each, uint8 (n, 3), or stay as they are."""
        self._rec.log(entity, rr.LineStrips3D.from_fields(strips=_arrow(strips), colors=colours))

    def alarms(self, positions: Floats, poles: Strips, colours: Sequence[Colour], texts: list[str]) -> None:
        """A pole with a ball and its words for each."""
        told = np.array(colours, np.uint8).reshape(-1, 3)
        self.lines("world/alarms/poles", poles, told)
        balls = rr.Points3D(
            positions,
            colors=told,
            radii=[_screen(5.0)],
            labels=[shown(text, 60) for text in texts],
            show_labels=True,
        )
        self._rec.log("world/alarms/marks", balls)

    def followed(self, position: Floats) -> None:
        """Where the vehicle or target is that the camera follows: an entity whose origin moves, with a halo."""
        self._rec.log(FOLLOWED_ENTITY, rr.Transform3D.from_fields(translation=position))


def _arrow(strips: Strips) -> pa.Array:
    """As rerun keeps them, without an array for each line."""
    wanted = rr.components.LineStrip3DBatch._ARROW_DATATYPE
    points = pa.array(np.ascontiguousarray(strips.points, np.float32).reshape(-1))
    triples = pa.FixedSizeListArray.from_arrays(points, type=wanted.value_type)
    return pa.ListArray.from_arrays(pa.array(strips.offsets), triples, type=wanted)


def _screen(radius: float) -> float:
    """A radius in points of the viewer's window, the same at every zoom: rerun takes negative radii so."""
    return -radius
