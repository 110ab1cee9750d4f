"""Figures of a terrain: heights, photo, classes and cost; a route on its relief.

A map is values of each cell of a level in colours, drawn by matplotlib, with the relief as a shadow over them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, Normalize
from matplotlib.patches import Patch
from numpy.typing import NDArray

from launch_scripts.observe.palette import BLUE, RED, hillshade
from launch_scripts.report.plots_and_cards import saved
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.pyramid import Level, level_of
from shared_map.terrain.synthetic import TINT
from shared_map.terrain.terrain import Terrain

MOST_CELLS = 1 << 21
"""Most cells of a panel; larger terrains are shown by a coarser level of their pyramid."""
_PANEL_IN = 6.6
"""Longer side of a panel, in inches."""
_LETHAL, _VOID = "#3b1a5a", "#9a9a9a"
# Muted greens to rock to snow. No blue: valleys must not look like lakes.
_HEIGHTS = LinearSegmentedColormap.from_list(
    "heights", ["#6d9a6b", "#a9bd85", "#e3d9a8", "#c9a77c", "#9a7a62", "#b5aaa3", "#ffffff"]
).with_extremes(bad=_VOID)
_PACES = LinearSegmentedColormap.from_list(
    "paces", ["#fbf7dc", "#f6d27a", "#ee9140", "#cf4a2c", "#7d1626"]
).with_extremes(bad=_LETHAL)
_GROUND = LinearSegmentedColormap.from_list("ground", ["#ede6d1", "#5c4576"])
"""From passable to lethal cells."""
_TINTS = [*(TINT / 255)]
for _kind, _tint in (  # photos' own colours do not tell these classes apart
    (TerrainClass.ROAD, (1.0, 0.91, 0.69)), (TerrainClass.BUILT, (0.75, 0.38, 0.35)),
    (TerrainClass.SHRUB, (0.70, 0.64, 0.31)), (TerrainClass.WETLAND, (0.37, 0.62, 0.58)),
):  # fmt: skip
    _TINTS[_kind] = np.array(_tint)
_CLASSES = ListedColormap(_TINTS)


def _draw_map(
    axes: Axes, level: Level, title: str, values: Any, shadow: float, **colours: Any
) -> tuple[Any, float]:
    """Draws values of each cell on axes in metres, or kilometres of a large terrain, from its north-west corner.

    values   float (rows, cols), NaN where there is none; or colours, (rows, cols, 3)
    shadow   how dark the relief makes a slope at most, 0 to 1
    colours  as `Axes.imshow` takes them

    Returns the image, for a bar of colours, and the metres of the axes' unit.
    """
    grid = level.grid
    unit_m, unit = (1000.0, "km") if max(grid.rows, grid.cols) * grid.resolution_m >= 4000 else (1.0, "m")
    side = grid.resolution_m / unit_m
    place: Any = {"extent": (0.0, grid.cols * side, grid.rows * side, 0.0), "interpolation": "nearest"}
    image = axes.imshow(values, **colours, **place)
    dark = np.zeros((grid.rows, grid.cols, 4), np.float32)
    dark[..., 3] = np.clip(shadow * (1 - hillshade(level.elevation_m, grid.resolution_m) / 0.7), 0, 1)
    axes.imshow(dark, **place)
    axes.set(title=title, xlabel=f"east, {unit}", ylabel=f"south, {unit}")
    axes.grid(visible=False)
    return image, unit_m


# --- a terrain ----------------------------------------------------------------------------------------------------


def draw_terrain(terrain: Terrain, path: Path, title: str) -> None:
    """Elevation, photo, classes and cost, two by two."""
    level = level_of(terrain, MOST_CELLS)
    grid, climb = terrain.grid, terrain.climb
    ratio = min(max(grid.rows / grid.cols, 0.3), 3.0)
    wide_in, high_in = (_PANEL_IN, _PANEL_IN * ratio) if ratio <= 1 else (_PANEL_IN / ratio, _PANEL_IN)
    voids = np.isnan(level.elevation_m)
    driven = np.isfinite(level.pace_s_per_m) & (level.lethal_share < 0.5)
    low, high = np.percentile(level.pace_s_per_m[driven], (0, 99)) if driven.any() else (0.0, 1.0)
    shares = np.bincount(level.classes.reshape(-1), minlength=len(TerrainClass)) / level.classes.size
    of_classes = [
        Patch(facecolor=_TINTS[kind], edgecolor="#888", label=f"{kind.name.lower()} {_percent(shares[kind])}")
        for kind in sorted(TerrainClass, key=lambda kind: -shares[kind])
        if shares[kind]
    ]
    cost = "cost"
    if climb is not None:
        ground = "ground" if climb.wind is None else "flight"
        cost = f"cost of level {ground} (steps cost by their climb{' and the wind' if climb.windy else ''} too)"
    void = [Patch(color=_VOID, label=f"void {voids.mean():.1%}")] if voids.any() else []
    lethal = [Patch(color=_LETHAL, label=f"lethal {level.lethal_share.mean():.1%}")]
    paces = np.where(driven, level.pace_s_per_m, np.nan)
    spread = Normalize(float(low), max(float(high), 1.01 * float(low)))
    kinds = Normalize(-0.5, len(_TINTS) - 0.5)
    panels: tuple[tuple[str, Any, float, dict[str, Any], str, list[Patch]], ...] = (
        ("elevation", level.elevation_m, 0.6, {"cmap": _HEIGHTS}, "metres", void),
        ("photo", level.photo, 0.0, {}, "", []),
        ("classes", level.classes, 0.35, {"cmap": _CLASSES, "norm": kinds}, "", of_classes),
        (cost, paces, 0.3, {"cmap": _PACES, "norm": spread}, "seconds per metre", lethal),
    )
    with saved(path, (2 * wide_in + 4.2, 2 * high_in + 1.9), layout="constrained") as figure:
        for axes, (name, values, shadow, colours, of_bar, patches) in zip(
            figure.subplots(2, 2).reshape(-1), panels, strict=True
        ):
            image, unit_m = _draw_map(axes, level, name, values, shadow, **colours)
            if of_bar:
                beside = axes.inset_axes((1.02, 0.0, 0.04, 0.85 if patches else 1.0))
                figure.colorbar(image, cax=beside, label=of_bar)
            if patches:
                axes.legend(handles=patches, loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=10)
        wide, high = grid.cols * grid.resolution_m / unit_m, grid.rows * grid.resolution_m / unit_m
        size = f"{wide:.4g} x {high:.4g} {'km' if unit_m > 1 else 'm'}"
        facts = f"{grid.rows} x {grid.cols} cells of {grid.resolution_m:g} m, {size}"
        coarse = "" if level.side == 1 else f"; a pixel shows {level.side} x {level.side} cells"
        figure.suptitle(f"{title}\n{facts}{coarse}", x=0.01, ha="left", fontsize=13)


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.095 else f"{share:.1%}" if share >= 0.0005 else "< 0.1%"


# --- a route ------------------------------------------------------------------------------------------------------


def draw_route(
    terrain: Terrain,
    path: Path,
    title: str,
    xy_m: NDArray[np.float64],
    at_m: NDArray[np.float64],
    height_m: NDArray[np.float64],
) -> None:
    """A route on the relief, lethal ground dark, and its heights below.

    xy_m      float64 (2, n), metres of the map
    at_m      float64 (n,), metres driven until there
    height_m  float64 (n,), NaN over a void
    """
    level = level_of(terrain, MOST_CELLS)
    high_in = 8.0 * min(max(level.grid.rows / level.grid.cols, 0.3), 1.4)
    with saved(path, (8.6, high_in + 3.0), layout="constrained") as figure:
        above, below = figure.subplots(2, 1, height_ratios=[high_in, 2.2])
        _, unit_m = _draw_map(above, level, title, level.lethal_share, 0.65, cmap=_GROUND, norm=Normalize(0, 1))
        along, down = (xy_m[0] - terrain.grid.west_m) / unit_m, (terrain.grid.north_m - xy_m[1]) / unit_m
        above.plot(along, down, color="white", linewidth=3.6)
        above.plot(along, down, color=RED, linewidth=1.8)
        for n, label in ((0, "from"), (-1, "to")):
            above.plot(along[n], down[n], "o", color=RED, markeredgecolor="white", markersize=7)
            above.annotate(
                label, (along[n], down[n]), xytext=(7, 7), textcoords="offset points", weight="bold",
                bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
            )  # fmt: skip
        at = at_m / unit_m
        below.plot(at, height_m, color=BLUE, linewidth=1.4)
        if np.isfinite(height_m).any():
            below.fill_between(at, np.nanmin(height_m), height_m, color=BLUE, alpha=0.15)
        unit = "km" if unit_m > 1 else "m"
        below.set(xlabel=f"along the route, {unit}", ylabel="height, m", xlim=(0, max(at[-1], 1e-9)))
