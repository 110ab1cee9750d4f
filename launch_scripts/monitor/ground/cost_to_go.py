"""Cost-to-go of targets on a coarse grid, as their planners answer it: which to ask, and pictures of the answers.

The monitor grows no tree. It asks for the costs of at most `_MOST_SAMPLES` cells, of one target at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from launch_scripts.monitor.ground.ground_colours import COST_TO_GO_COLOURS, UNREACHED, GroundColours, between
from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.movers.styles import HUES
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.planning import CostReply, CostRequest

Ints = NDArray[np.int64]
_MOST_SAMPLES = 64 * 64
_ASK_NS = 2 * NS_PER_S
_BESIDE = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
_ON_THE_WAY = np.linspace(0, 1, 9)[1:-1]
"""Where between two samples it is looked for lethal cells."""
_STEPS = (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10)
_LEAST_BRANCH = 3
"""Samples whose way leads through one from which a line is drawn."""
_PIXELS = 160
"""Of a picture's longer side: some for each sample, so that slopes are smooth."""
_BANDS = 10
_SHOWN_PERCENT = 97
"""Of the places lie within the scale: a few that are far off must not take half of it."""


class CostSamples:
    """Asks for the cost-to-go of the shown target every other time, of all others in turn between.

    rows, cols  of the samples, int64 (n,) and (m,)
    costs_s     target -> float32 (n, m), inf where there is no way
    """

    def __init__(self, grid: GridSpec, shown: str | None) -> None:
        step = max(1, math.ceil(math.sqrt(grid.cells / _MOST_SAMPLES)))
        while -(-grid.rows // step) * -(-grid.cols // step) > _MOST_SAMPLES:
            step += 1
        self.step = step
        self.rows = np.arange(min(step // 2, grid.rows - 1), grid.rows, step, dtype=np.int64)
        self.cols = np.arange(min(step // 2, grid.cols - 1), grid.cols, step, dtype=np.int64)
        cells = self.rows[:, None] * grid.cols + self.cols
        self.request = CostRequest(cells=cells.reshape(-1).tolist())
        self.costs_s: dict[str, Floats] = {}
        self._shown = shown
        self._targets: list[str] = []
        """Targets with a planner, the one that was asked least lately first."""
        self._due_ns, self._asked = 0, 0

    def hear_target(self, target: str) -> None:
        """A planner told its state."""
        if target not in self._targets:
            self._targets.append(target)

    def next_target(self, now_ns: int, slower: int = 1) -> str | None:
        """The target to ask about now, if it is time.

        slower  by how many times as seldom as somebody needs who looks
        """
        if now_ns < self._due_ns or not self._targets:
            return None
        self._due_ns = now_ns + slower * _ASK_NS
        self._asked += 1
        others = [target for target in self._targets if target != self._shown]
        if self._shown in self._targets and (self._asked % 2 or not others):
            return self._shown
        self._targets.remove(others[0])
        self._targets.append(others[0])
        return others[0]

    def hear(self, reply: CostReply) -> bool:
        """Takes an answer in. Returns whether it says something."""
        costs = column(reply.cost_to_go_s, "<f4")
        if reply.target not in self._targets or len(costs) != len(self.request.cells):
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


def unit_of(seconds: float) -> tuple[str, float]:
    """The unit in which people say a time, and its seconds."""
    return next(
        (each for each in (("hours", 3600.0), ("minutes", 60.0)) if seconds >= 2 * each[1]), ("seconds", 1.0)
    )


def full_scale_s(seconds: float) -> float:
    """The end of a scale for costs up to this: few digits in their unit."""
    unit_s = unit_of(seconds)[1]
    power = 10.0 ** math.floor(math.log10(max(seconds / unit_s, 1e-3)))
    return float(min(step * power * unit_s for step in _STEPS if step * power * unit_s >= seconds * 0.9999))


class TargetPictures:
    """Draws samples of cost-to-go on the relief.

    full_s  the cost at the far end of the scale; changes when costs outgrow it or need little more than half of it
    """

    def __init__(self, mesh: TerrainMesh, colours: GroundColours, samples: CostSamples) -> None:
        self._mesh, self._colours, self._samples = mesh, colours, samples
        grid = mesh.grid
        self._rows, self._cols = (
            ((np.arange(pixels) + 0.5) / pixels * side).astype(np.int64)
            for side in (grid.rows, grid.cols)
            for pixels in (max(1, round(side * _PIXELS / max(grid.rows, grid.cols))),)
        )
        self._palette = between(COST_TO_GO_COLOURS, 256)
        self.full_s = 0.0

    def to_target(self, target: str) -> Bytes:
        """The cost-to-go as a heat map, with a line between each two of ten bands."""
        costs = self._samples.spread(self._samples.costs_s[target], self._rows, self._cols)
        reached = np.isfinite(costs)
        most = float(np.percentile(costs[reached], _SHOWN_PERCENT)) if reached.any() else 0.0
        if not 0.6 * self.full_s <= most <= 1.1 * self.full_s:
            self.full_s = full_scale_s(most)
        share = np.where(reached, costs, 0) / self.full_s
        pixels = self._palette[np.clip(share * 255, 0, 255).astype(np.intp)]
        band = np.floor(share * _BANDS)
        pixels[:-1][band[:-1] != band[1:]] *= 0.35
        pixels[:, :-1][band[:, :-1] != band[:, 1:]] *= 0.35
        pixels[~reached] = UNREACHED
        return self._colours.on_relief(pixels, self._rows, self._cols)

    def tree(self, target: str) -> tuple[Floats, Floats]:
        """Where the cost falls most between samples, as a river that ends at the target: lines float32 (n, 2, 3),
        and their radii as rerun takes those in points of the window, float32 (n,)."""
        ends, through = coarse_tree(self._samples.costs_s[target], self._samples, self._colours.lethal_at)
        cells = ends[..., 0] * self._mesh.grid.cols + ends[..., 1]
        radii = -(0.25 + 0.16 * np.log2(through / 2)).astype(np.float32)
        return self._mesh.place_cells(cells, 0.15 * self._mesh.scale_m), radii

    def territories(self, order: Sequence[str]) -> Bytes:
        """Which target each place is nearest to in cost, in the colours that targets have in the plots."""
        samples = self._samples
        costs = {id: samples.spread(each, self._rows, self._cols) for id, each in samples.costs_s.items()}
        nearest = nearest_target(costs, order)
        pixels = np.array(HUES, np.float32)[nearest % len(HUES)]
        pixels[nearest < 0] = UNREACHED
        return self._colours.on_relief(pixels, self._rows, self._cols)
