"""`report.html`: what a run's folder says, for people, in one file."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, TemplateError

from launch_scripts.observe.alarms import Alarm
from launch_scripts.observe.counts import percent
from launch_scripts.observe.facts import count, duration, fact, grouped, together
from launch_scripts.observe.run_folder import REPORT_FILE, SCENARIO_FILE, read_report, write_file
from launch_scripts.report.geo.track_file import TRACKS_FILE, read_tracks
from launch_scripts.report.page.map_svg import map_parts
from launch_scripts.report.page.theme import themed_svg
from launch_scripts.report.pictures.learned_picture import QUICKER, SLOWER
from launch_scripts.report.pictures.plots import PLOTS, draw_plot
from launch_scripts.report.results.result_tables import TABLES
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
        loader=PackageLoader("launch_scripts.report.page", "templates"),
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
    places: dict[int, str] = {}
    told: list[Alarm] = []
    for row in report.get("alarms") or []:
        alarm = Alarm(row["kind"], row["about"], row["text"], row["since_s"], row["over_s"], target=row["target"])
        places[id(alarm)] = "" if row["row"] is None else f"row {row['row']}, col {row['col']}"
        told.append(alarm)

    def line(alarm: Alarm) -> str:
        parts = (f"{alarm.label}: {alarm.text}", places[id(alarm)], alarm.when)
        return ", ".join(part for part in parts if part)

    groups = [
        (together(group), group[0].serious, [line(alarm) for alarm in group])
        if len(group) > 1
        else (line(group[0]), group[0].serious, [])
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
_TEXTS = ("group", "class", "state_at_end", "target_at_end")


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
    return (count(value) if isinstance(value, int | float) else str(value)), value
