"""Colours of the terrain in each layer of the view: arrays in, pixels out.

Colours with a meaning are those of Okabe and Ito; known hazards are hatched, found ones filled, so that the two
differ without colour, too.

Cost-to-go of targets is that of a coarse grid, as their planners answer it: the monitor grows no tree. It asks for
the costs of at most `_MOST_SAMPLES` cells, of one target at a time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from launch_scripts.monitor.styles import HUES
from launch_scripts.monitor.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.observe import palette
from launch_scripts.observe.palette import hillshade, rgb
from shared_map.array_files import Bools
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.terrain import Terrain, any_in_blocks
from swarm.grid import GridSpec, Window
from swarm.wire.fields import column
from swarm.wire.messages.planning import CostReply, CostRequest

Colour = tuple[int, int, int]
LETHAL_MARK, SLOW_MARK, FAST_MARK = (98, 30, 165), (235, 150, 0), (90, 200, 250)
LETHAL_PRIOR, HATCH, NO_GO, ROAD = (12, 14, 20), (200, 200, 212), rgb(palette.RED), (232, 222, 196)
STILL_HIDDEN_LETHAL, STILL_HIDDEN_SLOW = rgb(palette.RED), rgb(palette.ORANGE)
FOUND, OVERRULED = rgb(palette.SKY), rgb(palette.PINK)
TREE = (255, 255, 255)
UNREACHED = (70, 60, 66)
_HATCH_TEXELS = 7
_CIVIDIS = "#00224e #1a386f #434e6c #61656f #7d7c78 #9b9476 #bcae6c #dec958 #fee838"
COST_COLOURS = tuple(_CIVIDIS.split())
"""From high to low cost."""
_VIRIDIS = "#fde725 #aadc32 #5cc863 #27ad81 #21908d #2c718e #3b518b #472c7a #440154"
COST_TO_GO_COLOURS = tuple(_VIRIDIS.split())
"""From the target outwards."""
LEARNED_COLOURS = (palette.BLUE, "#6f757b", palette.ORANGE)
"""From a quarter of the prior pace to four times it."""
_MOST_FACTOR = 4.0
_COST_STEPS = 256
Ints = NDArray[np.int64]
_MOST_SAMPLES = 64 * 64
_BESIDE = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
_ON_THE_WAY = np.linspace(0, 1, 9)[1:-1]
"""Positions between two samples at which lethal cells are looked for."""
_LEAST_BRANCH = 3
"""Samples whose way leads through one from which a line is drawn."""
_PIXELS = 160
"""Longer side of a picture, in pixels: some for each sample, so that slopes are smooth."""
_BANDS = 10
_SHOWN_PERCENT = 97
"""Percentage of the values within the scale: a few outliers must not take half of it."""


class GroundColours:
    """The layers' pixels. Current knowledge is read from the shared map's bare cost, which changes in place.

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
        """Returns pixels of the pace, dark where it is high, and hatched where it is lethal."""
        side, now = self._mesh.texel, self._now[_cells(window)]
        low, high = np.log(self.quickest_s_per_m), np.log(self.slowest_s_per_m)
        with np.errstate(divide="ignore"):
            level = (high - np.log(now[::side, ::side])) / (high - low)
        image = self._scaled(self._cost_colours, level, window)
        image[any_in_blocks(np.isinf(now), side)] = LETHAL_PRIOR
        self._hatch(image, window)
        return image

    def known_of(self, window: Window) -> Bytes:
        """Returns pixels of the map's knowledge against ground truth, on grey relief."""
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
        """Returns pixels of learned factors on the prior pace: on grey relief, orange for slower and blue for
        faster."""
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
        """Returns True for each of these rows and columns of cells that is lethal by the map: bool (rows, cols)."""
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
    """Returns evenly spaced colours between those named, float32 (steps, 3), 0 to 255."""
    named = np.array([rgb(colour) for colour in colours], np.float32)
    at = np.linspace(0, len(named) - 1, steps)
    channels = [np.interp(at, np.arange(len(named)), named[:, n]) for n in range(3)]
    return np.stack(channels, axis=1).astype(np.float32)


def _cells(window: Window) -> tuple[slice, slice]:
    return slice(window.row0, window.row1), slice(window.col0, window.col1)


def _mixed(pixels: Bytes, colour: Colour, share: float) -> Bytes:
    mixed: Bytes = ((1 - share) * pixels + share * np.array(colour)).astype(np.uint8)
    return mixed


class CostSamples:
    """Asks for the cost-to-go of the shown target every other time, of all in turn between.

    rows, cols  of the samples, int64 (n,) and (m,)
    costs_s     target -> float32 (n, m), inf where there is no way
    """

    def __init__(self, grid: GridSpec, displayed: str | None) -> None:
        step = max(1, math.ceil(math.sqrt(grid.cells / _MOST_SAMPLES)))
        while -(-grid.rows // step) * -(-grid.cols // step) > _MOST_SAMPLES:
            step += 1
        self.step = step
        self.rows = np.arange(min(step // 2, grid.rows - 1), grid.rows, step, dtype=np.int64)
        self.cols = np.arange(min(step // 2, grid.cols - 1), grid.cols, step, dtype=np.int64)
        cells = self.rows[:, None] * grid.cols + self.cols
        self.request = CostRequest(cells=cells.reshape(-1).tolist())
        self.costs_s: dict[str, Floats] = {}
        self._displayed = displayed
        self.targets: deque[str] = deque()
        """Targets with a planner, the one that was asked least lately first."""
        self._asked = 0

    def next_target(self) -> str | None:
        """The target to ask about; None while none has a planner."""
        self._asked += 1
        if self._asked % 2 and self._displayed in self.targets:
            return self._displayed
        self.targets.rotate(-1)
        return self.targets[-1] if self.targets else None

    def on_costs(self, reply: CostReply) -> bool:
        """Takes an answer in. Returns whether it says something."""
        costs = column(reply.cost_to_go_s, "<f4")
        if reply.target not in self.targets or len(costs) != len(self.request.cells):
            return False
        if not np.isfinite(costs).any():
            return self.costs_s.pop(reply.target, None) is not None
        self.costs_s[reply.target] = np.array(costs, np.float32).reshape(len(self.rows), len(self.cols))
        return True

    def spread(self, costs: Floats, rows: Ints, cols: Ints) -> Floats:
        """Costs at these rows and columns of cells, float32 (rows, cols): between the finite ones of the four
        samples around, inf where none is."""
        finite = np.isfinite(costs).astype(np.float32)
        at = np.meshgrid((rows - self.rows[0]) / self.step, (cols - self.cols[0]) / self.step, indexing="ij")
        total, weight = (
            map_coordinates(each, at, order=1, mode="nearest") for each in (np.where(finite, costs, 0), finite)
        )
        result = np.full(total.shape, np.inf, np.float32)
        np.divide(total, weight, out=result, where=weight > 0)
        return result


def coarse_tree(
    costs: Floats, samples: CostSamples, lethal_at: Callable[[Ints, Ints], NDArray[np.bool_]]
) -> tuple[Ints, Ints]:
    """From each sample to the neighbour to which the cost falls most over the distance, never across lethal ground.

    lethal_at  of rows and columns of cells, bool (rows, cols)

    Returns the ends of lines, int64 (k, 2, 2) as (row, col) of cells, and how many samples' ways lead along each.
    """
    n, m = costs.shape
    finite = np.isfinite(costs)
    here = np.where(finite, costs, -np.inf)
    beside = np.pad(costs, 1, constant_values=np.inf)
    index = np.arange(n * m).reshape(n, m)
    best, parent = np.zeros((n, m)), np.full((n, m), -1, np.int64)
    for d_row, d_col in _BESIDE:
        fall = here - beside[1 + d_row : 1 + d_row + n, 1 + d_col : 1 + d_col + m]
        fall /= math.hypot(d_row, d_col)
        barred = np.zeros((n, m), np.bool_)
        for share in _ON_THE_WAY * samples.step:
            row = np.clip(np.rint(samples.rows + share * d_row).astype(np.int64), 0, samples.rows[-1])
            col = np.clip(np.rint(samples.cols + share * d_col).astype(np.int64), 0, samples.cols[-1])
            barred |= lethal_at(row, col)
        better = (fall > best) & ~barred
        best[better], parent[better] = fall[better], (index + d_row * m + d_col)[better]
    parents = parent.reshape(-1)
    through = np.ones(n * m, np.int64)
    for sample in np.argsort(-costs.reshape(-1), kind="stable"):  # the farthest first; inf has no parent
        if parents[sample] >= 0:
            through[parents[sample]] += through[sample]
    drawn = np.flatnonzero((parents >= 0) & (through >= _LEAST_BRANCH))
    ends = np.stack([drawn, parents[drawn]], axis=1)
    return np.stack([samples.rows[ends // m], samples.cols[ends % m]], axis=-1), through[drawn]


def nearest_target(costs: dict[str, Floats], order: Sequence[str]) -> Ints:
    """Index in `order` of the target with the least cost at each place; -1 where none can be reached."""
    unreached = np.full(next(iter(costs.values())).shape, np.inf, np.float32)
    stacked = np.stack([costs.get(target, unreached) for target in order] or [unreached])
    return np.where(np.isfinite(stacked.min(axis=0)), stacked.argmin(axis=0), -1)


class TargetPictures:
    """Draws samples of cost-to-go on the relief.

    full_s  the cost at the far end of the scale; changes when costs outgrow it or need little more than half of it
    """

    def __init__(self, mesh: TerrainMesh, colours: GroundColours, samples: CostSamples) -> None:
        self._mesh, self._colours, self._samples = mesh, colours, samples
        grid = mesh.grid
        pixel = max(grid.rows, grid.cols) / _PIXELS
        self._rows, self._cols = (
            np.linspace(0, side - 1, max(1, round(side / pixel))).astype(np.int64)
            for side in (grid.rows, grid.cols)
        )
        self._palette = between(COST_TO_GO_COLOURS, 256)
        self.full_s = 0.0

    def to_target(self, target: str) -> Bytes:
        """The cost-to-go as a heat map, with a line between each two of ten bands."""
        costs = self._samples.spread(self._samples.costs_s[target], self._rows, self._cols)
        reached = np.isfinite(costs)
        most = float(np.percentile(costs[reached], _SHOWN_PERCENT)) if reached.any() else 0.0
        if not 0.6 * self.full_s <= most <= 1.1 * self.full_s:
            self.full_s = max(most, 1e-3)
        share = np.where(reached, costs, 0) / self.full_s
        pixels = self._palette[np.clip(share * 255, 0, 255).astype(np.intp)]
        band = np.floor(share * _BANDS)
        pixels[:-1][band[:-1] != band[1:]] *= 0.35
        pixels[:, :-1][band[:, :-1] != band[:, 1:]] *= 0.35
        pixels[~reached] = UNREACHED
        return self._colours.on_relief(pixels, self._rows, self._cols)

    def tree(self, target: str) -> tuple[Floats, Floats]:
        """Returns the steepest descent of the cost between samples, as a river that ends at the target: lines
        float32 (n, 2, 3), and their radii as rerun takes those in points of the window, float32 (n,)."""
        ends, through = coarse_tree(self._samples.costs_s[target], self._samples, self._colours.lethal_at)
        cells = ends[..., 0] * self._mesh.grid.cols + ends[..., 1]
        radii = -(0.25 + 0.16 * np.log2(through / 2)).astype(np.float32)
        return self._mesh.place_cells(cells, 0.15 * self._mesh.scale_m), radii

    def territories(self, order: Sequence[str]) -> Bytes:
        """Returns which target each place is nearest to in cost, in the colours that targets have in the plots."""
        samples = self._samples
        costs = {id: samples.spread(each, self._rows, self._cols) for id, each in samples.costs_s.items()}
        nearest = nearest_target(costs, order)
        pixels = np.array(HUES, np.float32)[nearest % len(HUES)]
        pixels[nearest < 0] = UNREACHED
        return self._colours.on_relief(pixels, self._rows, self._cols)
