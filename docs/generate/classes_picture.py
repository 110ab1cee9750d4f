"""The picture of docs/classes.md: where rovers and walkers of one run have been, on the ground that each may drive.

python -m docs.generate.classes_picture [FILE]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from numpy.typing import NDArray

from launch_scripts.observe.palette import BLUE, GREEN, INK, ORANGE, STYLE
from launch_scripts.simulation.node import Node
from launch_scripts.simulation.simulate import Simulation
from shared_map.class_grounds import class_grounds
from swarm.config.load import load_scenario
from vehicle_agent.service import AgentService

FILE = Path(__file__).parents[2] / "docs" / "images" / "classes.png"
_SCENARIO = Path(__file__).parents[2] / "launch_scripts" / "scenarios" / "walkers.toml"
_COLOURS = {"ground": BLUE, "walker": ORANGE}
_SAID = {"ground": "rovers", "walker": "walkers"}


def driven(simulation: Simulation, seconds: float) -> dict[str, dict[str, list[int]]]:
    """Class -> vehicle -> the cells that it entered within so many seconds."""
    cells: dict[str, dict[str, list[int]]] = {}

    def look(node: Node) -> None:
        if not isinstance(node.service, AgentService):
            return
        agent = node.service.agent
        of_class = cells.setdefault(agent.plan.group.vehicle_class, {})
        for id, vehicle in agent.vehicles.items():
            been = of_class.setdefault(id, [])
            if not been or been[-1] != vehicle.cell:
                been.append(vehicle.cell)

    simulation.after_tick.append(look)
    simulation.run_until(seconds)
    return cells


def draw(file: Path) -> None:
    """Write the picture: the ground that each class may drive, and where its vehicles have been on it."""
    simulation = Simulation(load_scenario(_SCENARIO))
    grounds = class_grounds(simulation.scenario, simulation.terrain, simulation.truth)
    cells = driven(simulation, simulation.scenario.seconds)
    grid = simulation.terrain.grid
    km = grid.resolution_m / 1e3
    extent = (0.0, grid.cols * km, grid.rows * km, 0.0)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 5.6), layout=ConstrainedLayoutEngine())
        for axes, name in zip(figure.subplots(1, 2), _SAID, strict=True):
            other = next(each for each in _SAID if each != name)
            own, others = (np.isfinite(grounds[each].truth) for each in (name, other))
            kind = np.where(own & others, 0, np.where(own, 1, 2))
            shades = ListedColormap(["#ffffff", "#cfe8d5", "#c9ccd1"])
            axes.imshow(kind, cmap=shades, vmin=0, vmax=2, extent=extent, interpolation="nearest")
            axes.add_collection(
                LineCollection(_lines(cells[name], grid.cols, km), colors=_COLOURS[name], linewidths=0.8)
            )
            entered = {cell for been in cells[name].values() for cell in been}
            alone = int((own & ~others).ravel()[sorted(entered)].sum())
            axes.set_title(
                f"{len(cells[name])} {_SAID[name]}: {len(entered):,} cells, {alone:,} closed to {_SAID[other]}",
                fontsize=9,
                color=INK,
            )
            axes.set_xlabel("km")
        figure.legend(
            handles=[
                Patch(facecolor="#ffffff", edgecolor=INK, label="both may drive"),
                Patch(facecolor="#cfe8d5", edgecolor=GREEN, label="only these may"),
                Patch(facecolor="#c9ccd1", edgecolor=INK, label="lethal to these"),
            ],
            loc="outside lower center",
            ncols=3,
            fontsize=8,
            frameon=False,
        )
        figure.savefig(file, dpi=110)


def _lines(tracks: Mapping[str, list[int]], cols: int, km: float) -> list[NDArray[np.float64]]:
    """A line for each vehicle, broken where it went on elsewhere."""
    lines = []
    for been in tracks.values():
        rows, columns = np.divmod(np.array(been, np.int64), cols)
        places = np.stack(((columns + 0.5) * km, (rows + 0.5) * km), axis=1)
        lines += [np.array(pair) for pair in pairwise(places)]
    return lines


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
