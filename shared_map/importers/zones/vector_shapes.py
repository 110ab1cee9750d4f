"""Shapes of a file in any coordinate system, brought into cells of a grid: repaired, cut at its border, densified
as the projection bends them; and its areas as simple rings, for orders to a running swarm.

Cell coordinates are (column, row) from the north-west corner: cell (r, c) is the square from (c, r) to (c+1, r+1).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.importers.georeference import bounds_in, crs_name, is_local, system_named
from shared_map.importers.zones.vector_files import Features, Layer, open_layer, read_features
from swarm.errors import TerrainError
from swarm.grid import GridSpec

Box = tuple[float, float, float, float]
_MOST_CROSSINGS = 50_000
_STEP_M = 1000.0
"""Longer edges are cut: a straight edge in one system is bent in another, by some centimetres over this length."""
_DEG_M = 111_000.0
_POLYGONS = 3
MOST_OUTLINES = 50
_TOLERANCES_CELLS = (0.01, 0.05, 0.1, 0.25)
"""Tolerances for dropped corners, tried in order until few enough are left."""

Corner = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Shapes:
    """Simple shapes (points, lines, polygons) in cell coordinates.

    of        int64 (n,)  which feature each is a part of
    mended    ids of features that crossed themselves
    unusable  id -> why a feature is left out
    empty     how many features have no shape
    """

    shapes: NDArray[Any]
    of: NDArray[np.int64]
    mended: list[str]
    unusable: dict[str, str]
    empty: int


class Placing:
    """Transformation of a layer's coordinates onto a grid.

    Parameters
    ----------
    grid : GridSpec
    layer : Layer
    crs : str or None
        What the scenario says that its system is; "local" is that of a terrain without a place.
    margin_m : float
        So far outside the grid shapes are still of use.

    Raises
    ------
    TerrainError
        If the system is not known or none, or the layer does not touch the terrain.
    """

    def __init__(self, grid: GridSpec, layer: Layer, crs: str | None, margin_m: float) -> None:
        self.grid, self.layer = grid, layer
        self._target, self._crs = systems_of(grid, layer.crs, crs, layer.what)
        self._margin_cells = margin_m / grid.resolution_m + 2.0
        with self._reprojecting():
            self._box = self._extent()
        self._degrees = self._crs is not None and bool(self._crs.is_geographic)
        self._shifts = [0.0, -360.0, 360.0] if self._degrees else [0.0]
        if layer.bounds is not None:
            self._check_touches(layer.bounds)

    @property
    def crs(self) -> str:
        """The system of the layer, for people."""
        return "local" if self._crs is None else crs_name(self._crs)

    def _extent(self) -> Box:
        """The terrain with its margin, in the layer's coordinates; degrees go on beyond 180."""
        from rasterio.transform import from_origin
        from rasterio.warp import transform as to_crs

        grid, out = self.grid, self._margin_cells * self.grid.resolution_m
        rows, cols = grid.rows + 2 * self._margin_cells, grid.cols + 2 * self._margin_cells
        west, north = grid.west_m - out, grid.north_m + out
        if self._crs is None or self._crs == self._target:
            return west, north - rows * grid.resolution_m, west + cols * grid.resolution_m, north
        around = from_origin(west, north, grid.resolution_m, grid.resolution_m)
        what = f"{self.layer.what}: the terrain"
        box = bounds_in(around, rows, cols, self._target, self._crs, what)  # type: ignore[arg-type]
        if self._crs.is_geographic and box[2] - box[0] > 180:
            middle, _ = to_crs(self._target, self._crs, [west + cols / 2 * grid.resolution_m], [north])
            turned = bounds_in(around, rows, cols, self._target, _degrees_around(self._crs, middle[0]), what)  # type: ignore[arg-type]
            box = (turned[0] + middle[0], turned[1], turned[2] + middle[0], turned[3])
        # The border was looked at in some of its points only, and may bulge between them.
        wide, high = 0.01 * (box[2] - box[0]), 0.01 * (box[3] - box[1])
        return box[0] - wide, box[1] - high, box[2] + wide, box[3] + high

    def _check_touches(self, bounds: Box) -> None:
        what, named = self.layer.what, self.crs
        if self._degrees:
            worst = max(abs(bounds[0]), abs(bounds[2])), max(abs(bounds[1]), abs(bounds[3]))
            if worst[0] > 540 or worst[1] > 90.0001:
                raise TerrainError(
                    f"{what} reaches from {_shown(bounds)}, which are no degrees, as {named} has them; set crs"
                )
        if not self.boxes(bounds):
            raise TerrainError(
                f"{what} does not touch the terrain: it reaches from {_shown(bounds)}, the terrain from"
                f" {_shown(self._box)} in {named}; is crs right?"
            )

    def boxes(self, bounds: Box) -> list[tuple[float, Box]]:
        """(turn in degrees, where to look in the layer) of each part of a layer that may be on the terrain."""
        found = []
        for shift in self._shifts:
            box = (self._box[0] + shift, self._box[1], self._box[2] + shift, self._box[3])
            if box[0] <= bounds[2] and bounds[0] <= box[2] and box[1] <= bounds[3] and bounds[1] <= box[3]:
                found.append((-shift, box))
        return found

    def place(self, features: Features, box: Box, shift: float) -> Shapes:
        """Features that were read from a box, in cells."""
        with np.errstate(all="ignore"):  # coordinates of damaged files may be as large as numbers are
            return self._place(features, box, shift)

    def _place(self, features: Features, box: Box, shift: float) -> Shapes:
        import shapely

        geometries = features.geometries
        bounds = shapely.bounds(geometries)
        lacking = shapely.is_missing(geometries) | shapely.is_empty(geometries)
        unusable: dict[str, str] = {}
        finite = np.isfinite(bounds).all(axis=1)
        for n in np.flatnonzero(~lacking & ~finite):
            unusable[features.ids[n]] = "its coordinates are no numbers"
        if self._degrees:
            for n in np.flatnonzero(finite & (bounds[:, 2] - bounds[:, 0] > 180)):
                if _jumps(geometries[n]):
                    unusable[features.ids[n]] = "an edge of it spans more than 180 degrees: cut it at 180"
                    finite[n] = False
        kept = np.flatnonzero(finite & ~lacking)
        shapes, of = _simple(geometries[kept])
        of = kept[of]
        shapes, of, mended = _mended(shapes, of, features.ids, unusable)
        shapes = np.asarray(shapely.clip_by_rect(shapes, *box), object) if len(shapes) else shapes
        if self._crs is not None and self._crs != self._target:
            unit_m = _DEG_M if self._degrees else float(self._crs.linear_units_factor[1])
            shapes = shapely.segmentize(shapes, _STEP_M / unit_m)
        with self._reprojecting():
            shapes = shapely.transform(shapes, lambda points: self._to_cells(points, shift))
        shapes, within = _simple(shapes)
        of = of[within]
        good = np.isfinite(shapely.bounds(shapes)).all(axis=1)
        return Shapes(shapes[good], of[good], mended, unusable, int(lacking.sum()))

    @contextmanager
    def _reprojecting(self) -> Iterator[None]:
        """Makes what PROJ says of systems that do not go together a TerrainError."""
        from rasterio._err import CPLE_BaseError
        from rasterio.errors import RasterioError

        try:
            yield
        except (RasterioError, CPLE_BaseError) as error:
            raise TerrainError(
                f"{self.layer.what} cannot be brought from {self.crs} to the terrain's system; is crs right?"
            ) from error

    def _to_cells(self, points: NDArray[np.float64], shift: float) -> NDArray[np.float64]:
        from rasterio.warp import transform as to_crs

        xs, ys = points[:, 0] + shift, points[:, 1]
        if self._crs is not None and self._crs != self._target and len(points):
            moved = to_crs(self._crs, self._target, xs, ys)
            xs, ys = np.asarray(moved[0]), np.asarray(moved[1])
        grid = self.grid
        return np.stack([(xs - grid.west_m) / grid.resolution_m, (grid.north_m - ys) / grid.resolution_m], axis=1)


def systems_of(grid: GridSpec, own: str, given: str | None, what: str) -> tuple[Any, Any]:
    """(the terrain's system, a file's); (None, None) if the file is in the terrain's own metres.

    own    the file's system as it says; empty if it does not
    given  what the scenario says that it is
    """
    import rasterio

    if given == "local":
        return None, None
    found = None
    if given is not None:
        found = system_named(given, f"{what}: crs")
    elif own:
        with suppress(TerrainError):
            found = system_named(own, what)
    if found is None:
        raise TerrainError(
            f"{what} does not say in which coordinate system it is; set crs, for example 'EPSG:4326', or 'local'"
            " for metres of the terrain's own map"
        )
    if grid.crs == "local":
        if is_local(found):
            return None, None
        raise TerrainError(
            f"{what} is in {crs_name(found)}, and the terrain has no place; set terrain.crs, or crs = 'local' if"
            " its coordinates are metres of the terrain's own map"
        )
    if not found.is_geographic and not found.is_projected:
        raise TerrainError(f"{what} is in {crs_name(found)}, which has no place on the Earth; set crs")
    return rasterio.CRS.from_user_input(grid.crs), found


def _degrees_around(crs: Any, lon_deg: float) -> Any:
    """The same degrees, with longitudes counted from one in the middle of the terrain."""
    import rasterio

    return rasterio.CRS.from_proj4(f"+proj=longlat +pm={lon_deg!r} +datum=WGS84 +no_defs")


def _shown(box: Box) -> str:
    return f"{box[0]:.7g}, {box[1]:.7g} to {box[2]:.7g}, {box[3]:.7g}"


def _jumps(geometry: Any) -> bool:
    """Returns True if an edge spans more than half of the globe, and not all of it."""
    import shapely

    parts, _ = _simple(np.array([geometry], object))
    for part in parts:
        for ring in shapely.get_rings(part) if part.geom_type == "Polygon" else [part]:
            jumps = np.abs(np.diff(shapely.get_coordinates(ring)[:, 0]))
            if ((jumps > 180) & (jumps < 359.999)).any():
                return True
    return False


def _simple(geometries: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Points, lines and polygons that geometries consist of, and of which each is a part."""
    import shapely

    of = np.arange(len(geometries))
    parts = geometries
    while len(parts) and (shapely.get_type_id(parts) > _POLYGONS).any():
        parts, index = shapely.get_parts(parts, return_index=True)
        of = of[index]
    kept = ~(shapely.is_missing(parts) | shapely.is_empty(parts)) if len(parts) else np.zeros(0, np.bool_)
    return np.asarray(parts, object)[kept], of[kept]


def _mended(
    shapes: NDArray[Any], of: NDArray[np.int64], ids: list[str], unusable: dict[str, str]
) -> tuple[NDArray[Any], NDArray[np.int64], list[str]]:
    """Polygons that cross themselves, as the areas that their rings enclose."""
    import shapely

    polygons = shapely.get_type_id(shapes) == _POLYGONS
    wrong = np.flatnonzero(polygons)[~shapely.is_valid(shapes[polygons])]
    if not len(wrong):
        return shapes, of, []
    shapes = shapes.copy()
    for n in wrong:
        if _crossings(shapes[n]) > _MOST_CROSSINGS:
            unusable[ids[of[n]]] = "it crosses itself thousands of times"
            shapes[n] = None
        else:
            shapes[n] = shapely.make_valid(shapes[n], method="structure", keep_collapsed=False)
    simple, within = _simple(shapes)
    return simple, of[within], sorted({ids[of[n]] for n in wrong} - unusable.keys())


def _crossings(polygon: Any) -> float:
    """Estimates the crossings of a polygon's edges from a sample: counting all takes as long as the repair."""
    import shapely

    points = shapely.get_coordinates(polygon)
    edges = shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1))
    some = edges[np.unique(np.linspace(0, len(edges) - 1, 200).astype(np.intp))]
    crossed = shapely.STRtree(edges).query(some, predicate="crosses").shape[1]
    return float(crossed * len(edges) / len(some) / 2)


# --- for orders ---------------------------------------------------------------------------------------------


def outlines_of(
    path: Path, grid: GridSpec, layer: str | None, crs: str | None, most_corners: int
) -> list[list[Corner]]:
    """The areas of a file, each as corners (row, col) of a grid; those that overlap are one.

    Parameters
    ----------
    layer, crs : str or None
        As in a scenario's zone.
    most_corners : int
        Of one area.

    Raises
    ------
    TerrainError
        The file cannot be read, has no area on the terrain, has an unusable feature, an area with a hole or with
        more than `most_corners` corners, or too many areas.
    """
    import shapely

    what = f"zone {path}"
    found = open_layer(path, layer, what)
    if found.bounds is None:
        raise TerrainError(f"{what} holds no area")
    placing = Placing(grid, found, crs, 2 * grid.resolution_m)
    areas = []
    for shift, box in placing.boxes(found.bounds):
        shapes = placing.place(read_features(found, box, ()), box, shift)
        for id, why in shapes.unusable.items():
            raise TerrainError(f"{what}: feature {id} cannot be used: {why}; repair or remove it")
        areas.append(shapes.shapes[shapely.get_type_id(shapes.shapes) == 3])
    parts = shapely.get_parts(shapely.union_all(np.concatenate(areas)))
    parts = parts[shapely.area(parts) > 0] if len(parts) else parts
    if not len(parts):
        raise TerrainError(f"{what} holds no area on the terrain")
    if len(parts) > MOST_OUTLINES:
        raise TerrainError(f"{what} holds {len(parts)} areas; at most {MOST_OUTLINES} are ordered at once")
    return [_ring(part, what, most_corners) for part in parts]


def _ring(area: object, what: str, most: int) -> list[Corner]:
    import shapely

    if shapely.get_num_interior_rings(area):
        raise TerrainError(f"{what} holds an area with a hole, which an order cannot have; cut it in two")
    points = np.zeros((0, 2))
    for tolerance in _TOLERANCES_CELLS:
        points = shapely.get_coordinates(shapely.simplify(area, tolerance))[:-1]
        if len(points) <= most:
            return [(float(row), float(col)) for col, row in points]
    raise TerrainError(f"{what} holds an area of {len(points)} corners, at most {most} are ordered; simplify it")
