"""Elevation and photo to cost: time and memory, beside a plain NumPy and rasterio pass over the same files.

Each pass is a process of its own, so that its peak memory is its own; they take turns, and the medians count.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.harness import benchmark, track
from bench.isolated import isolated, status_bytes

RESOLUTION_M = 10.0
RESOLUTION_DEG = 0.0001
PASSES = ("plain", "swarm", "swarm without photo", "swarm with wide vehicles")
WIDE_M = 2.5 * RESOLUTION_M
"""Radius of vehicles larger than a cell: lethal cells are inflated by three cells."""


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
    import rasterio
    from rasterio.transform import from_origin

    from shared_map.terrain.synthetic.landscape import landscape, paint_photo

    elevation_m, classes = landscape(size, size, RESOLUTION_M, size * RESOLUTION_M / 20, seed=1)
    photo = paint_photo(elevation_m, classes, RESOLUTION_M, seed=1)
    step = RESOLUTION_DEG if degrees else RESOLUTION_M
    west, north = (8.0, 47.0) if degrees else (500_000, 5_200_000)
    common: dict[str, Any] = {
        "driver": "GTiff",
        "height": size,
        "width": size,
        "crs": "EPSG:4326" if degrees else "EPSG:32632",
        "transform": from_origin(west, north, step, step),
        "tiled": True,
        "compress": "deflate",
        "zlevel": 1,
    }
    with rasterio.open(folder / "dem.tif", "w", count=1, dtype="float32", **common) as file:
        file.write(elevation_m, 1)
    with rasterio.open(folder / "photo.tif", "w", count=3, dtype="uint8", photometric="rgb", **common) as file:
        file.write(np.moveaxis(photo, 2, 0))


def _plain(folder: Path) -> None:
    """The obvious implementation: read all, numpy.gradient, degrees, a quadratic, a colour threshold."""
    import numpy as np
    import rasterio

    with rasterio.open(folder / "dem.tif") as file:
        elevation_m = file.read(1)
    with rasterio.open(folder / "photo.tif") as file:
        red, green, blue = file.read()
    down, right = np.gradient(elevation_m, RESOLUTION_M)
    slope = np.degrees(np.arctan(np.hypot(down, right)))
    pace = 0.1 * (1 + 5 * (slope / 35) ** 2)
    light = 0.299 * red + 0.587 * green + 0.114 * blue
    pace = np.where((green > red) & (light < 90), pace * 1.8, pace)
    pace[slope > 35] = np.inf
    pace[(blue > 1.2 * red) & (green > 1.02 * red) & (slope < 3)] = np.inf
    assert np.isfinite(pace).any()


def _swarm(folder: Path, name: str) -> None:
    from shared_map.terrain.terrain import build_terrain
    from swarm.config.ground import CostConfig, TerrainConfig
    from swarm.config.scenario import Scenario

    photo = None if name == "swarm without photo" else str(folder / "photo.tif")
    cost = CostConfig(vehicle_radius_m=WIDE_M if name == "swarm with wide vehicles" else 0.0)
    build_terrain(Scenario(terrain=TerrainConfig(source=str(folder / "dem.tif"), photo=photo), cost=cost))


def one_pass(name: str, folder: str) -> dict[str, float]:
    """Time of a pass, without imports and with them, s; and the most memory that this process has taken."""
    started = time.perf_counter()
    import rasterio  # noqa: F401
    import scipy.ndimage  # noqa: F401

    import shared_map.importers.sources  # noqa: F401

    imported, cpu_s = time.perf_counter(), time.process_time()
    if name == "plain":
        _plain(Path(folder))
    else:
        _swarm(Path(folder), name)
    return {
        "seconds": time.perf_counter() - imported,
        "cpu_s": time.process_time() - cpu_s,
        "import_s": imported - started,
        "peak_mb": status_bytes("VmHWM") / 2**20,
    }
