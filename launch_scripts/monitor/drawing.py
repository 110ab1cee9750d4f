"""The only module that logs to rerun: takes the scene's arrays.

Few entities with many instances each, arrays instead of lists, style logged once: see what was measured in
docs/decisions/0008-the-live-view.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, MeshTile, TerrainMesh
from launch_scripts.monitor.movers.looks import HUES
from launch_scripts.monitor.serving.sinks import Streams
from launch_scripts.report.samples import Sample
from swarm.wire.messages.vehicles import VehicleState

_WINDOW_COLOUR = (255, 200, 60)


class Drawing:
    """Logs the scene to one recording stream."""

    def __init__(self, rec: rr.RecordingStream | Streams, mesh: TerrainMesh, target_ids: Sequence[str]) -> None:
        self._rec = rec
        self._mesh = mesh
        self._target_ids = list(target_ids)

    def set_time(self, frame: int, seconds: float) -> None:
        """Sets the time of all that follows. What is logged before the first call is on no timeline."""
        self._rec.set_time("tick", sequence=frame)
        self._rec.set_time("sim_time", duration=seconds)

    def begin(self) -> None:
        """Logs what never changes: the terrain's mesh and the styles."""
        rec, mesh = self._rec, self._mesh
        rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for tile in mesh.mesh_tiles():
            self._tile(tile)
        line = _screen_points(1.3)
        rec.log("world/windows", _style(rr.LineStrips3D, [_WINDOW_COLOUR], [line]), static=True)
        states = [state.name.lower() for state in VehicleState]
        self._series("states", states, HUES[: len(states)])
        self._series("captures_and_marks", ["captures", "marks / 100"], [(255, 210, 31), (170, 110, 240)])
        for chart in ("gap", "growth_ms"):
            self._series(chart, self._target_ids, self._colours())
        self._series("messages", ["all processes"], [(86, 180, 233)])

    def _colours(self) -> list[tuple[int, ...]]:
        return [HUES[n % len(HUES)] for n in range(len(self._target_ids))]

    def _tile(self, tile: MeshTile) -> None:
        self._rec.log(
            f"world/ground/{tile.index}",
            rr.Mesh3D.from_fields(
                vertex_positions=tile.vertices,
                triangle_indices=tile.triangles,
                vertex_texcoords=tile.texcoords,
            ),
            static=True,
        )

    def _series(self, chart: str, names: list[str], colours: Sequence[tuple[int, ...]]) -> None:
        self._rec.log(f"plots/{chart}", rr.SeriesLines(names=names, colors=colours, widths=1.5), static=True)

    def texture(self, tile: int, image: Bytes) -> None:
        """Logs the photo of a tile, with its marks. Not static: a viewer which joins late gets only recent data."""
        height, width, _ = image.shape
        self._rec.log(
            f"world/ground/{tile}",
            rr.Mesh3D.from_fields(
                albedo_texture_buffer=np.ascontiguousarray(image).tobytes(),
                albedo_texture_format=rr.components.ImageFormat(
                    width=width, height=height, color_model="RGB", channel_datatype="U8"
                ),
            ),
        )

    def windows(self, strips: Floats) -> None:
        self._rec.log("world/windows", rr.LineStrips3D.from_fields(strips=strips))

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
