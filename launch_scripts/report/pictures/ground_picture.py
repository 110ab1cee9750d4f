"""The still half of a run's picture: terrain, what is forbidden or lethal on it, and what its map did not know."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from launch_scripts.observe.palette import BLACK, FORBIDDEN, LETHAL_GROUND, hillshade
from shared_map.terrain.pyramid import Level, any_in_blocks, level_of
from shared_map.terrain.terrain import Terrain, build_truth
from shared_map.terrain.zones import zone_mask
from swarm.config.ground import HiddenConfig
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError

GROUND_FILE = "ground.webp"
_LONG_SIDE_PX = 1600
_DPI = 150
_MOST_CELLS = 1 << 20
"""Cells of the ground that are drawn at most: about as many as the picture has pixels."""
Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class GroundPicture:
    """A picture of the ground from its north-west to its south-east corner.

    pixels  uint8 (height, width, 3)
    drawn   what is on it beside the terrain, for a legend: lethal, forbidden, hidden
    level   of the terrain, that was drawn
    """

    pixels: NDArray[np.uint8]
    drawn: tuple[str, ...]
    level: Level

    def webp(self) -> bytes:
        from PIL import Image

        file = io.BytesIO()
        Image.fromarray(self.pixels).save(file, "WEBP", quality=88, method=2)
        return file.getvalue()


def ground_picture(terrain: Terrain, scenario: Scenario, truth: NDArray[np.float32] | None) -> GroundPicture:
    """Draw the ground.

    truth  true pace of every cell, to outline hidden obstacles; None if it is secret or unknown
    """
    seen = level_of(terrain, _MOST_CELLS)
    lethal = any_in_blocks(np.isinf(terrain.pace_s_per_m), seen.side)
    forbidden = any_in_blocks(forbidden_cells(scenario, terrain), seen.side)
    hidden = any_in_blocks(hidden_cells(scenario, terrain, truth), seen.side)
    with mpl.rc_context({"hatch.linewidth": 0.5}):
        figure, axes = _canvas(seen)
        axes.imshow(_photo(seen), extent=(0, seen.grid.cols, seen.grid.rows, 0), interpolation="bilinear")
        _fill(axes, lethal & ~forbidden, LETHAL_GROUND, 0.45, "xxxx", "#d7dbe0", edge=None)
        _fill(axes, forbidden, BLACK, 0.5, "////", FORBIDDEN, edge=FORBIDDEN)
        _outline(axes, hidden, (("white", 1.9, "-"), (BLACK, 0.8, ":")))
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    there = {"lethal": lethal & ~forbidden, "forbidden": forbidden, "hidden": hidden}
    return GroundPicture(pixels, tuple(name for name, cells in there.items() if cells.any()), seen)


def forbidden_cells(scenario: Scenario, terrain: Terrain) -> Bools:
    """What the scenario's zones forbid. Zones of vector files are among what is lethal: to read them again takes
    long."""
    cells = np.zeros(terrain.pace_s_per_m.shape, np.bool_)
    for zone in scenario.cost.zones:
        if zone.kind == "forbidden" and zone.file is None:
            try:
                cells |= zone_mask(zone, terrain.grid)
            except TerrainError:  # a mask that is not there any more; its cells are lethal all the same
                continue
    return cells & np.isinf(terrain.pace_s_per_m)


def hidden_cells(scenario: Scenario, terrain: Terrain, truth: NDArray[np.float32] | None) -> Bools:
    """Where the truth differs from what the map knew at the beginning, but for what a whole class of ground is
    slower or quicker by: that would outline every meadow."""
    if truth is None:
        return np.zeros(terrain.pace_s_per_m.shape, np.bool_)
    known = terrain.ground_s_per_m
    if scenario.terrain.hidden.class_factor:
        only_classes = HiddenConfig(class_factor=scenario.terrain.hidden.class_factor)
        known = build_truth(
            msgspec.structs.replace(
                scenario, terrain=msgspec.structs.replace(scenario.terrain, hidden=only_classes)
            ),
            terrain,
        )
    differs: Bools = (truth != known) & ~(np.isinf(truth) & np.isinf(terrain.pace_s_per_m))
    return differs


def _canvas(seen: Level) -> tuple[Figure, Axes]:
    rows, cols = seen.grid.rows, seen.grid.cols
    scale = _LONG_SIDE_PX / max(rows, cols)
    width, height = (max(round(side * scale), 1) for side in (cols, rows))
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set(xlim=(0, cols), ylim=(rows, 0))
    axes.set_aspect("auto")
    return figure, axes


def _photo(seen: Level) -> NDArray[np.float32]:
    """The photo with hillshade, paled so that tracks stand out."""
    shade = hillshade(seen.elevation_m, seen.grid.resolution_m)
    photo = seen.photo.astype(np.float32) / 255
    grey = photo.mean(axis=2, keepdims=True)
    paled = 0.55 * (0.65 * photo + 0.35 * grey) + 0.45
    lit: NDArray[np.float32] = np.clip(paled * (0.62 + 0.55 * shade[..., None]), 0, 1).astype(np.float32)
    return lit


def _fill(
    axes: Axes, cells: Bools, colour: str, alpha: float, hatch: str, hatch_colour: str, edge: str | None
) -> None:
    """Cells darkened and hatched, so that neither a grey print nor a colour-blind eye misses them."""
    if not cells.any():
        return
    x, y, padded = _padded(cells)
    axes.contourf(x, y, padded, levels=[0.5, 1.5], colors=[colour], alpha=alpha)
    with mpl.rc_context({"hatch.color": hatch_colour}):
        hatched: Any = axes.contourf(x, y, padded, levels=[0.5, 1.5], colors="none", hatches=[hatch])
        hatched.set_edgecolor(hatch_colour)
        hatched.set_linewidth(0.0)
    if edge is not None:
        _outline(axes, cells, ((BLACK, 2.4, "-"), (edge, 1.2, "-")))


def _outline(axes: Axes, cells: Bools, strokes: Sequence[tuple[str, float, str]]) -> None:
    if cells.any():
        x, y, padded = _padded(cells)
        for colour, width, style in strokes:
            axes.contour(x, y, padded, levels=[0.5], colors=colour, linewidths=width, linestyles=style)


def _padded(cells: Bools) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
    """Centres of cells and their values, with a border of none, so that areas at the edge are closed."""
    rows, cols = cells.shape
    return np.arange(-1, cols + 1) + 0.5, np.arange(-1, rows + 1) + 0.5, np.pad(cells, 1).astype(np.float32)
