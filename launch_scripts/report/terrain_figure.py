"""Figures of a terrain: heights, photo, classes and cost; a route on its relief; rules by which slope becomes pace.

All figures of terrains are drawn on `MapAxes`, in the terrain's own unit of length; PNG is written by `saved`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.patches import Patch
from numpy.typing import NDArray

from launch_scripts.observe.palette import BLUE, RED, hillshade
from launch_scripts.report.run_plots import saved
from shared_map.arrays import Floats
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.pyramid import Level, level_of
from shared_map.terrain.synthetic.landscape import TINT
from shared_map.terrain.terrain import Terrain

MOST_CELLS = 1 << 21
"""Most cells of a panel; larger terrains are shown by a coarser level of their pyramid."""
_PANEL_IN = 6.6
"""Longer side of a panel, in inches."""
_LETHAL, _VOID = "#3b1a5a", "#9a9a9a"
# Muted greens to rock to snow. No blue: valleys must not look like lakes.
_HEIGHTS = LinearSegmentedColormap.from_list(
    "heights", ["#6d9a6b", "#a9bd85", "#e3d9a8", "#c9a77c", "#9a7a62", "#b5aaa3", "#ffffff"]
)
_PACES = LinearSegmentedColormap.from_list("paces", ["#fbf7dc", "#f6d27a", "#ee9140", "#cf4a2c", "#7d1626"])
_CLASS_TINT: Mapping[TerrainClass, str] = {
    TerrainClass.ROAD: "#ffe9b0",
    TerrainClass.BUILT: "#c0625a",
    TerrainClass.SHRUB: "#b3a44e",
    TerrainClass.WETLAND: "#5f9e93",
}
"""Colours of classes which a photo's own colours do not tell apart."""


class MapAxes(NamedTuple):
    """Axes over a level of a terrain, in its unit from the north-west corner.

    unit_m, unit  1000 m and "km", or 1 m and "m" of a small terrain
    shade         float32 (rows, cols), light of the relief
    """

    axes: Axes
    level: Level
    unit_m: float
    unit: str
    shade: Floats

    @classmethod
    def of(cls, axes: Axes, level: Level, title: str = "") -> MapAxes:
        """Axes which are as large as the terrain, named and titled."""
        grid = level.grid
        far = max(grid.rows, grid.cols) * grid.resolution_m >= 4000
        unit_m, unit = (1000.0, "km") if far else (1.0, "m")
        axes.set_title(title)
        axes.set(xlabel=f"east, {unit}", ylabel=f"south, {unit}")
        axes.grid(visible=False)
        return cls(axes, level, unit_m, unit, hillshade(level.elevation_m, grid.resolution_m))

    def show(self, image: Any) -> None:
        """Draws the colours of each cell of the level, 0 to 1 or bytes: (rows, cols, 3)."""
        grid, side = self.level.grid, self.level.grid.resolution_m / self.unit_m
        extent = (0.0, grid.cols * side, grid.rows * side, 0.0)
        self.axes.imshow(image, extent=extent, interpolation="nearest", aspect="equal")

    def lit(self, colours: Any, share: float) -> Any:
        """Colours shaded by the relief; `share` is the strength of the shading."""
        light = np.float32(1 - share) + np.float32(share / 0.7) * self.shade[..., None]
        return np.clip(np.asarray(colours, np.float32)[..., :3] * light, 0, 1)

    def key(self, patches: Sequence[Patch]) -> None:
        """A legend beside the axes."""
        self.axes.legend(handles=patches, loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=10)

    def bar(self, colours: Colormap, scale: Normalize, label: str, patches: Sequence[Patch]) -> None:
        """A bar of colours beside the axes, below a legend if there are patches."""
        figure: Any = self.axes.figure
        beside = self.axes.inset_axes((1.02, 0.0, 0.04, 0.85 if patches else 1.0))
        figure.colorbar(ScalarMappable(scale, colours), cax=beside, label=label)
        if patches:
            self.key(patches)


# --- a terrain ----------------------------------------------------------------------------------------------------


def draw_terrain(terrain: Terrain, path: Path, title: str) -> None:
    """Elevation, photo, classes and cost, two by two."""
    level = level_of(terrain, MOST_CELLS)
    grid = level.grid
    ratio = min(max(grid.rows / grid.cols, 0.3), 3.0)
    wide_in, high_in = (_PANEL_IN, _PANEL_IN * ratio) if ratio <= 1 else (_PANEL_IN / ratio, _PANEL_IN)
    with saved(path, (2 * wide_in + 4.2, 2 * high_in + 1.9), layout="constrained") as figure:
        panels = figure.subplots(2, 2).reshape(-1)
        names = ("elevation", "photo", "classes", _name_of_cost(terrain))
        elevation, photo, classes, cost = (
            MapAxes.of(axes, level, name) for axes, name in zip(panels, names, strict=True)
        )
        _elevation(elevation)
        photo.show(level.photo)
        size = (grid.cols * grid.resolution_m / photo.unit_m, grid.rows * grid.resolution_m / photo.unit_m)
        _classes(classes)
        _cost(cost, terrain)
        facts = (
            f"{terrain.grid.rows} x {terrain.grid.cols} cells of {terrain.grid.resolution_m:g} m,"
            f" {size[0]:.4g} x {size[1]:.4g} {photo.unit}"
        )
        coarse = "" if level.side == 1 else f"; a pixel shows {level.side} x {level.side} cells"
        figure.suptitle(f"{title}\n{facts}{coarse}", x=0.01, ha="left", fontsize=13)


def _elevation(panel: MapAxes) -> None:
    heights = panel.level.elevation_m
    known = np.isfinite(heights)
    low, high = (float(heights[known].min()), float(heights[known].max())) if known.any() else (0.0, 1.0)
    scale = Normalize(low, max(high, low + 1.0))
    image = panel.lit(_HEIGHTS(scale(np.where(known, heights, low))), 0.75)
    image[~known] = to_rgb(_VOID)
    panel.show(image)
    patches = [] if known.all() else [Patch(color=_VOID, label=f"void {1 - known.mean():.1%}")]
    panel.bar(_HEIGHTS, scale, "metres", patches)


def _classes(panel: MapAxes) -> None:
    colours = TINT / np.float32(255)
    for kind, tint in _CLASS_TINT.items():
        colours[kind] = to_rgb(tint)
    found = panel.level.classes
    panel.show(panel.lit(colours[np.minimum(found, len(colours) - 1)], 0.35))
    shares = np.bincount(found.reshape(-1), minlength=len(TerrainClass)) / found.size
    order = sorted((kind for kind in TerrainClass if shares[kind]), key=lambda kind: -shares[kind])
    panel.key(
        [
            Patch(facecolor=colours[kind], edgecolor="#888", label=f"{kind.name.lower()} {_percent(shares[kind])}")
            for kind in order
        ]
    )


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.095 else f"{share:.1%}" if share >= 0.0005 else "< 0.1%"


def _cost(panel: MapAxes, terrain: Terrain) -> None:
    level = panel.level
    driven = np.isfinite(level.pace_s_per_m)
    paces = level.pace_s_per_m[driven]
    low, high = (float(value) for value in np.percentile(paces, (0, 99))) if paces.size else (0.0, 1.0)
    scale = Normalize(low, max(high, low * 1.01))
    colours = panel.lit(_PACES(scale(np.where(driven, level.pace_s_per_m, low))), 0.3)
    # A partly lethal pixel is tinted in part, so that walls thinner than a pixel are seen.
    share = np.sqrt(np.where(driven, level.lethal_share, np.float32(1)))[..., None]
    panel.show(colours * (1 - share) + np.array(to_rgb(_LETHAL), np.float32) * share)
    lethal = Patch(color=_LETHAL, label=f"lethal {level.lethal_share.mean():.1%}")
    panel.bar(_PACES, scale, "seconds per metre", [lethal])


def _name_of_cost(terrain: Terrain) -> str:
    climb = terrain.climb
    if climb is None:
        return "cost"
    level = "ground" if climb.wind is None else "flight"
    return f"cost of level {level} (steps cost by their climb{' and the wind' if climb.windy else ''} too)"


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
        panel = MapAxes.of(above, level, title)
        share = level.lethal_share[..., None]
        ground, lethal = (np.array(rgb, np.float32) for rgb in ((0.93, 0.90, 0.82), (0.36, 0.27, 0.46)))
        panel.show(panel.lit(ground * (1 - share) + lethal * share, 0.65))
        along, down = (
            (xy_m[0] - terrain.grid.west_m) / panel.unit_m,
            (terrain.grid.north_m - xy_m[1]) / panel.unit_m,
        )
        above.plot(along, down, color="white", linewidth=3.6)
        above.plot(along, down, color=RED, linewidth=1.8)
        for n, label in ((0, "from"), (-1, "to")):
            above.plot(along[n], down[n], "o", color=RED, markeredgecolor="white", markersize=7)
            above.annotate(
                label, (along[n], down[n]), xytext=(7, 7), textcoords="offset points", weight="bold",
                bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
            )  # fmt: skip
        at = at_m / panel.unit_m
        below.plot(at, height_m, color=BLUE, linewidth=1.4)
        if np.isfinite(height_m).any():
            below.fill_between(at, np.nanmin(height_m), height_m, color=BLUE, alpha=0.15)
        below.set(xlabel=f"along the route, {panel.unit}", ylabel="height, m", xlim=(0, max(at[-1], 1e-9)))


# --- slope rules --------------------------------------------------------------------------------------------------

_STEEPEST_PERCENT = 60
_MOST_FACTOR = 8.0
_ALIKE = 4.0
"""Vehicles of which one is quicker than another by more are shown on a logarithmic scale."""
_COLOURS = ("#1b6ca8", "#c8553d", "#4f9d69", "#8e6bb0", "#b8860b", "#3a3a3a", "#d48fb0", "#1fa3a3")


def draw_rules(groups: Mapping[str, Sequence[Any]], path: Path) -> None:
    """Pace or speed over slope, a panel for each group: its title and its `slope_rules.Curve`s."""
    slopes = np.linspace(-_STEEPEST_PERCENT, _STEEPEST_PERCENT, 1201)
    with saved(path, (7.5 * len(groups), 5.6), layout="constrained") as figure:
        panels = figure.subplots(1, len(groups), squeeze=False)[0]
        for panel, (title, curves) in zip(panels, groups.items(), strict=True):
            for n, curve in enumerate(curves):
                values = curve.at(slopes)
                values[~np.isfinite(values) | (values == 0)] = np.nan
                panel.plot(slopes, values, "-" if n % 8 < 4 else "--", color=_COLOURS[n % 8], label=curve.name)
            panel.set_title(title)
            panel.set(xlabel="slope in %, negative is downhill", xlim=(-_STEEPEST_PERCENT, _STEEPEST_PERCENT))
            panel.axvline(0, color="#999", linewidth=0.8)
            speeds = [curve.cost.flat_speed_m_per_s for curve in curves]
            if curves[0].unit == "factor":
                panel.set(ylabel="pace over that of level ground", ylim=(0, _MOST_FACTOR))
                panel.axhline(1, color="#999", linewidth=0.8)
            else:
                panel.set_ylabel("speed on open ground, m/s")
                if max(speeds) < _ALIKE * min(speeds):
                    panel.set_ylim(bottom=0)
                else:
                    panel.set_yscale("log")
                    ticks = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20)
                    panel.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
                    panel.minorticks_off()
            panel.legend()
