"""Writes what a run leaves behind: `report.json`, tables, `tracks.npz`, `ground.npz`, pictures, `report.html`."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.palette import image_bytes
from launch_scripts.observe.run_folder import REPORT_FILE, ended
from launch_scripts.observe.run_recorder import Recorder
from launch_scripts.report.npz_files import GROUND_PACE_FILE, TRACKS_FILE, packed_ground, packed_tracks, tracks_in
from shared_map.learning.learned_factors import factors_in, learned_kinds
from shared_map.terrain.terrain import Terrain
from shared_map.terrain.terrain_report import bounds_deg
from swarm.files import write_file

PICTURE_FILE = "report.png"


def make_report(recorder: Recorder, terrain: Terrain, **measured: Any) -> dict[str, Any]:
    """The numbers of a run, its terrain and its course.

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
            **asdict(terrain.grid),
            **bounds_deg(terrain.grid),
            "notes": list(terrain.notes),
        },
        "learned_kinds": [each._asdict() for each in learned_kinds(recorder.observed.learned_words())],
        "series": recorder.series(),
        "distributions": recorder.distributions(),
        "notes": recorder.notes_told(),
    }


def write_report(
    folder: Path,
    report: dict[str, Any],
    recorder: Recorder,
    terrain: Terrain,
    *,
    truth: NDArray[np.float32] | None = None,
) -> None:
    """Writes the files named above. Raises StoreError if the folder cannot be written.

    truth  true pace of every cell, to outline hidden obstacles; None if it is secret or unknown
    """
    report = {**report, **({"made": made} if (made := ended(folder)) else {})}
    from launch_scripts.report import run_page, run_picture  # matplotlib takes a moment

    tracks, factors = packed_tracks(recorder), factors_in(recorder.observed.learned_words())
    ground = run_picture.ground_picture(terrain, recorder.scenario, truth)
    report = {**report, "ground_shows": ground.drawn}
    write_file(folder / REPORT_FILE, json.dumps(report, indent=1, allow_nan=False).encode() + b"\n")
    for section, (file, _) in TABLES.items():
        write_file(folder / file, csv_of(section, report))
    write_file(folder / TRACKS_FILE, tracks)
    write_file(folder / run_picture.GROUND_FILE, image_bytes(ground.pixels, "WEBP"))
    write_file(folder / GROUND_PACE_FILE, packed_ground(terrain, ground.level))
    if (factors != 1).any():
        pixels = run_picture.learned_pixels(terrain, factors)
        write_file(folder / run_picture.LEARNED_FILE, image_bytes(pixels, "PNG"))
    shown = tracks_in(tracks, folder / TRACKS_FILE)
    run_picture.save_picture(folder / PICTURE_FILE, ground, shown, report)
    run_page.write_page(folder)


TABLES = {"by_target": ("targets.csv", "target"), "by_group": ("groups.csv", "group"),
          "by_vehicle": ("vehicles.csv", "vehicle")}  # fmt: skip
"""Section of the report -> its file, and what its first column is called."""


def csv_of(section: str, report: Mapping[str, Any]) -> bytes:
    """One row per target, group or vehicle. Missing values are empty."""
    rows = [flat(id, row) for id, row in report[section].items()]
    columns = list(dict.fromkeys(["id", *(name for row in rows for name in row)]))
    file = io.StringIO()
    writer = csv.DictWriter(file, columns, lineterminator="\n")
    writer.writerow({**dict(zip(columns, columns, strict=True)), "id": TABLES[section][1]})
    writer.writerows(rows)
    return file.getvalue().encode()


def flat(id: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """A row without tables inside: `certified_gap_mean` and so on."""
    values: dict[str, Any] = {"id": id}
    for name, value in row.items():
        if name == "certified_gap":
            values |= {f"{name}_{part}": (value or {}).get(part) for part in ("mean", "p95", "max", "unproven")}
        else:
            values[name] = value
    return values
