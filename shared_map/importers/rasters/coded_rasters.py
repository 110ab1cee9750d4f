"""Rasters whose numbers are no heights: codes of land cover, and heights stored as colours."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from shared_map.importers.cover.land_cover import read_cover
from shared_map.importers.rasters.encoded_heights import TITLES, heights_decoded
from shared_map.importers.rasters.georeference import crs_of, overruled, plan_grid
from shared_map.importers.rasters.raster_contents import Contents, contents_of
from shared_map.importers.rasters.rasters import elevation_of
from shared_map.importers.source import Source
from shared_map.terrain.row_bands import Progress
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError

_METRES = 'LOCAL_CS["image",UNIT["metre",1]]'
"""Where an image without a place lies."""
_HALF_WORLD_M = math.pi * 6_378_137.0
"""Half of the side of the web's map, EPSG:3857."""
_DEEPEST_ZOOM = 24


def of_other_contents(dataset: Any, path: Path, config: TerrainConfig, progress: Progress) -> Source | None:
    """What a raster gives that holds land cover, or heights stored as colours; None if it holds plain heights."""
    holds = contents_of(dataset, f"terrain {path}", config)
    if holds.is_cover:
        return _cover(dataset, path, config, progress)
    return None if holds.encoding is None else _colours(dataset, holds, path, config, progress)


def _cover(dataset: Any, path: Path, config: TerrainConfig, progress: Progress) -> Source:
    """A land-cover map alone: its classes on level ground."""
    crs, transform, placed = _place(dataset, path, config)
    grid, _, notes = plan_grid(
        transform, dataset.height, dataset.width, crs, config.resolution_m, f"terrain {path}"
    )
    cover = read_cover(path, grid, config, progress)
    level = np.zeros((grid.rows, grid.cols), np.float32)
    alone = "there are no heights: the land cover lies on level ground, and slopes cost nothing"
    told = (str(path), *placed, *notes, *cover.notes, alone)
    return Source(grid, level, cover.classes, factor=cover.factor, notes=told)


def _colours(dataset: Any, holds: Contents, path: Path, config: TerrainConfig, progress: Progress) -> Source:
    """Heights stored as colours, decoded in the file's own cells."""
    assert holds.encoding is not None
    known = f"heights are stored as colours, {TITLES[holds.encoding]}, {holds.how}"
    crs, transform, placed = _place(dataset, path, config)
    with heights_decoded(dataset, holds.encoding, path, crs, transform) as (heights, told):
        raster = elevation_of(heights, path, config, progress)
    classes = np.zeros(raster.elevation_m.shape, np.uint8)
    notes = (str(path), known, *placed, *told, *raster.notes)
    return Source(raster.grid, raster.elevation_m, classes, level=raster.level, notes=notes)


def _place(dataset: Any, path: Path, config: TerrainConfig) -> tuple[Any, Any, tuple[str, ...]]:
    """(coordinate system, transform, what people should know of both) of a raster.

    An image without a place lies where its path says if that is the path of a tile of a web map, zoom/x/y.png. Else
    it lies anywhere, in metres.
    """
    import rasterio
    from rasterio.transform import from_origin

    if dataset.crs or not dataset.transform.is_identity:
        crs = crs_of(dataset.crs, config.crs, f"terrain {path}")
        return crs, dataset.transform, overruled(dataset.crs, config.crs)
    tile = re.search(r"(?:^|/)(\d{1,2})/(\d{1,8})/(\d{1,8})(?:@2x)?\.\w+$", path.as_posix())
    if tile is not None and dataset.height == dataset.width and config.crs is None:
        zoom, col, row = (int(number) for number in tile.groups())
        if zoom <= _DEEPEST_ZOOM and max(col, row) < 2**zoom:
            side_m = 2 * _HALF_WORLD_M / 2**zoom
            west, north = -_HALF_WORLD_M + col * side_m, _HALF_WORLD_M - row * side_m
            step_m = side_m / dataset.width
            said = f"placed by its path: tile x {col}, y {row} (from the north) of zoom {zoom} of the web's map"
            return rasterio.CRS.from_epsg(3857), from_origin(west, north, step_m, step_m), (said,)
    if config.resolution_m is None:
        raise TerrainError(f"terrain {path}: an image has no scale; set terrain.resolution_m (metres per pixel)")
    anywhere = from_origin(0.0, 0.0, config.resolution_m, config.resolution_m)
    return rasterio.CRS.from_wkt(_METRES), anywhere, ()
