"""`swarm report`: what a run has left, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from launch_scripts.command_line import complete
from launch_scripts.commands.shared_options import Runs

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def _root() -> None:
    """Look at what runs have left."""


@app.command()
def export(
    run: Annotated[
        str, typer.Argument(help="A run's folder, or its name in --runs.", autocompletion=complete.runs)
    ],
    out: Annotated[Path, typer.Option(help="Write .gpkg (layers, in the map's metres) or .geojson (WGS 84).")],
    runs: Runs = Path("runs"),
) -> None:
    """Write the tracks, captures and marks of a run for a GIS.

    Layers: vehicle_tracks and target_tracks (lines, with the time of each point), captures (points), marks
    (polygons of cells that say the same). The times are the property times of a GeoJSON's lines; a GeoPackage has
    points with times, too: vehicle_places and target_places.

    swarm report export runs/LAST --out run.gpkg
    """
    from launch_scripts.report.geo.geo_layers import check_layer_file, track_layers, write_layers
    from launch_scripts.report.geo.track_file import TRACKS_FILE, read_tracks
    from launch_scripts.report.results.run_folder import find_run
    from shared_map.terrain.places import MapFrame
    from swarm.errors import ConfigError

    check_layer_file(out)
    folder = find_run(run, runs)
    path = folder / TRACKS_FILE
    if not path.exists():
        raise ConfigError(f"{folder} has no {TRACKS_FILE}: the run has not ended yet, or its launcher was killed")
    tracks = read_tracks(path)
    layers = track_layers(tracks)
    store = folder / "map.sqlite"
    if store.exists():
        from launch_scripts.commands.map import marks_of

        layers.append(marks_of(store)[1])
    write_layers(out, layers, MapFrame(tracks.grid))
    print(f"{out}: {', '.join(f'{len(layer.features)} {layer.name}' for layer in layers)}")
