"""Height models as files, for tests of the readers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from shared_map.array_files import Floats
from shared_map.importers.terrain_sources import Source, load_source
from shared_map.terrain.pace_layers import TerrainClass
from swarm.config.ground import TerrainConfig

SIDE = 200
_SET_LATER = ("scales", "offsets", "units", "colorinterp", "gcps")


def hills(seed: int, relief_m: float, smooth_cells: float = 12.0) -> Floats:
    """Heights of rounded hills, `relief_m` from the lowest to the highest."""
    rough = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), smooth_cells)
    rough -= rough.min()
    return np.asarray(rough / rough.max() * relief_m, np.float32)


def written(path: Path, bands: Any, dtype: str | None = "float32", **profile: Any) -> Path:
    """A raster of a band, (rows, cols), or of several; `dtype` None is that of the array.

    profile  rasterio's, and what it sets later: scales, offsets, units, colorinterp, gcps; `mask`; `colours`, a
             palette; `tags` of the file and `band_tags`
    """
    import rasterio
    from rasterio.transform import from_origin

    bands = (bands if bands.ndim == 3 else bands[None]).astype(dtype or bands.dtype)
    place = {
        "driver": "GTiff",
        "crs": "EPSG:32632",
        "transform": from_origin(500_000, 5_000_000, 20, 20),
        **profile,
    }
    later = {name: place.pop(name) for name in _SET_LATER if name in place}
    mask, colours, tags, of_band = (place.pop(name, None) for name in ("mask", "colours", "tags", "band_tags"))
    shape = dict(zip(("count", "height", "width"), bands.shape, strict=True))
    with rasterio.open(path, "w", dtype=bands.dtype, **shape, **place) as file:
        file.write(bands)
        for name, values in later.items():
            setattr(file, name, values)
        for level, given in ((0, tags), (1, of_band)):
            if given:  # GDAL writes its directory again even for none
                file.update_tags(level, **given)
        if mask is not None:
            file.write_mask(mask)
        if colours is not None:
            file.write_colormap(1, colours)
    return path


def said(notes: Sequence[str], words: str) -> bool:
    return any(words in note for note in notes)


def load(source: Path | str, **keys: Any) -> Source:
    return load_source(TerrainConfig(source=str(source), **keys), seed=1)


def is_water(source: Source) -> Any:
    return source.classes == TerrainClass.WATER
