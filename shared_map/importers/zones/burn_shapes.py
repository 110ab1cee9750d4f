"""Shapes of a file in any coordinate system, brought into cells of a grid: repaired, cut at its border, densified
as the projection bends them; and burnt, by the middles of cells or wherever these are touched.

Cell coordinates are (column, row) from the north-west corner: cell (r, c) is the square from (c, r) to (c+1, r+1).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.features import rasterize
from rasterio.transform import Affine, from_origin
from rasterio.warp import transform as to_crs

from shared_map.array_files import Floats
from shared_map.importers.georeference import bounds_in, crs_name, reprojecting, system_named, systems_of
from shared_map.importers.zones.vector_files import Features, Layer, parts_of, unusable
from shared_map.importers.zones.zone_files import FileFacts
from swarm.errors import TerrainError
from swarm.grid import GridSpec, Window

Floats64 = NDArray[np.float64]
MOST_FEATURES, MOST_CORNERS = 500_000, 20_000_000
"""Limits of one layer on the terrain."""
_MOST_CROSSINGS = 50_000
"""Crossings of a shape with itself: a repair takes time by their number. Chosen, not measured."""
_STEP_M = 1000.0
"""Longer edges are cut: a straight edge in one system is bent in another, by some centimetres over this length."""
_DEG_M = 111_000.0
"""Metres of a degree of latitude, to a hundredth."""
_LINE, POLYGON = 1, 3
"""Numbers of a line and of a polygon among the types of shapely."""
_MOST_BURNT_CELLS = 1 << 34
"""Cells of all boxes around shapes: 64 times the largest grid. Bounds the time. Chosen, not measured."""
_HEAVY = 50_000_000
"""Corners times rows of a polygon: GDAL looks at every corner in every row."""
_CHUNK = 4096
"""Shapes that are handed to GDAL at once: it takes Python's lists of numbers, which are large."""
_PIECE = 50
"""Corners of a line that is widened at once: one of many that crosses itself often would take for ever."""
_NUDGE = (1.3e-4, 0.7e-4)
"""In cells. A line through the very corner of cells passes two of them that have no side in common, and no vehicle
drives from one to the other between closed cells. Only rounded coordinates touch cells exactly."""


class Placing:
    """Transformation of a layer's coordinates onto a grid.

    Parameters
    ----------
    grid : GridSpec
    layer : Layer
    crs : str or None
        Its system, as the scenario has it; "local" is that of a terrain without a place.
    margin_m : float
        So far outside the grid shapes are still of use.
    facts : FileFacts
        What is done is entered there.

    Raises
    ------
    TerrainError
        If the system is not known or none, or the layer does not touch the terrain.
    """

    def __init__(self, grid: GridSpec, layer: Layer, crs: str | None, margin_m: float, facts: FileFacts) -> None:
        self._grid, self._layer, self._facts = grid, layer, facts
        own = None
        with suppress(TerrainError):
            own = system_named(layer.crs, layer.what)
        self._target, self._crs = systems_of(grid, own, crs, layer.what, "crs")
        facts.crs = "local" if self._crs is None else crs_name(self._crs)
        self._moves = bool(self._crs != self._target)
        self._degrees = self._crs is not None and bool(self._crs.is_geographic)
        self._shifts = [0.0, -360.0, 360.0] if self._degrees else [0.0]
        self._reach = np.full(4, np.nan)
        self._touched, self._features, self._corners = False, 0, 0
        # The terrain with its margin, in the layer's coordinates; degrees go on beyond 180.
        side_m, out = grid.resolution_m, margin_m / grid.resolution_m + 2.0
        rows, cols = grid.rows + 2 * out, grid.cols + 2 * out
        west, north = grid.west_m - out * side_m, grid.north_m + out * side_m
        self._box = west, north - rows * side_m, west + cols * side_m, north
        if self._moves:
            around = from_origin(west, north, side_m, side_m)
            with reprojecting(layer.what, self._crs, self._target):
                west, south, east, north = bounds_in(around, rows, cols, self._target, self._crs)  # type: ignore[arg-type]
            # The border was looked at in some of its points only, and may bulge between them.
            wide, high = 0.01 * (east - west), 0.01 * (north - south)
            self._box = west - wide, south - high, east + wide, north + high

    def check_touched(self) -> None:
        """Raises TerrainError if the layer holds no feature, or none that was placed is on the terrain."""
        what = self._layer.what
        if np.isnan(self._reach).any():
            raise TerrainError(f"{what} holds no feature or fence")
        if not self._touched:
            hint = "are x and y in reverse?" if self._reversed(self._reach[None])[0] else "is crs right?"
            raise TerrainError(
                f"{what} does not touch the terrain: it reaches from {_box_text(*self._reach)}, the terrain from"
                f" {_box_text(*self._box)} in {self._facts.crs}; {hint}"
            )

    def _on(self, bounds: Floats64) -> NDArray[np.bool_]:
        """True for each of (n, 4) bounds that meets the terrain, in any turn."""
        west, south, east, north = self._box
        high = (bounds[:, 1] <= north) & (bounds[:, 3] >= south)
        wide = [(bounds[:, 0] <= east + by) & (bounds[:, 2] >= west + by) for by in self._shifts]
        return np.asarray(high & np.any(wide, axis=0))

    def _reversed(self, bounds: Floats64) -> NDArray[np.bool_]:
        """True for each of (n, 4) bounds that meets the terrain only if x and y change places. A terrain whose x
        and y are much alike tells nothing."""
        west, south, east, north = self._box
        alike = abs(west + east - south - north) < 8 * max(east - west, north - south)
        return ~self._on(bounds) & self._on(bounds[:, [1, 0, 3, 2]]) & (not alike)

    def _check_bounds(self, features: Features, bounds: Floats64) -> None:
        """Raises TerrainError if it is not sure where features lie."""
        what = self._layer.what
        if self._degrees:
            wrong = (np.abs(bounds[:, ::2]).max(axis=1) > 540) | (np.abs(bounds[:, 1::2]).max(axis=1) > 90.0001)
            for n in np.flatnonzero(wrong)[:1]:
                raise TerrainError(
                    f"{what}: feature {features.id(features.of[n])} reaches from {_box_text(*bounds[n])}, which"
                    f" are no degrees, as {self._facts.crs} has them; set crs"
                )
            for n in np.flatnonzero(bounds[:, 2] - bounds[:, 0] > 180):
                if _jumps(features.shapes[n]):
                    why = "an edge of it spans more than 180 degrees: cut it at 180"
                    raise unusable(what, features.id(features.of[n]), why)
        for n in np.flatnonzero(self._reversed(bounds)) if self._touched or self._on(bounds).any() else ():
            raise unusable(what, features.id(features.of[n]), "it is on the terrain only if x and y change places")

    def place(self, features: Features) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Simple shapes (points, lines, polygons) in cells, and of which feature each is a part. Raises
        TerrainError, which names the feature, if one cannot be placed."""
        with np.errstate(all="ignore"):  # coordinates of damaged files may be as large as numbers are
            bounds = shapely.bounds(features.shapes)
            if len(bounds):
                reach, before = shapely.total_bounds(features.shapes), self._reach
                self._reach = np.concatenate((np.fmin(before[:2], reach[:2]), np.fmax(before[2:], reach[2:])))
            self._check_bounds(features, bounds)
            near = self._on(bounds)
            self._touched |= bool(near.any())
            self._features += len(np.unique(features.of[near]))
            self._corners += int(shapely.get_num_coordinates(features.shapes[near]).sum())
            if self._features > MOST_FEATURES or self._corners > MOST_CORNERS:
                most = f"{MOST_FEATURES} features or {MOST_CORNERS} corners"
                raise TerrainError(f"{self._layer.what} has over {most}; simplify it")
            shapes, of, mended = _mended(features, near, self._layer.what)
            placed = [self._placed(shapes, of, shift, features) for shift in self._shifts]
        self._facts.features += len(features.numbers)
        self._facts.outside += len(features.numbers) - len(np.unique(of))
        self._facts.repaired += sorted({*mended, *map(features.id, features.closed.tolist())})
        return np.concatenate([each for each, _ in placed]), np.concatenate([each for _, each in placed])

    def _placed(
        self, shapes: NDArray[Any], of: NDArray[np.int64], shift: float, features: Features
    ) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """The parts of shapes within the terrain's box that is turned by some degrees."""
        box = (self._box[0] + shift, self._box[1], self._box[2] + shift, self._box[3])
        shapes, within = _simple(np.asarray(shapely.clip_by_rect(shapes, *box), object))
        of, grid = of[within], self._grid

        def to_cells(points: Floats64) -> Floats64:
            xs, ys = points[:, 0] - shift, points[:, 1]
            if self._moves and len(points):
                xs, ys = map(np.asarray, to_crs(self._crs, self._target, xs, ys))
            return np.stack([xs - grid.west_m, grid.north_m - ys], axis=1) / grid.resolution_m

        if self._moves:
            unit_m = _DEG_M if self._degrees else float(self._crs.linear_units_factor[1])
            shapes = shapely.segmentize(shapes, _STEP_M / unit_m)
        with reprojecting(self._layer.what, self._crs, self._target):
            shapes = shapely.transform(shapes, to_cells)
        for n in of[~np.isfinite(shapely.bounds(shapes)).all(axis=1)]:
            raise unusable(self._layer.what, features.id(n), "it has no place in the terrain's system")
        return shapes, of


def _box_text(west: float, south: float, east: float, north: float) -> str:
    return f"{west:.7g}, {south:.7g} to {east:.7g}, {north:.7g}"


def _jumps(shape: Any) -> bool:
    """Returns True if an edge of a simple shape spans more than half of the globe, and not all of it."""
    lines = shapely.get_rings(shape) if shape.geom_type == "Polygon" else [shape]
    wide = np.abs(np.concatenate([np.diff(shapely.get_coordinates(line)[:, 0]) for line in lines]))
    return bool(((wide > 180) & (wide < 359.999)).any())


def _simple(geometries: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Points, lines and polygons that geometries consist of, without empty ones, and of which each is a part."""
    parts, of = parts_of(geometries)
    kept = ~shapely.is_empty(parts)
    return parts[kept], of[kept]


def _mended(
    features: Features, near: NDArray[np.bool_], what: str
) -> tuple[NDArray[Any], NDArray[np.int64], set[str]]:
    """Shapes of features, and of which each is a part: polygons that cross themselves as what their rings enclose.

    Raises TerrainError if a polygon encloses nothing, takes too long to repair, or has holes in holes.
    """
    shapes = features.shapes.copy()
    # A line of one place is a point: GEOS does not cut it.
    still = (shapely.get_type_id(shapes) == _LINE) & (shapely.length(shapes) == 0)
    shapes[still] = shapely.get_point(shapes[still], 0)
    polygons = near & (shapely.get_type_id(shapes) == POLYGON)
    wrong = np.flatnonzero(polygons)[~shapely.is_valid(shapes[polygons])]
    for n in wrong:
        if _crossings(shapes[n]) > _MOST_CROSSINGS:
            raise unusable(what, features.id(features.of[n]), "it crosses itself thousands of times")
        if shapely.is_valid_reason(shapes[n]).startswith(("Holes are nested", "Nested holes")):
            raise unusable(what, features.id(features.of[n]), "a hole of it lies in another")
        shapes[n] = shapely.make_valid(shapes[n], method="structure", keep_collapsed=False)
        if shapely.is_empty(shapes[n]):
            raise unusable(what, features.id(features.of[n]), "it encloses no ground")
    simple, within = _simple(shapes[near])
    return simple, features.of[near][within], {features.id(features.of[n]) for n in wrong}


def _crossings(polygon: Any) -> float:
    """Estimates the crossings of a polygon's edges from a sample: counting all takes as long as the repair."""
    points = shapely.get_coordinates(polygon)
    edges = shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1))
    some = edges[np.unique(np.linspace(0, len(edges) - 1, 200).astype(np.intp))]
    crossed = shapely.STRtree(edges).query(some, predicate="crosses").shape[1]
    return float(crossed * len(edges) / len(some) / 2)


# --- in cell coordinates, they become cells -------------------------------------------------------------------


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
    pieces, of = [], []
    for n, shape in enumerate(shapes):
        parts, points = [shape], shapely.get_coordinates(shape)
        if halves[n] > 0 and len(points) > _PIECE:
            starts = range(0, len(points) - 1, _PIECE)
            parts = [shapely.LineString(points[start : start + _PIECE + 1]) for start in starts]
        pieces += parts
        of += [n] * len(parts)
    widened, owners = np.array(pieces, object), np.array(of, np.intp)
    lines = halves[owners] > 0
    widened[lines] = shapely.buffer(widened[lines], halves[owners][lines])
    return widened, owners


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
    rows = ((north - 1, middle), (middle, south + 1))
    halves = [shapely.clip_by_rect(shape, west - 1, top, east + 1, bottom) for top, bottom in rows]
    pieces = (piece for half in halves for piece in shapely.get_parts(half))
    return [part for piece in pieces if piece.geom_type == "Polygon" for part in _parts(piece)]
