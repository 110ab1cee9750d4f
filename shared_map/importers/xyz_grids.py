"""Heights as text: points x, y, z of a regular grid (.xyz, .csv).

GDAL's driver for such files is not used: it fills missing points with 0 where 0 is a height, too, and refuses
points that do not come row by row.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rasterio import CRS
from rasterio.transform import from_origin

from shared_map.importers.georeference import check_size
from shared_map.importers.raster_files import Numbers
from swarm.config.input_files import FileKind, read_lines
from swarm.errors import TerrainError

_KIND = FileKind.POINTS
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


class _Layout(NamedTuple):
    """Layout of a text.

    what       names the file in sentences
    delimiter  between numbers; None is any blank
    header     number of the line that names columns; 0 if there is none
    columns    of x, y and z
    degrees    whether x and y are longitude and latitude
    """

    path: Path
    what: str
    delimiter: str | None
    header: int = 0
    columns: tuple[int, int, int] = (0, 1, 2)
    degrees: bool = False


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
    return _points(_layout(path, what))


# --- text to numbers ----------------------------------------------------------------------------------------


def _layout(path: Path, what: str) -> _Layout:
    number, first = next((each for lines in _lines(path) for each in lines.items()), (0, ""))
    if not first:
        raise TerrainError(f"{what} holds no numbers")
    delimiter = next((each for each in ";\t," if each in first), None)
    words = [word.strip(" \"'").lower() for word in first.split(delimiter)]
    try:
        np.array([word or "nan" for word in words], np.float64)
    except ValueError:
        x, y, z = (next((words.index(name) for name in names if name in words), None) for names in (_X, _Y, _Z))
        if x is None or y is None or z is None:
            raise TerrainError(f"{what}, line {number}: {first[:60]!r} names no x, y, z or lon, lat, z") from None
        degrees = words[x] in _DEGREES and words[y] in _DEGREES
        return _Layout(path, what, delimiter, number, (x, y, z), degrees)
    if len(words) < 3 or (path.suffix.lower() != ".xyz" and words[3:] not in ([], [""])):
        raise TerrainError(f"{what}: its first line has {len(words)} numbers; expected x, y and z")
    return _Layout(path, what, delimiter)


def _lines(path: Path) -> Iterator[dict[int, str]]:
    """Number -> line of those that are neither empty nor a comment, some at a time."""
    stripped = ((n, line.strip(" ")) for n, line in enumerate(read_lines(path, _KIND, _LONGEST), 1))
    kept = ((n, line) for n, line in stripped if line and not line.startswith("#"))
    while lines := dict(itertools.islice(kept, _LINES)):
        yield lines


def _numbers(layout: _Layout) -> Iterator[Points]:
    """float64 (lines, columns) of the text, piece by piece; empty fields are NaN."""
    mark = layout.delimiter
    empty = None if mark is None else re.compile(f"(?:(?<={mark})|^) *(?={mark}|$)")

    def numbers_of(lines: Iterable[str]) -> Points:
        filled = lines if empty is None else [empty.sub("nan", line) for line in lines]
        return np.loadtxt(filled, np.float64, delimiter=mark, usecols=layout.columns, ndmin=2, comments=None)

    for lines in _lines(layout.path):
        lines.pop(layout.header, None)
        if not lines:
            continue
        try:
            yield numbers_of(lines.values())
        except _NO_NUMBERS as error:
            for number, line in lines.items():
                try:
                    numbers_of([line])
                except _NO_NUMBERS as fault:
                    why = re.split(r" at row|: row", str(fault))[0][:120]
                    raise TerrainError(f"{layout.what}, line {number}: {why}; expected x, y and z") from error
            raise


# --- points -------------------------------------------------------------------------------------------------


class _Axis(NamedTuple):
    """Middles of cells along x or y: the first, the last, how far apart, how many."""

    first: float
    last: float
    step: float
    cells: int


def _points(layout: _Layout) -> Numbers:
    what, total = layout.what, 0
    xs = ys = np.zeros(0)
    for part in _numbers(layout):
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
    for part in _numbers(layout):  # a second time: to hold the points would take ten times their grid
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
    crs = CRS.from_epsg(4326) if layout.degrees else None
    return Numbers(heights.reshape(down.cells, across.cells), place, crs, tuple(notes))


def _axis(values: NDArray[np.float64], name: str, what: str) -> _Axis:
    """The even steps that the different values along an axis lie on. Raises TerrainError if they lie on none."""
    span = float(values[-1] - values[0]) if len(values) else 0.0
    apart = values[np.concatenate(([True], np.diff(values) > _SAME * span))]
    gaps = np.diff(apart)
    if span <= 0 or not len(gaps):
        raise TerrainError(f"{what}: all points have the same {name}; a grid has at least two of each")
    # Printed coordinates are rounded: the step is the whole extent over the number of steps, not the smallest gap.
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    at = np.concatenate(([0], np.cumsum(np.rint(gaps / step))))
    step = float(apart[-1] - apart[0]) / float(at[-1])
    if np.abs(apart - apart[0] - at * step).max() > _OFF_STEP * step:
        raise _irregular(what, f"{name} has gaps from {gaps.min():g} to {gaps.max():g}, of no common step")
    return _Axis(float(apart[0]), float(apart[-1]), step, int(at[-1]) + 1)


def _irregular(what: str, why: str) -> TerrainError:
    return TerrainError(f"{what}: its points lie on no regular grid: {why}; gdal_grid makes one of them")
