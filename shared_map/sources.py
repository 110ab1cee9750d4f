"""Where elevation, photo and classes come from: built-in terrains and files, put on one square metric grid."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shared_map.layers import Bytes, Floats
from swarm.config import TerrainConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec

JACKSBORO_RESOLUTION_M = 75.0
JACKSBORO_FILE = "jacksboro_fault_dem.npz"
SYNTHETIC_RESOLUTION_M = 30.0
MAX_CELLS = 16384 * 16384


@dataclass(frozen=True, eq=False)
class Source:
    """Everything known about the ground on one grid. A void is a NaN height."""

    grid: GridSpec
    elevation_m: Floats
    classes: Bytes
    photo: Bytes | None = None
    notes: tuple[str, ...] = ()


def load_source(config: TerrainConfig, seed: int) -> Source:
    """Read or make what the scenario names. Raises TerrainError with one sentence."""
    if config.source == "jacksboro":
        return _jacksboro(config, seed)
    if config.source == "synthetic":
        return _synthetic(config, seed)
    raise TerrainError(f"terrain.source {config.source!r}: only jacksboro and synthetic can be read yet")


def _synthetic(config: TerrainConfig, seed: int) -> Source:
    from shared_map.synthetic import cover, synthetic_elevation

    resolution_m = config.resolution_m or SYNTHETIC_RESOLUTION_M
    elevation_m = synthetic_elevation(config.rows, config.cols, config.relief_m, seed)
    grid = GridSpec(config.rows, config.cols, resolution_m)
    classes = cover(elevation_m, resolution_m, seed)
    return Source(grid, elevation_m, classes, notes=(f"synthetic landscape, seed {seed}",))


def _jacksboro(config: TerrainConfig, seed: int) -> Source:
    """The elevation model of the Jacksboro fault that comes with matplotlib (USGS, 3 arc seconds)."""
    from shared_map.synthetic import cover

    path = _jacksboro_path()
    try:
        with np.load(path, allow_pickle=False) as file:
            heights = file["elevation"].astype(np.float32)
            dx_deg, dy_deg = float(file["dx"]), float(file["dy"])
            north_deg, west_deg = float(file["ymin"]), float(file["xmin"])  # matplotlib calls the north ymin
    except (OSError, ValueError, KeyError) as error:
        raise TerrainError(f"{path} cannot be read ({error}); reinstall matplotlib") from error
    middle_deg = north_deg - dy_deg * heights.shape[0] / 2
    per_lat, per_lon = metres_per_degree(middle_deg)
    resolution_m = config.resolution_m or JACKSBORO_RESOLUTION_M
    row_step, col_step = resolution_m / (dy_deg * per_lat), resolution_m / (dx_deg * per_lon)
    rows, cols = int(heights.shape[0] / row_step), int(heights.shape[1] / col_step)
    if rows < 2 or cols < 2:
        raise TerrainError(f"terrain.resolution_m = {resolution_m:g} leaves {rows} x {cols} cells of jacksboro")
    check_size(rows, cols, "jacksboro")
    elevation_m = resample(heights, rows, cols, row_step, col_step)
    lakes = cover(heights, 90.0, seed)
    classes = cover(elevation_m, resolution_m, seed, lakes=False)
    from shared_map.layers import TerrainClass

    at_row = np.clip(((np.arange(rows) + 0.5) * row_step).astype(np.intp), 0, heights.shape[0] - 1)
    at_col = np.clip(((np.arange(cols) + 0.5) * col_step).astype(np.intp), 0, heights.shape[1] - 1)
    classes[(lakes == TerrainClass.WATER)[np.ix_(at_row, at_col)]] = TerrainClass.WATER
    crs = f"+proj=eqc +lat_ts={middle_deg:.6f} +lon_0={west_deg:.6f} +datum=WGS84 +units=m"
    north_m = round(north_deg * per_lat, 3)
    grid = GridSpec(rows, cols, resolution_m, 0.0, north_m, crs)
    notes = (
        "Jacksboro fault, Tennessee: USGS 3 arc seconds, public domain, from matplotlib's sample data",
        f"resampled from {dy_deg * per_lat:.1f} x {dx_deg * per_lon:.1f} m to {resolution_m:g} m, bilinear",
    )
    return Source(grid, elevation_m, classes, notes=notes)


def _jacksboro_path() -> Path:
    # Not matplotlib.cbook.get_sample_data: importing it takes 0.8 s.
    spec = importlib.util.find_spec("matplotlib")
    if spec is None or spec.origin is None:
        raise TerrainError("terrain.source = 'jacksboro' comes with matplotlib, which is not installed")
    path = Path(spec.origin).parent / "mpl-data" / "sample_data" / JACKSBORO_FILE
    if not path.is_file():
        raise TerrainError(f"matplotlib is installed without its sample data: {path} is missing")
    return path


def metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    """Length of one degree of latitude and of longitude on WGS 84, to the millimetre."""
    phi = math.radians(latitude_deg)
    lat = 111132.954 - 559.822 * math.cos(2 * phi) + 1.175 * math.cos(4 * phi)
    lon = 111412.84 * math.cos(phi) - 93.5 * math.cos(3 * phi)
    return round(lat, 3), round(lon, 3)


def check_size(rows: int, cols: int, what: str) -> None:
    if rows * cols > MAX_CELLS:
        raise TerrainError(f"{what} would be {rows} x {cols} cells; set a larger terrain.resolution_m")


def resample(values: Floats, rows: int, cols: int, row_step: float, col_step: float) -> Floats:
    """Bilinear at cell middles, from the same north-west corner; steps are source cells per cell."""
    return _along_rows(_along_rows(values, rows, row_step).T, cols, col_step).T.copy()


def _along_rows(values: Floats, count: int, step: float) -> Floats:
    at = np.clip((np.arange(count) + 0.5) * step - 0.5, 0, values.shape[0] - 1)
    low = np.minimum(at.astype(np.intp), max(values.shape[0] - 2, 0))
    part = (at - low).astype(np.float32)[:, None]
    high = np.minimum(low + 1, values.shape[0] - 1)
    between: Floats = values[low] * (np.float32(1) - part) + values[high] * part
    return between
