"""The passes of `bench terrain`, each in a process which imports nothing else: its memory is that of the pass."""

from __future__ import annotations

import time
from pathlib import Path

from bench.isolated import status_bytes

RESOLUTION_M = 10.0
RESOLUTION_DEG = 0.0001
WIDE_M = 2.5 * RESOLUTION_M
"""Radius of vehicles larger than a cell: lethal cells are inflated by three cells."""


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

    import shared_map.importers.terrain_sources  # noqa: F401

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
