"""What colours the terrain has in each layer of the view: arrays in, pixels out.

Colours are those of Okabe and Ito where they carry meaning; what is known beforehand is hatched, what was found is
filled, so that the two differ without colour, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.observe import palette
from launch_scripts.observe.palette import hillshade, rgb
from shared_map.arrays import Bools
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.pyramid import any_in_blocks
from shared_map.terrain.terrain import Terrain
from swarm.grid import Window

Colour = tuple[int, int, int]
LETHAL_MARK, SLOW_MARK, FAST_MARK = (98, 30, 165), (235, 150, 0), (90, 200, 250)
LETHAL_PRIOR, HATCH, NO_GO, ROAD = (12, 14, 20), (200, 200, 212), rgb(palette.RED), (232, 222, 196)
STILL_HIDDEN_LETHAL, STILL_HIDDEN_SLOW = rgb(palette.RED), rgb(palette.ORANGE)
FOUND, OVERRULED = rgb(palette.SKY), rgb(palette.PINK)
WINDOW, TREE = (255, 200, 60), (255, 255, 255)
UNREACHED = (70, 60, 66)
_HATCH_TEXELS = 7
_CIVIDIS = "#00224e #1a386f #434e6c #61656f #7d7c78 #9b9476 #bcae6c #dec958 #fee838"
COST_COLOURS = tuple(_CIVIDIS.split())
"""From dear to cheap."""
_VIRIDIS = "#fde725 #aadc32 #5cc863 #27ad81 #21908d #2c718e #3b518b #472c7a #440154"
COST_TO_GO_COLOURS = tuple(_VIRIDIS.split())
"""From the target outwards."""
LEARNED_COLOURS = (palette.BLUE, "#6f757b", palette.ORANGE)
"""From a quarter of the prior pace to four times it."""
_MOST_FACTOR = 4.0
_COST_STEPS = 256


class GroundColours:
    """The layers' pixels. What is known now is read from the shared map's ground, which changes in place.

    now      float32 (rows, cols)  the ground as the map knows it; inf is lethal
    truth    the ground as it is, where this process knows it
    unmarked float32 (rows, cols)  the ground without marks, with what is learned, which changes in place, too; the
             prior if not given
    slowest_s_per_m, quickest_s_per_m  ends of the scale of costs
    """

    def __init__(
        self, mesh: TerrainMesh, terrain: Terrain, now: Floats, truth: Floats | None, unmarked: Floats | None = None
    ) -> None:
        self._mesh, self._now, self._truth, self._known_before = mesh, now, truth, terrain.ground_s_per_m
        self._prior = self._known_before if unmarked is None else unmarked
        seen = mesh.seen
        shade = 0.42 + 0.78 * hillshade(seen.elevation_m, seen.grid.resolution_m)[..., None]
        self._shade = np.asarray(shade, np.float32)
        colours = seen.photo.astype(np.float32)
        grey = colours.mean(axis=2, keepdims=True)  # on full colours green vehicles would drown
        self.photo: Bytes = np.clip((0.42 * colours + 0.53 * grey) * self._shade, 0, 255).astype(np.uint8)
        road = seen.classes == TerrainClass.ROAD
        self.photo[road] = _mixed(self.photo[road], ROAD, 0.4)
        self._closed: Bools = seen.lethal_share >= 0.5
        self._no_go: Bools = np.zeros(self._closed.shape, np.bool_)
        drivable = seen.pace_s_per_m[np.isfinite(seen.pace_s_per_m)]
        ends = np.percentile(drivable, (1, 99)) if len(drivable) else (0.1, 1.0)
        self.quickest_s_per_m = float(ends[0])
        self.slowest_s_per_m = max(float(ends[1]), 1.25 * self.quickest_s_per_m)
        self._cost_colours = between(COST_COLOURS, _COST_STEPS)
        self._learned_colours = between(LEARNED_COLOURS, _COST_STEPS)

    def close(self, cells: NDArray[np.int64]) -> None:
        """Says which cells zones close."""
        side, cols = self._mesh.texel, self._mesh.grid.cols
        self._no_go[:] = False
        self._no_go[cells // cols // side, cells % cols // side] = True

    def photo_of(self, window: Window) -> Bytes:
        """Photo of a window with closed ground and marks drawn in: where the ground differs from the prior."""
        texels = self._texels(window)
        photo: Bytes = self.photo[texels].copy()
        self._hatch(photo, window)
        now, before = self._now[_cells(window)], self._prior[_cells(window)]
        drivable = np.isfinite(now)
        self._mark(photo, drivable & (now < before), FAST_MARK, 0.75)
        self._mark(photo, drivable & (now > before), SLOW_MARK, 0.75)
        self._mark(photo, ~drivable & np.isfinite(before), LETHAL_MARK, 0.85, ~self._no_go[texels])
        return photo

    def cost_of(self, window: Window) -> Bytes:
        """What a metre costs, dark where it is dear, and hatched where nothing drives."""
        side, now = self._mesh.texel, self._now[_cells(window)]
        low, high = np.log(self.quickest_s_per_m), np.log(self.slowest_s_per_m)
        with np.errstate(divide="ignore"):
            level = (high - np.log(now[::side, ::side])) / (high - low)
        image = self._scaled(self._cost_colours, level, window)
        image[any_in_blocks(np.isinf(now), side)] = LETHAL_PRIOR
        self._hatch(image, window)
        return image

    def known_of(self, window: Window) -> Bytes:
        """What the map knows against what is true, on grey relief."""
        assert self._truth is not None
        now, before, true = (each[_cells(window)] for each in (self._now, self._prior, self._truth))
        texels = self._texels(window)
        image: Bytes = np.clip(105 * self._shade[texels], 0, 255).repeat(3, axis=2).astype(np.uint8)
        image[self._closed[texels]] //= 2
        hidden = now != true
        self._mark(image, ~hidden & (true != before), FOUND)
        self._mark(image, hidden & (now != before), OVERRULED)
        self._mark(image, hidden & (now == before) & np.isfinite(true), STILL_HIDDEN_SLOW)
        self._mark(image, hidden & (now == before) & np.isinf(true), STILL_HIDDEN_LETHAL)
        return image

    def learned_of(self, window: Window) -> Bytes:
        """By what the prior pace is multiplied, by what vehicles have measured of each kind of ground: on grey
        relief, orange where it is slower and blue where it is quicker."""
        part, side = _cells(window), self._mesh.texel
        before, prior = (np.asarray(each[part])[::side, ::side] for each in (self._known_before, self._prior))
        with np.errstate(invalid="ignore"):
            off = np.where(np.isinf(before), 0.0, np.log(prior / before)) / np.log(_MOST_FACTOR)
        image = self._scaled(self._learned_colours, (off + 1) / 2, window)
        self._hatch(image, window)
        return image

    def _mark(
        self, image: Bytes, cells: Bools, colour: Colour, share: float = 0.85, but: Bools | None = None
    ) -> None:
        """Mixes a colour into the texels with any of these cells: however many a texel shows, one of them is seen.

        but  bool, by texel: where the colour goes; None: everywhere
        """
        where = any_in_blocks(cells, self._mesh.texel)
        where = where if but is None else where & but
        image[where] = _mixed(image[where], colour, share)

    def _scaled(self, colours: Floats, level: Floats, window: Window) -> Bytes:
        """Colours of a scale, 0 to 1, on the relief."""
        index = np.rint(np.clip(level, 0, 1) * (_COST_STEPS - 1)).astype(np.intp)
        shade = 0.45 + 0.55 * self._shade[self._texels(window)]
        image: Bytes = np.clip(colours[index] * shade, 0, 255).astype(np.uint8)
        return image

    def lethal_at(self, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> Bools:
        """Whether the map says that these rows and columns of cells are lethal: bool (rows, cols)."""
        lethal: Bools = np.isinf(self._now[rows[:, None], cols])
        return lethal

    def on_relief(self, colours: Floats, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> Bytes:
        """Colours of these rows and columns of cells, float32 (rows, cols, 3), lit; lethal ground is dark."""
        side = self._mesh.texel
        shade = 0.5 + 0.5 * self._shade[rows[:, None] // side, cols // side]
        lit: Bytes = np.clip(colours * shade, 0, 255).astype(np.uint8)
        lit[self.lethal_at(rows, cols)] = LETHAL_PRIOR
        return lit

    def _hatch(self, image: Bytes, window: Window) -> None:
        """Darkens ground that was known to be lethal, and hatches it; red where a zone closes it."""
        texels = self._texels(window)
        closed, no_go = self._closed[texels], self._no_go[texels]
        if not (closed.any() or no_go.any()):
            return
        row, col = texels[0].start, texels[1].start
        rows, cols = np.ogrid[row : row + image.shape[0], col : col + image.shape[1]]
        stripe = (rows + cols) % _HATCH_TEXELS < 2
        closed = closed & ~no_go
        image[closed] = _mixed(image[closed], LETHAL_PRIOR, 0.45)
        image[closed & stripe] = _mixed(image[closed & stripe], HATCH, 0.45)
        stripe = (rows - cols) % _HATCH_TEXELS < 3
        image[no_go] = _mixed(image[no_go], NO_GO, 0.25)
        image[no_go & stripe] = _mixed(image[no_go & stripe], NO_GO, 0.75)

    def _texels(self, window: Window) -> tuple[slice, slice]:
        side = self._mesh.texel
        return (
            slice(window.row0 // side, -(-window.row1 // side)),
            slice(window.col0 // side, -(-window.col1 // side)),
        )


def between(colours: Sequence[str], steps: int) -> Floats:
    """So many colours evenly between those named, float32 (steps, 3), 0 to 255."""
    named = np.array([rgb(colour) for colour in colours], np.float32)
    at = np.linspace(0, len(named) - 1, steps)
    channels = [np.interp(at, np.arange(len(named)), named[:, n]) for n in range(3)]
    return np.stack(channels, axis=1).astype(np.float32)


def _cells(window: Window) -> tuple[slice, slice]:
    return slice(window.row0, window.row1), slice(window.col0, window.col1)


def _mixed(pixels: Bytes, colour: Colour, share: float) -> Bytes:
    mixed: Bytes = ((1 - share) * pixels + share * np.array(colour)).astype(np.uint8)
    return mixed
