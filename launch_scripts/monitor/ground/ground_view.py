"""What lies still in the view: decides which tiles, zones and windows are drawn again, and when."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import rerun as rr

from launch_scripts.monitor.ground.cost_to_go import CostSamples
from launch_scripts.monitor.ground.ground_colours import GroundColours
from launch_scripts.monitor.ground.ground_drawing import GroundDrawing
from launch_scripts.monitor.ground.layers import (
    COST,
    KNOWN,
    LEARNED,
    NEAREST,
    PHOTO,
    Layer,
    legends,
    nearest_legend,
    to_target_legend,
)
from launch_scripts.monitor.ground.target_layers import TargetPictures
from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.ground.windows import window_outlines
from launch_scripts.monitor.ground.zones import Area, closed_cells, ordered_areas
from launch_scripts.monitor.movers.looks import Look
from launch_scripts.monitor.serving.sinks import Streams
from shared_map.cost_map import CostMap
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import Terrain
from swarm.clock import NS_PER_S
from swarm.grid import Window
from swarm.wire.messages.planning import CostReply, PlannerStatus

_WINDOWS_NS = NS_PER_S
_LAYER_NS = 5 * NS_PER_S
_UNSEEN = 4
"""While nobody looks the ground is drawn so many times as seldom, for the recording."""
_ALL_NAMED, _NAMED_SHARE = 4, 0.12
"""So many windows all have names. Of more, those of a share of the terrain's width: in a small one stands its
target, which has a name."""
_MOST_TARGETS = 256
"""Targets beside the scenario's of which planners may tell: nothing grows with the names that anybody makes up."""
_NEAREST_NS = 8 * NS_PER_S


@dataclass(eq=False)
class _Tiles:
    """A layer of tiles: which are out of date. Marks come many times a second to the same tiles, and each of their
    pictures is drawn once for all; one that looks as before is not logged again.

    layer      whose tiles these are
    every_ns   how often tiles that are out of date are drawn
    at_once    how many at most
    """

    layer: Layer
    picture: Callable[[Window], Bytes]
    every_ns: int
    at_once: int
    due_ns: int = 0

    def __post_init__(self) -> None:
        self.stale: dict[int, None] = {}
        self._shown: dict[int, int] = {}
        """Tile -> hash of its pixels as they were logged last."""

    def draw_anew(self, tiles: int) -> None:
        """All of so many tiles are to be logged, whatever they look like, and soon."""
        self.stale = dict.fromkeys(range(tiles))
        self._shown.clear()
        self.due_ns = 0

    def looks_new(self, tile: int, image: Bytes) -> bool:
        """Whether a tile has other pixels than when this was asked last."""
        pixels = hash(image.tobytes())
        if self._shown.get(tile) == pixels:
            return False
        self._shown[tile] = pixels
        return True


class GroundView:
    """Draws terrain, layers, zones and windows on a recording stream.

    truth    the true ground, where this process knows it
    zones    those of the scenario
    layers   tabs of the view
    targets  in order of their colours
    movers   what the legends say of all that moves
    classes  of vehicles beside "ground", in the order of their numbers
    """

    def __init__(
        self,
        rec: rr.RecordingStream | Streams,
        mesh: TerrainMesh,
        terrain: Terrain,
        cost_map: CostMap,
        replica: MapReplica,
        layers: Sequence[Layer],
        targets: Sequence[str],
        truth: Floats | None = None,
        zones: Sequence[Area] = (),
        movers: Sequence[Look] = (),
        classes: Sequence[str] = (),
    ) -> None:
        self._classes = classes
        self._mesh, self._cost_map, self._replica, self._zones = mesh, cost_map, replica, list(zones)
        self._movers = movers
        self._cells = terrain.grid.cells
        self._drawing = GroundDrawing(rec, mesh)
        self._colours = colours = GroundColours(
            mesh, terrain, cost_map.ground_s_per_m, truth, cost_map.prior_s_per_m
        )
        self._colours.close(closed_cells(self._zones))
        self._shown, self._target_ids = list(layers), list(targets)
        tiled = (
            _Tiles(PHOTO, colours.photo_of, NS_PER_S, 80),
            _Tiles(COST, colours.cost_of, _LAYER_NS, 80),
            _Tiles(KNOWN, colours.known_of, _LAYER_NS, 80),
            _Tiles(LEARNED, colours.learned_of, _LAYER_NS, 80),
        )
        self._layers = [each for each in tiled if each.layer in layers]
        self._targets = [layer for layer in layers if layer.target is not None]
        self.samples = CostSamples(terrain.grid, next((layer.target for layer in self._targets), None))
        self._pictures = TargetPictures(mesh, colours, self.samples)
        self._nearest_due_ns = 0
        self._ordered: list[Area] = []
        self._zones_version = 0
        self._windows: dict[str, tuple[int, ...]] = {}
        """Target -> the window that its planner grew last."""
        self._windows_new, self._windows_due_ns = False, 0

    def begin(self) -> None:
        """Draws all of it."""
        tiled = [each.layer.entity for each in self._layers if each.layer is not PHOTO]
        wholes = [layer.entity for layer in self._shown if layer not in (each.layer for each in self._layers)]
        self._drawing.begin(tiled, wholes, legends(self._colours, self._shown, self._movers), self._zones)
        if NEAREST in self._shown:
            self._drawing.legend(NEAREST.name, nearest_legend(self._target_ids, self._movers))
        self._pictures.full_s = 0.0  # so that the next answer draws a legend
        self.draw_anew()
        self.finish()

    def draw_anew(self) -> None:
        """What is drawn on change only is drawn once more, when it is due."""
        self._drawing.ordered(self._ordered)
        self._windows_new = bool(self._windows)
        for layer in self._layers:
            layer.draw_anew(self._mesh.tiles)

    def finish(self) -> None:
        """Draws all tiles that are out of date."""
        self._look_for_changes()
        for layer in self._layers:
            self._draw_tiles(layer, self._mesh.tiles)

    def hear_status(self, status: PlannerStatus) -> None:
        if status.target not in self._windows and len(self._windows) >= _MOST_TARGETS + len(self._target_ids):
            return
        self.samples.hear_target(status.target)
        window = tuple(status.window)
        if self._windows.get(status.target) != window:
            self._windows[status.target] = window
            self._windows_new = True

    def hear_costs(self, reply: CostReply, now_ns: int) -> None:
        """Draws what a planner answered."""
        if not self.samples.hear(reply):
            return
        for layer in self._targets:
            if layer.target == reply.target and reply.target in self.samples.costs_s:
                self._draw_to_target(layer, reply.target)
        if NEAREST in self._shown and now_ns >= self._nearest_due_ns and self.samples.costs_s:
            self._nearest_due_ns = now_ns + _NEAREST_NS
            self._drawing.texture(NEAREST.entity, 0, self._pictures.territories(self._target_ids))

    def tick(self, now_ns: int, watched: bool) -> None:
        """Draws what has changed, now and then."""
        slower = 1 if watched else _UNSEEN
        self._look_for_changes()
        self._draw_ordered(now_ns)
        for layer in self._layers:
            if now_ns >= layer.due_ns:
                layer.due_ns = now_ns + slower * layer.every_ns
                self._draw_tiles(layer, layer.at_once)
        if self._windows_new and now_ns >= self._windows_due_ns:
            self._windows_new, self._windows_due_ns = False, now_ns + _WINDOWS_NS
            self._draw_windows()

    def next_target(self, now_ns: int, watched: bool) -> str | None:
        """The target whose planner is to be asked for costs now, if it is time."""
        return self.samples.next_target(now_ns, 1 if watched else _UNSEEN)

    def _look_for_changes(self) -> None:
        for window in self._cost_map.take_dirty():
            changed = dict.fromkeys(self._mesh.tiles_touching(window))
            for layer in self._layers:
                layer.stale.update(changed)

    def _draw_tiles(self, layer: _Tiles, most: int) -> None:
        for tile in list(layer.stale)[:most]:
            del layer.stale[tile]
            image = layer.picture(self._mesh.tile_window(tile))
            if layer.looks_new(tile, image):
                self._drawing.texture(layer.layer.entity, tile, image)

    def _draw_to_target(self, layer: Layer, target: str) -> None:
        before_s = self._pictures.full_s
        self._drawing.texture(layer.entity, 0, self._pictures.to_target(target))
        tree = self._pictures.tree(target)
        self._drawing.tree(layer.entity, tree.lines, tree.radii)
        if self._pictures.full_s != before_s:
            self._drawing.legend(layer.name, to_target_legend(target, self._pictures.full_s, self._movers))

    def _draw_ordered(self, now_ns: int) -> None:
        """Draws operators' zones when they change."""
        version = self._replica.zones_version
        if version == self._zones_version:
            return
        self._zones_version = version
        self._ordered = ordered_areas(self._replica, now_ns, self._classes)
        self._colours.close(closed_cells([*self._zones, *self._ordered]))
        self._drawing.ordered(self._ordered)

    def _draw_windows(self) -> None:
        """Draws the window that each planner grew last, unless it is the whole terrain."""
        told = (
            (target, Window(*self._windows[target])) for target in sorted(self._windows) if self._windows[target]
        )
        parts = {target: w for target, w in told if not w.empty and w.cells < self._cells}
        grid = self._mesh.grid
        least = _NAMED_SHARE * max(grid.rows, grid.cols)
        few = len(parts) <= _ALL_NAMED
        names = [
            f"window of {target}" if few or max(w.row1 - w.row0, w.col1 - w.col0) >= least else None
            for target, w in parts.items()
        ]
        self._drawing.windows(window_outlines(self._mesh, list(parts.values())), names)
