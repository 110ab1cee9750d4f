"""Files of shapes for tests of zones: written in any system, painted on a small grid."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from rasterio.warp import transform as to_crs

from shared_map.terrain.zones import paint_zones
from swarm.config.ground import CostConfig, ZoneConfig
from swarm.grid import GridSpec

UTM = GridSpec(40, 50, 10.0, 500_000.0, 5_200_000.0, "EPSG:32632")
OPEN = CostConfig(flat_speed_m_per_s=10.0, road_speed_m_per_s=20.0)


def feature(shape: Any, id: int | str | None = None, **tags: Any) -> dict[str, Any]:
    geometry = None if shape is None else shapely.geometry.mapping(shape)
    found = {"type": "Feature", "properties": tags, "geometry": geometry}
    return found if id is None else found | {"id": id}


def in_crs(shape: Any, grid: GridSpec, crs: str) -> Any:
    """A shape in (column, row) of a grid, its corners in another system."""

    def moved(points: np.ndarray) -> np.ndarray:
        xs, ys = grid.west_m + points[:, 0] * grid.resolution_m, grid.north_m - points[:, 1] * grid.resolution_m
        return np.array((xs, ys) if grid.crs == crs else to_crs(grid.crs, crs, xs, ys)).T

    return shapely.transform(shape, moved)


def geojson(path: Path, features: list[dict[str, Any]], grid: GridSpec = UTM, crs: str = "EPSG:4326") -> str:
    """Writes features, whose shapes are in (column, row) of a grid."""
    for each in features:
        if each["geometry"] is not None:
            each["geometry"] = shapely.geometry.mapping(in_crs(shapely.geometry.shape(each["geometry"]), grid, crs))
    text: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    if crs != "EPSG:4326":
        text["crs"] = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{crs.replace(':', '::')}"}}
    path.write_text(json.dumps(text))
    return str(path)


def written(
    path: Path, shapes: list[Any], crs: str | None, columns: dict[str, list[Any]] | None = None, **given: Any
) -> str:
    """Writes shapes, which are in (column, row) of `UTM`, by the library."""
    from pyogrio.raw import write

    moved = [in_crs(shape, UTM, crs or UTM.crs) for shape in shapes]
    columns = columns or {"n": list(range(len(shapes)))}
    write(
        path,
        geometry=shapely.to_wkb(np.array(moved, object)),
        field_data=[np.array(values) for values in columns.values()],
        fields=list(columns),
        crs=crs,
        geometry_type=given.pop("geometry_type", "Polygon"),
        **given,
    )
    return str(path)


def painted(
    zones: list[ZoneConfig], grid: GridSpec = UTM, ground: float = 0.1, classes: np.ndarray | None = None
) -> tuple[np.ndarray, list[Any]]:
    pace = np.full((grid.rows, grid.cols), ground, np.float32)
    facts = paint_zones(pace, zones, grid, OPEN, classes=classes)
    return pace, facts


def middles(grid: GridSpec = UTM) -> np.ndarray:
    cols, rows = np.meshgrid(np.arange(grid.cols) + 0.5, np.arange(grid.rows) + 0.5)
    return shapely.points(cols, rows)


def squares(grid: GridSpec = UTM) -> np.ndarray:
    cols, rows = np.meshgrid(np.arange(grid.cols), np.arange(grid.rows))
    return shapely.box(cols, rows, cols + 1, rows + 1)
