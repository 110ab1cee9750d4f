"""How long it takes to a place from everywhere on a terrain: as a raster, and as lines of equal time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from launch_scripts.commands.route_on_terrain import finder_for
from launch_scripts.launcher.options import find_scenario
from shared_map.arrays import Floats
from shared_map.terrain.places import parse_place
from shared_map.terrain.terrain import build_terrain
from swarm.errors import ConfigError, TerrainError
from swarm.grid import GridSpec

_MOST_BANDS = 200


@dataclass(frozen=True, eq=False)
class Reach:
    """cost_to_go_s  float32 (rows, cols), s; inf where there is no way"""

    grid: GridSpec
    cost_to_go_s: Floats

    @property
    def share(self) -> float:
        """Of all cells those from which there is a way."""
        return float(np.isfinite(self.cost_to_go_s).mean())

    def quantiles_s(self) -> tuple[float, float]:
        """(median, longest) of all cells from which there is a way."""
        known = self.cost_to_go_s[np.isfinite(self.cost_to_go_s)]
        return float(np.median(known)), float(known.max())


def reach(source: str, place: str) -> Reach:
    """What driving to a place takes from everywhere. Raises TerrainError or ConfigError with one sentence."""
    scenario = find_scenario(source)
    terrain = build_terrain(scenario)
    cell = parse_place(place, terrain.grid, "--to")
    if terrain.lethal.reshape(-1)[cell]:
        row, col = terrain.grid.row_col(cell)
        raise TerrainError(f"--to is on lethal ground (cell:{row},{col}): nothing leads there")
    return Reach(terrain.grid, finder_for(scenario, terrain, cell).cost_to_go_s())


def write_reach(found: Reach, path: Path, every_s: float) -> None:
    """Write seconds as a GeoTIFF (-1 where there is no way), or areas of equal time as GeoJSON.

    every_s  how far apart in time the lines of the GeoJSON are

    Raises ConfigError on another ending or too many lines, TerrainError if the file cannot be written.
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        from launch_scripts.commands.terrain_files import write_geotiff

        seconds = np.where(np.isfinite(found.cost_to_go_s), found.cost_to_go_s, np.float32(-1))
        write_geotiff(path, [seconds], found.grid, nodata=-1.0)
    elif path.suffix.lower() == ".geojson":
        many = found.quantiles_s()[1] / every_s
        if many > _MOST_BANDS:
            raise ConfigError(f"--every-s {every_s:g} makes {many:.0f} areas, at most {_MOST_BANDS}: ask for fewer")
        collection = {"type": "FeatureCollection", "features": list(_areas(found, every_s))}
        try:
            path.write_text(json.dumps(collection), encoding="utf-8")
        except OSError as error:
            raise TerrainError(f"cannot write {path}: {error.strerror or error}") from error
    else:
        raise ConfigError(f"--out {path}: write .tif or .geojson")


def _areas(found: Reach, every_s: float) -> Iterator[dict[str, Any]]:
    """Areas between lines of equal time, in WGS 84 where the terrain has a place, else in its own metres."""
    import rasterio
    from rasterio.features import shapes
    from rasterio.transform import from_origin
    from rasterio.warp import transform_geom

    from shared_map.terrain.importers.georeference import degrees_of

    grid, known = found.grid, np.isfinite(found.cost_to_go_s)
    bands = np.where(known, np.floor(np.where(known, found.cost_to_go_s, 0) / every_s), -1).astype(np.int32)
    where = from_origin(grid.west_m, grid.north_m, grid.resolution_m, grid.resolution_m)
    system = None if grid.crs == "local" else rasterio.CRS.from_user_input(grid.crs)
    for shape, band in shapes(bands, mask=known, transform=where):
        if system is not None:
            shape = transform_geom(system, degrees_of(system), shape)
        properties = {"from_s": band * every_s, "to_s": (band + 1) * every_s}
        yield {"type": "Feature", "properties": properties, "geometry": shape}
