"""The files of `swarm export`: which layers a run has, what they are called, where they go."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from launch_scripts.observe.run_folder import REPORT_FILE, lacks, read_report
from launch_scripts.report.geo.csv_layers import write_csv
from launch_scripts.report.geo.geo_layers import (
    Layer,
    capture_layer,
    marks_of_tracks,
    route_layer,
    track_layers,
    write_layers,
)
from launch_scripts.report.geo.track_file import TRACKS_FILE, RunTracks, read_tracks
from shared_map.terrain.places import MapFrame
from swarm.errors import ConfigError, StoreError

EXPORTED = "export"
"""Folder in a run's folder that exports go to."""
FORMATS = ("geojson", "gpkg", "csv")
Groups = Mapping[str, str]


def _vehicle_tracks(tracks: RunTracks, groups: Groups) -> list[Layer]:
    return [layer for layer in track_layers(tracks, groups) if layer.name.startswith("vehicle")]


def _target_tracks(tracks: RunTracks, groups: Groups) -> list[Layer]:
    return [layer for layer in track_layers(tracks, groups) if layer.name.startswith("target")]


WHAT: Mapping[str, Callable[[RunTracks, Groups], list[Layer]]] = {
    "tracks": _vehicle_tracks,
    "targets": _target_tracks,
    "captures": lambda tracks, _: [capture_layer(tracks)],
    "routes": lambda tracks, _: [route_layer(tracks)],
    "marks": lambda tracks, _: [marks_of_tracks(tracks)],
}
"""What can be exported -> its layers."""


def tracks_of_run(folder: Path) -> RunTracks:
    """Raises ConfigError or StoreError in one sentence."""
    path = folder / TRACKS_FILE
    if not path.exists():
        raise lacks(folder, TRACKS_FILE)
    return read_tracks(path)


def export_run(folder: Path, what: Sequence[str], format: str, out: Path | None, force: bool) -> list[str]:
    """Write layers of a run; returns a line for each file. Raises ConfigError or StoreError in one sentence.

    what    keys of `WHAT`; all if empty
    format  one of `FORMATS`; gpkg is one file, of the others there is one per layer
    out     folder to write to; one in the run's folder by default
    force   replace files that are there
    """
    tracks = tracks_of_run(folder)
    groups = groups_of(read_report(folder)) if (folder / REPORT_FILE).exists() else {}
    layers = [layer for name in WHAT if not what or name in what for layer in WHAT[name](tracks, groups)]
    frame, run = MapFrame(tracks.grid), folder.resolve().name
    if format == "gpkg":
        files = {f"{run}.gpkg": layers}
    else:
        files = {f"{run}-{layer.name}.{format}": [layer] for layer in layers}
    where = free_places(folder, list(files), out, force)
    for path, some in zip(where, files.values(), strict=True):
        if format == "csv":
            try:
                write_csv(path, some[0], frame)
            except OSError as error:
                raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
        else:
            write_layers(path, some, frame)
    return [
        f"{path}: {', '.join(f'{len(layer.features):,} {layer.name}' for layer in some)}"
        for path, some in zip(where, files.values(), strict=True)
    ]


def free_places(folder: Path, names: Sequence[str], out: Path | None, force: bool) -> list[Path]:
    """Where files of these names go. Raises ConfigError before anything is written if one is there already."""
    to = folder / EXPORTED if out is None else out
    if to.exists() and not to.is_dir():
        raise ConfigError(f"--out {to} is a file; expected a folder")
    paths = [to / name for name in names]
    there = [path for path in paths if path.exists()]
    if there and not force:
        raise ConfigError(f"{there[0]} is there already; --force replaces it, --out FOLDER writes elsewhere")
    try:
        to.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"cannot make the folder {to}: {error.strerror or error}") from error
    return paths


def groups_of(report: Mapping[str, Any]) -> dict[str, str]:
    rows = report.get("by_vehicle")
    if not isinstance(rows, dict):
        return {}
    return {id: str(row["group"]) for id, row in rows.items() if isinstance(row, dict) and "group" in row}
