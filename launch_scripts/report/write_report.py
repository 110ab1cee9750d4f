"""Writes what a run leaves behind: `report.json`, tables of its results, `tracks.npz` and `report.png`."""

from __future__ import annotations

import importlib.metadata
import json
import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.report.files import replacing, write_file
from launch_scripts.report.geo.track_file import TRACKS_FILE, packed_tracks
from launch_scripts.report.recorder import Recorder
from launch_scripts.report.results.result_tables import TABLES, csv_of
from launch_scripts.report.results.run_folder import REPORT_FILE, ended
from shared_map.terrain.terrain import Terrain
from shared_map.terrain.terrain_report import bounds_deg
from swarm.errors import StoreError

log = logging.getLogger(__name__)


def make_report(recorder: Recorder, terrain: Terrain, **measured: Any) -> dict[str, Any]:
    """The numbers of a run.

    measured  what the caller knows better than the recorder, as `Recorder.report` takes it
    """
    return with_series(recorder.report(**measured), recorder, terrain)


def with_series(numbers: Mapping[str, Any], recorder: Recorder, terrain: Terrain) -> dict[str, Any]:
    """The numbers of a run, its terrain and its course."""
    return {
        **numbers,
        "version": importlib.metadata.version("terrain-swarm"),
        "terrain": {
            "digest": terrain.digest,
            "rows": terrain.grid.rows,
            "cols": terrain.grid.cols,
            "resolution_m": terrain.grid.resolution_m,
            "west_m": terrain.grid.west_m,
            "north_m": terrain.grid.north_m,
            "crs": terrain.grid.crs,
            **bounds_deg(terrain.grid),
            "notes": list(terrain.notes),
        },
        "series": recorder.series(),
    }


def write_report(
    folder: Path,
    report: dict[str, Any],
    recorder: Recorder,
    terrain: Terrain,
    *,
    truth: NDArray[np.float32] | None = None,
) -> None:
    """Writes what is named above. Raises StoreError if the folder cannot be written.

    truth  true pace of every cell, to outline hidden obstacles; None if it is secret or unknown
    """
    whole = {**report, **({"made": made} if (made := ended(folder)) else {})}
    contents: dict[str, Callable[[], bytes]] = {
        REPORT_FILE: lambda: json.dumps(whole, indent=1, allow_nan=False).encode() + b"\n",
        **{file: partial(csv_of, section, report) for section, (file, _) in TABLES.items()},
        TRACKS_FILE: lambda: packed_tracks(recorder),
    }
    for name, content in contents.items():
        try:
            write_file(folder / name, content())
        except OSError as error:
            raise StoreError(f"cannot write {folder / name}: {error.strerror or error}") from error
    _draw(folder / "report.png", recorder, report, terrain, truth)


def _draw(
    path: Path, recorder: Recorder, report: dict[str, Any], terrain: Terrain, truth: NDArray[np.float32] | None
) -> None:
    from launch_scripts.report.pictures.picture import save_picture  # matplotlib takes a moment

    try:
        with replacing(path) as half:
            save_picture(half, recorder, report, terrain, truth)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
