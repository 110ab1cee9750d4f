"""Logs to rerun what lies still. Few entities, style logged once: see docs/decisions/0008-the-live-view.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from launch_scripts.monitor.ground.ground_colours import TREE, WINDOW
from launch_scripts.monitor.ground.legend import ZONE_COLOURS
from launch_scripts.monitor.ground.map_margin import map_margin
from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, MeshTile, TerrainMesh
from launch_scripts.monitor.ground.windows import SIDE_POINTS
from launch_scripts.monitor.ground.zones import Area, borders, title_places
from launch_scripts.monitor.serving.sinks import Streams
from launch_scripts.monitor.shown_text import shown

_MARGIN_COLOUR = (200, 206, 214)
_NAMES_SHOWN = 40
_LINE, _THIN = -1.3, -0.8
"""Radii in points of the viewer's window, the same at every zoom: rerun takes negative radii so."""
_NO_BALL = -0.1
_WHOLE_SIDE = 112
PHOTO = "world/ground"


class GroundDrawing:
    """Logs the ground, its layers, zones, windows, margin and legends to one recording stream."""

    def __init__(self, rec: rr.RecordingStream | Streams, mesh: TerrainMesh) -> None:
        self._rec, self._mesh = rec, mesh

    def begin(
        self, layers: Sequence[str], wholes: Sequence[str], legends: Mapping[str, bytes], zones: Sequence[Area]
    ) -> None:
        """Logs what never changes.

        layers  entities that have the terrain's tiles, coarser than the photo
        wholes  entities that have the terrain in one piece
        """
        self._rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for tile in self._mesh.mesh_tiles():
            self._tile(PHOTO, tile)
        if layers:
            for tile in self._mesh.mesh_tiles(coarser=2):
                for layer in layers:
                    self._tile(layer, tile)
        for layer in wholes:
            self._tile(layer, self._mesh.whole(_WHOLE_SIDE))
        for layer, picture in legends.items():
            self.legend(layer, picture)
        style = rr.LineStrips3D.from_fields(colors=[WINDOW], radii=[_LINE])
        self._rec.log("world/windows", style, static=True)
        margin = map_margin(self._mesh)
        lines = rr.LineStrips3D(margin.lines, colors=[_MARGIN_COLOUR], radii=[_LINE])
        self._rec.log("world/margin", lines, static=True)
        self._rec.log("world/margin/texts", _texts(margin.places, margin.texts, [_MARGIN_COLOUR]), static=True)
        self._zones("planned", zones, static=True)

    def ordered(self, zones: Sequence[Area]) -> None:
        """Logs the zones of operators. Not static, as they come and go."""
        self._zones("ordered", zones, static=False)

    def texture(self, layer: str, tile: int, image: Bytes) -> None:
        """Logs the pixels of a tile. Not static: a viewer which joins late gets only recent data."""
        height, width, _ = image.shape
        self._rec.log(
            f"{layer}/{tile}",
            rr.Mesh3D.from_fields(
                albedo_texture_buffer=np.ascontiguousarray(image).tobytes(),
                albedo_texture_format=rr.components.ImageFormat(
                    width=width, height=height, color_model="RGB", channel_datatype="U8"
                ),
            ),
        )

    def legend(self, layer: str, picture: bytes) -> None:
        image = rr.EncodedImage(contents=picture, media_type="image/png")
        self._rec.log(f"legend/{layer}", image, static=True)

    def tree(self, layer: str, lines: Floats, radii: Floats) -> None:
        """Logs lines as thick as what leads along them."""
        self._rec.log(f"{layer}/tree", rr.LineStrips3D(lines, colors=[TREE], radii=radii))

    def windows(self, outlines: Floats, names: Sequence[str | None]) -> None:
        """Logs outlines of windows, with their names in the south; None has no name."""
        self._rec.log("world/windows", rr.LineStrips3D.from_fields(strips=outlines))
        named = [n for n, name in enumerate(names) if name is not None][:_NAMES_SHOWN]
        places = outlines[named, 5 * SIDE_POINTS // 2] if named else np.empty((0, 3), np.float32)
        texts = [name for name in names if name is not None][:_NAMES_SHOWN]
        self._rec.log("world/windows/names", _texts(places, texts, [WINDOW]))

    def _zones(self, whose: str, zones: Sequence[Area], *, static: bool) -> None:
        parts = [borders(self._mesh, [area]) for area in zones]
        strips = np.concatenate([np.empty((0, 2, 3), np.float32), *parts])
        per_zone = np.array([ZONE_COLOURS[area.rule] for area in zones], np.uint8).reshape(-1, 3)
        colours = np.repeat(per_zone, [len(part) for part in parts], axis=0)
        path = f"world/zones/{whose}"
        self._rec.log(path, rr.LineStrips3D(strips, colors=colours, radii=[_LINE]), static=static)
        named = zones[:_NAMES_SHOWN]
        pale = (per_zone[:_NAMES_SHOWN].astype(np.uint16) + 2 * 255) // 3  # on their own hatches names would drown
        titles = [area.title for area in named]
        texts = _texts(title_places(self._mesh, named), titles, pale.astype(np.uint8))
        self._rec.log(f"{path}/names", texts, static=static)

    def _tile(self, layer: str, tile: MeshTile) -> None:
        mesh = rr.Mesh3D.from_fields(
            vertex_positions=tile.vertices, triangle_indices=tile.triangles, vertex_texcoords=tile.texcoords
        )
        self._rec.log(f"{layer}/{tile.index}", mesh, static=True)


def _texts(places: Floats, texts: list[str], colours: Sequence[tuple[int, ...]] | Bytes) -> rr.Points3D:
    return rr.Points3D(
        places, labels=[shown(text, 60) for text in texts], colors=colours, radii=[_NO_BALL], show_labels=True
    )
