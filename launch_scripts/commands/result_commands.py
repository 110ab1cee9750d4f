"""`swarm runs compare`, `report`, `export` and `replay`: what runs have left."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from launch_scripts.commands.shared_options import AsJson, Force, Runs, duration
from launch_scripts.launcher.console import progress
from launch_scripts.observe.run_folders import SCENARIO_FILE, find_run, read_report
from launch_scripts.plain_text import plain
from launch_scripts.report.compare import LeftRun, circumstances_that_differ, figures, settings_that_differ, text_of
from launch_scripts.typer_commands import command, complete_runs, family_app
from swarm.config.explain import choice
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.errors import ConfigError

if TYPE_CHECKING:
    from launch_scripts.simulation.replay import Replayed

app = family_app("Compare, export and replay finished runs, and write their reports again.")
RunArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN", help="A run's folder, its name in --runs, or LAST.", autocompletion=complete_runs
    ),
]
_ROW = "{:<20} {:>10} {:>8} {:>8} {:>8}  {}"
_SHOWN = 300
"""Characters of an output."""


@command(app)
def compare(
    run: Annotated[list[str], typer.Argument(metavar="RUN...", autocompletion=complete_runs)],
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """Compare runs: settings, versions, machines and metrics.

    Endpoints of a run are left out: free ports differ each time.

    swarm runs compare 20261122-154115-44bb LAST

    run  Folders of runs, or their names in --runs.
    """
    if len(run) < 2:
        raise ConfigError("compare takes two runs or more, such as two folders in runs/")
    found = [_left(name, runs) for name in run]
    settings, made = settings_that_differ(found), circumstances_that_differ(found)
    numbers = figures(found)
    if as_json:
        tables = {"scenario": dict(settings), "made": dict(made), "figures": dict(numbers)}
        typer.echo(json.dumps({"runs": [each.name for each in found], **tables}, indent=2, default=str))
        return
    console = Console(highlight=False)
    for each in found:
        if each.settings is None:
            console.print(Text(plain(f"{each.name} has no {SCENARIO_FILE}: its settings are not known")))
    if not settings:
        console.print("the scenarios are the same")
    for heading, rows in (("setting", settings), ("circumstance", made), ("figure", numbers)):
        table = Table(heading, pad_edge=False)
        for each in found:
            table.add_column(Text(plain(each.name)), justify="right", overflow="fold")
        for label, values in rows:
            table.add_row(Text(plain(label)), *(Text(plain(text_of(label, value))) for value in values))
        if rows:
            console.print(table)


def _left(name: str, runs: Path) -> LeftRun:
    folder = find_run(name, runs)
    report, path = read_report(folder), folder / SCENARIO_FILE
    settings = None
    if path.exists():
        settings = parse_toml(read_text(path, FileKind.SCENARIO), str(path), ConfigError)
    return LeftRun(folder.resolve().name, report, settings)


@command(app)
def report(run: RunArgument = "LAST", runs: Runs = Path("runs")) -> None:
    """Write the report of a run again: report.html, one file for any browser.

    Every run writes it.

    swarm runs report LAST
    """
    from launch_scripts.report.run_page_and_map import write_page

    typer.echo(write_page(find_run(run, runs)))


@command(app)
def export(
    run: RunArgument = "LAST",
    what: list[str] | None = None,
    format: str | None = None,
    out: Path | None = None,
    force: Force = False,
    runs: Runs = Path("runs"),
) -> None:
    """Export a run for a GIS, a spreadsheet or Foxglove.

    Layers: vehicle_tracks and target_tracks with the time of each point, captures, routes with their certified
    gaps, and marks as areas of one kind and pace (docs/gis/routes.md).

    swarm runs export LAST

    swarm runs export LAST --out run.gpkg --what tracks --what marks

    swarm runs export LAST --format mcap

    what    tracks, targets, captures, routes or marks; may be given several times; all by default.
    format  {layers}, without the dot; {several}: one file; mcap: ROS 2 messages.
    out     A file, whose ending is its format, or a folder; by default export/ in the run's folder.
    """
    from launch_scripts.report.run_gis_layers import ENDINGS, WHAT, export_run

    ending = "" if out is None or out.is_dir() else out.suffix.lower().removeprefix(".")
    if ending and ending not in ENDINGS:
        raise ConfigError(
            f"--out: found {out}, expected a folder, or a file with an ending of {', '.join(ENDINGS)}"
        )
    chosen = format or (ending if ending in ENDINGS else ENDINGS[0])
    for option, given, allowed in (("--what", what or (), tuple(WHAT)), ("--format", [chosen], ENDINGS)):
        for each in given:
            if each not in allowed:
                raise ConfigError(f"{option}: found {each!r}{choice(each, tuple(allowed))}")
    if ending in ENDINGS and ending != chosen:
        raise ConfigError(f"--format: found {chosen!r} with --out {out}, expected {ending!r}, or a folder")
    folder = find_run(run, runs)
    with progress(f"exporting {folder}"):
        if chosen == "mcap":
            from launch_scripts.report.mcap_export import export_mcap

            lines = [export_mcap(folder, out, force)]
        else:
            lines = export_run(folder, what or (), chosen, out, force)
    for line in lines:
        typer.echo(line)


@command(app)
def replay(
    run: RunArgument = "LAST",
    process: str | None = None,
    until_s: Annotated[float | None, duration(least_s=0.0)] = None,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> int:
    """Replay recorded inputs of a run, and report the first output that differs.

    swarm demo --record-inputs
    swarm runs replay
    swarm runs replay LAST --process planner-t3 --until-s 34.5

    Simulated runs always record inputs. Exit code 1 if any output differs or a recording cannot be replayed.

    process  Only this process, such as planner-t3.
    until_s  Stop at this time of the run's own clock.
    """
    from launch_scripts.simulation.replay import other_versions, recordings_of, replay_run

    logging.getLogger().addHandler(logging.NullHandler())  # what the processes logged is in their own logs
    folder = find_run(run, runs)
    recordings, refused = recordings_of(folder, process)
    others = {name: two for recorded in recordings for name, two in other_versions(recorded).items()}
    if not as_json:
        for package, (then, now) in others.items():
            typer.echo(f"recorded with {package} {then}, replayed with {now}")
        typer.echo(_ROW.format("process", "generation", "events", "outputs", "seconds", "result"))
    rows: list[Replayed] = []
    for row in replay_run(folder, process, until_s):
        rows.append(row)
        if not as_json:
            typer.echo("\n".join(map(plain, _lines(row))))
    if as_json:
        checked = {"versions": others, "processes": list(map(_fields, rows)), "unreadable": refused}
        typer.echo(json.dumps({"run": str(folder), **checked}, indent=2))
    else:
        outcomes = [row.outcome for row in rows if row.outcome is not None]
        events, outputs = (f"{sum(getattr(each, name) for each in outcomes):,}" for name in ("events", "outputs"))
        same = f"{sum(row.same for row in rows)} of {len(rows)} recordings give the same"
        typer.echo(f"{events} events, {outputs} outputs: {same}")
        for sentence in refused:
            typer.echo(plain(sentence))
    return int(bool(refused) or not all(row.same for row in rows))


def _lines(row: Replayed) -> Iterator[str]:
    """A row of the table, and what explains it."""
    recorded, outcome = row.recorded, row.outcome
    name = (recorded.process, recorded.generation)
    who = "{}, generation {}".format(*name)
    if outcome is None:
        yield _ROW.format(*name, "-", "-", "-", "not replayed")
        yield f"{who}: {row.why}"
        return
    difference = outcome.difference
    if difference is not None:
        result = f"differs at event {difference.event:,}"
    elif outcome.damaged is not None:
        result = "damaged; same until there"
    else:
        result = "same" if outcome.ended == "ended as asked" else f"same ({outcome.ended})"
    yield _ROW.format(*name, f"{outcome.events:,}", f"{outcome.outputs:,}", f"{outcome.seconds:.2f}", result)
    if difference is not None:
        yield f"{who}: event {difference.event:,}, {difference.what}, at {difference.seconds:.2f} s"
        for label, output in (("recorded", difference.recorded), ("replayed", difference.replayed)):
            text = "nothing more" if output is None else output[:_SHOWN]
            yield f"    {label}: {text}{' ...' if output and len(output) > _SHOWN else ''}"
    elif outcome.damaged is not None:
        yield f"{who}: {recorded.path} is {outcome.damaged}"


def _fields(row: Replayed) -> dict[str, Any]:
    recorded = row.recorded
    return {
        "process": recorded.process,
        "generation": recorded.generation,
        "incarnation": recorded.head.incarnation,
        "bytes": recorded.path.stat().st_size,
        "same": row.same,
        "why": row.why,
        **({} if row.outcome is None else dataclasses.asdict(row.outcome)),
    }
