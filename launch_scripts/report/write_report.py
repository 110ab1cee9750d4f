"""Writes `report.json` and `report.png`."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.report.recorder import Recorder
from shared_map.terrain.terrain import Terrain
from swarm.errors import StoreError

log = logging.getLogger(__name__)


def write_report(
    folder: Path,
    recorder: Recorder,
    terrain: Terrain,
    *,
    truth: NDArray[np.float32] | None = None,
    **measured: Any,
) -> dict[str, Any]:
    """Writes both files and returns the numbers. Raises StoreError if the folder cannot be written.

    truth     true pace of every cell, to outline hidden obstacles; None if it is secret or unknown
    measured  what the caller knows better than the recorder, as `Recorder.report` takes it
    """
    report = {
        **recorder.report(**measured),
        "version": importlib.metadata.version("terrain-swarm"),
        "terrain": {
            "digest": terrain.digest,
            "rows": terrain.grid.rows,
            "cols": terrain.grid.cols,
            "resolution_m": terrain.grid.resolution_m,
            "notes": list(terrain.notes),
        },
        "series": recorder.series(),
    }
    try:
        _write(folder / "report.json", json.dumps(report, indent=1, allow_nan=False).encode() + b"\n")
    except OSError as error:
        raise StoreError(f"cannot write {folder / 'report.json'}: {error.strerror or error}") from error
    _draw(folder / "report.png", recorder, report, terrain, truth)
    return report


def _draw(
    path: Path, recorder: Recorder, report: dict[str, Any], terrain: Terrain, truth: NDArray[np.float32] | None
) -> None:
    from launch_scripts.report.picture import save_picture  # matplotlib takes a moment

    partial = path.with_name(path.name + ".part")
    try:
        save_picture(partial, recorder, report, terrain, truth)
        partial.replace(path)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error


def _write(path: Path, content: bytes) -> None:
    """Replaces a file atomically."""
    partial = path.with_name(path.name + ".part")
    with partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
