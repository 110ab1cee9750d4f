"""`report.html`: what a run's folder says, for people, in one file."""

from __future__ import annotations

import base64
import datetime
import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, TemplateError
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from launch_scripts.observe import palette
from launch_scripts.observe.counts import percent
from launch_scripts.observe.facts import count, duration, fact, grouped, together
from launch_scripts.observe.palette import GROUPS, STYLE, round_length, said_length
from launch_scripts.observe.run_alarms import Alarm
from launch_scripts.observe.run_folder import REPORT_FILE, SCENARIO_FILE, read_report, write_file
from launch_scripts.report.map_figure import (
    GROUND_FILE,
    LEARNED_FILE,
    QUICKER,
    SLOWER,
    Points,
    colours_of_groups,
    group_of,
    in_km,
    mark_overlay,
)
from launch_scripts.report.run_arrays import TRACKS_FILE, RunTracks, read_tracks
from launch_scripts.report.run_plots import PLOTS, draw_plot
from launch_scripts.report.write_report import TABLES, flat
from swarm.config.input_files import FileKind, read_bytes, read_text
from swarm.errors import StoreError
from swarm.grid import GridSpec

PAGE_FILE = "report.html"
_NOTES_SHOWN = 400
_ROWS_SHOWN = 2000


def write_page(folder: Path) -> Path:
    """Write the page of a run from what its folder holds. Raises ConfigError or StoreError in one sentence."""
    report = read_report(folder)
    path = folder / PAGE_FILE
    try:
        text = page_of(folder, report)
    except (TypeError, KeyError, ValueError, AttributeError, IndexError, ArithmeticError, TemplateError) as error:
        raise StoreError(f"{folder / REPORT_FILE} is damaged: {type(error).__name__}: {error}") from error
    try:
        write_file(path, text.encode())
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    return path


def page_of(folder: Path, report: Mapping[str, Any]) -> str:
    """The page's text. What comes from files is escaped by the template."""
    environment = environment_of_pages()
    tracks = folder / TRACKS_FILE
    scenario = folder / SCENARIO_FILE
    recording = folder / "run.rrd"  # without a byte where the monitor ended before it drew anything
    notes = list(report.get("notes") or [])
    return environment.get_template(
        "report.html.j2"
    ).render(
        report=report,
        name=folder.resolve().name,
        where=f"{folder.resolve().parent.name}/{folder.resolve().name}",
        cards=_cards(report),
        alarms=_alarms(report),
        left_behind=_left_behind(report),
        map=map_parts(folder, read_tracks(tracks), report) if tracks.exists() else None,
        slower=SLOWER,
        quicker=QUICKER,
        plots=[
            (plot, themed_svg(lambda axes, plot=plot: draw_plot(axes, plot, report, titled=False)))  # type: ignore[misc]
            for plot in PLOTS
        ],
        tables=[_table(section, heading, report) for section, (_, heading) in TABLES.items()],
        notes=notes[-_NOTES_SHOWN:],
        notes_left=max(len(notes) - _NOTES_SHOWN, 0),
        scenario=read_text(scenario, FileKind.SCENARIO) if scenario.exists() else None,
        recording=recording.is_file() and recording.stat().st_size > 0,
    )


def environment_of_pages() -> Environment:
    """Templates that escape all that they are given, and raise where something is missing."""
    environment = Environment(
        loader=PackageLoader("launch_scripts.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(percent=percent, count=count, when=_when)
    return environment


def _when(text: str) -> str:
    try:
        return f"{datetime.datetime.fromisoformat(text):%Y-%m-%d %H:%M} UTC"
    except ValueError:
        return text


Card = tuple[str, str, str, str]
"""What a figure is called, the figure, what it means; good, bad or nothing."""


def _cards(report: Mapping[str, Any]) -> list[Card]:
    gap = report["certified_gap"]
    unproven = gap.get("unproven") or 0
    return [
        _of_fact(report, "captures"),
        (
            "certified gap, mean",
            percent(gap["mean"]),
            "Routes that vehicles began cost at most so much more than the cheapest that exist: proven, by a lower "
            "bound with each." + (f" {count(unproven)} had none and are not counted." if unproven else ""),
            "",
        ),
        (
            "certified gap, p95",
            percent(gap["p95"]),
            f"Of 100 routes, 95 are proven to be at least as good as this. The worst: {percent(gap['max'])}.",
            "",
        ),
        _of_fact(report, "collisions", must_be_zero=True),
        _of_fact(report, "lethal_entries", must_be_zero=True),
        _of_fact(report, "marks"),
        _of_fact(report, "reroute_requests"),
        _of_fact(report, "routes_served"),
        _timing(report, "growth_ms", "growing a tree, p50", "All cheapest paths to one target"),
        _timing(report, "route_query_ms", "asking for a route, p50", "From a vehicle's question to the answer"),
        _timing(report, "mark_to_tree_ms", "from mark to tree, p50", "From what a sensor sees to a tree's cost"),
        ("messages/s, mean", count(report["messages_per_s"]), "Of all processes, over the whole run.", ""),
    ]


def _of_fact(report: Mapping[str, Any], name: str, must_be_zero: bool = False) -> Card:
    value, told = report[name], fact(name)
    tone = "" if not must_be_zero or value is None else "bad" if value else "good"
    return told.label, told.text(value), told.meaning, tone


def _timing(report: Mapping[str, Any], name: str, label: str, meaning: str) -> Card:
    quantiles = report[name]
    return label, duration(quantiles["p50"]), f"{meaning}; p99 {duration(quantiles['p99'])}.", ""


def _alarms(report: Mapping[str, Any]) -> list[tuple[str, bool, list[str]]]:
    """What went wrong, the serious first: a line, whether it is serious, and the lines that it stands for."""
    size = report.get("terrain") or {}
    grid = GridSpec(size.get("rows", 1), size.get("cols", 1), 1.0)
    told = [
        Alarm(
            row["kind"], row["about"], row["text"], row["since_s"], row["over_s"],
            None if row["row"] is None else row["row"] * grid.cols + row["col"], row["target"],
        )
        for row in report.get("alarms") or []
    ]  # fmt: skip
    groups = [
        (together(group), group[0].serious, [alarm.line(grid) for alarm in group])
        if len(group) > 1
        else (group[0].line(grid), group[0].serious, [])
        for group in grouped(told)
    ]
    return sorted(groups, key=lambda group: not group[1])


def _left_behind(report: Mapping[str, Any]) -> list[str]:
    """What vehicles did not do, in sentences."""
    said = [
        f"{count(report[name])} of {count(report['vehicles'])} vehicles {words}"
        for name, words in (("lost", "are lost at the end"), ("stranded", "are stranded at the end"))
        if report.get(name)
    ]
    vehicles, routed = report["vehicles"], report.get("vehicles_routed")
    if routed is not None and routed < vehicles:
        said.append(f"{count(vehicles - routed)} of {count(vehicles)} vehicles never had a route")
    return said


_COLUMNS = {
    "captures": "captures",
    "vehicles": "vehicles",
    "group": "group",
    "class": "class",
    "routes": "routes",
    "distance_m": "driven, km",
    "waiting_s": "waited, s",
    "standing_s": "stood, s",
    "certified_gap_mean": "gap, mean",
    "certified_gap_p95": "gap, p95",
    "certified_gap_max": "gap, max",
    "certified_gap_unproven": "unproven",
    "growths": "growths",
    "window_growths": "windows",
    "chased_by_at_end": "chased by, at the end",
    "state_at_end": "at the end",
    "target_at_end": "going for",
}
"""Column -> its heading, in order."""
_TEXTS = ("group", "class", "state_at_end", "target_at_end")


def _table(section: str, heading: str, report: Mapping[str, Any]) -> dict[str, Any]:
    rows = {id: flat(id, row) for id, row in (report.get(section) or {}).items()}
    columns = [name for name in _COLUMNS if any(name in row for row in rows.values())]
    shown = list(rows.items())[:_ROWS_SHOWN]
    return {
        "section": section,
        "heading": heading,
        "columns": [(_COLUMNS[name], name in _TEXTS) for name in columns],
        "rows": [(id, [_cell(name, row.get(name)) for name in columns]) for id, row in shown],
        "left": len(rows) - len(shown),
    }


def _cell(name: str, value: Any) -> tuple[str, Any]:
    """Its text, and what it is sorted by."""
    if value is None:
        return "–", ""
    if name in ("certified_gap_mean", "certified_gap_p95", "certified_gap_max"):
        return percent(value), value
    if name == "distance_m":
        return f"{value / 1000:,.2f}", value
    if name.endswith("_s"):
        return f"{value:,.0f}", value
    return (count(value) if isinstance(value, int | float) else str(value)), value


# --- the map, as SVG over the picture of its ground: tracks can be pointed at and switched ------------------------

WIDTH = 1000
"""Units of the drawing across the longer side of the map."""
_MOST_POINTS = 60_000
"""Points of all tracks: more would be slow to look at."""


def map_parts(folder: Path, tracks: RunTracks, report: Mapping[str, Any]) -> dict[str, Any]:
    """What the page's template makes a map of: places in units of the drawing, pictures as data."""
    grid = tracks.grid
    long_km = max(grid.rows, grid.cols) * grid.resolution_m / 1000
    scale = WIDTH / long_km
    samples = sum(len(track.time_ns) for track in (*tracks.vehicles, *tracks.targets))
    step = max(1, -(-samples // _MOST_POINTS))
    groups = colours_of_groups(report)
    vehicles = [
        {
            "id": track.id,
            "group": (group := group_of(track.id, report)),
            "colour": groups.get(group, GROUPS[0]),
            **_drawn(in_km(track, grid) * scale, step),
        }
        for track in tracks.vehicles
        if len(track.time_ns)
    ]
    pieces = [(track.id, in_km(track, grid) * scale) for track in tracks.targets if len(track.time_ns)]
    bar_km = round_length(grid.cols * grid.resolution_m / 5000)
    ground, learned = folder / GROUND_FILE, folder / LEARNED_FILE
    return {
        "width": round(grid.cols * grid.resolution_m / 1000 * scale, 1),
        "height": round(grid.rows * grid.resolution_m / 1000 * scale, 1),
        "ground": data_uri("image/webp", read_bytes(ground, FileKind.RUN)) if ground.exists() else None,
        "learned": data_uri("image/png", read_bytes(learned, FileKind.RUN)) if learned.exists() else None,
        "marks": _png(tracks) if len(tracks.marks.cells) else None,
        "groups": groups,
        "vehicles": vehicles,
        "thin": 1 / max(1.0, len(vehicles) / 60) ** 0.5,
        "targets": [{"id": id, **_drawn(line, step)} for id, line in pieces],
        "last": {id: [round(float(v), 1) for v in line[-1]] for id, line in pieces},
        "captures": [
            {"target": track.id, "place": [round(float(v), 1) for v in in_km(track, grid)[0] * scale]}
            for track in tracks.captures
        ],
        "bar": {"units": round(bar_km * scale, 1), "text": said_length(bar_km * 1000)},
    }


def data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _drawn(line: Points, step: int) -> dict[str, Any]:
    """A path of every step-th point, and those that go straight on left out; where it begins and ends."""
    some = np.concatenate([line[:-1:step], line[-1:]])
    before, after = np.diff(some[:-1], axis=0), np.diff(some[1:], axis=0)
    straight = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) < 0.05 * np.hypot(*before.T)
    kept = np.ones(len(some), np.bool_)
    kept[1:-1] = ~straight
    points = [f"{x:.1f} {y:.1f}" for x, y in some[kept]]
    return {"path": "M" + "L".join(points), "begin": points[0].split(), "end": points[-1].split()}


def _png(tracks: RunTracks) -> str:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(mark_overlay(tracks)).save(file, "PNG", optimize=True)
    return data_uri("image/png", file.getvalue())


# --- plots, as SVG whose colours follow the page: one drawing, light and dark -------------------------------------

WIDTH_IN, HEIGHT_IN = 4.1, 1.8
_THEMED = {
    palette.INK: "--ink",
    palette.FAINT: "--faint",
    STYLE["axes.edgecolor"]: "--rule",
    STYLE["grid.color"]: "--grid",
    palette.VIOLET: "--violet",
    palette.BLUE: "--blue",
    palette.BLACK: "--black",
    "#ffffff": "--card",
    "#000000": "--ink",
}
"""Colour of a drawing -> the page's variable that takes its place."""
_VARIABLES = {colour.lower(): variable for colour, variable in _THEMED.items()}
_COLOUR = re.compile("|".join(_THEMED), re.IGNORECASE)


def themed_svg(draw: Callable[[Axes], None]) -> Markup:
    """What `draw` draws, as an SVG element. Its text is text; the page says in which font."""
    with mpl.rc_context({**STYLE, "svg.fonttype": "none", "svg.hashsalt": "run"}):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN))
        axes = figure.add_axes((0.125, 0.135, 0.775, 0.7))
        axes.set_facecolor("none")
        draw(axes)
        file = io.StringIO()
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return Markup(themed(file.getvalue()))


def themed(svg: str) -> str:
    """The SVG element of a file, as wide as its place, in the page's colours."""
    element = svg[svg.index("<svg") :]
    head, _, rest = element.partition(">")
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    return _COLOUR.sub(lambda found: f"var({_VARIABLES[found.group().lower()]})", f"{head}>{rest}")
