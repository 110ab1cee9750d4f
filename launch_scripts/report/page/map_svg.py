"""The map of a run as SVG over the picture of its ground: tracks can be pointed at and switched."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from launch_scripts.observe.palette import GROUPS, round_length, said_length
from launch_scripts.report.geo.track_file import RunTracks
from launch_scripts.report.pictures.ground_picture import GROUND_FILE
from launch_scripts.report.pictures.learned_picture import LEARNED_FILE
from launch_scripts.report.pictures.map_picture import (
    Points,
    colours_of_groups,
    group_of,
    in_km,
    mark_overlay,
)
from swarm.config.input_files import FileKind, read_bytes

WIDTH = 1000
"""Units of the drawing across the longer side of the map."""
_MOST_POINTS = 60_000
"""Points of all tracks: more would be slow to look at."""


def map_parts(folder: Path, tracks: RunTracks, report: Mapping[str, Any]) -> dict[str, Any]:
    """What the page's template makes a map of: places in units of the drawing, pictures as data."""
    grid = tracks.grid
    long_km = max(grid.rows, grid.cols) * grid.resolution_m / 1000
    scale = WIDTH / long_km
    samples = sum(len(track.time_ns) for track in (*tracks.vehicles, *tracks.targets))
    step = max(1, -(-samples // _MOST_POINTS))
    groups = colours_of_groups(report)
    vehicles = [
        {
            "id": track.id,
            "group": (group := group_of(track.id, report)),
            "colour": groups.get(group, GROUPS[0]),
            **_drawn(in_km(track, grid) * scale, step),
        }
        for track in tracks.vehicles
        if len(track.time_ns)
    ]
    pieces = [(track.id, in_km(track, grid) * scale) for track in tracks.targets if len(track.time_ns)]
    bar_km = round_length(grid.cols * grid.resolution_m / 5000)
    ground, learned = folder / GROUND_FILE, folder / LEARNED_FILE
    return {
        "width": round(grid.cols * grid.resolution_m / 1000 * scale, 1),
        "height": round(grid.rows * grid.resolution_m / 1000 * scale, 1),
        "ground": data_uri("image/webp", read_bytes(ground, FileKind.RUN)) if ground.exists() else None,
        "learned": data_uri("image/png", read_bytes(learned, FileKind.RUN)) if learned.exists() else None,
        "marks": _png(tracks) if len(tracks.marks.cells) else None,
        "groups": groups,
        "vehicles": vehicles,
        "thin": 1 / max(1.0, len(vehicles) / 60) ** 0.5,
        "targets": [{"id": id, **_drawn(line, step)} for id, line in pieces],
        "last": {id: [round(float(v), 1) for v in line[-1]] for id, line in pieces},
        "captures": [
            {"target": track.id, "place": [round(float(v), 1) for v in in_km(track, grid)[0] * scale]}
            for track in tracks.captures
        ],
        "bar": {"units": round(bar_km * scale, 1), "text": said_length(bar_km * 1000)},
    }


def data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _drawn(line: Points, step: int) -> dict[str, Any]:
    """A path of every step-th point, and those that go straight on left out; where it begins and ends."""
    some = np.concatenate([line[:-1:step], line[-1:]])
    before, after = np.diff(some[:-1], axis=0), np.diff(some[1:], axis=0)
    straight = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) < 0.05 * np.hypot(*before.T)
    kept = np.ones(len(some), np.bool_)
    kept[1:-1] = ~straight
    points = [f"{x:.1f} {y:.1f}" for x, y in some[kept]]
    return {"path": "M" + "L".join(points), "begin": points[0].split(), "end": points[-1].split()}


def _png(tracks: RunTracks) -> str:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(mark_overlay(tracks)).save(file, "PNG", optimize=True)
    return data_uri("image/png", file.getvalue())
