"""The picture of docs/learning.md: a map whose prior is wrong about a class, before anything was driven and after.

python -m docs.generate.learned_picture [FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from bench.planning.learning import LearningRun
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from launch_scripts.observe.palette import INK
from launch_scripts.observe.plot_style import STYLE
from shared_map.arrays import Floats
from shared_map.terrain.terrain import build_terrain
from swarm.config.ground import TerrainConfig
from swarm.config.scenario import Scenario

FILE = Path(__file__).parents[2] / "docs" / "images" / "learning.png"
_SEED, _AGENTS = 0, 4
_LEGS = (0, 1)
_MOST = 4.0


def draw(file: Path) -> None:
    """Write the picture: by what the truth differs from the map, before and after a leg of every vehicle."""
    terrain = build_terrain(Scenario(terrain=TerrainConfig(source="jacksboro")))
    run = LearningRun(terrain, _SEED, _AGENTS, wrong=True)
    km = terrain.grid.resolution_m / 1e3
    extent = (0.0, terrain.grid.cols * km, terrain.grid.rows * km, 0.0)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.6, 4.2), layout=ConstrainedLayoutEngine(h_pad=0.12))
        driven = 0
        for axes, legs in zip(figure.subplots(1, len(_LEGS)), _LEGS, strict=True):
            while driven < legs:
                run.drive()
                driven += 1
            known = np.isfinite(run.true)
            off = np.full(known.shape, np.nan, np.float32)
            off[known] = np.log2(run.true[known] / run.learned[known])
            image = axes.imshow(
                _smoothed(off),
                cmap="PuOr_r",
                norm=TwoSlopeNorm(0.0, -np.log2(_MOST), np.log2(_MOST)),
                extent=extent,
                interpolation="nearest",
            )
            for way in run.seen:
                rows, cols = np.divmod(way, terrain.grid.cols)
                axes.plot((cols + 0.5) * km, (rows + 0.5) * km, color=INK, linewidth=1.6)
            cells = len(np.unique(np.concatenate(run.seen))) if run.seen else 0
            title = "before" if not legs else f"{cells} cells driven, {cells / off.size:.2%} of the map"
            error = np.sqrt(np.mean((off[known] * np.log(2)) ** 2))
            axes.set_title(f"{title}: error {error:.2f}", fontsize=9)
            axes.set_xlabel("km")
        bar = figure.colorbar(image, ax=figure.axes, shrink=0.8)
        bar.set_ticks([-2, -1, 0, 1, 2], labels=["1/4", "1/2", "1", "2", "4"])
        bar.set_label("true pace / pace on the map")
        figure.savefig(file, dpi=100)


def _smoothed(values: Floats, side: int = 2) -> Floats:
    """Means of blocks: what differs from cell to cell would be noise in a picture."""
    rows, cols = (length // side * side for length in values.shape)
    blocks = values[:rows, :cols].reshape(rows // side, side, cols // side, side)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
