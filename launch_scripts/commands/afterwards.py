"""Sub-commands about what runs have left: compare, report, export, replay."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.panels import LEFT
from launch_scripts.commands.shared_options import AsJson, Runs

app = typer.Typer()

RunArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN", help="A run's folder, its name in --runs, or LAST.", autocompletion=complete.runs
    ),
]


@app.command(rich_help_panel=LEFT)
def compare(
    run: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN...", help="Folders of runs, or their names in --runs.", autocompletion=complete.runs
        ),
    ],
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """Show what differs between runs: settings, versions and machines, and all figures beside each other.

    Where a run listened is left out: free ports differ each time.

    swarm compare 20261122-154115-44bb LAST
    """
    from launch_scripts.commands.compare import compare_runs

    compare_runs(run, runs, as_json)


@app.command(rich_help_panel=LEFT)
def report(run: RunArgument = "LAST", runs: Runs = Path("runs")) -> None:
    """Write a run's page again: report.html, one file that opens anywhere without a network.

    It has the run's figures and what they mean, its map, plots over time, tables per target, group and vehicle, the
    scenario as it ran, machine and versions. Every run writes it at its end.

    swarm report LAST
    """
    from launch_scripts.commands.report import write_report_page

    write_report_page(run, runs)


@app.command(rich_help_panel=LEFT)
def export(
    run: RunArgument = "LAST",
    what: Annotated[
        list[str] | None,
        typer.Option(
            help="tracks, targets, captures, routes or marks; may be given several times; all by default.",
            autocompletion=complete.words("launch_scripts.report.run_layers", "WHAT"),
        ),
    ] = None,
    format: Annotated[
        str,
        typer.Option(
            help="geojson, csv or gpx, a file per layer; gpkg or kml, one file with all layers.",
            autocompletion=complete.words("launch_scripts.report.run_layers", "ENDINGS"),
        ),
    ] = "geojson",
    out: Annotated[
        Path | None, typer.Option(help="Folder to write to; by default export/ in the run's folder.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Write a recording with ROS 2 messages instead, for Foxglove.")
    ] = False,
    runs: Runs = Path("runs"),
) -> None:
    """Write what a run has left for a GIS, a spreadsheet or Foxglove.

    Layers: vehicle_tracks and target_tracks with the time of each point, captures, routes that vehicles began with
    their certified gaps, and marks as areas that say the same. GeoJSON and the columns lat and lon of CSV are in
    WGS 84 where the terrain has a place, else in metres of its map; a GeoPackage is in the map's metres.

    swarm export LAST

    swarm export LAST --format gpkg --what tracks --what marks

    swarm export LAST --mcap
    """
    from launch_scripts.commands.report import export_from

    export_from(run, runs, what or (), format, out, force, mcap)


@app.command(rich_help_panel=LEFT)
def replay(
    run: RunArgument = "LAST",
    process: Annotated[str | None, typer.Option(help="Only this process, such as planner-t3.")] = None,
    until: Annotated[
        float | None, typer.Option(min=0, help="Only so many seconds from the start of the run, by its own clock.")
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Copy what is replayed into a folder: a test case.")
    ] = None,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """Feed what the processes of a run heard to the services of this build, and say where their outputs first
    differ.

    swarm demo --record-inputs, then swarm replay

    swarm replay LAST --process planner-t3 --until 34.5 --keep my-case

    A simulated run is always recorded. Exit code 1 if any output differs or a recording cannot be replayed.
    """
    from launch_scripts.commands.replay import replay_one

    if not replay_one(run, runs, process, until, keep, as_json):
        raise typer.Exit(1)
