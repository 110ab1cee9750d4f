"""Pictures of the cost-to-go of a target with its tree, and of the target that is nearest in cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from launch_scripts.monitor.ground.cost_to_go import CostSamples, coarse_tree, full_scale_s, nearest_target, spread
from launch_scripts.monitor.ground.ground_colours import COST_TO_GO_COLOURS, UNREACHED, GroundColours, between
from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.movers.looks import HUES

_PIXELS = 160
"""Of a picture's longer side: some for each sample, so that slopes are smooth."""
_BANDS = 10
_SHOWN_PERCENT = 97
"""Of the places lie within the scale: a few that are far off must not take half of it."""
_HUES = np.array(HUES, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Lines float32 (n, 2, 3), and their radii in points of the window, float32 (n,)."""

    lines: Floats
    radii: Floats


class TargetPictures:
    """Draws samples of cost-to-go on the relief.

    full_s  the cost at the far end of the scale; changes when costs outgrow it or need little more than half of it
    """

    def __init__(self, mesh: TerrainMesh, colours: GroundColours, samples: CostSamples) -> None:
        self._mesh, self._colours, self._samples = mesh, colours, samples
        grid = mesh.grid
        share = _PIXELS / max(grid.rows, grid.cols)
        self._rows, self._cols = (
            ((np.arange(max(1, round(side * share))) + 0.5) / max(1, round(side * share)) * side).astype(np.intp)
            for side in (grid.rows, grid.cols)
        )
        self._palette = between(COST_TO_GO_COLOURS, 256)
        self.full_s = 0.0

    def to_target(self, target: str) -> Bytes:
        """The cost-to-go as a heat map, with a line between each two of ten bands."""
        costs = self._spread(self._samples.costs_s[target])
        reached = np.isfinite(costs)
        most = float(np.percentile(costs[reached], _SHOWN_PERCENT)) if reached.any() else 0.0
        if not 0.6 * self.full_s <= most <= 1.1 * self.full_s:
            self.full_s = full_scale_s(most)
        share = np.where(reached, costs, 0) / self.full_s
        pixels = self._palette[np.clip(share * 255, 0, 255).astype(np.intp)]
        band = np.floor(share * _BANDS)
        edge = np.zeros(band.shape, np.bool_)
        edge[:-1] |= band[:-1] != band[1:]
        edge[:, :-1] |= band[:, :-1] != band[:, 1:]
        pixels[edge] *= 0.35
        pixels[~reached] = UNREACHED
        return self._colours.on_relief(pixels, self._rows, self._cols)

    def tree(self, target: str) -> Tree:
        """Where the cost falls most between samples, as a river that ends at the target."""
        samples, grid = self._samples, self._mesh.grid
        costs = samples.costs_s[target]
        ends, through = coarse_tree(costs, samples.rows, samples.cols, self._colours.lethal_at)
        lines = self._mesh.place_cells(ends[..., 0] * grid.cols + ends[..., 1], 0.15 * self._mesh.scale_m)
        radii = 0.25 + 0.16 * np.log2(through / 2)
        return Tree(lines, -radii.astype(np.float32))

    def territories(self, order: Sequence[str]) -> Bytes:
        """Which target each place is nearest to in cost, in the colours that targets have in the plots."""
        costs: Mapping[str, Floats] = {t: self._spread(each) for t, each in self._samples.costs_s.items()}
        nearest = nearest_target(dict(costs), list(order))
        pixels = _HUES[nearest % len(_HUES)]
        pixels[nearest < 0] = UNREACHED
        return self._colours.on_relief(pixels, self._rows, self._cols)

    def _spread(self, costs: Floats) -> Floats:
        rows, cols = self._rows.astype(np.float32), self._cols.astype(np.float32)
        return spread(costs, (self._samples.rows, self._samples.cols), rows, cols)
