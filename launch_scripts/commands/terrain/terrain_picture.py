"""Picture of a terrain: elevation, photo, classes and cost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke

from launch_scripts.observe.palette import hillshade
from shared_map.arrays import Floats
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.pyramid import Level, level_of
from shared_map.terrain.synthetic.landscape import TINT
from shared_map.terrain.terrain import Terrain
from swarm.errors import TerrainError

MOST_CELLS = 1 << 21
"""Most cells of a panel's side; larger terrains are shown by a coarser level of their pyramid."""
_PANEL_IN = 6.6
"""Longer side of a panel, in inches."""
_KEY_IN = 1.7
_DPI = 120
_LETHAL = "#3b1a5a"
_VOID = "#9a9a9a"
# Muted greens to rock to snow. No blue: valleys must not look like lakes.
_HEIGHTS = LinearSegmentedColormap.from_list(
    "heights", ["#6d9a6b", "#a9bd85", "#e3d9a8", "#c9a77c", "#9a7a62", "#b5aaa3", "#ffffff"]
)
_PACES = LinearSegmentedColormap.from_list("paces", ["#fbf7dc", "#f6d27a", "#ee9140", "#cf4a2c", "#7d1626"])
_CLASS_TINT: dict[TerrainClass, str] = {
    TerrainClass.ROAD: "#ffe9b0",
    TerrainClass.BUILT: "#c0625a",
    TerrainClass.SHRUB: "#b3a44e",
    TerrainClass.WETLAND: "#5f9e93",
}
"""Colours of classes which a photo's own colours do not tell apart."""


def draw(terrain: Terrain, path: Path, title: str) -> None:
    """Elevation, photo, classes and cost, two by two; keys stand beside the panels, never on them."""
    level = level_of(terrain, MOST_CELLS)
    shade = hillshade(level.elevation_m, level.grid.resolution_m)
    wide, high = _panel_inches(level)
    figure = Figure(figsize=(2 * (wide + _KEY_IN) + 0.9, 2 * high + 1.85))
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        *(2, 4),
        width_ratios=[wide, _KEY_IN, wide, _KEY_IN],
        left=0.62 / figure.get_figwidth(),
        right=1 - 0.1 / figure.get_figwidth(),
        bottom=0.55 / figure.get_figheight(),
        top=1 - 0.95 / figure.get_figheight(),
        wspace=0.03,
        hspace=0.36 / high,
    )
    places = [(row, col) for row in (0, 1) for col in (0, 2)]
    panels = [figure.add_subplot(grid[row, col]) for row, col in places]
    keys = [figure.add_subplot(grid[row, col + 1]) for row, col in places]
    _elevation(panels[0], keys[0], level, shade)
    _photo(panels[1], keys[1], level)
    _classes(panels[2], keys[2], level, shade)
    _cost(panels[3], keys[3], terrain, level, shade)
    for number, panel in enumerate(panels):
        _frame(panel, level, below=number > 1, left=number % 2 == 0)
    for key in keys:
        key.set_axis_off()
    left, inch = 0.62 / figure.get_figwidth(), 1 / figure.get_figheight()
    figure.text(left, 1 - 0.15 * inch, title, fontsize=15, weight="bold", va="top")
    figure.text(left, 1 - 0.44 * inch, _facts(terrain, level), fontsize=10, va="top", color="#555")
    try:
        figure.savefig(path, dpi=_DPI)
    except (OSError, ValueError) as error:
        raise TerrainError(f"cannot write the picture {path}: {error}") from error


def _panel_inches(level: Level) -> tuple[float, float]:
    """(width, height) in the terrain's proportions, with a least breadth."""
    ratio = min(max(level.grid.rows / level.grid.cols, 0.3), 3.0)
    return (_PANEL_IN, _PANEL_IN * ratio) if ratio <= 1 else (_PANEL_IN / ratio, _PANEL_IN)


def _facts(terrain: Terrain, level: Level) -> str:
    grid = terrain.grid
    unit, name = _unit(level)
    facts = (
        f"{grid.rows} x {grid.cols} cells of {grid.resolution_m:g} m,"
        f" {grid.cols * grid.resolution_m / unit:.4g} x {grid.rows * grid.resolution_m / unit:.4g} {name}"
    )
    return facts if level.side == 1 else f"{facts}; a pixel shows {level.side} x {level.side} cells"


def _unit(level: Level) -> tuple[float, str]:
    longest_m = max(level.grid.rows, level.grid.cols) * level.grid.resolution_m
    return (1000.0, "km") if longest_m >= 4000 else (1.0, "m")


def _show(panel: Axes, level: Level, image: Any) -> None:
    unit, _ = _unit(level)
    grid = level.grid
    extent = (0.0, grid.cols * grid.resolution_m / unit, grid.rows * grid.resolution_m / unit, 0.0)
    panel.imshow(image, extent=extent, interpolation="nearest", aspect="equal")


def _frame(panel: Axes, level: Level, *, below: bool, left: bool) -> None:
    _, name = _unit(level)
    panel.tick_params(labelsize=9, color="#888", labelcolor="#444", labelbottom=below, labelleft=left)
    for side in panel.spines.values():
        side.set_color("#888")
    if below:
        panel.set_xlabel(f"east, {name}", fontsize=10)
    if left:
        panel.set_ylabel(f"south, {name}", fontsize=10)


def _named(panel: Axes, name: str) -> None:
    panel.set_title(name, fontsize=12, loc="left", pad=5)


def _lit(colours: Any, shade: Floats, share: float) -> Any:
    """Colours shaded by the relief; `share` is the strength of the shading."""
    light = np.float32(1 - share) + np.float32(share / 0.7) * shade[..., None]
    return np.clip(np.asarray(colours, np.float32)[..., :3] * light, 0, 1)


# --- the panels -------------------------------------------------------------------------------------------------


def _elevation(panel: Axes, key: Axes, level: Level, shade: Floats) -> None:
    heights = level.elevation_m
    known = np.isfinite(heights)
    low, high = (float(heights[known].min()), float(heights[known].max())) if known.any() else (0.0, 1.0)
    scale = Normalize(low, max(high, low + 1.0))
    image = _lit(_HEIGHTS(scale(np.where(known, heights, low))), shade, 0.75)
    image[~known] = to_rgb(_VOID)
    _show(panel, level, image)
    _named(panel, "elevation")
    patches = [] if known.all() else [Patch(color=_VOID, label=f"void {1 - known.mean():.1%}")]
    _bar(key, _HEIGHTS, scale, "metres", patches)


def _photo(panel: Axes, key: Axes, level: Level) -> None:
    _show(panel, level, level.photo)
    _named(panel, "photo")
    _scale_bar(panel, level)
    tail = 1 - 0.6 / _inches_high(key)
    key.annotate(
        "N", xy=(0.14, 1.0), xytext=(0.14, tail), xycoords="axes fraction", ha="center", va="center",
        fontsize=12, arrowprops={"arrowstyle": "-|>", "color": "#333"},
    )  # fmt: skip


def _classes(panel: Axes, key: Axes, level: Level, shade: Floats) -> None:
    colours = TINT / np.float32(255)
    for kind, tint in _CLASS_TINT.items():
        colours[kind] = to_rgb(tint)
    _show(panel, level, _lit(colours[np.minimum(level.classes, len(colours) - 1)], shade, 0.35))
    _named(panel, "classes")
    counts = np.bincount(level.classes.reshape(-1), minlength=len(TerrainClass))
    order = sorted((kind for kind in TerrainClass if counts[kind]), key=lambda kind: -counts[kind])
    names = {kind: f"{kind.name.lower()} {_percent(counts[kind], level)}" for kind in order}
    keys = [Patch(facecolor=colours[kind], edgecolor="#888", label=name) for kind, name in names.items()]
    _legend(key, keys, 1.0)


def _percent(count: int, level: Level) -> str:
    share = count / level.classes.size
    return f"{share:.0%}" if share >= 0.095 else f"{share:.1%}" if share >= 0.0005 else "< 0.1%"


def _cost(panel: Axes, key: Axes, terrain: Terrain, level: Level, shade: Floats) -> None:
    driven = np.isfinite(level.pace_s_per_m)
    paces = level.pace_s_per_m[driven]
    low, high = (float(value) for value in np.percentile(paces, (0, 99))) if paces.size else (0.0, 1.0)
    scale = Normalize(low, max(high, low * 1.01))
    colours = _lit(_PACES(scale(np.where(driven, level.pace_s_per_m, low))), shade, 0.3)
    # A partly lethal pixel is tinted in part, so that walls thinner than a pixel are seen.
    share = np.sqrt(np.where(driven, level.lethal_share, np.float32(1)))[..., None]
    _show(panel, level, colours * (1 - share) + np.array(to_rgb(_LETHAL), np.float32) * share)
    _named(panel, _name_of_cost(terrain))
    lethal = Patch(color=_LETHAL, label=f"lethal {level.lethal_share.mean():.1%}")
    _bar(key, _PACES, scale, "seconds per metre", [lethal], extend="max")


def _name_of_cost(terrain: Terrain) -> str:
    climb = terrain.climb
    if climb is None:
        return "cost"
    level = "ground" if climb.wind is None else "flight"
    return f"cost of level {level} (steps cost by their climb{' and the wind' if climb.windy else ''} too)"


# --- keys -------------------------------------------------------------------------------------------------------


def _bar(
    key: Axes, colours: Colormap, scale: Normalize, label: str, patches: list[Patch], extend: str = "neither"
) -> None:
    bar = key.inset_axes((0.06, 0.0, 0.15, 1 - 0.55 / _inches_high(key) if patches else 1.0))
    colour_bar = key.figure.colorbar(ScalarMappable(scale, colours), cax=bar, extend=extend)
    colour_bar.set_label(label, fontsize=10)
    colour_bar.ax.tick_params(labelsize=9)
    colour_bar.outline.set_edgecolor("#888")
    if patches:
        _legend(key, patches, 1.0)


def _inches_high(key: Axes) -> float:
    figure = key.get_figure(root=True)
    assert figure is not None
    return float(key.get_window_extent().height / figure.get_dpi())


def _legend(key: Axes, patches: list[Patch], top: float) -> None:
    key.legend(
        handles=patches, loc="upper left", bbox_to_anchor=(0.0, top + 0.015), frameon=False, fontsize=10,
        handlelength=1.3, handleheight=1.1, labelspacing=0.5,
    )  # fmt: skip


def _scale_bar(panel: Axes, level: Level) -> None:
    """A bar of 1, 2 or 5 times a power of ten, about a fifth of the width, in the lower left corner."""
    unit, name = _unit(level)
    width, height = (n * level.grid.resolution_m / unit for n in (level.grid.cols, level.grid.rows))
    power = 10.0 ** np.floor(np.log10(width / 5))
    length = next(power * n for n in (5, 2, 1) if power * n <= width / 4)
    x, y = 0.03 * width, height - 0.035 * max(width, height)
    thick = 0.009 * max(width, height)
    for number, colour in enumerate(("black", "white")):
        start = x + number * length / 2
        panel.add_patch(
            Rectangle((start, y - thick), length / 2, thick, facecolor=colour, edgecolor="black", linewidth=0.8)
        )
    text = panel.text(x, y - 1.7 * thick, f"{length:g} {name}", color="white", fontsize=10, weight="bold")
    text.set_path_effects([withStroke(linewidth=2.5, foreground="black")])
