"""Draws what lies still: decides which tiles and zones are drawn again, and when.

Zones are those of the scenario, those that its files draw, and those that operators ordered. Few entities, style
logged once: see docs/design/live-view.md.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from launch_scripts.monitor import ground_colours, live_layout
from launch_scripts.monitor.rerun_outputs import Pen, RateLimit, even, inline, ragged
from launch_scripts.monitor.styles import Entry
from launch_scripts.monitor.terrain_mesh import Bytes, Floats, MeshTile, TerrainMesh
from launch_scripts.observe.palette import format_length, round_length
from shared_map.cost_map import CostMap
from shared_map.keeper.zone_orders import cells_of_zones
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import Terrain
from shared_map.terrain.zones import covered_cells
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import class_numbers
from swarm.errors import SwarmError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.planning import CostReply, PlannerStatus

log = logging.getLogger(__name__)

Rule = Literal["no-go", "slow", "quick", "pace"]
_RULES: dict[str, Rule] = {
    "forbidden": "no-go", "keep_in": "no-go", "water": "no-go", "rough": "slow", "preferred": "quick",
    "road": "quick", "pace": "pace",
}  # fmt: skip
_MOST_EDGES = 20_000
"""Sides of texels along a border that is drawn. A zone with more is named, and hatched if closed."""
_LARGEST_FILE = 1 << 25
_EVERY_S = {"photo": 1.0, "cost": 5.0, "known": 5.0, "learned": 5.0, "nearest": 8.0, "question": 2.0}
"""Interval at which outdated tiles of a layer are drawn, and a planner is asked for costs."""
_UNSEEN = 4
"""Factor by which the ground is drawn less often without viewers, for the recording."""
_TILES_AT_ONCE = 80
"""Tiles of a layer that are drawn in one turn: bounds its time. Chosen, not measured."""
_NAMES_SHOWN = 40
_MOST_TARGETS = 256
"""Targets beside the scenario's of which planners may tell: nothing grows with the names that anybody makes up."""
_MARGIN_COLOUR = (200, 206, 214)
_LINE_PX = 1.3
_AS_PAINTED = (255, 255, 255)
_WHOLE_SIDE = 112
_BAR_SHARE = 0.25
"""Largest share of the terrain's width."""


@dataclass(frozen=True, slots=True, eq=False)
class Area:
    """A zone: its cells, int64 (n,), and what it does to them.

    vehicle_class  for whom; None: for all
    """

    name: str
    rule: Rule
    cells: NDArray[np.int64]
    vehicle_class: str | None = None

    @property
    def title(self) -> str:
        whom = "" if self.vehicle_class is None else f" for {self.vehicle_class}"
        return self.name if self.name == self.rule else f"{self.name}: {self.rule}{whom}"


@dataclass(frozen=True, eq=False)
class Scene:
    """Inputs of drawing a run that are known beforehand.

    pen     draws on the recording stream, on the mesh of the terrain
    layers  tabs of the view
    truth   the true ground, where this process knows it
    zones   those of the scenario
    """

    pen: Pen
    layers: Sequence[live_layout.Layer] = (live_layout.PHOTO,)
    truth: Floats | None = None
    zones: Sequence[Area] = ()


class GroundView:
    """Draws terrain, layers and zones on a recording stream.

    movers  what the legends say of all that moves
    """

    def __init__(
        self,
        scene: Scene,
        terrain: Terrain,
        cost_map: CostMap,
        replica: MapReplica,
        scenario: Scenario,
        movers: Sequence[Entry] = (),
    ) -> None:
        self._pen, self._mesh, self._cost_map, self._replica = scene.pen, scene.pen.mesh, cost_map, replica
        self._layers, self._movers = scene.layers, movers
        self._planned, self._zones = scene.zones, scene.zones
        """Zones of the scenario, and all that stand."""
        self._target_ids, self._classes = scenario.target_ids, list(class_numbers(scenario))
        now, prior = cost_map.ground_s_per_m, cost_map.prior_s_per_m
        self._colours = colours = ground_colours.GroundColours(self._mesh, terrain, now, scene.truth, prior)
        self._colours.close(closed_cells(self._zones))
        drawn_by = {
            live_layout.PHOTO: colours.photo_of,
            live_layout.COST: colours.cost_of,
            live_layout.KNOWN: colours.known_of,
            live_layout.LEARNED: colours.learned_of,
        }
        self._tiled = {layer: picture for layer, picture in drawn_by.items() if layer in scene.layers}
        """Function that draws a tile of each layer of tiles."""
        self._stale: dict[str, dict[int, None]] = {layer.name: {} for layer in self._tiled}
        """Name of a layer -> its tiles that are out of date. Marks come many times a second to the same tiles, and
        each of their pictures is drawn once for all; one that looks as before is not logged again."""
        self._nearest = any(layer.name == live_layout.NEAREST.name for layer in scene.layers)
        self._to_target = next((layer for layer in scene.layers if layer.target is not None), None)
        self.samples = ground_colours.CostSamples(terrain.grid, self._to_target and self._to_target.target)
        self._pictures = ground_colours.TargetPictures(self._mesh, colours, self.samples)
        self._limit = RateLimit(_EVERY_S)
        self._zones_version = 0

    def begin(self) -> None:
        """Draws all of it. Constant data is static: the shape of the ground, legends, styles."""
        self._pen.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        fine, coarse = self._mesh.mesh_tiles(), self._mesh.mesh_tiles(coarser=2)
        whole = [self._mesh.whole(_WHOLE_SIDE)]
        for layer in self._layers:
            for n, tile in enumerate(
                fine if layer == live_layout.PHOTO else coarse if layer in self._tiled else whole
            ):
                self._pen.log(f"{layer.entity}/{n}", _mesh(tile), static=True)
            self._legend(layer)
        self._pen.style("world/zones", _LINE_PX)
        self._pen.style("world/margin", _LINE_PX, _MARGIN_COLOUR)
        self._pen.label_style("world/zones/names")
        self._pen.label_style("world/margin/texts", _MARGIN_COLOUR)
        self.draw_anew()
        self.finish()

    def draw_anew(self) -> None:
        """All is drawn once more when it is due, as the pen has forgotten it."""
        self._draw_margin()
        self._draw_zones()
        self._stale = {layer.name: dict.fromkeys(range(self._mesh.tiles)) for layer in self._tiled}
        self._limit.all_due()

    def finish(self) -> None:
        """Draws all tiles that are out of date."""
        self._take_changes()
        for layer in self._tiled:
            self._draw_tiles(layer, self._mesh.tiles)

    def hear_status(self, status: PlannerStatus) -> None:
        """Takes in that a target has a planner, which can be asked for costs."""
        targets = self.samples.targets
        if status.target not in targets and len(targets) < _MOST_TARGETS + len(self._target_ids):
            targets.append(status.target)

    def hear_costs(self, reply: CostReply, now_ns: int) -> None:
        """Draws what a planner answered."""
        if not self.samples.on_costs(reply):
            return
        layer = self._to_target
        if layer is not None and layer.target == reply.target and reply.target in self.samples.costs_s:
            self._draw_to_target(layer, reply.target)
        if self._nearest and self.samples.costs_s and self._limit.due("nearest", now_ns):
            self._texture(live_layout.NEAREST.entity, 0, self._pictures.territories(self._target_ids))

    def tick(self, now_ns: int, watched: bool) -> str | None:
        """Draws changes, at intervals. Returns the target whose planner is to be asked for costs now."""
        slower = 1 if watched else _UNSEEN
        self._take_changes()
        if self._zones_version != self._replica.zones_version:
            self._zones_version = self._replica.zones_version
            self._zones = [*self._planned, *ordered_areas(self._replica, now_ns, self._classes)]
            self._colours.close(closed_cells(self._zones))
            self._draw_zones()
        for layer in self._tiled:
            if self._limit.due(layer.name, now_ns, slower):
                self._draw_tiles(layer, _TILES_AT_ONCE)
        return self.samples.next_target() if self._limit.due("question", now_ns, slower) else None

    def _take_changes(self) -> None:
        for window in self._cost_map.take_dirty():
            changed = dict.fromkeys(self._mesh.tiles_touching(window))
            for stale in self._stale.values():
                stale.update(changed)

    def _draw_tiles(self, layer: live_layout.Layer, most: int) -> None:
        stale = self._stale[layer.name]
        for tile in list(stale)[:most]:
            del stale[tile]
            image = self._tiled[layer](self._mesh.tile_window(tile))
            if self._pen.news(f"{layer.entity}/{tile}", pixels=hash(image.tobytes())):
                self._texture(layer.entity, tile, image)

    def _texture(self, entity: str, tile: int, image: Bytes) -> None:
        """Logs the pixels of a tile. Not static: a viewer which joins late gets only recent data."""
        height, width, _ = image.shape
        form = rr.components.ImageFormat(width=width, height=height, color_model="RGB", channel_datatype="U8")
        pixels = np.ascontiguousarray(image).tobytes()
        texture = rr.Mesh3D.from_fields(
            albedo_texture_buffer=pixels, albedo_texture_format=form, albedo_factor=_AS_PAINTED
        )
        self._pen.log(f"{entity}/{tile}", texture)

    def _legend(self, layer: live_layout.Layer) -> None:
        """Draws the legend below a layer: once, but for a cost-to-go whenever its scale changes."""
        scale, pictures = None, self._pictures
        if layer == live_layout.COST:  # from high to low, evenly in the logarithm of the pace
            paces = np.geomspace(self._colours.slowest_s_per_m, self._colours.quickest_s_per_m, 5)
            scale = live_layout.Scale(
                ground_colours.COST_COLOURS, "seconds a kilometre", [f"{pace * 1000:.3g}" for pace in paces]
            )
        elif layer == live_layout.LEARNED:
            scale = live_layout.Scale(
                ground_colours.LEARNED_COLOURS, "times the prior pace", ["1/4", "1/2", "1", "2", "4"]
            )
        elif layer.target is not None and pictures.full_s:
            seconds = [float(f"{each:.3g}") for each in np.linspace(0, pictures.full_s, 6)]
            scale = live_layout.Scale(
                ground_colours.COST_TO_GO_COLOURS, f"seconds to {layer.target}", [f"{each:g}" for each in seconds]
            )
        picture = live_layout.legend_picture((*layer.entries, *self._movers), scale)
        image = rr.EncodedImage(contents=picture, media_type="image/png")
        self._pen.log(f"legend/{layer.name}", image, static=True)

    def _draw_to_target(self, layer: live_layout.Layer, target: str) -> None:
        before_s = self._pictures.full_s
        self._texture(layer.entity, 0, self._pictures.to_target(target))
        lines, radii = self._pictures.tree(target)
        self._pen.log(f"{layer.entity}/tree", rr.LineStrips3D(lines, colors=[ground_colours.TREE], radii=radii))
        if self._pictures.full_s != before_s:
            self._legend(layer)

    def _draw_zones(self) -> None:
        parts = [borders(self._mesh, area) for area in self._zones]
        per_zone = np.array([live_layout.ZONE_COLOURS[area.rule] for area in self._zones], np.uint8).reshape(-1, 3)
        colours = np.repeat(per_zone, [len(part) for part in parts], axis=0)
        self._pen.lines("world/zones", even(np.concatenate([np.empty((0, 2, 3), np.float32), *parts])), colours)
        named = self._zones[:_NAMES_SHOWN]
        places, titles = title_places(self._mesh, named), [inline(area.title, 60) for area in named]
        pale = (per_zone[:_NAMES_SHOWN].astype(np.uint16) + 2 * 255) // 3  # on their own hatches names would drown
        self._pen.points("world/zones/names", positions=places, labels=titles, colors=pale.astype(np.uint8))

    def _draw_margin(self) -> None:
        """Draws what a map has south of it, level with its lowest ground: a bar of known length in the west, an
        arrow to the north in the east, and how much heights are stretched."""
        mesh, unit = self._mesh, self._mesh.scale_m
        length_m, east = round_length(_BAR_SHARE * mesh.width_m), mesh.width_m - unit
        south, north = -mesh.depth_m - 4 * unit, -mesh.depth_m - 1.5 * unit
        shapes = [
            [(0, north, 0), (0, south, 0), (length_m, south, 0), (length_m, north, 0)],
            [(east, south, 0), (east, north, 0)],
            [(east - unit, north - unit, 0), (east, north, 0), (east + unit, north - unit, 0)],
        ]
        corners = np.array([corner for shape in shapes for corner in shape], np.float32)
        self._pen.lines("world/margin", ragged(corners, [len(shape) for shape in shapes]))
        texts = {
            format_length(length_m): (length_m / 2, south, 0),
            mesh.heights_text: (mesh.width_m / 2, south, 0),
            "N": (east - 2.2 * unit, north, 0),
        }
        places = np.array(list(texts.values()), np.float32)
        self._pen.points("world/margin/texts", positions=places, labels=list(texts))


def _mesh(tile: MeshTile) -> rr.Mesh3D:
    return rr.Mesh3D.from_fields(
        vertex_positions=tile.vertices, triangle_indices=tile.triangles, vertex_texcoords=tile.texcoords
    )


def scenario_areas(scenario: Scenario, grid: GridSpec) -> list[Area]:
    """The zones of a scenario. Roads from files are left out, as the terrain's classes show them; so are large
    files, and those that are not on this machine."""
    areas = []
    for zone in scenario.cost.zones:
        path = Path(zone.file or ".")
        if zone.file and (zone.kind == "road" or not path.exists() or path.stat().st_size > _LARGEST_FILE):
            continue
        try:
            cells = np.flatnonzero(covered_cells(zone, grid))
        except SwarmError as error:
            log.warning("a zone is not drawn: %s", error)
            continue
        if len(cells):
            factor = zone.factor or 1.0
            rule = _RULES.get(zone.kind) or ("slow" if factor > 1 else "quick")
            areas.append(Area(zone.called, rule, cells))
    return areas


def ordered_areas(replica: MapReplica, now_ns: int, classes: Sequence[str]) -> list[Area]:
    """The zones of operators that stand.

    classes  of vehicles beside "ground", in the order of their numbers
    """
    return [
        Area(
            name,
            "no-go" if each.kind == MarkKind.LETHAL else "pace",
            each.cells,
            classes[each.class_number - 1] if each.class_number else None,
        )
        for name, each in cells_of_zones(replica, now_ns).items()
        if each.class_number <= len(classes)
    ]


def closed_cells(areas: Iterable[Area]) -> NDArray[np.int64]:
    """Cells that any of these closes for all vehicles."""
    closed = (area.cells for area in areas if area.rule == "no-go" and area.vehicle_class is None)
    return np.concatenate([np.empty(0, np.int64), *closed])


def title_places(mesh: TerrainMesh, areas: Sequence[Area]) -> Floats:
    """Returns the positions of the zones' names: over the cell of each that is next to its middle."""
    places = []
    for area in areas:
        rows, cols = np.divmod(area.cells, mesh.grid.cols)
        apart = (rows - rows.mean()) ** 2 + (cols - cols.mean()) ** 2
        places.append(int(area.cells[int(apart.argmin())]))
    return mesh.place_cells(np.array(places, np.int64), 0.5 * mesh.scale_m)


def borders(mesh: TerrainMesh, area: Area) -> Floats:
    """The border of a zone, laid over the terrain: float32 (n, 2, 3), one line for each side of a texel."""
    rows, cols = np.divmod(area.cells, mesh.grid.cols)
    side = mesh.texel
    row0, col0 = int(rows.min()) // side, int(cols.min()) // side
    inside = np.zeros((int(rows.max()) // side - row0 + 3, int(cols.max()) // side - col0 + 3), np.bool_)
    inside[rows // side - row0 + 1, cols // side - col0 + 1] = True
    # Between texel n and n + 1 of the padded part lies the line n of the part, counted from its north or west.
    south_row, south_col = np.nonzero(inside[:-1] != inside[1:])
    east_row, east_col = np.nonzero(inside[:, :-1] != inside[:, 1:])
    ends = np.concatenate(
        [
            np.stack([south_row, south_col - 1, south_row, south_col], axis=1),
            np.stack([east_row - 1, east_col, east_row, east_col], axis=1),
        ]
    )
    if len(ends) > _MOST_EDGES:
        return np.empty((0, 2, 3), np.float32)
    corners = (ends.reshape(-1, 2, 2) + np.array((row0, col0))) * (side * mesh.grid.resolution_m)
    south_m, east_m = (corners[..., n].astype(np.float32) for n in (0, 1))
    return mesh.place(east_m, south_m, 0.12 * mesh.scale_m)
