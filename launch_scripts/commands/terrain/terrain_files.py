"""What `swarm terrain` writes for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from swarm.errors import TerrainError
from swarm.grid import GridSpec


def write_geotiff(path: Path, bands: list[Any], grid: GridSpec, **profile: Any) -> None:
    """A tiled, compressed GeoTIFF with overviews (its tile pyramid). A terrain without a place gets none.

    Raises TerrainError if it cannot be written.
    """
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.errors import RasterioError
    from rasterio.transform import from_origin

    side = {"tiled": True, "blockxsize": 256, "blockysize": 256} if min(grid.rows, grid.cols) >= 256 else {}
    size = {"height": grid.rows, "width": grid.cols, "count": len(bands), "dtype": bands[0].dtype}
    crs = None if grid.crs == "local" else grid.crs
    where = from_origin(grid.west_m, grid.north_m, grid.resolution_m, grid.resolution_m)
    try:
        with rasterio.open(
            path, "w", driver="GTiff", crs=crs, transform=where, compress="deflate", **side, **size, **profile
        ) as file:
            for number, band in enumerate(bands, 1):
                file.write(band, number)
            factors = [2**n for n in range(1, 8) if max(grid.rows, grid.cols) // 2**n >= 128]
            if factors:
                file.build_overviews(factors, Resampling.nearest)
    except (RasterioError, OSError) as error:
        raise TerrainError(f"cannot write {path}: {error}") from error
