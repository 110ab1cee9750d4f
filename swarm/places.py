"""Places that people name and read: one written form, for commands, scenarios and programs.

    46.81230,9.84560     latitude and longitude, WGS 84 (on another planet or moon, its own degrees)
    xy:779610,190390     metres of the map: the terrain's coordinate system
    cell:40,200          row and column from the north-west corner; of an area's corner also cell:40.5,200.5

Two bare whole numbers may be a row and a column as well: they are what lies in the terrain. A text that fits both
is refused. Without a coordinate system two bare numbers are metres of the map.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol

from swarm.errors import ConfigError
from swarm.grid import GridSpec, real

Kind = Literal["cell", "xy", "latlon"]
Corner = tuple[float, float]
"""(row, col): (0, 0) is the north-west corner of the terrain, (1, 1) of the cell one further."""

FORMS = "LAT,LON in degrees, xy:X,Y in metres of the map, or cell:ROW,COL"
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_PLACE = re.compile(rf"(?:(cell|xy|latlon):)?\s*({_NUMBER})\s*,\s*({_NUMBER})\s*")
_WHOLE = re.compile(r"[+-]?\d+")
_MOST_DECIMALS = 12
"""A tenth of a micrometre in degrees: a float has no more."""
_MEANINGS: dict[Kind, str] = {
    "cell": "a row and a column",
    "xy": "metres of the map",
    "latlon": "a latitude and longitude",
}


class Frame(Protocol):
    """A grid, and where it lies. Both methods raise ConfigError where the grid's crs is "local"."""

    @property
    def grid(self) -> GridSpec: ...

    def from_wgs84(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """(x_m, y_m); not finite where the map's system is not defined."""

    def to_wgs84(self, x_m: float, y_m: float) -> tuple[float, float]:
        """(lat_deg, lon_deg); not finite where the map's system is not defined."""


class Place(NamedTuple):
    """A location as the user wrote it.

    kind   None of two bare numbers
    whole  whether both numbers were written without a point
    """

    text: str
    kind: Kind | None
    first: float
    second: float
    whole: bool


Given = str | Sequence[float] | Place
"""A place as commands and scenarios have it; two numbers in a list are row and column."""


def read_place(given: Given, what: str) -> Place:
    """Parses a location before its terrain is known.

    Parameters
    ----------
    what : str
        Names the place in errors.

    Raises
    ------
    ConfigError
        In one sentence, if it is no place.
    """
    if isinstance(given, Place):
        return given
    if not isinstance(given, str):
        try:
            row, col = (real(what, each) for each in given)
            return Place(f"[{row:.12g}, {col:.12g}]", "cell", row, col, row == int(row) and col == int(col))
        except (TypeError, ValueError, OverflowError):
            raise ConfigError(f"{what} is {str(given)[:60]}; expected {FORMS}, or row and column") from None
    match: Any = _PLACE.fullmatch(given.strip())
    if match is None:
        comma = re.sub(r"(?<=[\d.])[\s;]+(?=[-+.\d])", ",", given.strip(), count=1)
        perhaps = f"; did you mean {comma[:60]!r}?" if _PLACE.fullmatch(comma) else ""
        raise ConfigError(f"{what} is {given[:60]!r}; expected {FORMS}{perhaps}")
    kind, first, second = match.groups()
    whole = all(_WHOLE.fullmatch(number) for number in (first, second))
    place = Place(given.strip()[:60], kind, float(first), float(second), whole)
    if kind == "latlon" and not _is_degrees(place):
        raise ConfigError(f"{what} is {_text(place)}, expected a latitude (-90 to 90) and longitude (-360 to 360)")
    return place


def cell_of(given: Given, frame: Frame, what: str) -> int:
    """Returns the cell that a user names. Raises ConfigError as `read_place`, if the place is outside the terrain,
    and on a row or column that is no whole number: half a row may be half a map away."""
    place, grid = read_place(given, what), frame.grid
    if place.kind == "cell" and not place.whole:
        raise ConfigError(f"{what} is {_text(place)}; expected whole numbers: a row and a column")
    kinds = _kinds_of(place, grid)
    cells = {kind: cell for kind in kinds if (cell := _cell_at(_corner(place, kind, frame, what), grid)) >= 0}
    if not cells:
        extents = "; ".join(extent_of(frame, kind) for kind in kinds)
        raise ConfigError(f"{what} is {_text(place)}, outside the terrain: {extents}{_perhaps(place, frame)}")
    if len(set(cells.values())) > 1:
        raise ConfigError(f"{what} is {_text(place)}, {_two_meanings(kinds)}")
    return next(iter(cells.values()))


def corners_of(given: Sequence[Given], frame: Frame, what: str) -> list[Corner]:
    """The corners of an area, which may lie outside the terrain. Corners without a prefix must all have the same
    form."""
    places, grid = [read_place(each, what) for each in given], frame.grid
    bare = [place for place in places if place.kind is None]
    kinds = _kinds_of(bare[0]._replace(whole=all(place.whole for place in bare)), grid) if bare else ()
    if len(kinds) > 1:
        found = {kind: [_inside(_corner(place, kind, frame, what), grid) for place in bare] for kind in kinds}
        fitting = [kind for kind in kinds if all(found[kind])] or [kind for kind in kinds if any(found[kind])]
        if len(fitting) != 1:
            raise ConfigError(f"{what} begins with {_text(bare[0])}, {_two_meanings(kinds)}")
        kinds = (fitting[0],)
    corners = [_corner(place, place.kind or kinds[0], frame, what) for place in places]
    for place, corner in zip(places, corners, strict=True):
        if not all(map(math.isfinite, corner)):
            hint = _perhaps(place, frame)
            raise ConfigError(f"{what} is {_text(place)}, far from the terrain: {extent_of(frame)}{hint}")
    return corners


def written(frame: Frame, cell: int) -> str:
    """A cell for people, in every form that a place may be given in; each leads back to the cell."""
    row, col = frame.grid.row_col(cell)
    side_m, (x_m, y_m) = frame.grid.resolution_m, frame.grid.centre_m(cell)
    digits = min(max(math.ceil(-math.log10(side_m / 4)), 0), _MOST_DECIMALS)
    text = f"xy:{x_m:.{digits}f},{y_m:.{digits}f}"
    degrees = _degrees(frame, x_m, y_m)
    if degrees is not None:
        text += f", latlon:{_short(frame, degrees, cell)}"
    return f"cell:{row},{col} ({text})"


def fields_of(frame: Frame, cell: int) -> dict[str, Any]:
    """A cell for programs: row, col, x_m, y_m and, where the terrain has a place, lat and lon of its middle."""
    row, col = frame.grid.row_col(cell)
    x_m, y_m = frame.grid.centre_m(cell)
    fields = {"row": row, "col": col, "x_m": round(x_m, 6), "y_m": round(y_m, 6)}
    degrees = _degrees(frame, x_m, y_m)
    return fields if degrees is None else fields | {"lat": round(degrees[0], 9), "lon": round(degrees[1], 9)}


def extent_of(frame: Frame, kind: Kind | None = None) -> str:
    """Returns the extent of a terrain, for sentences: in one kind of coordinates, or in all that it has."""
    grid = frame.grid
    east_m, south_m = grid.west_m + grid.cols * grid.resolution_m, grid.north_m - grid.rows * grid.resolution_m
    parts: dict[Kind, str] = {
        "cell": f"{grid.rows} x {grid.cols} cells",
        "xy": f"x {grid.west_m:.10g} to {east_m:.10g}, y {south_m:.10g} to {grid.north_m:.10g}",
    }
    if kind in (None, "latlon") and grid.crs != "local" and (box := bounds_of(frame)) is not None:
        south, west, north, east = box
        parts["latlon"] = f"latitude {south:.5f} to {north:.5f}, longitude {west:.5f} to {east:.5f}"
    return ", ".join(parts.values()) if kind is None else parts.get(kind, "a terrain without latitudes")


def bounds_of(frame: Frame) -> tuple[float, float, float, float] | None:
    """(south, west, north, east) in degrees; east is above 180 where the terrain crosses that. None if unknown."""
    grid, many = frame.grid, 8
    steps = [n / many for n in range(many + 1)]
    edge = {(u, v) for u in steps for v in (0.0, 1.0)} | {(v, u) for u in steps for v in (0.0, 1.0)}
    found = []
    for u, v in sorted(edge):
        x_m = grid.west_m + u * grid.cols * grid.resolution_m
        y_m = grid.north_m - v * grid.rows * grid.resolution_m
        if (degrees := _degrees(frame, x_m, y_m)) is None:
            return None
        found.append(degrees)
    lons = [lon for _, lon in found]
    if max(lons) - min(lons) > 180:
        lons = [lon + 360 if lon < 0 else lon for lon in lons]
    lats = [lat for lat, _ in found]
    for pole in (90.0, -90.0):
        x_m, y_m = frame.from_wgs84(pole, 0.0)
        if math.isfinite(x_m) and math.isfinite(y_m) and grid.cell_at(x_m, y_m) >= 0:
            lats, lons = [*lats, pole], [-180.0, 180.0]
    return min(lats), min(lons), max(lats), max(lons)


# --- what is behind -------------------------------------------------------------------------------------------


def _kinds_of(place: Place, grid: GridSpec) -> tuple[Kind, ...]:
    """Returns the possible meanings of a location's numbers."""
    if place.kind is not None:
        return (place.kind,)
    usual: Kind = "xy" if grid.crs == "local" else "latlon"
    return (usual, "cell") if place.whole else (usual,)


def _corner(place: Place, kind: Kind, frame: Frame, what: str) -> Corner:
    """Returns the location by one meaning of its numbers; not finite if it is nowhere."""
    grid = frame.grid
    if kind == "cell":
        return place.first, place.second
    x_m, y_m = place.first, place.second
    if kind == "latlon":
        if grid.crs == "local":
            raise ConfigError(
                f"{what} is {_text(place)}, and the terrain has no place on Earth; give xy:X,Y in its own metres"
                " or cell:ROW,COL, or say where it lies with terrain.crs"
            )
        if not _is_degrees(place):
            return math.nan, math.nan
        x_m, y_m = frame.from_wgs84(place.first, place.second)
    return (grid.north_m - y_m) / grid.resolution_m, (x_m - grid.west_m) / grid.resolution_m


def _is_degrees(place: Place) -> bool:
    return abs(place.first) <= 90 and abs(place.second) <= 360


def _perhaps(place: Place, frame: Frame) -> str:
    """The end of a sentence about a place outside the terrain: its numbers exchanged, or as metres of the map,
    where the terrain has that."""
    kinds: tuple[Kind, ...] = ("xy",) if frame.grid.crs == "local" else ("latlon", "xy")
    for kind in kinds if place.kind != "cell" else ():
        for first, second in ((place.first, place.second), (place.second, place.first)):
            other = Place(f"{kind}:{first:.12g},{second:.12g}", kind, first, second, False)
            if _cell_at(_corner(other, kind, frame, ""), frame.grid) >= 0:
                return f"; did you mean {other.text!r}?"
    return ""


def _cell_at(corner: Corner, grid: GridSpec) -> int:
    if not all(map(math.isfinite, corner)):
        return -1
    row, col = (math.floor(value) for value in corner)
    return grid.cell(row, col) if grid.inside(row, col) else -1


def _inside(corner: Corner, grid: GridSpec) -> bool:
    return 0 <= corner[0] <= grid.rows and 0 <= corner[1] <= grid.cols


def _degrees(frame: Frame, x_m: float, y_m: float) -> tuple[float, float] | None:
    if frame.grid.crs == "local":
        return None
    degrees = frame.to_wgs84(x_m, y_m)
    return degrees if all(map(math.isfinite, degrees)) else None


def _short(frame: Frame, degrees: tuple[float, float], cell: int) -> str:
    """Degrees with as few decimals as lead back to within a quarter of a cell."""
    x_m, y_m = frame.grid.centre_m(cell)
    text = ""
    for digits in range(4, _MOST_DECIMALS + 1):
        lat, lon = (f"{value:.{digits}f}" for value in degrees)
        text = f"{lat},{lon}"
        if math.dist(frame.from_wgs84(float(lat), float(lon)), (x_m, y_m)) < frame.grid.resolution_m / 4:
            break
    return text


def _text(place: Place) -> str:
    return place.text if place.text.startswith("[") else repr(place.text)


def _two_meanings(kinds: tuple[Kind, ...]) -> str:
    meanings = " and ".join(f"{_MEANINGS[kind]} ({kind}:)" for kind in kinds)
    return f"which may be {meanings}: write one of these before it"
