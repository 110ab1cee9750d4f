"""The one exporter of geometries and rasters, for other programs: a GIS, a spreadsheet, a navigation device.

| ending     | driver            | places                                                                      |
|------------|-------------------|-----------------------------------------------------------------------------|
| `.geojson` | GDAL's GeoJSON    | WGS 84, longitude first (RFC 7946); metres of the map where it has no place |
| `.gpkg`    | GDAL's GeoPackage | metres of the map, in its own coordinate system; one file holds all layers  |
| `.kml`     | GDAL's LIBKML     | WGS 84, laid on the ground                                                  |
| `.gpx`     | GDAL's GPX        | WGS 84; lines are tracks, points are waypoints, areas cannot be written     |
| `.csv`     | Python's csv      | a row per point, in metres and degrees; an area or a route as WKT           |
| `.tif`     | GDAL's GeoTIFF    | pixels of the map (`write_raster`)                                          |

Names of fields end in their unit: `_m`, `_s`, `_s_per_m`, `_m2`. A layer with costs says how they count (`COSTS`)
in the description of the layer or file, CSV in a column. All formats but CSV and GeoTIFF need the extra "vectors".
"""

from __future__ import annotations

import csv
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from launch_scripts.report import AREAS, FORMATS, ON_EARTH
from shared_map.terrain.map_frame import MapFrame
from swarm.errors import ConfigError, StoreError, require
from swarm.files import check_writable, replacing, write_file
from swarm.grid import GridSpec

COSTS = "Costs are seconds of travel: a step takes its length times the pace (s/m) of the cell that it enters."
"""The convention of costs, in each file that has some."""
_MEANINGS = {
    "lower_bound_s": "no route takes less than this", "certified_gap": "cost over a proven lower bound",
    "steps": "from cell to cell", "up_m": "sum of all climbs", "down_m": "sum of all descents",
    "height_m": "height of the ground", "at_m": "from the start", "at_s": "from the start",
    "from": "JSON, first cell", "to": "JSON, last cell", "from_s": "least of the area", "to_s": "most of the area",
}  # fmt: skip
"""Field -> its meaning, in the description of each layer which has costs and the field."""

Value = str | int | float | np.datetime64 | list[Any] | dict[str, Any] | None
FieldKind = Literal["text", "int", "flag", "real", "time", "json"]
Shape = Literal["Point", "LineString", "Polygon"]
Points = NDArray[np.float64]
"""float64 (n, 2): x and y in metres of the map, or (n, 3) with the height; a ring ends with its first point."""
TIMED: Mapping[str, FieldKind] = {"begins": "time", "ends": "time", "samples": "int", "length_m": "real"}
"""Fields of a track beside those which say whose it is."""


@dataclass(frozen=True, eq=False)
class Feature:
    """One geometry and its values.

    parts    polygon: its rings; line: one array of points; point: one array of one point
    time_ns  int64 (n,), UNIX time of each point of a line
    """

    parts: list[Points]
    values: Mapping[str, Value]
    time_ns: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class Layer:
    """Features of one shape with the same fields.

    about  a sentence for the description of the layer
    """

    name: str
    shape: Shape
    fields: Mapping[str, FieldKind]
    features: list[Feature] = field(default_factory=list)
    about: str = ""

    def described(self) -> str:
        """Returns the description: what the layer is about, and the meaning of its fields."""
        fields = [f"{name}: {_MEANINGS[name]}" for name in self.fields if name in _MEANINGS]
        return f"{self.about} {'; '.join(fields)}.".strip(" .") + "." if self.about else ""


def check_target(path: Path | None, option: str, *endings: str, force: bool = False) -> None:
    """Raises ConfigError or StoreError now, not after the work, if a file cannot be written.

    endings  allowed ones; none: any
    force    the file may exist, and is replaced
    """
    if path is None:
        return
    if path.is_dir():
        raise ConfigError(f"{option} {path}: cannot write a file there, it is a folder")
    if endings and path.suffix.lower() not in endings:
        found = f"the ending {path.suffix!r}" if path.suffix else "no ending"
        raise ConfigError(f"{option} {path}: found {found}, expected {' or '.join(endings)}")
    if not path.parent.is_dir():
        raise ConfigError(f"{option} {path}: cannot write there, the folder {path.parent} does not exist")
    if path.is_file() and not force:
        raise ConfigError(f"{option} {path}: the file exists; --force replaces it")
    if FORMATS.get(path.suffix.lower()):
        require("the command", "pyogrio", "shapely")
    check_writable(path.parent, file=path)


def check_on_earth(path: Path, frame: MapFrame) -> None:
    """Raises ConfigError where the terrain lies nowhere, and the file's format needs latitudes."""
    if frame.grid.crs == "local":
        known = "name its system (--crs, terrain.crs), or write .csv, .geojson or .gpkg"
        raise ConfigError(f"--out {path}: the terrain has no place on Earth: {known}")


def write_layers(path: Path, layers: Sequence[Layer], frame: MapFrame) -> None:
    """Writes layers in the format of the file's ending; of formats which hold one layer, the first.

    Raises
    ------
    ConfigError
        On another ending, and on a map without a place or an area where the format needs or forbids one.
    StoreError
        If the file cannot be written.
    """
    check_target(path, "--out", *FORMATS, force=True)
    ending = path.suffix.lower()
    driver = FORMATS[ending]
    if ending in ON_EARTH:
        check_on_earth(path, frame)
    if ending not in AREAS and any(layer.shape == "Polygon" for layer in layers):
        raise ConfigError(f"--out {path}: {driver} has no areas; write {' or '.join(AREAS)}")
    with replacing(path) as half:
        if not driver:
            _write_csv(half, layers[0], frame)
            return
        extra = map(_places_of, filter(_is_timed, layers)) if driver == "GPKG" else ()
        for number, layer in enumerate([*layers, *extra]):
            _write_layer(half, layer, frame, driver, append=number > 0)


# --- by GDAL ------------------------------------------------------------------------------------------------------

_TYPES: Mapping[FieldKind, Any] = {
    "text": object, "json": object, "int": np.int64, "flag": np.int32, "real": np.float64, "time": "datetime64[ms]"
}  # fmt: skip


def _write_layer(path: Path, layer: Layer, frame: MapFrame, driver: str, append: bool) -> None:
    import shapely
    from pyogrio import raw
    from pyogrio.errors import DataLayerError, DataSourceError

    placed, crs = frame.grid.crs != "local", None
    description = layer.described() or layer.name
    kinds, options, whole = dict[str, FieldKind](), {"DESCRIPTION": description}, dict[str, str]()
    match driver:
        case "GeoJSON":
            kinds = {"layer": "text", **({"times": "json"} if _is_timed(layer) else {})}
            options["COORDINATE_PRECISION"] = "8" if placed else "3"
        case "LIBKML":
            kinds, crs = {"tessellate": "flag", "altitudeMode": "text"}, "EPSG:4326"
        case "GPX":
            layer, options, crs = _gpx_points(layer), {}, "EPSG:4326"
            whole = {"METADATA_DESCRIPTION": description}
        case "GPKG":
            crs = named_system(frame) if placed else None
            # QGIS and ArcGIS of before 2020 open no newer one.
            whole = {} if append else {"VERSION": "1.2"}
    kinds |= layer.fields
    constant = {"layer": layer.name, "tessellate": 1, "altitudeMode": "clampToGround"}
    values: dict[str, list[Any]] = {
        name: [each.values.get(name, constant.get(name)) for each in layer.features] for name in kinds
    }
    if "times" in kinds:
        values["times"] = [
            None if each.time_ns is None else [*map(iso_time, each.time_ns)] for each in layer.features
        ]
    for name in (name for name, kind in kinds.items() if kind == "json"):
        # GDAL writes a text which is JSON as JSON into GeoJSON.
        values[name] = [None if value is None else json.dumps(value) for value in values[name]]
    high = any(part.shape[1] == 3 for feature in layer.features for part in feature.parts)
    try:
        with warnings.catch_warnings():
            # RFC 7946 has no system to name, nor has a site; GPX ends at 180 degrees, and begins at -180.
            warnings.filterwarnings("ignore", "'crs' was not provided|Longitude")
            raw.write(
                path,
                # Borders against the clock, holes with it, as RFC 7946 has it.
                shapely.to_wkb(
                    shapely.orient_polygons(_shapes(layer, frame, placed and driver != "GPKG")),
                    output_dimension=3 if high else 2,
                ),
                [np.array(values[name], _TYPES[kind]) for name, kind in kinds.items()],
                list(kinds),
                layer=layer.name,
                driver=driver,
                geometry_type=f"{layer.shape} Z" if high else layer.shape,
                crs=crs,
                append=append,
                layer_options=options,
                dataset_options=whole,
                gdal_tz_offsets={  # 100 is UTC
                    name: np.full(len(layer.features), 100) for name, kind in kinds.items() if kind == "time"
                },
            )
    except (DataSourceError, DataLayerError) as error:
        raise StoreError(f"cannot write {path}: {error}") from error


def _shapes(layer: Layer, frame: MapFrame, degrees: bool) -> NDArray[Any]:
    """The geometries of a layer, in degrees or in metres of the map."""
    import shapely

    shapes = np.empty(len(layer.features), object)
    for n, feature in enumerate(layer.features):
        parts = [in_degrees(part, frame) for part in feature.parts] if degrees else feature.parts
        if not all(np.isfinite(part[:, :2]).all() for part in parts):
            raise StoreError(
                f"cannot write the layer {layer.name}: a place has no longitude and latitude in "
                f"{frame.grid.crs[:60]}; write a .gpkg, which is in metres of the map"
            )
        holes = [parts[1:]] if layer.shape == "Polygon" else []
        shapes[n] = getattr(shapely, layer.shape)(parts[0], *holes)
    return shapes


def _is_timed(layer: Layer) -> bool:
    return any(each.time_ns is not None for each in layer.features)


def _gpx_points(layer: Layer) -> Layer:
    """The points of a layer as GDAL's GPX driver wants them: of lines their track points, of points waypoints."""
    names = [str(each.values.get("name") or next(iter(each.values.values()), "")) for each in layer.features]
    if layer.shape == "Point":
        return Layer("waypoints", "Point", {"name": "text", "time": "time"}, [
            Feature(each.parts, {"name": name, "time": each.values.get("at", each.values.get("begins"))})
            for each, name in zip(layer.features, names, strict=True)
        ])  # fmt: skip
    fields: dict[str, FieldKind] = {
        "track_fid": "int", "track_seg_id": "int", "track_name": "text", "ele": "real", "time": "time",
    }  # fmt: skip
    return Layer("track_points", "Point", fields, [
        Feature([place[:, :2]], {
            "track_fid": number, "track_seg_id": 0, "track_name": names[number], "time": time,
            "ele": round(float(place[0, 2]), 2) if place.shape[1] == 3 else None,
        })
        for number, _, place, time in _points_of(layer)
    ])  # fmt: skip


def _points_of(layer: Layer) -> Iterator[tuple[int, Feature, Points, np.datetime64 | None]]:
    """The points of lines: number of the line, the line, the place, float64 (1, 2) or (1, 3), and its time."""
    for number, line in enumerate(layer.features):
        for n, place in enumerate(line.parts[0]):
            yield number, line, place[None], None if line.time_ns is None else moment(line.time_ns[n])


def _places_of(layer: Layer) -> Layer:
    """The points of a layer of lines, each with its time: what a GIS plays back."""
    own = {name: kind for name, kind in layer.fields.items() if name not in TIMED}
    return Layer(layer.name.replace("_tracks", "_places"), "Point", {**own, "at": "time"}, [
        Feature([place], {**{name: line.values[name] for name in own}, "at": time})
        for _, line, place, time in _points_of(layer)
    ])  # fmt: skip


# --- as a table ---------------------------------------------------------------------------------------------------


def _write_csv(path: Path, layer: Layer, frame: MapFrame) -> None:
    """A row per point, with metres of the map, and degrees where it has a place. An area, and a line without times,
    is one row, with its shape as WKT, longitude first. The last column of a layer with costs states their rule."""
    layer = _places_of(layer) if _is_timed(layer) else layer
    placed = frame.grid.crs != "local"
    if layer.shape != "Point":
        import shapely

        digits = 8 if placed else 3
        texts = shapely.to_wkt(_shapes(layer, frame, placed), rounding_precision=digits, output_dimension=2)
        names, where = ["wkt"], [[text] for text in texts]
    else:
        points = np.concatenate([np.empty((0, 2)), *(each.parts[0][:, :2] for each in layer.features)])
        degrees = in_degrees(points, frame)[:, ::-1].round(8) if placed else np.empty((len(points), 0))
        names = ["x_m", "y_m", *(["lat", "lon"] if placed else [])]
        where = [[*xy, *lat_lon] for xy, lat_lon in zip(points.round(3).tolist(), degrees.tolist(), strict=True)]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        rule = {"cost_rule": "pace of the cell entered"} if layer.about == COSTS else {}
        writer.writerow([*layer.fields, *names, *rule])
        for feature, place in zip(layer.features, where, strict=True):
            values = (feature.values[name] for name in layer.fields)
            texts = (json.dumps(each) if isinstance(each, list | dict) else iso_time(each) for each in values)
            writer.writerow([*texts, *place, *rule.values()])


# --- values and shapes --------------------------------------------------------------------------------------------


def moment(time_ns: np.int64) -> np.datetime64:
    """A UNIX time in ns, to the millisecond."""
    return np.datetime64(int(time_ns) // 1_000_000, "ms")


def iso_time(value: Any) -> Any:
    """A time in words, `2026-11-22T15:41:15.250Z`, also of UNIX time in ns; any other value as it is."""
    if isinstance(value, np.int64):
        value = moment(value)
    if not isinstance(value, np.datetime64):
        return value
    return f"{np.datetime_as_string(value, 'ms')}Z"


def in_degrees(points: Points, frame: MapFrame) -> Points:
    """Longitudes and latitudes of points of the map, with their heights where they have some; without a jump where
    the map crosses 180 degrees."""
    lat, lon = frame.to_degrees(points[:, 0], points[:, 1])
    return np.column_stack([np.where(lon < _least_lon(frame), lon + 360.0, lon), lat, points[:, 2:]])


@lru_cache(4)
def _least_lon(frame: MapFrame) -> float:
    """Smaller longitudes lie beyond 180 degrees. Kept: each of thousands of points is a feature of a GPX file."""
    from swarm.places import bounds_of

    box = bounds_of(frame)
    return -360.0 if box is None or box[3] <= 180.0 else 0.0


def areas_of(
    values: NDArray[np.int32], inside: NDArray[np.bool_], grid: GridSpec
) -> Iterator[tuple[int, list[Points]]]:
    """(value, rings) of each connected area of equal value, in metres of the map: its border, then its holes.

    values, inside  (rows, cols); cells that are not `inside` belong to no area
    """
    from rasterio.features import shapes

    for shape, value in shapes(values, mask=inside, transform=transform_of(grid)):
        yield int(value), [np.array(ring, np.float64) for ring in shape["coordinates"]]


def turns_of(cells: NDArray[np.int64], grid: GridSpec) -> NDArray[np.int64]:
    """The cells of a route at which it turns, and both ends: int64 (n,)."""
    rows, cols = np.divmod(cells, grid.cols)
    turns = np.ones(len(cells), np.bool_)
    turns[1:-1] = (np.diff(rows, 2) != 0) | (np.diff(cols, 2) != 0)
    return cells[turns]


def named_system(frame: MapFrame) -> str:
    """The coordinate system of a map as WKT; one without a name gets one, by which a GIS lists it."""
    return str(frame.system.to_wkt()).replace('"unknown"', '"map of this terrain"')


# --- rasters ------------------------------------------------------------------------------------------------------


def transform_of(grid: GridSpec) -> Any:
    """The transform of rasterio from pixels to metres of the map."""
    from rasterio.transform import from_origin

    return from_origin(grid.west_m, grid.north_m, grid.resolution_m, grid.resolution_m)


TIFF = (".tif", ".tiff")


def write_raster(
    path: Path,
    bands: Sequence[NDArray[Any]],
    grid: GridSpec,
    *,
    descriptions: Sequence[str] = (),
    unit: str = "",
    tags: Mapping[str, str] | None = None,
    **profile: Any,
) -> None:
    """Writes a tiled, compressed GeoTIFF with overviews (its tile pyramid). A terrain without a place gets none.

    bands         (rows, cols) each, of one dtype
    descriptions  meaning of each band
    unit          unit of the first band, as a GIS shows it: s, s/m
    profile       as rasterio takes it, such as nodata

    Raises StoreError if it cannot be written.
    """
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.enums import Resampling
    from rasterio.errors import RasterioError

    side = {"tiled": True, "blockxsize": 256, "blockysize": 256} if min(grid.rows, grid.cols) >= 256 else {}
    size = {"height": grid.rows, "width": grid.cols, "count": len(bands), "dtype": bands[0].dtype}
    crs = None if grid.crs == "local" else named_system(MapFrame(grid))
    where = {"crs": crs, "transform": transform_of(grid)}
    try:
        with (
            replacing(path) as half,
            rasterio.open(
                half, "w", driver="GTiff", compress="deflate", **where, **side, **size, **profile
            ) as file,
        ):
            for number, band in enumerate(bands, 1):
                file.write(band, number)
            for number, text in enumerate(descriptions, 1):
                file.set_band_description(number, text)
            file.set_band_unit(1, unit)
            file.update_tags(TIFFTAG_SOFTWARE=f"terrain-swarm {version('terrain-swarm')}", **(tags or {}))
            factors = [2**n for n in range(1, 8) if max(grid.rows, grid.cols) // 2**n >= 128]
            if factors:
                file.build_overviews(factors, Resampling.nearest)
    except (RasterioError, CPLE_BaseError) as error:
        raise StoreError(f"cannot write {path}: {error.__cause__ or error}") from error


# --- missions of ground stations: QGroundControl's .plan, Mission Planner's .waypoints ----------------------------

_WAYPOINT = 16
"""MAVLink's command to drive to a place."""
_FRAME = 3
"""MAVLink's frame of degrees with heights above home."""
_PLAN = Path(__file__).with_name("templates") / "mission.plan"
"""A plan with one item, whose form all have. It is of a ground vehicle (MAVLink's number 10) and of PX4 (12): a
ground station asks before it uploads to another."""


def write_mission(path: Path, places: Sequence[tuple[float, float]]) -> None:
    """Writes places, each (latitude, longitude), in the format of the file's ending; the first is the home.

    Raises StoreError if the file cannot be written.
    """
    rows = [[_FRAME, _WAYPOINT, 0, 0, 0, 0, round(lat, 8), round(lon, 8), 0] for lat, lon in places]
    if path.suffix.lower() == ".waypoints":
        home = [0, _WAYPOINT, *rows[0][2:]]
        lines = [[number, int(not number), *row, 1] for number, row in enumerate([home, *rows])]
        text = "\n".join(["QGC WPL 110", *("\t".join(map(str, line)) for line in lines)]) + "\n"
    else:
        plan = json.loads(_PLAN.read_text(encoding="utf-8"))
        (form,) = plan["mission"]["items"]
        plan["mission"] |= {
            "plannedHomePosition": [*places[0], 0],
            "items": [
                {**form, "doJumpId": number, "frame": frame, "command": command, "params": params}
                for number, (frame, command, *params) in enumerate(rows, 1)
            ],
        }
        text = json.dumps(plan, indent=1)
    write_file(path, text.encode())
