"""`report.html`: what a run's folder says, for people, in one file."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, TemplateError

from launch_scripts.report.files import write_file
from launch_scripts.report.geo.track_file import TRACKS_FILE, read_tracks
from launch_scripts.report.page.map_svg import map_parts
from launch_scripts.report.page.theme import themed_svg
from launch_scripts.report.pictures.plots import PLOTS, draw_plot, duration
from launch_scripts.report.results.certified_gap import percent
from launch_scripts.report.results.result_tables import TABLES
from launch_scripts.report.results.run_folder import REPORT_FILE, SCENARIO_FILE, read_report
from swarm.config.input_files import FileKind, read_text
from swarm.errors import StoreError

PAGE_FILE = "report.html"
_NOTES_SHOWN = 400
_ROWS_SHOWN = 2000


def write_page(folder: Path) -> Path:
    """Write the page of a run from what its folder holds. Raises ConfigError or StoreError in one sentence."""
    report = read_report(folder)
    path = folder / PAGE_FILE
    try:
        text = page_of(folder, report)
    except (TypeError, KeyError, ValueError, AttributeError, IndexError, TemplateError) as error:
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
    notes = list(report.get("notes") or [])
    return environment.get_template(
        "report.html.j2"
    ).render(
        report=report,
        name=folder.resolve().name,
        where=f"{folder.resolve().parent.name}/{folder.resolve().name}",
        cards=_cards(report),
        alarms=alarms(report),
        map=map_parts(folder, read_tracks(tracks), report) if tracks.exists() else None,
        plots=[
            (plot, themed_svg(lambda axes, plot=plot: draw_plot(axes, plot, report, titled=False)))  # type: ignore[misc]
            for plot in PLOTS
        ],
        tables=[_table(section, heading, report) for section, (_, heading) in TABLES.items()],
        notes=notes[-_NOTES_SHOWN:],
        notes_left=max(len(notes) - _NOTES_SHOWN, 0),
        scenario=read_text(scenario, FileKind.SCENARIO) if scenario.exists() else None,
        recording=(folder / "run.rrd").exists(),
    )


def environment_of_pages() -> Environment:
    """Templates that escape all that they are given, and raise where something is missing."""
    environment = Environment(
        loader=PackageLoader("launch_scripts.report.page", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(percent=percent, number=number, when=_when, duration=duration)
    return environment


def number(value: Any) -> str:
    """A figure for people."""
    if value is None:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return f"{value:,.4g}" if isinstance(value, float) and value < 1e4 else f"{value:,.0f}"


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
        _count(report, "captures", "captures", "Times that a vehicle came within capture range of a target."),
        (
            "certified gap, mean",
            percent(gap["mean"]),
            "Routes that vehicles began cost at most so much more than the cheapest that exist: proven, by a lower "
            "bound with each." + (f" {number(unproven)} had none and are not counted." if unproven else ""),
            "",
        ),
        (
            "certified gap, p95",
            percent(gap["p95"]),
            f"Of 100 routes, 95 are proven to be at least as good as this. The worst: {percent(gap['max'])}.",
            "",
        ),
        _never(report, "collisions", "collisions", "Times that two vehicles stood in one cell: none is allowed."),
        _never(report, "lethal_entries", "lethal entries", "Times that a vehicle drove where nothing can drive."),
        _never(report, "lost", "vehicles lost", "At the end, without a route that they could still follow."),
        _count(report, "marks", "marks", "Cells that vehicles found to differ from the map."),
        _count(report, "reroute_requests", "re-route requests", "Times that vehicles asked for another way."),
        _count(report, "routes_served", "routes served", "Answers of all planners to vehicles that asked."),
        _timing(report, "growth_ms", "growing a tree, p50", "All cheapest paths to one target"),
        _timing(report, "route_query_ms", "asking for a route, p50", "From a vehicle's question to the answer"),
        _timing(report, "mark_to_tree_ms", "from mark to tree, p50", "From what a sensor sees to a tree's cost"),
    ]  # fmt: skip


def _count(report: Mapping[str, Any], name: str, label: str, meaning: str) -> Card:
    return label, number(report[name]), meaning, ""


def _never(report: Mapping[str, Any], name: str, label: str, meaning: str) -> Card:
    count = report[name]
    return label, number(count), meaning, "" if count is None else "bad" if count else "good"


def _timing(report: Mapping[str, Any], name: str, label: str, meaning: str) -> Card:
    quantiles = report[name]
    return label, duration(quantiles["p50"]), f"{meaning}; p99 {duration(quantiles['p99'])}.", ""


def alarms(report: Mapping[str, Any]) -> list[str]:
    """What a person should look at, in sentences."""
    tracking = report.get("tracking") or {}
    counted = (
        (report.get("collisions"), "collision", "collisions"),
        (report.get("lethal_entries"), "lethal cell was entered", "lethal cells were entered"),
        (report.get("driven_into"), "body was driven into", "bodies were driven into"),
        (report.get("hit_by_bodies"), "vehicle was hit by a body", "vehicles were hit by bodies"),
        (report.get("lost"), "vehicle is lost at the end", "vehicles are lost at the end"),
        (report.get("stranded"), "vehicle is stranded at the end", "vehicles are stranded at the end"),
        (report.get("restarts"), "process was started again", "processes were started again"),
        (report.get("payloads_dropped"), "message was dropped", "messages were dropped"),
        (tracking.get("lost"), "time that a target lost its tracker", "times that targets lost their trackers"),
    )
    said = [f"{number(count)} {one if count == 1 else many}" for count, one, many in counted if count]
    vehicles, routed = report.get("vehicles"), report.get("vehicles_routed")
    if vehicles and routed is not None and routed < vehicles:
        said.append(f"{number(vehicles - routed)} of {number(vehicles)} vehicles never had a route")
    return said


_COLUMNS = {
    "captures": "captures",
    "vehicles": "vehicles",
    "group": "group",
    "routes": "routes",
    "distance_m": "driven, km",
    "waiting_s": "waited, s",
    "standing_s": "stood, s",
    "gap_mean": "gap, mean",
    "gap_p95": "gap, p95",
    "gap_max": "gap, max",
    "unproven": "unproven",
    "growths": "growths",
    "window_growths": "windows",
    "chased_by_at_end": "chased by, at the end",
    "state_at_end": "at the end",
    "target_at_end": "going for",
}
"""Column -> its heading, in order."""
_TEXTS = ("group", "state_at_end", "target_at_end")


def _table(section: str, heading: str, report: Mapping[str, Any]) -> dict[str, Any]:
    rows = {id: _row(row) for id, row in (report.get(section) or {}).items()}
    columns = [name for name in _COLUMNS if any(name in row for row in rows.values())]
    shown = list(rows.items())[:_ROWS_SHOWN]
    return {
        "section": section,
        "heading": heading,
        "columns": [(_COLUMNS[name], name in _TEXTS) for name in columns],
        "rows": [(id, [_cell(name, row.get(name)) for name in columns]) for id, row in shown],
        "left": len(rows) - len(shown),
    }


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    gap = row.get("certified_gap") or {}
    flat = {name: value for name, value in row.items() if name != "certified_gap"}
    return {
        **flat,
        **{f"gap_{name}": gap.get(name) for name in ("mean", "p95", "max")},
        "unproven": gap.get("unproven"),
    }


def _cell(name: str, value: Any) -> tuple[str, Any]:
    """Its text, and what it is sorted by."""
    if value is None:
        return "–", ""
    if name.startswith("gap_"):
        return percent(value), value
    if name == "distance_m":
        return f"{value / 1000:,.2f}", value
    if name.endswith("_s"):
        return f"{value:,.0f}", value
    return number(value), value
