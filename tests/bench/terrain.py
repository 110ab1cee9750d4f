"""Elevation and photo to cost: time and memory, beside a plain NumPy and rasterio pass over the same files.

Each pass is a process of its own, so that its peak memory is its own; they take turns, and the medians count.
"""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer
from support.height_models import written

from bench.harness import benchmark, track
from bench.isolated import isolated
from bench.terrain_passes import RESOLUTION_DEG, RESOLUTION_M, one_pass

PASSES = ("plain", "swarm", "swarm without photo", "swarm with wide vehicles")


@benchmark()
def terrain(
    size: Annotated[int, typer.Option(min=64, help="Cells a side.")] = 4096,
    repeats: Annotated[int, typer.Option(min=1, help="Interleaved runs of each pass.")] = 3,
    degrees: Annotated[bool, typer.Option("--degrees", help="Files in degrees, which have to be warped.")] = False,
) -> dict[str, Any]:
    """Elevation and photo to cost: seconds and memory, beside a plain pass.

    ./launch_scripts/bench terrain --json

    Files in degrees are warped onto metres by ours; the plain pass takes them as they are.
    """
    found: dict[str, list[dict[str, float]]] = {name: [] for name in PASSES}
    with tempfile.TemporaryDirectory() as folder:
        _make(Path(folder), size, degrees)
        for _ in track(range(repeats)):
            for name, results in track(found.items()):
                results.append(isolated(one_pass, name, folder))
    rows: list[dict[str, Any]] = [
        {"pass": name, **{key: round(statistics.median(each[key] for each in results), 2) for key in results[0]}}
        for name, results in found.items()
    ]
    plain, ours = rows[:2]
    return {
        "size": size,
        "degrees": degrees,
        "passes": rows,
        "ratio": round(ours["seconds"] / plain["seconds"], 2),
        "cpu_ratio": round(ours["cpu_s"] / plain["cpu_s"], 2),
    }


def _make(folder: Path, size: int, degrees: bool) -> None:
    """A synthetic landscape and its photo as tiled, deflated GeoTIFFs."""
    import numpy as np
    from rasterio.transform import from_origin

    from shared_map.terrain.synthetic import landscape, paint_photo

    elevation_m, classes = landscape(size, size, RESOLUTION_M, size * RESOLUTION_M / 20, seed=1)
    photo = paint_photo(elevation_m, classes, RESOLUTION_M, seed=1)
    step = RESOLUTION_DEG if degrees else RESOLUTION_M
    west, north = (8.0, 47.0) if degrees else (500_000, 5_200_000)
    common: dict[str, Any] = {
        "crs": "EPSG:4326" if degrees else "EPSG:32632",
        "transform": from_origin(west, north, step, step),
        "tiled": True,
        "compress": "deflate",
        "zlevel": 1,
    }
    written(folder / "dem.tif", elevation_m, **common)
    written(folder / "photo.tif", np.moveaxis(photo, 2, 0), "uint8", photometric="rgb", **common)
