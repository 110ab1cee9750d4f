"""The map of a run: its ground, where everything went, what was marked and learned, where targets were captured."""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from launch_scripts.observe import palette
from launch_scripts.observe.palette import hillshade, rgb, round_length, said_length
from launch_scripts.report.run_arrays import RunTracks, Track
from launch_scripts.report.run_plots import halo
from shared_map.arrays import Floats
from shared_map.learning.factors import keys_of
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.pyramid import Level, any_in_blocks, level_of
from shared_map.terrain.terrain import Terrain, build_truth
from shared_map.terrain.zones import zone_mask
from swarm.config.ground import HiddenConfig
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind

_SHOWN_LABELS = 30
_MARK_PIXELS = 1 << 20
_FLIES = "^"
"""Marker of vehicles that fly."""
Points = NDArray[np.float64]


def draw_map(axes: Axes, ground: GroundPicture, tracks: RunTracks, report: Mapping[str, Any]) -> None:
    """Draw a run on axes in kilometres east and south of the north-west corner."""
    grid = tracks.grid
    width_km, height_km = grid.cols * grid.resolution_m / 1000, grid.rows * grid.resolution_m / 1000
    extent = (0.0, width_km, height_km, 0.0)
    axes.imshow(ground.pixels, extent=extent, interpolation="antialiased")
    axes.imshow(mark_overlay(tracks), extent=extent, interpolation="nearest", zorder=2)
    groups = colours_of_groups(report)
    _draw_vehicles(axes, tracks, groups, report)
    _draw_targets(axes, tracks)
    axes.set(xlim=(0, width_km), ylim=(height_km, 0))
    axes.set_aspect("equal", anchor="NW")
    axes.grid(False)
    _draw_coordinates(axes, grid)
    draw_scale_bar(axes, width_km, height_km)
    draw_north(axes)
    handles = _legend(ground, groups, report.get("aloft", ()))
    axes.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0, -0.022), ncol=-(-len(handles) // 2), handlelength=1.5,
        columnspacing=1.4, borderaxespad=0.3, handletextpad=0.5, borderpad=0, labelspacing=0.35,
    )  # fmt: skip


def colours_of_groups(report: Mapping[str, Any]) -> dict[str, str]:
    """Group -> its colour, in the order of the report."""
    return {
        group: palette.GROUPS[n % len(palette.GROUPS)]
        for n, group in enumerate(report.get("by_group") or {"": None})
    }


def group_of(vehicle: str, report: Mapping[str, Any]) -> str:
    """The group of a vehicle; the first where nobody knows it."""
    row = (report.get("by_vehicle") or {}).get(vehicle) or {}
    return str(row.get("group", next(iter(report.get("by_group") or {"": None}), "")))


def in_km(track: Track, grid: GridSpec) -> Points:
    """Kilometres east and south of the north-west corner."""
    return np.stack([track.xy_m[:, 0] - grid.west_m, grid.north_m - track.xy_m[:, 1]], axis=1) / 1000


def mark_overlay(tracks: RunTracks) -> NDArray[np.uint8]:
    """Marked cells, uint8 (rows, cols, 4); of a large grid blocks of cells in which any is marked."""
    grid, marks = tracks.grid, tracks.marks
    side = max(1, math.ceil(math.sqrt(grid.cells / _MARK_PIXELS)))
    rows, cols = -(-grid.rows // side), -(-grid.cols // side)
    overlay = np.zeros((rows * cols, 4), np.uint8)
    row, col = np.divmod(marks.cells, grid.cols)
    blocks, lethal = row // side * cols + col // side, marks.kinds == MarkKind.LETHAL
    for some, colour, alpha in ((~lethal, palette.MARKED_SLOW, 0.85), (lethal, palette.MARKED_LETHAL, 0.95)):
        overlay[blocks[some]] = [round(255 * part) for part in to_rgba(colour, alpha)]
    return overlay.reshape(rows, cols, 4)


def _draw_vehicles(axes: Axes, tracks: RunTracks, groups: Mapping[str, str], report: Mapping[str, Any]) -> None:
    grid = tracks.grid
    thin = 1 / max(1.0, len(tracks.vehicles) / 100) ** 0.5
    members: dict[str, list[Points]] = {group: [] for group in groups}
    for track in tracks.vehicles:
        if len(track.time_ns):
            members.setdefault(group_of(track.id, report), []).append(in_km(track, grid))
    for group, lines in members.items():
        if not lines:
            continue
        colour = groups.get(group, palette.GROUPS[0])
        _draw_strips(axes, lines, colour, 1.1 * thin, 1.9 * thin, zorder=3)
        starts, ends = (np.array([line[n] for line in lines]) for n in (0, -1))
        shape, size = (_FLIES, 46) if group in report.get("aloft", ()) else ("o", 26)
        axes.scatter(
            starts[:, 0], starts[:, 1], s=13 * thin**2, c="white", edgecolors=colour, linewidths=0.8, zorder=4
        )
        axes.scatter(
            ends[:, 0], ends[:, 1], s=size * thin**2, c=colour, marker=shape, edgecolors="white", linewidths=0.7,
            zorder=5,
        )  # fmt: skip


def _draw_targets(axes: Axes, tracks: RunTracks) -> None:
    grid = tracks.grid
    pieces = [(track.id, in_km(track, grid)) for track in tracks.targets if len(track.time_ns)]
    _draw_strips(axes, [line for _, line in pieces], palette.RED, 2.0, 3.6, zorder=6)
    if tracks.captures:
        places = np.concatenate([in_km(track, grid) for track in tracks.captures])
        axes.scatter(
            places[:, 0],
            places[:, 1],
            marker="*",
            s=115,
            c=palette.YELLOW,
            edgecolors=palette.BLACK,
            linewidths=0.7,
            zorder=8,
        )
    last = {id: line[-1] for id, line in pieces}
    for id, (x, y) in last.items():
        axes.scatter([x], [y], marker="D", s=48, c=palette.RED, edgecolors="white", linewidths=1.1, zorder=9)
        if len(last) <= _SHOWN_LABELS:
            _label(axes, id, float(x), float(y), grid)


def _draw_strips(
    axes: Axes, strips: Sequence[Points], colour: str, width: float, casing: float, zorder: int
) -> None:
    strips = [strip for strip in strips if len(strip) > 1]
    for line_colour, line_width, alpha in (("white", casing, 0.6), (colour, width, 1.0)):
        axes.add_collection(
            LineCollection(
                strips,
                colors=line_colour,
                linewidths=line_width,
                alpha=alpha,
                zorder=zorder,
                capstyle="round",
                joinstyle="round",
            )
        )


def _label(axes: Axes, text: str, x: float, y: float, grid: GridSpec) -> None:
    """Annotates beside the place, on the side where the text fits."""
    right = x * 1000 < 0.94 * grid.cols * grid.resolution_m
    below = y * 1000 < 0.04 * grid.rows * grid.resolution_m
    axes.annotate(
        text, (x, y), xytext=(6 if right else -6, -6 if below else 5), textcoords="offset points", fontsize=9,
        fontweight="bold", color=palette.RED, zorder=10, path_effects=halo(), ha="left" if right else "right",
        va="top" if below else "bottom",
    )  # fmt: skip


def _draw_coordinates(axes: Axes, grid: GridSpec) -> None:
    """Degrees along the west and south border, where the terrain has a place."""
    axes.set_xticks([])
    axes.set_yticks([])
    if grid.crs == "local":
        return
    frame = MapFrame(grid)
    side_m = grid.resolution_m
    east_km, south_km = (np.linspace(0, n * side_m / 1000, 200) for n in (grid.cols, grid.rows))
    _, lon = frame.to_degrees(grid.west_m + east_km * 1000, np.full(200, grid.north_m - grid.rows * side_m))
    lat, _ = frame.to_degrees(np.full(200, grid.west_m), grid.north_m - south_km * 1000)
    lon = np.unwrap(lon, period=360)
    for set_ticks, km, degrees, names in (
        (axes.set_xticks, east_km, lon, "EW"),
        (axes.set_yticks, south_km[::-1], lat[::-1], "NS"),
    ):
        low, high = float(degrees.min()), float(degrees.max())
        ticks = [tick for tick in MaxNLocator(4).tick_values(low, high) if low <= tick <= high]
        texts = [_degrees(value, names) for value in ticks]
        set_ticks(np.interp(ticks, degrees, km), texts, fontsize=7.5)
    axes.tick_params(axis="both", length=2.5, width=0.7, pad=2, labelsize=7.5)
    for text in axes.get_yticklabels():
        text.set(rotation=90, va="center")


def _degrees(value: float, names: str) -> str:
    value = (value + 180) % 360 - 180
    return f"{abs(value):.6g}° {names[0] if value >= 0 else names[1]}"


def draw_scale_bar(axes: Axes, width: float, height: float, unit_m: float = 1000.0) -> None:
    """A bar of a round length, about a fifth of the width, in the lower left corner of axes of this size."""
    length = round_length(width / 5)
    x0, y0 = 0.03 * width, height * 0.965
    for colour, width in (("white", 6.0), (palette.INK, 3.0)):
        axes.plot([x0, x0 + length], [y0, y0], color=colour, linewidth=width, solid_capstyle="butt", zorder=11)
    axes.annotate(
        said_length(length * unit_m), (x0, y0), xytext=(0, 5), textcoords="offset points", ha="left",
        fontsize=9.5,
        fontweight="bold", zorder=11, path_effects=halo(),
    )  # fmt: skip


def draw_north(axes: Axes) -> None:
    """An arrow to the north in the upper right corner."""
    axes.annotate(
        "N", xy=(0.968, 0.985), xytext=(0.968, 0.915), xycoords="axes fraction", ha="center", va="center",
        fontsize=10, fontweight="bold", zorder=11, path_effects=halo(),
        arrowprops={"arrowstyle": "-|>,head_width=0.22,head_length=0.45", "color": palette.INK, "linewidth": 1.6,
                    "path_effects": halo()},
    )  # fmt: skip


def _legend(ground: GroundPicture, groups: Mapping[str, str], aloft: Collection[str]) -> list[Any]:
    handles: list[Any] = [
        Line2D([], [], color=colour, linewidth=1.6, marker=_FLIES if group in aloft else "o", markersize=5,
               markerfacecolor=colour, markeredgecolor="white", markeredgewidth=0.6,
               label="vehicle" if len(groups) == 1 else f"vehicle of {group}")
        for group, colour in list(groups.items())[: len(palette.GROUPS)]
    ]  # fmt: skip
    handles += [
        Line2D([], [], color=palette.RED, linewidth=2, marker="D", markersize=6, markeredgecolor="white",
               label="target"),
        Line2D([], [], color="none", marker="*", markersize=12, markerfacecolor=palette.YELLOW,
               markeredgecolor=palette.BLACK, markeredgewidth=0.7, label="capture"),
        Patch(facecolor=palette.MARKED_LETHAL, label="marked lethal"),
        Patch(facecolor=palette.MARKED_SLOW, label="marked slow"),
    ]  # fmt: skip
    of_ground = {
        "hidden": Patch(facecolor="none", edgecolor=palette.BLACK, linestyle=":", label="hidden from the map"),
        "lethal": Patch(facecolor="#8b9097", edgecolor="#d7dbe0", hatch="xxxxx", linewidth=0,
                        label="lethal ground"),
        "forbidden": Patch(facecolor="#5d5d5d", edgecolor=palette.FORBIDDEN, hatch="/////", linewidth=0.8,
                           label="forbidden zone"),
    }  # fmt: skip
    return [*handles, *(patch for name, patch in of_ground.items() if name in ground.drawn)]


# --- the ground ---------------------------------------------------------------------------------------------------

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
        _fill(axes, lethal & ~forbidden, palette.LETHAL_GROUND, 0.45, "xxxx", "#d7dbe0", edge=None)
        _fill(axes, forbidden, palette.BLACK, 0.5, "////", palette.FORBIDDEN, edge=palette.FORBIDDEN)
        _outline(axes, hidden, (("white", 1.9, "-"), (palette.BLACK, 0.8, ":")))
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
        _outline(axes, cells, ((palette.BLACK, 2.4, "-"), (edge, 1.2, "-")))


def _outline(axes: Axes, cells: Bools, strokes: Sequence[tuple[str, float, str]]) -> None:
    if cells.any():
        x, y, padded = _padded(cells)
        for colour, width, style in strokes:
            axes.contour(x, y, padded, levels=[0.5], colors=colour, linewidths=width, linestyles=style)


def _padded(cells: Bools) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
    """Centres of cells and their values, with a border of none, so that areas at the edge are closed."""
    rows, cols = cells.shape
    return np.arange(-1, cols + 1) + 0.5, np.arange(-1, rows + 1) + 0.5, np.pad(cells, 1).astype(np.float32)


# --- what was learned of it ---------------------------------------------------------------------------------------

LEARNED_FILE = "learned.png"
SLOWER, QUICKER = palette.ORANGE, palette.BLUE
_MOST_PIXELS = 1 << 20
_FULL = math.log(4)
"""|ln(factor)| that is drawn as strongly as can be: no factor is beyond 4 or a quarter."""
_WEAKEST, _STRONGEST = 60, 210


def learned_pixels(terrain: Terrain, factors: Floats) -> NDArray[np.uint8]:
    """uint8 (rows, cols, 4): nothing where the prior stands, and where it is lethal. Of a large terrain every n-th
    cell.

    factors  float32 (KEYS,)  of each kind of ground
    """
    grid = terrain.grid
    side = max(1, math.ceil(math.sqrt(grid.cells / _MOST_PIXELS)))
    keys = keys_of(terrain.classes, terrain.elevation_m, grid.resolution_m)[::side, ::side]
    off = np.log(factors)[keys]
    off[np.isinf(np.asarray(terrain.ground_s_per_m)[::side, ::side])] = 0.0
    pixels = np.zeros((*off.shape, 4), np.uint8)
    strength = _WEAKEST + (_STRONGEST - _WEAKEST) * np.minimum(np.abs(off) / _FULL, 1.0)
    for where, colour in ((off > 0, SLOWER), (off < 0, QUICKER)):
        pixels[where, :3] = rgb(colour)
        pixels[where, 3] = strength[where].astype(np.uint8)
    return pixels


def learned_overlay(terrain: Terrain, factors: Floats) -> bytes:
    """`learned_pixels` as PNG."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(learned_pixels(terrain, factors)).save(file, "PNG", optimize=True)
    return file.getvalue()
