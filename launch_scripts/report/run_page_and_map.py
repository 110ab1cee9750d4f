"""The page and the picture of a run, `report.html` and `report.png`, and the map of a run, which both have.

`draw_map` draws the map for both. On the page it is an SVG whose elements are named, so that they can be pressed
and switched: `vehicle:ID`, `target:ID`, `captures`; the one image in it is that of the marks. The page says what a
run's folder holds, in one file.
"""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import msgspec
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, TemplateError
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_erosion

from launch_scripts.observe import palette
from launch_scripts.observe.alarms import Alarm
from launch_scripts.observe.palette import colours_of_groups, format_length, rgb, round_length
from launch_scripts.observe.run_folders import REPORT_FILE, SCENARIO_FILE, read_report
from launch_scripts.observe.run_state import WELL, count, grouped, left_behind
from launch_scripts.observe.summed_counts import percent
from launch_scripts.plain_text import first_of, number_of
from launch_scripts.report.plots_and_figures import PLOTS, STYLE, cards, draw_plot, halo, headline, saved
from launch_scripts.report.report_and_tracks import TABLES, TRACKS_FILE, RunTracks, Track, flat, read_tracks
from launch_scripts.report.run_gis_layers import groups_of
from shared_map.array_files import Bools, Bytes, Floats
from shared_map.learned_factors import keys_of
from shared_map.terrain.terrain import Level, Terrain, any_in_blocks, level_of
from shared_map.terrain.zones import zone_mask
from swarm.config.input_files import FileKind, read_bytes, read_text
from swarm.config.scenario import Scenario
from swarm.errors import StoreError, TerrainError
from swarm.files import write_file
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind

_SHOWN_LABELS = 30
"""Targets up to which the map names each. Chosen, not measured."""
_MOST_PIXELS = 1 << 20
"""Limit for pictures of marks and of learned factors: of a larger grid, blocks of cells."""
_MOST_POINTS = 60_000
"""Points of all tracks: more would be slow to look at."""
Points = NDArray[np.float64]


def size_km(grid: GridSpec) -> tuple[float, float]:
    """Width and height of a map."""
    return grid.cols * grid.resolution_m / 1000, grid.rows * grid.resolution_m / 1000


def draw_map(axes: Axes, tracks: RunTracks, report: Mapping[str, Any]) -> None:
    """Draws a run, but not its ground, on axes in kilometres east and south of the north-west corner."""
    grid = tracks.grid
    width_km, height_km = size_km(grid)
    axes.set(xlim=(0, width_km), ylim=(height_km, 0), aspect="equal")  # first: labels go by them
    if len(tracks.marks.cells):
        axes.imshow(mark_overlay(tracks), extent=(0, width_km, height_km, 0), interpolation="none", zorder=2)
    samples = sum(len(track.time_ns) for track in (*tracks.vehicles, *tracks.targets))
    step = max(1, -(-samples // _MOST_POINTS))
    groups, of_vehicle, labelled = colours_of_groups(report), groups_of(report), set[str]()
    thin = 1 / max(1.0, len(tracks.vehicles) / 100) ** 0.5
    for track in tracks.vehicles:
        group = of_vehicle.get(track.id, next(iter(groups)))
        label = "vehicle" if len(groups) == 1 else f"vehicle of {group}"
        shape = "^" if group in report.get("aloft", ()) else "o"
        colour = groups.get(group, palette.GROUPS[0])
        _draw_track(axes, f"vehicle:{track.id}", in_km(track, grid, step), colour, thin, shape,
                    label=None if label in labelled else label, zorder=3)  # fmt: skip
        labelled.add(label)
    last = {track.id: track for track in tracks.targets if len(track.time_ns)}
    for track in tracks.targets:
        line, is_last = in_km(track, grid, step), track is last.get(track.id)
        named = f"target{untracked(tracks, report)}" if track is next(reversed(last.values()), None) else None
        _draw_track(
            axes, f"target:{track.id}", line, palette.RED, 1.8, "D" if is_last else "", label=named, zorder=6
        )
        if is_last and len(last) <= _SHOWN_LABELS:
            _label(axes, track.id, float(line[-1, 0]), float(line[-1, 1]), width_km)
    places = np.concatenate([np.empty((0, 2)), *(in_km(track, grid) for track in tracks.captures)])
    axes.scatter(
        places[:, 0], places[:, 1], marker="*", s=115, c=palette.YELLOW, edgecolors=palette.BLACK, linewidths=0.7,
        label="capture", zorder=8, gid="captures",
    )  # fmt: skip
    axes.grid(False)
    _draw_scale(axes, width_km, height_km)


def untracked(tracks: RunTracks, report: Mapping[str, Any]) -> str:
    """Names the targets which are not on a map, for its legend; empty if all are there."""
    drawn = {track.id for track in tracks.targets}
    missing = [id for id in report.get("by_target") or () if id not in drawn]
    return f" (not drawn, no tracker: {first_of(missing)})" if missing else ""


def draw_border(axes: Axes, ground: GroundPicture, tracks: RunTracks) -> None:
    """Draws the ground of a map, and a legend below it."""
    width_km, height_km = size_km(tracks.grid)
    axes.imshow(ground.pixels, extent=(0, width_km, height_km, 0), interpolation="antialiased", zorder=1)
    axes.set_anchor("NW")
    axes.set(xticks=[], yticks=[])
    of_ground = {
        "hidden": Patch(facecolor="none", edgecolor=palette.BLACK, linestyle=":", label="hidden from the map"),
        "lethal": Patch(facecolor="#8b9097", edgecolor="#d7dbe0", hatch="xxxxx", label="lethal ground"),
        "forbidden": Patch(facecolor="#5d5d5d", edgecolor=palette.FORBIDDEN, hatch="/////", label="forbidden zone"),
    }
    handles = [
        *axes.get_legend_handles_labels()[0],
        Patch(facecolor=palette.MARKED_LETHAL, label="marked lethal"),
        Patch(facecolor=palette.MARKED_SLOW, label="marked slow"),
        *(patch for name, patch in of_ground.items() if name in ground.drawn),
    ]
    axes.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0, -0.022), ncol=-(-len(handles) // 2), handlelength=1.5,
        columnspacing=1.4, borderaxespad=0.3, handletextpad=0.5, borderpad=0, labelspacing=0.35,
    )  # fmt: skip


def in_km(track: Track, grid: GridSpec, step: int = 1) -> Points:
    """Kilometres east and south of the north-west corner, of every step-th place and the last."""
    xy_m = np.concatenate([track.xy_m[:-1:step], track.xy_m[-1:]])
    return np.stack([xy_m[:, 0] - grid.west_m, grid.north_m - xy_m[:, 1]], axis=1) / 1000


def mark_overlay(tracks: RunTracks) -> Bytes:
    """Marked cells, uint8 (rows, cols, 4); of a large grid blocks of cells in which any is marked."""
    grid, marks = tracks.grid, tracks.marks
    side = max(1, math.ceil(math.sqrt(grid.cells / _MOST_PIXELS)))
    overlay = np.zeros((-(-grid.rows // side), -(-grid.cols // side), 4), np.uint8)
    row, col = np.divmod(marks.cells, grid.cols)
    lethal = marks.kinds == MarkKind.LETHAL
    for some, colour in ((~lethal, palette.MARKED_SLOW), (lethal, palette.MARKED_LETHAL)):
        overlay[row[some] // side, col[some] // side] = (*rgb(colour), 230)
    return overlay


def _draw_track(
    axes: Axes, name: str, line: Points, colour: str, width: float, shape: str, *, label: str | None, zorder: float
) -> None:
    """Draws where something went, and by a shape where it ended."""
    if len(line):
        casing = [withStroke(linewidth=1.8 * width, foreground="white", alpha=0.6)]
        axes.plot(
            *line.T, color=colour, linewidth=1.1 * width, solid_capstyle="round", marker=shape, markevery=[-1],
            markersize=5.5 * width**0.5, markeredgecolor="white", markeredgewidth=0.7, path_effects=casing,
            label=label, gid=name, zorder=zorder,
        )  # fmt: skip


def _label(axes: Axes, text: str, x: float, y: float, width_km: float) -> None:
    """Annotates beside the place, on the side where the text fits; below it at the upper border, and beside another
    label."""
    side, others = 1 if x < 0.94 * width_km else -1, list[Any](axes.texts)
    beside = any(np.hypot(*np.subtract(each.xy, (x, y))) < 0.05 * width_km for each in others)
    below = beside or y < 0.04 * axes.get_ylim()[0]
    axes.annotate(
        text, (x, y), xytext=(6 * side, -6 if below else 5), textcoords="offset points", fontsize=9,
        fontweight="bold", color=palette.RED, zorder=10, path_effects=halo(), ha="left" if side > 0 else "right",
        va="top" if below else "bottom",
    )  # fmt: skip


def _draw_scale(axes: Axes, width_km: float, height_km: float) -> None:
    """A bar of a round length, about a fifth of the width, in the lower left corner; an arrow to the north."""
    length, x0, y0 = round_length(width_km / 5), 0.03 * width_km, 0.965 * height_km
    axes.plot([x0, x0 + length], [y0, y0], color=palette.INK, linewidth=3, path_effects=halo(), zorder=11)
    style: dict[str, Any] = {"fontweight": "bold", "zorder": 11, "path_effects": halo()}
    axes.annotate(format_length(length * 1000), (x0, y0), (0, 5), textcoords="offset points", fontsize=9.5, **style)
    axes.text(0.968, 0.985, "↑\nN", transform=axes.transAxes, ha="center", va="top", fontsize=12, **style)


# --- the ground ---------------------------------------------------------------------------------------------------

GROUND_FILE = "ground.webp"
_LONG_SIDE_PX = 1600
_MOST_CELLS = 1 << 20
"""Cells of the ground that are drawn at most: about as many as the picture has pixels."""
_HATCH_PX, _EDGE_PX = 11, 2
"""Pixels between lines of a hatch, and of an outline. The page draws these 1,600 pixels on some 1,060: lines stay 7
apart, which tells a hatch from a grey, and an outline stays wider than a pixel."""


@dataclass(frozen=True, eq=False)
class GroundPicture:
    """A picture of the ground from its north-west to its south-east corner.

    pixels  uint8 (height, width, 3)
    drawn   layers on it beside the terrain, for a legend: lethal, forbidden, hidden
    level   of the terrain, that was drawn
    """

    pixels: Bytes
    drawn: tuple[str, ...]
    level: Level


def ground_picture(terrain: Terrain, scenario: Scenario, truth: Floats | None) -> GroundPicture:
    """Draws the ground. Areas are darkened and hatched, so that neither a grey print nor a colour-blind eye misses
    them.

    truth  true pace of every cell, to outline hidden obstacles; None if it is secret or unknown
    """
    seen = level_of(terrain, _MOST_CELLS)
    scale = _LONG_SIDE_PX / max(seen.grid.rows, seen.grid.cols)
    size = max(round(seen.grid.cols * scale), 1), max(round(seen.grid.rows * scale), 1)
    photo = np.asarray(Image.fromarray(palette.photo_of(seen)).resize(size, Image.Resampling.BILINEAR), np.float32)
    pixels = photo.copy()
    down, along = np.mgrid[: size[1], : size[0]]
    rising, falling = (down + along) % _HATCH_PX == 0, (down - along) % _HATCH_PX == 0
    forbidden = forbidden_cells(scenario, terrain)
    areas = {
        "lethal": np.isinf(terrain.pace_s_per_m) & ~forbidden,
        "forbidden": forbidden,
        "hidden": hidden_cells(scenario, terrain, truth),
    }
    lethal, forbade, hidden = (
        np.asarray(Image.fromarray(any_in_blocks(cells, seen.side)).resize(size, Image.Resampling.NEAREST), bool)
        for cells in areas.values()
    )
    pixels[lethal] = 0.55 * pixels[lethal] + 0.45 * np.array(rgb(palette.LETHAL_GROUND))
    pixels[lethal & (rising | falling)] = rgb("#d7dbe0")
    pixels[forbade] = 0.5 * photo[forbade] + 0.5 * np.array(rgb(palette.BLACK))
    pixels[_edge_of(forbade) | (forbade & rising)] = rgb(palette.FORBIDDEN)
    pixels[_edge_of(hidden)] = 255
    pixels[_edge_of(hidden) & ((down + along) // 4 % 2 == 0)] = rgb(palette.BLACK)
    return GroundPicture(pixels.astype(np.uint8), tuple(name for name, cells in areas.items() if cells.any()), seen)


def _edge_of(inside: Bools) -> Bools:
    edge: Bools = inside & ~binary_erosion(inside, iterations=_EDGE_PX)
    return edge


def forbidden_cells(scenario: Scenario, terrain: Terrain) -> Bools:
    """Returns the cells that the scenario's zones forbid. Zones of vector files are among lethal cells: reading
    them again takes long."""
    cells = np.zeros(terrain.pace_s_per_m.shape, np.bool_)
    for zone in scenario.cost.zones:
        if zone.kind in ("forbidden", "keep_in") and zone.file is None:
            try:
                cells |= zone_mask(zone, terrain.grid)
            except TerrainError:  # a mask that is not there any more; its cells are lethal all the same
                continue
    return cells & np.isinf(terrain.pace_s_per_m)


def hidden_cells(scenario: Scenario, terrain: Terrain, truth: NDArray[np.float32] | None) -> Bools:
    """Returns the differences between ground truth and the initial map; only lethal ones if whole terrain classes
    are slower or faster in truth, as every meadow would be outlined."""
    if truth is None:
        return np.zeros(terrain.pace_s_per_m.shape, np.bool_)
    hidden: Bools = (truth != terrain.ground_s_per_m) & ~(np.isinf(truth) & np.isinf(terrain.pace_s_per_m))
    if scenario.terrain.hidden.class_factor:
        hidden &= np.isinf(truth)
    return hidden


# --- learned factors ----------------------------------------------------------------------------------------------

LEARNED_FILE = "learned.png"
SLOWER, QUICKER = palette.ORANGE, palette.BLUE
_FULL = math.log(4)
"""|ln(factor)| that is drawn as strongly as can be: no factor is beyond 4 or a quarter."""
_WEAKEST, _STRONGEST = 60, 210
"""Opacities of 255, chosen by eye. The weakest factor is still seen on any ground, and the ground is still seen
through the strongest."""


def learned_pixels(terrain: Terrain, factors: Floats) -> NDArray[np.uint8]:
    """Returns an RGBA picture, uint8 (rows, cols, 4), of the learned factors. Cells are transparent if their factor
    is 1 or the ground is lethal. On a large terrain it has only every n-th row and column.

    factors  float32 (KEYS,), the learned factor of each kind of ground
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


# --- the picture --------------------------------------------------------------------------------------------------

WIDTH_IN, HEIGHT_IN, DPI = 12.8, 9.6, 150
"""1920 x 1440 pixels: as wide as a usual screen."""

_MAP = (0.046, 0.058, 0.552, 0.776)
"""Left, bottom, width and height of the map at most, as shares of the page."""
_BESIDE = ("states", "captures", "gaps", "waiting", "messages", "timings")
"""Plots beside the map; the page of the run has all."""
_PLOTTED = ("certified gap, p95", "messages/s, mean")
"""Figures that a plot beside the map shows: the head of the picture has no room for them."""


def save_picture(path: Path, ground: GroundPicture, tracks: RunTracks, report: dict[str, Any]) -> None:
    """Draws the run and writes it as PNG."""
    with saved(path, (WIDTH_IN, HEIGHT_IN), DPI) as figure:
        _draw_head(figure, report)
        axes = figure.add_axes(_MAP)
        draw_map(axes, tracks, report)
        draw_border(axes, ground, tracks)
        left, width, top, bottom, gap = 0.655, 0.297, 0.818, 0.058, 0.052
        height = (top - bottom - gap * (len(_BESIDE) - 1)) / len(_BESIDE)
        for n, name in enumerate(_BESIDE):
            beside = figure.add_axes((left, top - height - n * (height + gap), width, height))
            draw_plot(beside, next(plot for plot in PLOTS if plot.name == name), report)


def _draw_head(figure: Figure, report: dict[str, Any]) -> None:
    title = f"{number_of(report['vehicles'], 'vehicle')}, {number_of(report['targets'], 'target')}"
    figure.text(0.033, 0.966, title, fontsize=21, fontweight="bold", va="center")
    facts = "   ·   ".join(headline(report, report["run_id"]))
    figure.text(0.033, 0.936, facts, fontsize=9, color=palette.FAINT, va="center")
    for y in (0.918, 0.853):
        figure.add_artist(Line2D([0.033, 0.967], [y, y], color=palette.RULE, linewidth=1))
    tiles = [tile for tile in cards(report) if tile.label not in _PLOTTED]
    widths = [max(len(tile.label), 1.9 * len(tile.text)) + 5 for tile in tiles]
    x, unit = 0.033, 0.95 / sum(widths)
    tones = {"": palette.INK, "good": palette.GREEN, "bad": palette.RED}
    for tile, width in zip(tiles, widths, strict=True):
        figure.text(x, 0.896, tile.text, fontsize=14, fontweight="bold", color=tones[tile.tone], va="center")
        figure.text(x, 0.869, tile.label, fontsize=8, color=palette.FAINT, va="center")
        x += unit * width


# --- the page -----------------------------------------------------------------------------------------------------

PAGE_FILE = "report.html"
_NOTES_SHOWN = 400
"""The newest ones. Chosen, not measured."""
_ROWS_SHOWN = 2000
_MAP_IN = 10.0
"""The longer side of the map."""
_PLOT_IN, _PLOT = (4.1, 1.8), (0.125, 0.135, 0.775, 0.7)
"""Size of a plot, and where its axes are in it."""


def write_page(folder: Path) -> Path:
    """Writes the page of a run from what its folder holds. Raises ConfigError or StoreError in one sentence."""
    report = read_report(folder)
    path = folder / PAGE_FILE
    try:
        text = page_of(folder, report)
    except (TypeError, KeyError, ValueError, AttributeError, IndexError, ArithmeticError, TemplateError) as error:
        raise StoreError(f"{folder / REPORT_FILE} is damaged: {type(error).__name__}: {error}") from error
    write_file(path, text.encode())
    return path


def page_of(folder: Path, report: Mapping[str, Any]) -> str:
    """The page's text. The template escapes all that it is given, and raises where something is missing."""
    environment = Environment(
        loader=PackageLoader("launch_scripts.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(percent=percent, count=count, number_of=number_of)
    scenario = folder / SCENARIO_FILE
    recording = folder / "run.rrd"  # without a byte where the monitor ended before it drew anything
    notes = list(report.get("notes") or [])
    return environment.get_template(
        "report.html.j2"
    ).render(
        report=report,
        name=folder.resolve().name,
        where=f"{folder.resolve().parent.name}/{folder.resolve().name}",
        facts=headline(report, folder.resolve().name),
        cards=cards(report),
        verdict=(verdict := str(report.get("verdict") or "")),
        well=WELL in verdict,
        alarms=_alarms(report),
        left_behind=left_behind(report),
        map=_map(folder, report),
        slower=SLOWER,
        quicker=QUICKER,
        plots=[
            (plot, _svg(_PLOT_IN, _PLOT, lambda axes, plot=plot: draw_plot(axes, plot, report, titled=False)))  # type: ignore[misc]
            for plot in PLOTS
        ],
        tables=[_table(section, heading, report) for section, (_, heading) in TABLES.items()],
        notes=notes[-_NOTES_SHOWN:],
        notes_left=max(len(notes) - _NOTES_SHOWN, 0),
        scenario=read_text(scenario, FileKind.SCENARIO) if scenario.exists() else None,
        recording=recording.is_file() and recording.stat().st_size > 0,
    )


def _alarms(report: Mapping[str, Any]) -> list[tuple[str, bool, list[str]]]:
    """Returns the alarms, the serious first: a line, whether it is serious, and the lines that it summarises."""
    alarms = msgspec.convert(report.get("alarms") or [], list[Alarm])
    return [
        (line, serious, parts)
        for serious in (True, False)
        for line, parts in grouped(each for each in alarms if each.serious == serious)
    ]


def _table(section: str, heading: str, report: Mapping[str, Any]) -> dict[str, Any]:
    rows = {id: flat(id, row) for id, row in (report.get(section) or {}).items()}
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))[1:]
    kept = list(rows.items())[:_ROWS_SHOWN]
    return {
        "section": section,
        "heading": heading,
        "columns": [name.replace("_", " ") for name in columns],
        "rows": [(id, [_cell(name, row.get(name)) for name in columns]) for id, row in kept],
        "left": len(rows) - len(kept),
    }


def _cell(name: str, value: Any) -> tuple[str, Any]:
    """Its text, and what it is sorted by."""
    if value is None:
        return "–", ""
    if name in ("certified_gap_mean", "certified_gap_p95", "certified_gap_max"):
        return percent(value), value
    return (count(value) if isinstance(value, int | float) else str(value)), value


# --- drawings of the page, as SVG ---------------------------------------------------------------------------------


def _map(folder: Path, report: Mapping[str, Any]) -> dict[str, Any] | None:
    """Returns the input of the page's map: a drawing over pictures; None without tracks."""
    if not (folder / TRACKS_FILE).exists():
        return None
    tracks = read_tracks(folder / TRACKS_FILE)
    width_km, height_km = size_km(tracks.grid)
    scale = _MAP_IN / max(width_km, height_km)

    return {
        "svg": _svg(
            (width_km * scale, height_km * scale), (0, 0, 1, 1), lambda axes: draw_map(axes, tracks, report)
        ),
        "groups": colours_of_groups(report),
        "untracked": untracked(tracks, report),
        "marks": len(tracks.marks.cells),
        "ground": _picture(folder / GROUND_FILE, "image/webp"),
        "learned": _picture(folder / LEARNED_FILE, "image/png"),
    }


def _picture(path: Path, kind: str) -> str | None:
    """A file as an address that holds it; None where there is none."""
    if not path.exists():
        return None
    return f"data:{kind};base64,{base64.b64encode(read_bytes(path, FileKind.RUN)).decode()}"


def _svg(
    size_in: tuple[float, float], place: tuple[float, float, float, float], draw: Callable[[Axes], None]
) -> Markup:
    """Returns the drawing of `draw` on axes at a place of a figure, as an SVG element as wide as its place. Its
    text is text, and the page says in which font."""
    with mpl.rc_context(fname=STYLE):
        figure = Figure(figsize=size_in)
        axes = figure.add_axes(place)
        draw(axes)
        file = io.StringIO()
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    head, _, rest = file.getvalue().partition("<svg ")[2].partition(">")
    sized = re.sub(r' (width|height)="[^"]*"', "", f" {head}")
    return Markup(f"<svg{sized}>{rest}")  # matplotlib has escaped what it was given
