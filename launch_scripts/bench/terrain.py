"""Elevation and photo to cost: time and memory, beside a plain NumPy and rasterio pass over the same files.

    python -m launch_scripts.bench.terrain --size 4096

Each pass is a process of its own, so that its peak memory is its own; the two alternate, and the medians count.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

RESOLUTION_M = 10.0


def run(size: int = 4096, repeats: int = 3, folder: Path | None = None) -> dict[str, Any]:
    """Measure and return seconds and peak memory of our pass and of the plain one."""
    with tempfile.TemporaryDirectory() as temporary:
        where = folder or Path(temporary)
        _make(where, size)
        passes: dict[str, list[dict[str, float]]] = {"plain": [], "swarm": [], "swarm without photo": []}
        for _ in range(repeats):
            for name, results in passes.items():
                results.append(_alone(name, where))
    report: dict[str, Any] = {
        "size": size,
        "cores": os.cpu_count(),
        "machine": platform.processor() or platform.machine(),
        "python": platform.python_version(),
    }
    for name, results in passes.items():
        report[name] = {
            "seconds": round(statistics.median(result["seconds"] for result in results), 2),
            "cpu_s": round(statistics.median(result["cpu_s"] for result in results), 2),
            "peak_mb": round(max(result["peak_mb"] for result in results)),
            "import_s": round(statistics.median(result["import_s"] for result in results), 2),
        }
    report["ratio"] = round(report["swarm"]["seconds"] / report["plain"]["seconds"], 2)
    report["cpu_ratio"] = round(report["swarm"]["cpu_s"] / report["plain"]["cpu_s"], 2)
    return report


def _alone(name: str, folder: Path) -> dict[str, float]:
    command = [sys.executable, "-m", "launch_scripts.bench.terrain", "--only", name, "--folder", str(folder)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=600)
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result


def _make(folder: Path, size: int) -> None:
    """A synthetic landscape and its photo as tiled, deflated GeoTIFFs."""
    import numpy as np
    import rasterio
    from rasterio.transform import from_origin

    from shared_map.synthetic import landscape, paint_photo

    elevation_m, classes = landscape(size, size, RESOLUTION_M, size * RESOLUTION_M / 20, seed=1)
    photo = paint_photo(elevation_m, classes, RESOLUTION_M, seed=1)
    common: dict[str, Any] = {
        "driver": "GTiff",
        "height": size,
        "width": size,
        "crs": "EPSG:32632",
        "transform": from_origin(500_000, 5_200_000, RESOLUTION_M, RESOLUTION_M),
        "tiled": True,
        "compress": "deflate",
        "zlevel": 1,
    }
    with rasterio.open(folder / "dem.tif", "w", count=1, dtype="float32", **common) as file:
        file.write(elevation_m, 1)
    with rasterio.open(folder / "photo.tif", "w", count=3, dtype="uint8", photometric="rgb", **common) as file:
        file.write(np.moveaxis(photo, 2, 0))


def _plain(folder: Path) -> None:
    """What anybody would write first: read everything, numpy.gradient, degrees, a quadratic, a colour threshold."""
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


def _swarm(folder: Path, photo: bool) -> None:
    from shared_map.terrain import build_terrain
    from swarm.config import Scenario, TerrainConfig

    source = TerrainConfig(source=str(folder / "dem.tif"), photo=str(folder / "photo.tif") if photo else None)
    build_terrain(Scenario(terrain=source))


def _only(name: str, folder: Path) -> None:
    started = time.perf_counter()
    import rasterio  # noqa: F401
    import scipy.ndimage  # noqa: F401

    import shared_map.sources  # noqa: F401

    imported, cpu = time.perf_counter(), time.process_time()
    if name == "plain":
        _plain(folder)
    else:
        _swarm(folder, photo=name == "swarm")
    done = time.perf_counter()
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    cpu_s = time.process_time() - cpu
    print(
        json.dumps({"seconds": done - imported, "cpu_s": cpu_s, "import_s": imported - started, "peak_mb": peak_mb})
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Elevation and photo to cost, beside a plain pass.")
    parser.add_argument("--size", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--only", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.only:
        _only(arguments.only, arguments.folder)
    else:
        print(json.dumps(run(arguments.size, arguments.repeats, arguments.folder), indent=1))


if __name__ == "__main__":
    main()
