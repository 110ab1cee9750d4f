"""`swarm compare`: what differs between runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from launch_scripts.launcher.console import REPORTED
from launch_scripts.observe.run_folder import SCENARIO_FILE, find_run, read_report
from launch_scripts.plain_text import plain
from launch_scripts.report.compare import (
    LeftRun,
    Row,
    circumstances_that_differ,
    figures,
    remarks,
    settings_that_differ,
    text_of,
)
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.errors import ConfigError


def compare_runs(names: Sequence[str], runs: Path, as_json: bool) -> None:
    """Print what differs between the scenarios of runs, and their figures. Raises ConfigError or StoreError."""
    if len(names) < 2:
        raise ConfigError("compare takes two runs or more, such as two folders in runs/")
    found = [_left(name, runs) for name in names]
    settings, made = settings_that_differ(found), circumstances_that_differ(found)
    numbers = figures(found, REPORTED)
    if as_json:
        sections = {"scenario": settings, "made": made, "figures": numbers}
        told = {name: dict(rows) for name, rows in sections.items()}
        named = {"runs": [run.name for run in found], "remarks": remarks(found)}
        print(json.dumps({**named, **told}, indent=2, default=str))
    else:
        _print(found, settings, made, numbers)


def _print(found: Sequence[LeftRun], settings: list[Row], made: list[Row], numbers: list[Row]) -> None:
    console = Console(highlight=False)
    for run in found:
        if run.settings is None:
            sentence = f"{run.name} has no {SCENARIO_FILE}: its settings are not known"
            console.print(Text(plain(sentence), style="yellow"))
    for sentence in remarks(found):
        console.print(Text(plain(sentence), style="yellow"))
    _show(console, found, "setting", settings)
    if not settings:
        console.print("the scenarios are the same")
    _show(console, found, "version or machine", made)
    _show(console, found, "figure", numbers)


def _show(console: Console, found: Sequence[LeftRun], heading: str, rows: Sequence[Row]) -> None:
    if not rows:
        return
    table = Table(heading, pad_edge=False)
    for run in found:
        table.add_column(Text(plain(run.name)), justify="right", overflow="fold")
    for label, values in rows:
        table.add_row(Text(plain(label)), *(Text(plain(text_of(label, value))) for value in values))
    console.print(table)


def _left(name: str, runs: Path) -> LeftRun:
    folder = find_run(name, runs)
    report = read_report(folder)
    path = folder / SCENARIO_FILE
    settings = None
    if path.exists():
        settings = parse_toml(read_text(path, FileKind.SCENARIO), str(path), ConfigError)
    return LeftRun(folder.resolve().name, report, settings)
