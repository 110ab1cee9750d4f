"""`report.html`: what a run's folder says, for people, in one file."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import matplotlib as mpl
import msgspec
from jinja2 import Environment, PackageLoader, StrictUndefined, TemplateError
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from launch_scripts.observe.fact_table import WELL, count, grouped, left_behind
from launch_scripts.observe.palette import colours_of_groups
from launch_scripts.observe.run_alarms import Alarm
from launch_scripts.observe.run_folder import REPORT_FILE, SCENARIO_FILE, read_report
from launch_scripts.observe.summed_counts import percent
from launch_scripts.report.npz_files import TRACKS_FILE, read_tracks
from launch_scripts.report.plots_and_cards import PLOTS, STYLE, cards, draw_plot, headline
from launch_scripts.report.report_json import TABLES, flat
from launch_scripts.report.run_picture import GROUND_FILE, LEARNED_FILE, QUICKER, SLOWER, draw_map, size_km
from swarm.clock import NS_PER_S
from swarm.config.input_files import FileKind, read_bytes, read_text
from swarm.errors import StoreError
from swarm.files import write_file
from swarm.grid import GridSpec

PAGE_FILE = "report.html"
_NOTES_SHOWN = 400
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
    environment.filters.update(percent=percent, count=count)
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
        verdict=(said := str(report.get("verdict") or "")),
        well=WELL in said,
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
    size = report.get("terrain") or {}
    grid = GridSpec(size.get("rows", 1), size.get("cols", 1), 1.0)
    began = (report.get("made") or {}).get("began")
    began_ns = None if began is None else round(datetime.fromisoformat(began).timestamp() * NS_PER_S)
    told = [replace(each, began_ns=began_ns) for each in msgspec.convert(report.get("alarms") or [], list[Alarm])]
    groups = [
        (line, alarms[0].serious, [each.line(grid) for each in alarms] if len(alarms) > 1 else [])
        for line, alarms in grouped(told, grid)
    ]
    return sorted(groups, key=lambda group: not group[1])


def _table(section: str, heading: str, report: Mapping[str, Any]) -> dict[str, Any]:
    rows = {id: flat(id, row) for id, row in (report.get(section) or {}).items()}
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))[1:]
    shown = list(rows.items())[:_ROWS_SHOWN]
    return {
        "section": section,
        "heading": heading,
        "columns": [name.replace("_", " ") for name in columns],
        "rows": [(id, [_cell(name, row.get(name)) for name in columns]) for id, row in shown],
        "left": len(rows) - len(shown),
    }


def _cell(name: str, value: Any) -> tuple[str, Any]:
    """Its text, and what it is sorted by."""
    if value is None:
        return "–", ""
    if name in ("certified_gap_mean", "certified_gap_p95", "certified_gap_max"):
        return percent(value), value
    return (count(value) if isinstance(value, int | float) else str(value)), value


# --- drawings, as SVG ---------------------------------------------------------------------------------------------


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
