"""Georeference of a raster: its coordinate system, the square metric north-up grid of a terrain, the transformation
between them, and rasters brought onto that grid.

This module imports rasterio, which agents never need.
"""

from __future__ import annotations

import glob
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.errors import CRSError, RasterioError
from rasterio.transform import array_bounds, from_origin
from rasterio.vrt import WarpedVRT
from rasterio.warp import Resampling, transform_bounds
from rasterio.warp import transform as to_crs

from shared_map.array_files import Floats
from shared_map.importers.gdal_rasters import READ_ROWS
from shared_map.terrain.row_bands import Progress, bands, no_progress
from swarm.config.input_files import FileKind, read_text
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec, is_of_earth

MAX_SPAN_DEG = 12.0
"""Beyond this, a local projection stretches by more than half a percent at its borders."""
MOST_STRETCH = 0.02
"""Mercator's metres, and those of maps in equal degrees, are true on one line only."""
_LIKE_WGS84 = (4326, 4258, 4269)
"""Degrees within a metre of WGS 84's. Those of other datums PROJ has to move, for which it needs the datum."""
METRES = 'LOCAL_CS["image",UNIT["metre",1]]'
"""Coordinate system of a terrain without a place on Earth."""
HIGHEST_DEG = 85.0
"""Degrees nearer to a pole than this are not put on metres."""


def metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    """Metres in one degree of latitude and of longitude on WGS 84, to the millimetre."""
    phi = math.radians(latitude_deg)
    lat = 111132.954 - 559.822 * math.cos(2 * phi) + 1.175 * math.cos(4 * phi)
    lon = 111412.84 * math.cos(phi) - 93.5 * math.cos(3 * phi)
    return round(lat, 3), round(lon, 3)


def equidistant(latitude_deg: float, longitude_deg: float) -> str:
    """A system in metres with `metres_per_degree` of a latitude; x is 0 at a longitude, y at the equator.

    PROJ's equidistant cylindrical projection knows spheres only. On that of WGS 84's equator its y is 0.3 % too
    long: metres of the ellipsoid taken for such y lie kilometres off. It therefore gets the sphere with the
    curvature of the ellipsoid there.
    """
    per_lat, per_lon = metres_per_degree(latitude_deg)
    # The standard parallel at which a degree of longitude on this sphere is as long as on the ellipsoid.
    parallel = math.degrees(math.acos(min(per_lon / per_lat, 1.0)))
    radius = per_lat * 180 / math.pi
    return f"+proj=eqc +lat_ts={parallel:.9f} +lon_0={longitude_deg:.9f} +R={radius:.4f} +units=m +no_defs"


def system_named(text: str, what: str) -> Any:
    """The CRS of a text, as rasterio has it; "local" means metres from anywhere. Raises TerrainError, which `what`
    begins, if it is none."""
    try:
        with rasterio.Env(CPL_LOG="/dev/null"):  # PROJ would say it, too
            return rasterio.CRS.from_user_input(METRES if text == "local" else text)
    except (CRSError, ValueError) as error:
        raise TerrainError(f"{what} {text!r} is no coordinate system; write EPSG:32632 or alike") from error


def own_system(dataset: Any, what: str, path: Path | None = None) -> Any:
    """The coordinate system of a raster, or of the .prj beside it, which GDAL reads beside some formats only; of
    degrees in a netCDF that names none, WGS 84.

    path  of the file, unless GDAL calls it the same
    """
    path = path or Path(dataset.name)
    for beside in () if dataset.crs else sorted(path.parent.glob(f"{glob.escape(path.stem)}.[pP][rR][jJ]")):
        # The names in it may be in any encoding.
        if text := read_text(beside, FileKind.SYSTEM, "latin-1").strip():
            return system_named(text, f"{what}: {beside}")
    if not dataset.crs and "degrees_north" in dataset.tags().values():  # a latitude of netCDF, by its conventions
        return rasterio.CRS.from_epsg(4326)
    return dataset.crs


def crs_of(found: Any, given: str | None, what: str, key: str = "terrain.crs") -> Any:
    """The coordinate system that the scenario names for a file (`given`, the value of `key`), else the file's own.

    Raises TerrainError if `given` is not one, or if there is neither; `what` names the file.
    """
    if given is not None:
        return system_named(given, f"{what}: {key}")
    if not found:
        raise TerrainError(
            f"{what} does not say in which coordinate system it is; set {key}, for example 'EPSG:32632', or 'local'"
            " for metres of the terrain's own map"
        )
    return found


def systems_of(grid: GridSpec, own: Any, given: str | None, what: str, key: str) -> tuple[Any, Any]:
    """(the terrain's system, a file's); (None, None) if the file is in the terrain's own metres.

    own    the file's system as it says; None if it does not
    given  what the scenario says that it is, the value of `key`
    """
    if given == "local":
        return None, None
    found = crs_of(own, given, what, key)
    if grid.crs == "local":
        if is_local(found):
            return None, None
        raise TerrainError(
            f"{what} is in {crs_name(found)}, and the terrain has no place; set terrain.crs, or crs = 'local' if"
            " its coordinates are metres of the terrain's own map"
        )
    if not found.is_geographic and not found.is_projected:
        raise TerrainError(f"{what} is in {crs_name(found)}, which has no place on the Earth; set {key}")
    return rasterio.CRS.from_user_input(grid.crs), found


def overruled(found: Any, given: str | None, transform: Any) -> tuple[str, ...]:
    """A note where `terrain.crs` (`given`) contradicts what the file itself says (`found`), or cannot place it."""
    if given in (None, "local") or not found:
        return ()
    if not (found.is_geographic or found.is_projected):
        nowhere = bool(transform.c == transform.f == 0)
        return (f"! the file has no origin: its north-west corner is x = 0, y = 0 of {given!r}",) * nowhere
    if rasterio.CRS.from_user_input(given) == found:
        return ()
    return (f"terrain.crs = {given!r} counts, though the file says {crs_name(found)}: every place follows from it",)


def metric_crs(crs: Any, lon_deg: float, lat_deg: float, lat_span_deg: float) -> Any:
    """The same system if its metres are true within `MOST_STRETCH`, else a local one: equidistant cylindrical while
    its scale is right within 1 % (no voids at the corners), transverse Mercator beyond.

    `lon_deg`, `lat_deg` are the middle of the terrain; `lat_span_deg` is its extent from south to north.
    """
    if is_local(crs):
        return crs
    rest = f"+lon_0={lon_deg:.6f} {_shape_of(crs)} +units=m +no_defs"
    local = rasterio.CRS.from_proj4(f"+proj=tmerc +lat_0={lat_deg:.6f} {rest}")
    is_metric = crs.is_projected and abs(crs.linear_units_factor[1] - 1.0) < 1e-9
    if is_metric and abs(_scale(crs, local) - 1.0) < MOST_STRETCH:
        return crs
    stretch = math.radians(lat_span_deg / 2) * abs(math.tan(math.radians(lat_deg)))
    if crs.is_geographic and stretch < 0.01:
        if crs.to_epsg() in _LIKE_WGS84:
            return rasterio.CRS.from_proj4(equidistant(lat_deg, lon_deg))
        return rasterio.CRS.from_proj4(f"+proj=eqc +lat_ts={lat_deg:.6f} {rest}")
    return local


def _scale(crs: Any, local: Any) -> float:
    """Returns the length of a true metre in a system, in the direction in which it is furthest from one.

    local  a system that is true around its origin
    """
    xs, ys = to_crs(local, crs, [0.0, 1000.0, 0.0], [0.0, 0.0, 1000.0])
    sides = [math.hypot(xs[n] - xs[0], ys[n] - ys[0]) / 1000.0 for n in (1, 2)]
    return max(sides, key=lambda side: abs(math.log(side)) if 0 < side < math.inf else math.inf)


def is_local(crs: Any) -> bool:
    """Returns True if a system has metres without a place on Earth, as surveys of sites and arenas use."""
    known = crs.to_dict(projjson=True)
    axes = known.get("coordinate_system", {}).get("axis", [])
    return known.get("type") == "EngineeringCRS" and {str(axis.get("unit")) for axis in axes} == {"metre"}


def degrees_of(crs: Any) -> Any:
    """Latitude and longitude on the body on which a system lies: WGS 84 on the Earth."""
    return rasterio.CRS.from_proj4(f"+proj=longlat {_shape_of(crs)} +no_defs")


def _shape_of(crs: Any) -> str:
    """The body that a system lies on, for PROJ: the Earth, or the ellipsoid of another planet or moon."""
    known = crs.to_dict()
    radius_m = known.get("R", known.get("a"))
    if radius_m is None or is_of_earth(float(radius_m)):
        return "+datum=WGS84"
    flat = float(known.get("rf") or math.inf)
    polar_m = float(known.get("b", float(radius_m) * (1 - 1 / flat)))
    return f"+a={float(radius_m)!r} +b={polar_m!r}"


def crs_name(crs: Any) -> str:
    """Returns the name of a rasterio CRS for people: EPSG:32632, or the beginning of its text."""
    text = "a local system" if is_local(crs) else _system(crs)
    return text if len(text) < 60 else text[:57] + "..."


@contextmanager
def reprojecting(what: str, crs: Any, target: Any) -> Iterator[None]:
    """Makes what PROJ says of systems that do not go together a TerrainError."""
    try:
        yield
    except (RasterioError, CPLE_BaseError) as error:
        names = crs_name(crs), crs_name(target)
        raise TerrainError(f"{what} is in {names[0]}, from which no way leads to {names[1]}") from error


def bounds_in(transform: Any, rows: int, cols: int, crs: Any, target: Any) -> tuple[float, float, float, float]:
    """(west, south, east, north) of a raster of rows x cols, in units of the system `target`; degrees count on
    beyond 180."""
    west, south, east, north = array_bounds(rows, cols, transform)
    (west, east), (south, north) = sorted((west, east)), sorted((south, north))  # of a file that is mirrored
    if target != crs:
        west, south, east, north = transform_bounds(crs, target, west, south, east, north)
    return west, south, east + 360.0 * (target.is_geographic and east < west), north


def check_metres(step: float, west: float, what: str) -> None:
    """Raises TerrainError where numbers without a coordinate system look like degrees."""
    if abs(step) < 0.1 and abs(west) <= 180:
        raise TerrainError(f"{what}: a cell of {step:g} looks like degrees; set terrain.crs = 'EPSG:4326'")


def is_kept(width_m: float, height_m: float, cells: int, resolution_m: float | None) -> bool:
    """Returns True if a metric grid is taken as it is: by a resampling no cell would move by more than half of one,
    so that it would only blur. All importers ask this.

    width_m, height_m  of a cell
    cells              along the longer side
    resolution_m       wanted side of a cell; None keeps that of the file
    """
    side_m = resolution_m or width_m
    return max(abs(side_m - width_m), abs(side_m - height_m)) * cells <= width_m / 2


def pixel_m(transform: Any, rows: int, cols: int, crs: Any, target: Any) -> tuple[float, float]:
    """Width and height in metres of the pixel in the middle."""
    places = [transform @ (cols / 2 + right, rows / 2 + down) for right, down in ((0, 0), (1, 0), (0, 1))]
    xs, ys = zip(*places, strict=True)
    if target != crs:
        xs, ys = to_crs(crs, target, xs, ys)
    return math.hypot(xs[1] - xs[0], ys[1] - ys[0]), math.hypot(xs[2] - xs[0], ys[2] - ys[0])


def plan_grid(
    transform: Any, rows: int, cols: int, crs: Any, resolution_m: float | None, what: str
) -> tuple[GridSpec, Any, list[str]]:
    """The grid for a raster: metric, north-up, with square cells.

    Parameters
    ----------
    transform, rows, cols, crs
        Of the raster, as rasterio gives them.
    resolution_m : float or None
        Side of a cell; None keeps that of the raster.
    what : str
        Names the raster in errors.

    Returns
    -------
    grid : GridSpec
    target : rasterio.CRS or None
        What to warp to; None if the raster has that grid already.
    notes : list of str
        What is done, for people.

    Raises
    ------
    TerrainError
        If the georeference is damaged, has neither metres nor degrees, is too near a pole or too wide for one flat
        grid; if no cell fits, or more than `MAX_CELLS` do.
    """
    if not crs.is_geographic and not crs.is_projected and not is_local(crs):
        raise TerrainError(f"{what} is in {crs_name(crs)}, without metres or degrees: warp it, or set terrain.crs")
    degrees = crs if is_local(crs) else degrees_of(crs)
    west, south, east, north = bounds_in(transform, rows, cols, crs, degrees)
    if not np.isfinite([west, south, east, north]).all():
        raise TerrainError(f"{what} lies beyond {crs_name(crs)}; its georeference is damaged")
    if east > 180 and crs.is_projected:
        ends, _ = to_crs(crs, degrees, *zip(transform @ (0, 0), transform @ (cols, rows), strict=True))
        back, _ = to_crs(degrees, crs, ends, [south, south])
        if abs(back[1] - back[0]) > 2 * abs(transform.a * cols) + abs(transform.b * rows):
            raise TerrainError(
                f"{what} reaches across 180 degrees, beyond the edge of {crs_name(crs)}; gdalwarp -t_srs EPSG:3832"
                " brings it onto one map"
            )
    if crs.is_geographic and not -90.000001 <= south <= north <= 90.000001:
        raise TerrainError(f"{what} reaches from latitude {south:.4g} to {north:.4g}; its georeference is damaged")
    if crs.is_geographic and not abs(south + north) / 2 < HIGHEST_DEG:
        raise TerrainError(
            f"{what} lies around latitude {(south + north) / 2:.4g}, where degrees of longitude have no width;"
            " gdalwarp -t_srs EPSG:3413 (in the south EPSG:3031) helps"
        )
    target = metric_crs(crs, (west + east) / 2, (south + north) / 2, north - south)
    if (
        target != crs
        and max(north - south, (east - west) * math.cos(math.radians((south + north) / 2))) > MAX_SPAN_DEG
    ):
        raise TerrainError(
            f"{what} spans {north - south:.4g} x {east - west:.4g} degrees: no flat grid is true over more than"
            f" {MAX_SPAN_DEG:g}; crop it"
        )
    width, height = pixel_m(transform, rows, cols, crs, target)
    notes = [f"{rows} x {cols} pixels of {height:.4g} x {width:.4g} m in {crs_name(crs)}"]
    north_up = transform.b == transform.d == 0 and transform.a > 0 > transform.e
    if not north_up:
        mirrored = "! " * (transform.determinant > 0 and transform.a < 0)
        notes.append(f"{mirrored}the file is mirrored, rotated or upside down; resampled north-up, voids beside")
    if target == crs and north_up and is_kept(width, height, max(rows, cols), resolution_m):
        check_size(rows, cols, what, float(transform.a))
        grid = GridSpec(rows, cols, float(transform.a), float(transform.c), float(transform.f), _system(crs))
        return grid, None, notes
    resolution = resolution_m or float(f"{math.sqrt(width * height):.4g}")
    west, south, east, north = bounds_in(transform, rows, cols, crs, target)
    high, wide = (int(min(side / resolution, MAX_CELLS) + 1e-6) for side in (north - south, east - west))
    if high < 1 or wide < 1:
        raise TerrainError(f"{what} is {north - south:.3g} x {east - west:.3g} m: no cell of {resolution:g} m fits")
    check_size(high, wide, what, resolution)
    notes.append(f"resampled to {high} x {wide} cells of {resolution:g} m in {crs_name(target)}")
    return GridSpec(high, wide, resolution, west, north, _system(target)), target, notes


def _system(crs: Any) -> str:
    """Text of a system in a GridSpec: as short as means the same."""
    if is_local(crs):
        return "local"
    short = crs.to_proj4().replace("=True", "")
    is_short = short and not crs.to_epsg() and rasterio.CRS.from_proj4(short) == crs
    return short if is_short else str(crs.to_string())


def check_size(rows: int, cols: int, what: str, resolution_m: float = 0.0) -> None:
    """Raises TerrainError unless there are 1 to `MAX_CELLS` cells; with their size it names one that is allowed."""
    if rows < 1 or cols < 1 or rows * cols > MAX_CELLS:
        least_m = resolution_m * math.sqrt(max(rows * cols, 0) / MAX_CELLS) * 1.01  # more than three digits lose
        coarser = f", or set terrain.resolution_m to at least {least_m:.3g}" if least_m > resolution_m else ""
        raise TerrainError(f"{what} has {rows} x {cols} cells; 1 to {MAX_CELLS} are allowed: crop it{coarser}")


def transform_of(grid: GridSpec) -> Any:
    """The affine transform from (col, row) of a grid to metres."""
    return from_origin(grid.west_m, grid.north_m, grid.resolution_m, grid.resolution_m)


@dataclass(frozen=True, eq=False)
class Placed:
    """Transformation of a raster onto the grid of a terrain.

    transform, crs  affine transform and coordinate system of the raster
    target          the grid's system
    share           of the terrain, within the raster's frame
    is_cells        whether the raster's pixels are the terrain's cells, which then are taken as they are
    """

    dataset: Any
    grid: GridSpec
    transform: Any
    crs: Any
    target: Any
    share: float = 1.0
    is_cells: bool = False

    @property
    def grows(self) -> bool:
        """True if the grid is at least half as coarse again: then its cells are averaged or counted."""
        size = self.dataset.height, self.dataset.width
        width, height = pixel_m(self.transform, *size, self.crs, self.target)
        return self.grid.resolution_m >= 1.5 * max(width, height)

    def on_grid(
        self, how: str, indexes: Any = 1, what: str = "", progress: Progress = no_progress
    ) -> Iterator[tuple[slice, Floats]]:
        """Some rows of the grid at a time, and their values, float32; NaN where the raster shows nothing.

        how       the name of one of rasterio's resamplings
        indexes   a band, or several
        what      the current step, as `progress` tells it
        """
        grid, dataset = self.grid, self.dataset
        is_real = np.dtype(dataset.dtypes[0]).kind == "f"
        void = math.nan if dataset.nodata is None and is_real else dataset.nodata
        resampling = Resampling.nearest if self.is_cells else Resampling[how]
        place = transform_of(grid)
        own = place if self.is_cells else self.transform
        size = {"width": grid.cols, "height": grid.rows, "dtype": "float32", "nodata": math.nan}
        crs = self.crs
        west, _, east, _ = bounds_in(own, dataset.height, dataset.width, crs, crs)
        if crs.is_geographic and not -180 <= west <= east <= 180:  # where PROJ's degrees do not go on
            same = crs.to_proj4().replace("=True", "")
            crs = rasterio.CRS.from_proj4(f"{same} +lon_wrap={(west + east) / 2:.9f}")
        source = {"src_crs": crs, "src_transform": own, "src_nodata": void}
        # A photo shows nothing only where no band does.
        target = {"crs": self.target, "transform": place, "NUM_THREADS": "ALL_CPUS", "UNIFIED_SRC_NODATA": "YES"}
        with WarpedVRT(dataset, resampling=resampling, **source, **target, **size) as cells:
            for row0, row1 in bands(grid.rows, READ_ROWS):
                yield slice(row0, row1), cells.read(indexes, window=((row0, row1), (0, grid.cols)))
                progress(what, row1 / grid.rows)


def place_on(dataset: Any, grid: GridSpec, given: str | None, what: str, key: str = "terrain.crs") -> Placed:
    """Returns the transformation of a file onto the terrain's grid.

    given  its system, as the value of `key` in the scenario; "local" is that of a terrain without a place. That of
           the terrain counts for files which do not state theirs

    Raises TerrainError if one of the two has no place on Earth and they differ in size, the file does not say in
    which system it is (nor does `given`), or does not overlap the terrain. Also on a picture without a place whose
    camera was turned: its pixels lie otherwise than it is shown.
    """
    same_shape = (dataset.height, dataset.width) == grid.shape
    has_place, own = not dataset.transform.is_identity, own_system(dataset, what)
    exif = dataset.tags().get("EXIF_Orientation", "1")
    if not has_place and exif != "1":
        raise TerrainError(f"{what} has EXIF orientation {exif}, expected 1: save it upright, or georeference it")
    given = None if own and key == "terrain.crs" else given
    if not has_place or (grid.crs == "local" and given is None):
        if not same_shape:
            raise TerrainError(
                f"{what} has {dataset.height} x {dataset.width} pixels and no place in common with the terrain of"
                f" {grid.rows} x {grid.cols} cells; georeference both, or make them the same size"
            )
        metres = rasterio.CRS.from_wkt(METRES)
        return Placed(dataset, grid, dataset.transform, metres, metres, is_cells=True)
    target, crs = systems_of(grid, own, given, what, key)
    if target is None:
        target = crs = rasterio.CRS.from_wkt(METRES)
    with reprojecting(what, crs, target):
        west, south, east, north = bounds_in(dataset.transform, dataset.height, dataset.width, crs, target)
    grid_east = grid.west_m + grid.cols * grid.resolution_m
    grid_south = grid.north_m - grid.rows * grid.resolution_m
    wide = min(east, grid_east) - max(west, grid.west_m)
    high = min(north, grid.north_m) - max(south, grid_south)
    if wide <= 0 or high <= 0:
        raise TerrainError(
            f"{what} does not overlap the terrain: it covers x {west:.7g}..{east:.7g}, y {south:.7g}..{north:.7g},"
            f" the terrain x {grid.west_m:.7g}..{grid_east:.7g}, y {grid_south:.7g}..{grid.north_m:.7g}"
        )
    share = wide * high / (grid.rows * grid.cols * grid.resolution_m**2)
    is_cells = crs == target and same_shape and dataset.transform.almost_equals(transform_of(grid), 1e-3)
    return Placed(dataset, grid, dataset.transform, crs, target, share, is_cells)
