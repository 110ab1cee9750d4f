"""Grids in plain formats: NumPy's .npz, MovingAI .map, ROS map_server's YAML with its image, and points x, y, z of
a regular grid as text (.xyz, .csv).

A header is checked against the file's length and the largest grid before memory is taken. GDAL's driver for points
is not used: it fills missing points with 0 where 0 is a height, too, and refuses points that do not come by rows.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import yaml
from msgspec import Meta, Struct
from numpy.typing import NDArray
from PIL import Image
from rasterio import CRS
from rasterio.transform import from_origin

from shared_map.array_files import Floats
from shared_map.importers.gdal_rasters import LONGEST_REASON, Numbers, ShortReads, faults_of
from shared_map.importers.georeference import METRES, check_size
from swarm.config.explain import explain
from swarm.config.input_files import FileKind, check_bytes, read_lines, read_text, size
from swarm.errors import TerrainError

_NPZ_ARRAYS = ("elevation", "resolution_m", "dx", "dy", "xmin", "ymin", "ymax")
_READ_ARRAYS = "elevation and resolution_m, or elevation, dx, dy, xmin and ymin (degrees)"
_HEADER_BYTES = 4096
"""Bytes of an array's header that NumPy parses; headers of grids have some 120."""
_SHOWN_MEMBERS = 10
"""Unread arrays that a sentence names at most. Chosen, not measured."""
MAX_STEP = 1e7
"""Metres or degrees: a quarter of the way around the Earth."""
SCALE_FACTOR = 9.0
"""ROS `scale` mode: pace grows by up to this many times between free and occupied."""


# --- numpy's archives ---------------------------------------------------------------------------------------


def read_npz(path: Path, what: str) -> Numbers:
    """Arrays in an archive of NumPy's.

    elevation           (rows, cols), numbers; row 0 is in the north
    resolution_m        side of a cell, or
    dx, dy, xmin, ymin  in degrees, as in matplotlib's samples; `ymin` is the north latitude

    Raises
    ------
    TerrainError
        If the file cannot be read, its arrays would unpack to more than the file may have, or are not as above.
    """
    arrays, unread = _members(path, what)
    heights = arrays.pop("elevation", None)
    if heights is None:
        held = ", ".join(sorted([*arrays, *unread])) or "nothing"
        raise TerrainError(f"{what} has no `elevation` (read: {_READ_ARRAYS}); it has {held}")
    if heights.ndim != 2 or heights.size == 0 or heights.dtype.kind not in "iuf":
        raise TerrainError(f"{what}: elevation is {heights.shape} {heights.dtype}; expected rows of numbers")
    check_size(heights.shape[0], heights.shape[1], what)
    ignored = [f"! not read: the arrays {', '.join(unread)} (read: {_READ_ARRAYS})"] * bool(unread)
    heights, notes = heights.astype(np.float32), ("arrays of NumPy", *ignored)
    try:
        numbers = {name: float(array.item()) for name, array in arrays.items()}
    except (TypeError, ValueError) as error:
        raise TerrainError(f"{what}: its cell size is no single number: {error}") from error
    for name in {"resolution_m", "dx", "dy"} & numbers.keys():
        if not 0 < numbers[name] < MAX_STEP:
            raise TerrainError(f"{what}: the size of a cell is {numbers[name]:g}; it must be positive")
    if "resolution_m" in numbers:
        side_m = numbers["resolution_m"]
        return Numbers(heights, from_origin(0.0, 0.0, side_m, side_m), CRS.from_wkt(METRES), notes)
    if {"dx", "dy", "xmin", "ymin"} <= numbers.keys():
        # matplotlib's jacksboro file calls the northern latitude ymin and the southern one ymax.
        north = max(numbers["ymin"], numbers.get("ymax", -math.inf))
        place = from_origin(numbers["xmin"], north, numbers["dx"], numbers["dy"])
        return Numbers(heights, place, CRS.from_epsg(4326), notes)
    return Numbers(heights, notes=notes)


def _members(path: Path, what: str) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays of `_NPZ_ARRAYS` in an .npz, and the names of others, which are never unpacked."""
    kind = FileKind.ARRAYS
    check_bytes(path, kind)
    faults = faults_of(f"{what} is truncated or no .npz of numbers")
    with faults, ShortReads(path) as file, np.load(file, max_header_size=_HEADER_BYTES) as archive:
        wanted = [name for name in _NPZ_ARRAYS if name in archive.files]
        total = sum(archive.zip.getinfo(f"{name}.npy").file_size for name in wanted)
        if total > kind.most_bytes:
            most = size(kind.most_bytes)
            raise kind.refusal(path, f"its arrays would unpack to {size(total)}; at most {most} are read")
        unread = sorted(set(archive.files) - {*_NPZ_ARRAYS, "xmax"})
        return {name: archive[name] for name in wanted}, [name[:40] for name in unread[:_SHOWN_MEMBERS]]


# --- maps without heights -----------------------------------------------------------------------------------


def read_map(path: Path) -> Numbers:
    """MovingAI grid map: paces relative to open ground, which are 1 on `.` `G` `S` and inf on `@` `O` `T` `W`.

    Raises
    ------
    TerrainError
        If the file cannot be read, its rows are not what its header says, or a letter is unknown.
    """
    lines = read_lines(path, FileKind.TEXT_GRID)
    words = [line[:200].split() for line in itertools.islice(lines, 4)]
    try:
        ((_, kind), *_, (marker,)) = words
        header = {line[0]: line[-1] for line in words}
        rows, cols = int(header["height"]), int(header["width"])
        if marker != "map":
            raise ValueError(marker)
    except (ValueError, KeyError) as error:
        raise TerrainError(f"terrain {path} is no MovingAI map, which has type, height, width, map") from error
    check_size(rows, cols, f"terrain {path}")
    letters = np.full(256, np.nan, np.float32)
    letters[list(b".GS")], letters[list(b"@OTW")] = 1.0, np.inf
    factor = np.empty((rows, cols), np.float32)
    row = 0
    for row, line in enumerate(filter(str.strip, lines), 1):
        if row > rows or len(line) != cols:
            raise TerrainError(f"terrain {path}, line {row + 4}: {len(line)} cells; expected {rows} rows of {cols}")
        factor[row - 1] = letters[np.frombuffer(line.encode("ascii", "replace"), np.uint8)]
        if (unknown := np.isnan(factor[row - 1])).any():
            col = int(unknown.argmax())
            raise TerrainError(f"terrain {path}, line {row + 4}, column {col + 1}: {line[col]!r} is no ground")
    if row < rows:
        raise TerrainError(f"terrain {path} has {row} rows; its header says {rows}")
    return Numbers(factor, notes=(f"MovingAI map of type {kind}",))


class _RosMap(Struct, frozen=True):
    """The keys of a map_server's YAML; `origin` is the south-western corner and how far the image is turned."""

    image: str
    resolution: Annotated[float, Meta(gt=0, lt=MAX_STEP)]
    origin: Annotated[list[Annotated[float, Meta(ge=-_FURTHEST, le=_FURTHEST)]], Meta(min_length=2)]
    occupied_thresh: Annotated[float, Meta(ge=0, le=1)]
    free_thresh: Annotated[float, Meta(ge=0, le=1)]
    mode: Literal["trinary", "scale", "raw"] = "trinary"
    negate: bool = False


def read_ros(path: Path) -> Numbers:
    """ROS map_server: a yaml that names an image, its resolution, origin and thresholds.

    Paces relative to open ground are 1 on free, inf on occupied cells. Between the thresholds they are NaN in the
    mode `trinary`, and rise from 1 to 1 + `SCALE_FACTOR` in the modes `scale` and `raw`; in `raw`, values above 100
    are NaN.

    Raises
    ------
    TerrainError
        If a file cannot be read, a key is missing or out of range, or the origin is turned.
    """
    try:
        raw = yaml.safe_load(read_text(path, FileKind.ROS_MAP))
        found = msgspec.convert(raw if isinstance(raw, dict) else {}, _RosMap, strict=False)
    except msgspec.ValidationError as error:
        raise TerrainError(f"terrain {path} is no ROS map: {explain(str(error), raw, _RosMap, 'map')}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise TerrainError(f"terrain {path}: no YAML: {' '.join(str(error).split())[:LONGEST_REASON]}") from error
    west, south, *rotation = found.origin
    image, occupied, free = path.parent / found.image, found.occupied_thresh, found.free_thresh
    if rotation and abs(rotation[0]) > 1e-9:
        raise TerrainError(f"terrain {path}: the origin is turned by {rotation[0]:g} rad; turn the image instead")
    if free > occupied:
        raise TerrainError(f"terrain {path}: thresholds are {free:g}, {occupied:g}; expected free <= occupied")
    pixels = _grey(image)
    if found.negate:
        pixels = 255 - pixels
    factor = np.full(pixels.shape, np.nan, np.float32)
    is_raw = found.mode == "raw"
    known = pixels <= (100 if is_raw else 255)
    taken = pixels / np.float32(100) if is_raw else np.float32(1) - pixels / np.float32(255)
    factor[known & (taken < free)] = 1.0
    if found.mode != "trinary":
        between = known & (taken >= free) & (taken <= occupied)
        share = (taken[between] - np.float32(free)) / np.float32(max(occupied - free, 1e-6))
        factor[between] = np.float32(1) + np.float32(SCALE_FACTOR) * share
    factor[known & (taken > occupied)] = np.inf
    north = south + pixels.shape[0] * found.resolution
    place = from_origin(west, north, found.resolution, found.resolution)
    return Numbers(factor, place, notes=(f"ROS map, mode {found.mode}, {np.isnan(factor).mean():.1%} unknown",))


def _grey(path: Path) -> Floats:
    """The image of a ROS map: PGM, PNG or BMP. Colours count by their mean, as in map_server.

    Returns
    -------
    float32 (rows, cols)
        From 0 for black to 255 for white. Row 0 is on top; NaN where the image is transparent.

    Raises
    ------
    TerrainError
        If the file cannot be read, is no such image, or is shorter than its header says.
    """
    check_bytes(path, FileKind.IMAGE)
    faults = faults_of(f"image {path} is truncated or no PGM, PNG or BMP")
    with faults, Image.open(path, formats=("PPM", "PNG", "BMP")) as image:
        check_size(image.height, image.width, f"image {path}")
        if image.mode in ("L", "I", "I;16"):
            return np.asarray(image, np.float32) / np.float32(1 if image.mode == "L" else 257)
        colours = np.asarray(image.convert("RGBA"), np.float32)
    return np.where(colours[..., 3] > 0, colours[..., :3].mean(axis=-1), np.float32(np.nan))


_LINES, _LONGEST = 10_000, 4096
"""Lines that are read at once, and bytes of the longest: 40 MB."""
_MOST_STEPS = 1 << 20
"""More places along one axis are no grid."""
_SAME = 1e-6
"""Coordinates nearer to each other than this share of the whole extent are one."""
_FURTHEST = 1e9
"""Metres or degrees: 25 times around the Earth. Beyond it no system has coordinates, and float64 still tells a
micrometre."""
_OFF_STEP = 0.05
"""Share of a step: printed coordinates are rounded. Points further off would be put into cells whose middle they
miss."""
_LEAST_FILLED = 0.1
"""Share of a grid's cells: points with fewer are scattered, and a small file would ask for the memory of a large
grid."""
_X = ("x", "lon", "long", "lng", "longitude", "easting", "east", "e")
_Y = ("y", "lat", "latitude", "northing", "north", "n")
_Z = ("z", "h", "height", "elevation", "elev", "alt", "altitude", "dem", "value")
_DEGREES = ("lon", "long", "lng", "longitude", "lat", "latitude")

_NO_NUMBERS = (ValueError, IndexError, OverflowError)
"""Exceptions of numpy on malformed lines."""
Points = NDArray[np.float64]


def read_text_grid(path: Path, what: str) -> Numbers:
    """Heights of a text.

    Parameters
    ----------
    path : Path
        Numbers between commas, semicolons, tabs or blanks; a header may name x, y and z (or lon, lat ...). Points
        may come in any order, and coordinates are those of the middles of cells. Without a header, three columns
        (in .xyz: the first three) are x, y, z.
    what : str
        Names the file in sentences.

    Returns
    -------
    Numbers
        Missing points and empty fields are NaN.

    Raises
    ------
    TerrainError
        If the file cannot be read or is no text, a line holds what is no number, or the points lie on no regular
        grid.
    """
    points, is_degrees = _points_of(path, what)
    total, xs, ys = 0, np.zeros(0), np.zeros(0)
    for part in points():
        xs, ys = (np.unique(np.concatenate((known, part[:, n]))) for n, known in ((0, xs), (1, ys)))
        if not ((np.abs(xs) <= _FURTHEST).all() and (np.abs(ys) <= _FURTHEST).all()):
            raise TerrainError(f"{what}: a point has no x or no y, or one beyond {_FURTHEST:g}")
        total += len(part)
        if max(len(xs), len(ys)) > _MOST_STEPS:
            raise _irregular(what, f"x and y have more than {_MOST_STEPS} different values")
    across, down = _axis(xs, "x", what), _axis(ys, "y", what)
    cells, steps = down.cells * across.cells, f"{across.step:g} x {down.step:g}"
    if total < _LEAST_FILLED * cells:
        raise _irregular(what, f"{total} points are {total / cells:.1%} of a grid of {steps}")
    check_size(down.cells, across.cells, what)
    heights = np.full(cells, np.nan, np.float32)
    for part in points():  # a second time: to hold the points would take ten times their grid
        col = np.rint((part[:, 0] - across.first) / across.step).astype(np.intp)
        row = np.rint((down.last - part[:, 1]) / down.step).astype(np.intp)
        at = row * across.cells + col
        with np.errstate(over="ignore"):  # what is too large for float32 becomes infinite, which is no-data
            z = part[:, 2].astype(np.float32)
        before = heights[at]
        heights[at] = z
        other = (~np.isnan(before) & (before != z)) | (~np.isnan(z) & (heights[at] != z))
        if other.any():
            x, y, height_m = part[int(other.argmax())]
            raise TerrainError(f"{what}: two heights at x {x:g}, y {y:g}, of which one is {height_m:g}")
    missing = int(np.isnan(heights).sum())
    notes = [f"{total} points x, y, z, {steps} apart, the middles of cells"]
    if missing:
        notes.append(f"{missing} points of the grid ({missing / cells:.1%}) are missing or have no height: voids")
    west, north = across.first - across.step / 2, down.last + down.step / 2
    place = from_origin(west, north, across.step, down.step)
    crs = CRS.from_epsg(4326) if is_degrees else None
    return Numbers(heights.reshape(down.cells, across.cells), place, crs, tuple(notes))


# --- text to numbers ----------------------------------------------------------------------------------------


def _points_of(path: Path, what: str) -> tuple[Callable[[], Iterator[Points]], bool]:
    """Returns (what yields the points of a text, float64 (lines, 3), some at a time; whether x and y are longitude
    and latitude). Empty fields are NaN."""
    number, first = next(_lines(path), (0, ""))
    if not first:
        raise TerrainError(f"{what} holds no numbers")
    mark = next((each for each in ";\t," if each in first), None)
    decimal = "," if mark in (";", "\t") else "."
    words = [word.strip(" \"'").lower() for word in first.replace(decimal, ".").split(mark)]
    header, columns, is_degrees = 0, (0, 1, 2), False
    try:
        np.array([word or "nan" for word in words], np.float64)
    except ValueError:
        x, y, z = (next((words.index(name) for name in names if name in words), None) for names in (_X, _Y, _Z))
        if x is None or y is None or z is None:
            raise TerrainError(f"{what}, line {number}: {first[:60]!r} names no x, y, z or lon, lat, z") from None
        header, columns, is_degrees = number, (x, y, z), {words[x], words[y]} <= {*_DEGREES}
    else:
        if len(words) < 3 or (path.suffix.lower() != ".xyz" and words[3:] not in ([], [""])):
            raise TerrainError(f"{what}: its first line has {len(words)} numbers; expected x, y and z")
    empty = None if mark is None else re.compile(f"(?:(?<={mark})|^) *(?={mark}|$)")

    def numbers_of(lines: Iterable[str]) -> Points:
        filled = lines if empty is None else [empty.sub("nan", each.replace(decimal, ".")) for each in lines]
        return np.loadtxt(filled, delimiter=mark, usecols=columns, ndmin=2, comments=None, quotechar='"')

    def points() -> Iterator[Points]:
        kept = (each for each in _lines(path) if each[0] != header)
        while lines := dict(itertools.islice(kept, _LINES)):
            try:
                yield numbers_of(lines.values())
            except _NO_NUMBERS as error:
                for number, line in lines.items():
                    try:
                        numbers_of([line])
                    except _NO_NUMBERS as fault:
                        why = re.split(r" at row|: row", str(fault))[0][:120]
                        raise TerrainError(f"{what}, line {number}: {why}; expected x, y and z") from error
                raise

    return points, is_degrees


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number, line) of those that are neither empty nor a comment."""
    stripped = ((n, line.strip(" ")) for n, line in enumerate(read_lines(path, FileKind.POINTS, _LONGEST), 1))
    return ((n, line) for n, line in stripped if line and not line.startswith("#"))


# --- points -------------------------------------------------------------------------------------------------


class _Axis(NamedTuple):
    """Middles of cells along x or y: the first, the last, how far apart, how many."""

    first: float
    last: float
    step: float
    cells: int


def _axis(values: NDArray[np.float64], name: str, what: str) -> _Axis:
    """The even steps that the different values along an axis lie on. Raises TerrainError if they lie on none."""
    if len(values) < 2:
        raise TerrainError(f"{what}: its points have {len(values)} different {name}; a grid has at least two")
    span = float(values[-1] - values[0])
    apart = values[np.concatenate(([True], np.diff(values) > _SAME * span))]
    gaps = np.diff(apart)
    # Printed coordinates are rounded: the step is the whole extent over the number of steps, not the smallest gap.
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    at = np.concatenate(([0], np.cumsum(np.rint(gaps / step))))
    step = float(apart[-1] - apart[0]) / float(at[-1])
    if np.abs(apart - apart[0] - at * step).max() > _OFF_STEP * step:
        raise _irregular(what, f"{name} has gaps from {gaps.min():g} to {gaps.max():g}, of no common step")
    return _Axis(float(apart[0]), float(apart[-1]), step, int(at[-1]) + 1)


def _irregular(what: str, why: str) -> TerrainError:
    return TerrainError(f"{what}: its points lie on no regular grid: {why}; gdal_grid makes one of them")
