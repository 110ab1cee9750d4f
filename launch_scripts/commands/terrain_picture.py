"""What a terrain looks like and costs, in one picture with metres and seconds per metre."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from shared_map.arrays import Bytes
from shared_map.layers import TerrainClass
from shared_map.synthetic import TINT, hillshade
from shared_map.terrain import Terrain
from swarm.errors import TerrainError

LARGEST = 1400
"""Cells on a side of a picture's panel; larger terrains are thinned out."""
LETHAL_COLOUR = "#4a1486"


def draw(terrain: Terrain, path: Path, title: str) -> None:
    """Hillshade, photo, classes and cost, side by side."""
    grid = terrain.grid
    stride = -(-max(grid.rows, grid.cols) // LARGEST)
    thin = (slice(None, None, stride), slice(None, None, stride))
    in_km = max(grid.rows, grid.cols) * grid.resolution_m >= 4000
    unit = 1000.0 if in_km else 1.0
    extent = (0.0, grid.cols * grid.resolution_m / unit, grid.rows * grid.resolution_m / unit, 0.0)
    figure = Figure(figsize=(15, 1 + 12 * min(max(grid.rows / grid.cols, 0.3), 3.0)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    panels = figure.subplots(2, 2)
    shown: dict[str, Any] = {"extent": extent, "interpolation": "nearest"}
    heights = terrain.elevation_m[thin]
    _elevation(figure, panels[0, 0], heights, grid.resolution_m * stride, shown)
    panels[0, 1].imshow(terrain.photo[thin], **shown)
    panels[0, 1].set_title("photo")
    _classes(panels[1, 0], terrain.classes[thin], shown)
    _cost(figure, panels[1, 1], terrain, thin, shown)
    for panel in panels.flat:
        panel.set_xlabel(f"east, {'km' if in_km else 'm'}")
        panel.set_ylabel(f"south, {'km' if in_km else 'm'}")
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise TerrainError(f"cannot write the picture {path}: {error}") from error


def _elevation(figure: Figure, panel: Axes, heights: Any, resolution_m: float, shown: dict[str, Any]) -> None:
    # The lower quarter of this map is the blue of the sea: valleys are no lakes.
    ground = ListedColormap(colormaps["terrain"](np.linspace(0.25, 1.0, 256)))
    image = panel.imshow(heights, cmap=ground, **shown)
    light = np.repeat(hillshade(heights, resolution_m, 1.5)[..., None], 4, axis=2)
    light[..., :3], light[..., 3] = np.where(light[..., :3] > 0.7, 1.0, 0.0), np.abs(light[..., 3] - 0.7) * 0.9
    panel.imshow(np.clip(light, 0, 1), **shown)
    figure.colorbar(image, ax=panel, label="elevation, m", shrink=0.8)
    panel.set_title("elevation")


def _classes(panel: Axes, classes: Bytes, shown: dict[str, Any]) -> None:
    colours = TINT / 255.0
    panel.imshow(classes, cmap=ListedColormap(colours), vmin=-0.5, vmax=len(colours) - 0.5, **shown)
    present = [kind for kind in TerrainClass if (classes == kind).any()]
    keys = [Patch(color=colours[kind], label=kind.name.lower()) for kind in present]
    panel.legend(handles=keys, loc="upper right", fontsize=8)
    panel.set_title("classes")


def _cost(figure: Figure, panel: Axes, terrain: Terrain, thin: Any, shown: dict[str, Any]) -> None:
    pace = terrain.pace_s_per_m[thin]
    finite = pace[np.isfinite(pace)]
    low, high = (float(value) for value in np.percentile(finite, (0, 99)))
    panel.set_facecolor(LETHAL_COLOUR)
    visible = np.where(np.isfinite(pace), pace, np.nan)
    image = panel.imshow(visible, cmap="YlOrRd", vmin=low, vmax=max(high, low * 1.01), **shown)
    figure.colorbar(image, ax=panel, label="pace, seconds per metre", extend="max", shrink=0.8)
    panel.legend(handles=[Patch(color=LETHAL_COLOUR, label="lethal")], loc="upper right", fontsize=8)
    panel.set_title(f"cost: {1 - len(finite) / pace.size:.1%} lethal")
