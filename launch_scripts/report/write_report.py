"""Writes what a run leaves behind: `report.json`, `tracks.npz` and `report.png`."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.report.recorder import Recorder
from launch_scripts.report.track_file import TRACKS_FILE, packed_tracks
from shared_map.terrain.terrain import Terrain
from shared_map.terrain.terrain_report import bounds_deg
from swarm.errors import StoreError

log = logging.getLogger(__name__)


def make_report(recorder: Recorder, terrain: Terrain, **measured: Any) -> dict[str, Any]:
    """The numbers of a run.

    measured  what the caller knows better than the recorder, as `Recorder.report` takes it
    """
    return {
        **recorder.report(**measured),
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
    """Writes `report.json`, the tracks and `report.png`. Raises StoreError if the folder cannot be written.

    truth  true pace of every cell, to outline hidden obstacles; None if it is secret or unknown
    """
    try:
        _write(folder / "report.json", json.dumps(report, indent=1, allow_nan=False).encode() + b"\n")
    except OSError as error:
        raise StoreError(f"cannot write {folder / 'report.json'}: {error.strerror or error}") from error
    try:
        _write(folder / TRACKS_FILE, packed_tracks(recorder))
    except OSError as error:
        raise StoreError(f"cannot write {folder / TRACKS_FILE}: {error.strerror or error}") from error
    _draw(folder / "report.png", recorder, report, terrain, truth)


def _draw(
    path: Path, recorder: Recorder, report: dict[str, Any], terrain: Terrain, truth: NDArray[np.float32] | None
) -> None:
    from launch_scripts.report.picture import save_picture  # matplotlib takes a moment

    try:
        with _replacing(path) as partial:
            save_picture(partial, recorder, report, terrain, truth)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error


def _write(path: Path, content: bytes) -> None:
    with _replacing(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A file to write which then takes the place of another. Half a one is removed: a full disk needs the space."""
    partial = path.with_name(path.name + ".part")
    try:
        yield partial
        partial.replace(path)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
