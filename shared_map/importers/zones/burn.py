"""Shapes in cell coordinates become cells: by their middles, or wherever they are touched."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.features import rasterize
from rasterio.transform import Affine

from shared_map.array_files import Floats
from swarm.errors import TerrainError
from swarm.grid import GridSpec, Window

_MOST_BURNT_CELLS = 1 << 34
_HEAVY = 50_000_000
"""Corners times rows of a polygon: GDAL looks at every corner in every row."""
_CHUNK = 4096
"""Shapes that are handed to GDAL at once: it takes Python's lists of numbers, which are large."""
_PIECE = 50
"""Corners of a line that is widened at once: one of many that crosses itself often would take for ever."""
POLYGON = 3
_NUDGE = (1.3e-4, 0.7e-4)
"""In cells. A line through the very corner of cells passes two of them that have no side in common, and no vehicle
drives from one to the other between closed cells. Only rounded coordinates touch cells exactly."""


class Drawn(NamedTuple):
    """A simple shape in cells, its value, and the width of a line or point in cells; an area has its own."""

    shape: Any
    value: float
    width_cells: float


def burn(
    drawing: Sequence[Drawn], grid: GridSpec, what: str, *, everywhere: bool = False, least_wins: bool = False
) -> tuple[Window, Floats]:
    """The window of cells around a drawing, and their values, float32, NaN where there is none.

    everywhere  whether an area covers all cells that it touches, or those whose middle it holds. A line covers all
                that it passes in either case, so that it has no gaps, and as an area those within half its width
    least_wins  where shapes overlap the least value counts, else the largest

    Raises TerrainError, which `what` begins, if shapes lie upon each other too often.
    """
    if not drawing:
        return Window(0, 0, 0, 0), np.zeros((0, 0), np.float32)
    shapes = np.array([each.shape for each in drawing], object)
    values = np.array([each.value for each in drawing])
    halves = np.array([each.width_cells for each in drawing]) / 2
    areas = shapely.get_type_id(shapes) == POLYGON
    halves[areas] = 0.0
    window = _window(shapes, halves, grid, what)
    size = (max(window.row1 - window.row0, 0), max(window.col1 - window.col0, 0))
    passed, held = np.full(size, np.nan, np.float32), np.full(size, np.nan, np.float32)
    if window.empty:
        return window, passed
    order = np.argsort(-values if least_wins else values, kind="stable")  # the last one burnt stays
    for first in range(0, len(order), _CHUNK):
        some = order[first : first + _CHUNK]
        lines = some[~areas[some]]
        nudged = shapely.transform(shapes[lines], lambda points: points + _NUDGE)
        _rasterize(nudged, values[lines], passed, window, everywhere=True)
        # The middle of a cell that a line does not pass is half a cell away from it, at least.
        wide = some[areas[some] | (halves[some] > (0.0 if everywhere else 0.5))]
        widened, of = _widened(shapes[wide], halves[wide])
        _rasterize(widened, values[wide][of], held, window, everywhere=everywhere)
    (np.fmin if least_wins else np.fmax)(passed, held, out=passed)
    return window, passed


def _window(shapes: NDArray[Any], halves: NDArray[np.float64], grid: GridSpec, what: str) -> Window:

    box = shapely.bounds(shapes)
    west, north, east, south = box[:, 0] - halves, box[:, 1] - halves, box[:, 2] + halves, box[:, 3] + halves
    if ((east - west + 1) * (south - north + 1)).sum() > _MOST_BURNT_CELLS:
        raise TerrainError(f"{what} lies upon itself too often ({len(shapes)} shapes); dissolve it")
    return Window(
        int(np.clip(np.floor(north.min()) - 1, 0, grid.rows)),
        int(np.clip(np.floor(west.min()) - 1, 0, grid.cols)),
        int(np.clip(np.ceil(south.max()) + 1, 0, grid.rows)),
        int(np.clip(np.ceil(east.max()) + 1, 0, grid.cols)),
    )


def _widened(shapes: NDArray[Any], halves: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[np.intp]]:
    """Polygons as they are, lines and points as areas, long ones in pieces; and of which shape each is a part."""
    of = np.arange(len(shapes))
    long = np.flatnonzero((halves > 0) & (shapely.get_num_coordinates(shapes) > _PIECE)) if len(shapes) else of
    if len(long):
        pieces, owners = [], []
        for n in long.tolist():
            points = shapely.get_coordinates(shapes[n])
            starts = range(0, len(points) - 1, _PIECE)
            pieces += [shapely.LineString(points[start : start + _PIECE + 1]) for start in starts]
            owners += [n] * len(starts)
        short = np.setdiff1d(of, long)
        of = np.concatenate([short, np.array(owners, np.intp)])
        by_owner = np.argsort(of, kind="stable")
        shapes = np.concatenate([shapes[short], np.array(pieces, object)])[by_owner]
        of = of[by_owner]
    lines = halves[of] > 0
    widened = shapes.copy()
    widened[lines] = shapely.buffer(shapes[lines], halves[of][lines])
    return widened, of


def _rasterize(
    shapes: NDArray[Any], values: NDArray[np.float64], out: Floats, window: Window, *, everywhere: bool
) -> None:

    pairs = [(part, value) for shape, value in zip(shapes, values.tolist(), strict=True) for part in _parts(shape)]
    if not pairs:
        return
    place = Affine.translation(window.col0, window.row0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        rasterize(pairs, out=out, transform=place, all_touched=everywhere, skip_invalid=False)


def _parts(shape: Any) -> list[Any]:
    """A shape in pieces that GDAL burns in a bounded time: a polygon of very many corners is cut along rows of
    cells."""
    west, north, east, south = shape.bounds
    heavy = shapely.get_num_coordinates(shape) * (south - north) > _HEAVY
    if shape.geom_type != "Polygon" or not heavy or south - north < 2:
        return [shape]
    middle = float(np.floor((north + south) / 2))
    halves = [
        shapely.clip_by_rect(shape, west - 1, top, east + 1, bottom)
        for top, bottom in ((north - 1, middle), (middle, south + 1))
    ]
    pieces = (piece for half in halves for piece in shapely.get_parts(half))
    return [part for piece in pieces if piece.geom_type == "Polygon" for part in _parts(piece)]
