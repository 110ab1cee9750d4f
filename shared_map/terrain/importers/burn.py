"""Shapes in cell coordinates become cells: by their middles, or wherever they are touched."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Floats
from shared_map.terrain.importers.on_grid import cells_spanned, widened
from swarm.errors import TerrainError
from swarm.grid import GridSpec, Window

_MOST_BURNT_CELLS = 1 << 34
_HEAVY = 50_000_000
"""Corners times rows of a polygon: GDAL looks at every corner in every row."""
_LINE_TYPES = (0, 1, 2)


@dataclass
class Drawing:
    """Shapes with a value each. Lines and points have a width; lines are never thinner than the cells they pass.

    by_middle  polygons that cover the cells whose middle they contain
    touched    shapes that cover every cell which they touch
    """

    by_middle: list[tuple[Any, float]] = field(default_factory=list)
    touched: list[tuple[Any, float]] = field(default_factory=list)

    def add(self, shape: Any, value: float, width_cells: float, everywhere: bool) -> None:
        """One shape; `everywhere`: areas cover all cells that they touch, not those whose middle they have."""
        is_line = shape.geom_type != "Polygon"
        if is_line:
            self.touched.append((shape, value))
            if width_cells <= 0:
                return
            areas = widened(shape, width_cells / 2)
        else:
            areas = [shape]
        (self.touched if everywhere else self.by_middle).extend((area, value) for area in areas)

    def __bool__(self) -> bool:
        return bool(self.by_middle or self.touched)


def burn(drawing: Drawing, grid: GridSpec, what: str, *, least_wins: bool = False) -> tuple[Window, Floats]:
    """The window of cells around a drawing, and their values, float32, NaN where there is none.

    least_wins  where shapes overlap the least value counts, else the largest

    Raises TerrainError, which `what` begins, if shapes lie upon each other a thousandfold.
    """
    window = _window(drawing, grid, what)
    values = np.full((max(window.row1 - window.row0, 0), max(window.col1 - window.col0, 0)), np.nan, np.float32)
    if window.empty:
        return window, values
    for pairs, everywhere in ((drawing.by_middle, False), (drawing.touched, True)):
        found = _burnt(pairs, window, least_wins, everywhere)
        (np.fmin if least_wins else np.fmax)(values, found, out=values)
    return window, values


def burn_mask(drawing: Drawing, grid: GridSpec, what: str) -> tuple[Window, Bools]:
    """As `burn`, whether there is anything."""
    window, values = burn(drawing, grid, what)
    return window, ~np.isnan(values)


def _window(drawing: Drawing, grid: GridSpec, what: str) -> Window:
    import shapely

    shapes = np.array([shape for shape, _ in (*drawing.by_middle, *drawing.touched)], object)
    if not len(shapes):
        return Window(0, 0, 0, 0)
    if cells_spanned(shapes) > _MOST_BURNT_CELLS:
        raise TerrainError(
            f"{what} lies upon itself too often ({len(shapes)} shapes); dissolve it, or split the file"
        )
    west, north, east, south = shapely.total_bounds(shapes)
    return Window(
        int(np.clip(np.floor(north) - 1, 0, grid.rows)),
        int(np.clip(np.floor(west) - 1, 0, grid.cols)),
        int(np.clip(np.ceil(south) + 1, 0, grid.rows)),
        int(np.clip(np.ceil(east) + 1, 0, grid.cols)),
    )


def _burnt(pairs: list[tuple[Any, float]], window: Window, least_wins: bool, everywhere: bool) -> Floats:
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.features import rasterize
    from rasterio.transform import Affine

    shape = (window.row1 - window.row0, window.col1 - window.col0)
    if not pairs:
        return np.full(shape, np.nan, np.float32)
    ordered = sorted(pairs, key=lambda pair: pair[1], reverse=least_wins)  # the last one burnt stays
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        found: Floats = rasterize(
            _light(ordered),
            out_shape=shape,
            fill=np.nan,
            dtype="float32",
            transform=Affine.translation(window.col0, window.row0),
            all_touched=everywhere,
            skip_invalid=True,
        )
    return found


def _light(pairs: Iterable[tuple[Any, float]]) -> list[tuple[Any, float]]:
    """The same shapes, polygons of very many corners cut along rows of cells."""
    return [(part, value) for shape, value in pairs for part in _cut(shape)]


def _cut(shape: Any) -> NDArray[Any] | list[Any]:
    import shapely

    if shape.geom_type not in ("Polygon", "MultiPolygon"):
        return [shape]
    west, north, east, south = shape.bounds
    if shapely.get_num_coordinates(shape) * (south - north) <= _HEAVY or south - north < 2:
        return [shape]
    middle = float(np.floor((north + south) / 2))
    halves = [
        shapely.clip_by_rect(shape, west - 1, top, east + 1, bottom)
        for top, bottom in ((north - 1, middle), (middle, south + 1))
    ]
    return [
        part
        for half in halves
        for polygon in shapely.get_parts(half)
        if polygon.geom_type == "Polygon"
        for part in _cut(polygon)
    ]
