"""Height models as files, for tests of what is read from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from shared_map.arrays import Floats
from shared_map.importers.sources import Source, load_source
from shared_map.terrain.layers import TerrainClass
from swarm.config.ground import TerrainConfig

SIDE = 200


def hills(seed: int, relief_m: float, smooth_cells: float = 12.0) -> Floats:
    """Heights of rounded hills, `relief_m` from the lowest to the highest."""
    rough = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), smooth_cells)
    rough -= rough.min()
    return np.asarray(rough / rough.max() * relief_m, np.float32)


def written(path: Path, heights: Any, dtype: str = "float32", **profile: Any) -> Path:
    import rasterio
    from rasterio.transform import from_origin

    place = {"crs": "EPSG:32632", "transform": from_origin(500_000, 5_000_000, 20, 20), **profile}
    rows, cols = heights.shape
    with rasterio.open(path, "w", driver="GTiff", height=rows, width=cols, count=1, dtype=dtype, **place) as file:
        file.write(heights.astype(dtype), 1)
    return path


def load(path: Path, **keys: Any) -> Source:
    return load_source(TerrainConfig(source=str(path), **keys), seed=1)


def is_water(source: Source) -> Any:
    return source.classes == TerrainClass.WATER
