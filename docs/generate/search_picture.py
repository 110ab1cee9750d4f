"""The picture of docs/search.md: what is believed about a target that nobody sees, and who is to look where.

python -m docs.generate.search_picture [FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from bench.search_times import TICK_S, Ground, Run
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from launch_scripts.observe.palette import BLUE, INK, ORANGE, RED
from launch_scripts.observe.plot_style import STYLE
from planner_service.search.searcher import Searcher
from planner_service.search.ways import Ways
from swarm.config.load import load_scenario
from swarm.grid import walk

FILE = Path(__file__).parents[2] / "docs" / "images" / "search.png"
_SCENARIO = Path(__file__).parents[2] / "launch_scripts" / "scenarios" / "jacksboro.toml"
_AFTER_S = (0.0, 900.0, 1800.0)
_BELIEF = LinearSegmentedColormap.from_list("belief", ["#e6550d00", "#fdae6bc0", "#e6550de0", "#7f2704ff"])
_SEED = 36


def draw(file: Path) -> None:
    """Write the picture: the belief over the ground at three times of one search."""
    ground = Ground.of(load_scenario(_SCENARIO))
    one = Run(ground, "waypoints", 10, 900.0, _SEED, near=False)
    ways = Ways(ground.costs)
    searcher = Searcher(ways, one.range_m, one.slowness, one.seed)
    searcher.begin(ground.terrain.pace_s_per_m, one.last, one.lost_s)
    grid, pace = ground.terrain.grid, ground.terrain.pace_s_per_m
    km = grid.resolution_m / 1e3
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 4.3), layout=ConstrainedLayoutEngine(h_pad=0.12))
        every = figure.subplots(1, len(_AFTER_S))
        now_s = 0.0
        for axes, after_s in zip(every, _AFTER_S, strict=True):
            while True:
                places = [ground.metres(driver.cell) for driver in one.drivers]
                searcher.tick(TICK_S if now_s else 0.0, places)
                for number, driver in enumerate(one.drivers):
                    name = f"{number}"
                    if (not driver.cells or searcher.wants_place(name)) and searcher.may_decide:
                        route = searcher.route(ways, name, driver.cell, 0, 0)[0]
                        driver.cells = list(walk(grid, route.start, route.directions))[1:]
                if now_s >= after_s and all(driver.cells for driver in one.drivers):
                    break
                for driver in one.drivers:
                    driver.drive(ground.terrain, TICK_S)
                one.move(TICK_S)
                now_s += TICK_S
            assert searcher.belief is not None
            total = searcher.belief.total
            extent = (0.0, grid.cols * km, grid.rows * km, 0.0)
            axes.imshow(np.where(np.isfinite(pace), pace, np.nan), cmap="Greys", vmin=0, vmax=0.6, extent=extent)
            side_km = searcher.belief.blocks.side_m / 1e3
            over = (0.0, total.shape[1] * side_km, total.shape[0] * side_km, 0.0)
            axes.imshow(np.sqrt(total), cmap=_BELIEF, extent=over, interpolation="nearest")
            for number, driver in enumerate(one.drivers):
                cells = np.array([driver.cell, *driver.cells])
                rows, cols = np.divmod(cells, grid.cols)
                axes.plot((cols + 0.5) * km, (rows + 0.5) * km, color=BLUE, linewidth=0.9)
                axes.plot((cols[-1] + 0.5) * km, (rows[-1] + 0.5) * km, "x", color=BLUE, markersize=5)
                label = "vehicle, its way and its place" if number == 0 else None
                axes.plot((cols[0] + 0.5) * km, (rows[0] + 0.5) * km, "o", color=BLUE, markersize=4, label=label)
            for cell, marker, colour, label in (
                (one.last, "+", INK, "seen last"),
                (one.target.cell, "*", RED, "where it is"),
            ):
                row, col = divmod(cell, grid.cols)
                axes.plot((col + 0.5) * km, (row + 0.5) * km, marker, color=colour, markersize=9, label=label)
            axes.set_title(f"{(one.lost_s + now_s) / 60:.0f} min after it was seen", fontsize=9)
            axes.set_xlim(0, grid.cols * km)
            axes.set_ylim(grid.rows * km, 0)
            axes.set_xlabel("km")
        every[0].plot([], [], "s", color=ORANGE, label="where it may be")
        every[0].legend(loc="lower left", fontsize=7, frameon=True, framealpha=0.9)
        figure.savefig(file, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
