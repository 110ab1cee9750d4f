"""Colour photo and slope -> what covers the ground: by rules without any labels, or learnt from a few.

Rules look at means of colours, at texture and at slope, a tile at a time: a tile's arrays fit into the cache of a
core, and this is most of what an import costs. They do not depend on the exposure of a photo.

A shadow is as dark and blue as a lake, but lies on a slope and is not smooth; a cloud is as bright as snow and
never water. Water must therefore be flat, smooth and bluish or nearly black, and is grown from cells where that is
certain.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.terrain.pace_layers import READABLE, TerrainClass, grade_of_padded, polygon_mask, spread
from shared_map.terrain.row_bands import Progress, counted, in_bands, looked_up, no_progress, padded_rows
from swarm.config.explain import converted
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.setting_types import ClassName, Point, Polygon, Section
from swarm.errors import TerrainError
from swarm.grid import GridSpec

HALO = 2
"""Cells around a tile that its features look at."""
TILE_COLS = 512
"""Width of a tile as high as a band: a dozen float32 arrays of its cells fit into the cache of a core."""
_RED_LIGHT, _GREEN_LIGHT, _BLUE_LIGHT = 0.299, 0.587, 0.114
"""Brightness of red, green and blue to the eye (Rec. 601)."""
LEVEL_GRADE, SHORE_GRADE = 0.05, 0.15
"""About 3 and 8.5 degrees: water is level; beside it the bank already tilts the slope of a 3 x 3 window."""
STILL_GRADE = 0.004
"""A lake's own cells in a height model are level to some millimetres a metre."""
LIKELY, CERTAIN, STILL = np.uint8(1), np.uint8(2), np.uint8(4)
"""Signs of water, as bits of one byte."""
EXPOSURES = ((1.1, 1.03), (0.9, 0.97))
"""(gain, red over green): two photos of one place differ by as much, and more."""
LEVEL_SAND = 0.1
"""On gentler ground, bright and uneven cells may be a beach, a roof or a quarry instead of snow."""
_GRASS, _SOIL, _ROCK, _BUILT, _FOREST, _SNOW, _SHADE = (np.uint8(1 << n) for n in range(len(READABLE)))
CLASS_OF_READINGS = np.full(256, TerrainClass.UNKNOWN, np.uint8)
"""uint8 (256,), TerrainClass by readings: UNKNOWN where they are several."""
CLASS_OF_READINGS[[1 << n for n in range(len(READABLE))]] = READABLE


class Features(NamedTuple):
    """Features of a tile. Each is float32 (rows, cols).

    red, green, blue, light  mean of 3 x 3 cells, 0..255
    around, texture          mean and standard deviation of light over 5 x 5 cells, 0..255
    grade                    m/m
    sharp                    three of (rows, cols): red, green and blue of the photo itself, 0..255
    """

    red: Floats
    green: Floats
    blue: Floats
    light: Floats
    around: Floats
    texture: Floats
    grade: Floats
    sharp: tuple[Floats, Floats, Floats]

    def columns(self) -> Floats:
        """float32 (cells, 11) for a learner, row by row; the last column is the grade."""
        total = np.maximum(self.red + self.green + self.blue, 1)
        colours = (self.red, self.green, self.blue)
        shares = (self.red / total, self.green / total, self.blue / total)
        parts = (*colours, self.light, self.around, self.texture, saturation(*colours), *shares, self.grade)
        return np.stack([part.reshape(-1) for part in parts], axis=1).astype(np.float32)


def features_of(padded: Bytes, grade: Floats) -> Features:
    """The features of a tile.

    padded  uint8 (rows + 2 HALO, cols + 2 HALO, 3), red, green, blue
    grade   float32 (rows, cols)
    """
    planes = [np.ascontiguousarray(padded[..., n]) for n in range(3)]
    # Sums of bytes are exact in 16 bits.
    sums = (box_sum(plane[1:-1, 1:-1].astype(np.uint16), 1) for plane in planes)
    red, green, blue = (nine.astype(np.float32) * np.float32(1 / 9) for nine in sums)
    sharp = [plane.astype(np.float32) for plane in planes]
    light = _light(*sharp)
    around = box_sum(light, 2) * np.float32(1 / 25)
    texture = box_sum(light * light, 2) * np.float32(1 / 25)
    texture -= around * around
    np.sqrt(np.maximum(texture, 0, out=texture), out=texture)
    inner = tuple(plane[HALO:-HALO, HALO:-HALO] for plane in sharp)
    # The light of a mean is the mean of the light.
    return Features(red, green, blue, _light(red, green, blue), around, texture, grade, inner)  # type: ignore[arg-type]


def saturation(red: Floats, green: Floats, blue: Floats) -> Floats:
    """0 grey to 1."""
    brightest = np.maximum(np.maximum(red, green), blue)
    darkest = np.minimum(np.minimum(red, green), blue)
    return np.asarray((brightest - darkest) / np.maximum(brightest, 1), np.float32)


def _light(red: Floats, green: Floats, blue: Floats) -> Floats:
    return np.asarray(red * _RED_LIGHT + green * _GREEN_LIGHT + blue * _BLUE_LIGHT, np.float32)


def box_sum(padded: NDArray[Any], reach: int) -> NDArray[Any]:
    """Sums over squares of `reach` cells to each side, without the outer `reach` rows and columns; same type."""
    rows, cols = padded.shape[0] - 2 * reach, padded.shape[1] - 2 * reach
    down = padded[:rows].copy()
    for n in range(1, 2 * reach + 1):
        down += padded[n : n + rows]
    across = down[:, :cols].copy()
    for n in range(1, 2 * reach + 1):
        across += down[:, n : n + cols]
    return across


def tiles(
    rgb: Bytes, elevation_m: Floats, resolution_m: float, row0: int, row1: int
) -> Iterator[tuple[slice, Features]]:
    """The tiles of the band from row0 to row1: which columns, and the features. Beyond the photo it is mirrored.

    Other arguments are as of `classify.class_readings`.
    """
    rows, cols = rgb.shape[:2]
    padded_m = padded_rows(elevation_m, row0, row1)
    above, below = max(row0 - HALO, 0), min(row1 + HALO, rows)
    pads = ((HALO - (row0 - above), HALO - (below - row1)), (HALO, HALO), (0, 0))
    padded = np.pad(rgb[above:below], pads, mode="symmetric")
    for col0 in range(0, cols, TILE_COLS):
        col1 = min(col0 + TILE_COLS, cols)
        grade = np.nan_to_num(grade_of_padded(padded_m[:, col0 : col1 + 2], resolution_m))
        yield slice(col0, col1), features_of(padded[:, col0 : col1 + 2 * HALO], grade)


def ground_readings(f: Features) -> Bytes:
    """Returns the readings of the photo, also at slightly different exposures: bits of `READABLE`."""
    readings = _ground(f.red, f.green, f.blue, f.light, f.around, f.texture, f.grade)
    doubtful = (readings == _SNOW) & (f.grade < LEVEL_SAND) & (f.texture > 8)
    for gain, warm in EXPOSURES:
        colours = f.red * (np.float32(gain) * np.float32(warm)), f.green * gain, f.blue * gain / warm
        readings |= _ground(*colours, f.light * gain, f.around * gain, f.texture * gain, f.grade)
    readings |= doubtful * _SHADE
    return readings


def _ground(
    red: Floats, green: Floats, blue: Floats, light: Floats, around: Floats, texture: Floats, grade: Floats
) -> Bytes:
    """Everything but water, one bit of `READABLE` for each cell: the highest whose rule holds."""
    colour = saturation(red, green, blue)
    grey = colour < 0.16
    bare = (grade > 0.2) & (colour < 0.095) & (light > 105)
    cliff = (grade > 0.7) & grey & (light > 100)
    rough = (texture > 22) & (around > 95) & (grade < 0.2)
    speck = (light > around + 12) & (light > 110) & (light < 215) & (grade < 0.25)
    meadow = (green >= red) & (green >= blue) & (light > 90)
    trees = (around < 96) & (texture > 17) & ~meadow
    leaves = (green >= 0.93 * red) & (blue <= 1.2 * green)
    shade = (around < 100) & (blue > 1.18 * green) & (grade > LEVEL_GRADE)
    found = np.full(red.shape, _GRASS, np.uint8)
    for bit, where in (
        (_SOIL, (red > 1.04 * green) & (colour > 0.15)),
        (_ROCK, bare | cliff),
        (_BUILT, grey & (rough | speck)),
        (_FOREST, leaves & (trees | (around < 78))),
        (_SNOW, (light > 205) & (colour < 0.12)),
        (_SHADE, shade),
    ):
        np.maximum(found, where.view(np.uint8) * bit, out=found)
    # Cells in the shade of a wall are part of it.
    found[shade & (grade > 0.5)] = _ROCK
    return found


def water_signs(f: Features) -> Bytes:
    """Returns the signs of water in each cell, as a sum of bits.

    LIKELY   colour or darkness of water, on ground which is no slope: may be part of a lake
    CERTAIN  colour of water on smooth or level ground: a lake has a fifth of such cells
    STILL    level as a lake, whatever the colour
    """
    dead_level = f.grade < STILL_GRADE
    # Sky light in a shadow is blue, not green: a lake is both.
    teal = (f.blue > 1.45 * f.red) & (f.green > 1.4 * f.red)
    black = (f.light < 40) & (f.blue >= f.red)
    dim = (f.light < 65) & (f.blue >= f.red) & dead_level
    coloured = (f.blue > 1.2 * f.red) & (f.green > 1.02 * f.red) & (f.around < 170) | black | dim
    smooth = ((f.texture < 8) | teal) & (f.grade < LEVEL_GRADE)
    # The shore is drawn by single pixels: a mean of 3 x 3 is half land there.
    red, green, blue = f.sharp
    wet: Bools = (blue > 1.2 * red) & (green > 1.02 * red)
    dark = (green < 50) & (blue >= red) & (dead_level | black)
    likely = (wet | dark | coloured & smooth) & (f.grade < SHORE_GRADE)
    certain = coloured & (smooth | dead_level)
    return np.asarray(likely * LIKELY | certain * CERTAIN | dead_level * STILL, np.uint8)


# --- roads ----------------------------------------------------------------------------------------------------


COARSEST_M = 30.0
"""On coarser cells a thin line is a ridge, a river or a seam of the photo."""
REACH = 8
"""Rows and columns around a cell that its strength looks at."""
_DIRECTIONS = 8
"""Directions of a line that are tried: half a turn in steps of 22.5 degrees."""
_SIDE = 2.0
"""Cells from the middle of a line to the ground beside it, with which it is compared."""
_TAPS = (-4, -2, 0, 2, 4)
"""Cells along a line at which its contrast is taken: all within `REACH`."""
_MARGIN = 6
"""Margin for side and tap together."""
_BRIGHTEST = 40
"""Grey levels over its sides that count at most: one bright roof is no road."""
_FIXED = 8
"""Parts of a grey level while strengths are summed in 16 bits, which is twice as fast as in floats."""
_STRONG = 60
"""Strength from which on a cell is part of a road by itself. Chosen, not measured."""
_SHORTEST = 25
"""Cells; specks, roofs and field boundaries are shorter."""

Shorts = NDArray[np.int16]


def line_strength(rgb: Bytes) -> Bytes:
    """Returns the likeness of each cell to the crest of a line.

    Parameters
    ----------
    rgb : uint8 (rows, cols, 3), red, green, blue

    Returns
    -------
    uint8 (rows, cols), tenths of a grey level
        0 where there is no crest. The outer `REACH` rows and columns are found from less of the photo.
    """
    # A road is bright in red, unlike forest and meadow, and in blue, unlike bare soil.
    grey = np.minimum(rgb[..., 0], rgb[..., 2]).astype(np.float32)
    smooth = (ndimage.gaussian_filter(grey, 0.7, truncate=3) * _FIXED).astype(np.int16)
    padded = np.pad(smooth, _MARGIN, mode="edge")
    here = _moved(padded, 2, 0, 0)
    best, crest = np.zeros(smooth.shape, np.int16), np.zeros(smooth.shape, np.bool_)
    for number in range(_DIRECTIONS):
        angle = math.pi * number / _DIRECTIONS
        down, right = math.sin(angle), math.cos(angle)
        ahead, behind, one, other = (
            _moved(padded, 2, _SIDE * by_row, _SIDE * by_col)
            for by_row, by_col in ((down, right), (-down, -right), (right, -down), (-right, down))
        )
        # Brighter than both sides, less a quarter of the bend along the line.
        contrast = here - np.maximum(one, other) - np.abs(ahead + behind - 2 * here) // 4
        np.clip(contrast, -_BRIGHTEST * _FIXED, _BRIGHTEST * _FIXED, out=contrast)
        first, second, *others = (_moved(contrast, 4, tap * down, tap * right) for tap in _TAPS)
        total = sum(others, first + second)
        sides = np.maximum(*(_moved(padded, _MARGIN, sign * right, -sign * down) for sign in (1, -1)))
        # Masks and maxima: NumPy's copy "where" costs as much as thirty of them.
        better = total > best
        np.maximum(best, total, out=best)
        crest |= better
        crest &= ~better | (smooth >= sides)
    best *= crest
    best //= _FIXED * len(_TAPS) // 10
    return np.minimum(best, 255).astype(np.uint8)


def _moved(array: Shorts, trim: int, down: float, right: float) -> Shorts:
    """The array without `trim` rows and columns on each side, of cells so far away."""
    rows, cols = array.shape
    dr, dc = round(down), round(right)
    return array[trim + dr : rows - trim + dr, trim + dc : cols - trim + dc]


def long_lines(strength: Bytes) -> Bools:
    """The cells of strong lines that are long, over gaps of a cell or two.

    Parameters
    ----------
    strength : uint8 (rows, cols), tenths of a grey level
        From `line_strength`.

    Returns
    -------
    bool (rows, cols)
    """
    strong = strength >= _STRONG
    labels, count = ndimage.label(spread(strong, (1, 1)), np.ones((3, 3), np.int8))
    sizes = counted(labels, count + 1, strong)
    line = strong & looked_up(sizes >= _SHORTEST, labels)
    del labels
    padded = np.pad(line, 1)
    rows, cols = line.shape
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        before = padded[1 - down : 1 - down + rows, 1 - right : 1 - right + cols]
        behind = padded[1 + down : 1 + down + rows, 1 + right : 1 + right + cols]
        line |= before & behind
    return np.asarray(line, np.bool_)


LEVEL_M, LEVEL_PER_CELL = 0.25, 0.025
"""Standard deviation of a lake's heights: metres of the survey, and per metre of cell for the bank in a cell at the
shore. Lakes that were measured have at most nine tenths of it; the shadow of a cloud lies over more."""
SMALLEST_LAKE = 12
"""Cells. Chosen, not measured."""
SHORE = (2, 2, 2)
"""Around lakes, as `spread` takes it: a beach is a bright line, too."""
ROAD_GRADE = np.float32(0.5)
"""Grade of the hillside that a road is cut into, over 3 x 3 cells."""


class ByRules(NamedTuple):
    """Readings of a photo by rules.

    classes   uint8 (rows, cols), TerrainClass; UNKNOWN also where a photo that is exposed a little differently
              would show another class
    readings  uint8 (rows, cols), which classes those are, bits of `pace_layers.READABLE`; 0 where it is known
    """

    classes: Bytes
    readings: Bytes


def class_readings(
    rgb: Bytes, elevation_m: Floats, resolution_m: float, progress: Progress = no_progress
) -> ByRules:
    """Classifies a photo by rules, without training labels. Returns the class of each cell, and for cells of class
    UNKNOWN the classes that are possible (readings).

    Parameters
    ----------
    rgb : uint8 (rows, cols, 3), red, green, blue
    elevation_m : float32 (rows, cols), m
        Cells without a height (NaN) count as level.
    resolution_m : float
        Side of a cell, in metres. Roads are searched for only if it is at most `COARSEST_M` (30 m).
    progress : callable
        Called with the current step and the share of it that is done.

    """
    rows, cols = rgb.shape[:2]
    classes = np.empty((rows, cols), np.uint8)
    readings = np.empty((rows, cols), np.uint8)
    wetness = np.empty((rows, cols), np.uint8)
    lines = np.zeros((rows, cols), np.uint8)

    def work(row0: int, row1: int) -> None:
        for part, features in tiles(rgb, elevation_m, resolution_m, row0, row1):
            readings[row0:row1, part] = ground_readings(features)
            wetness[row0:row1, part] = water_signs(features)
            if resolution_m <= COARSEST_M:
                above, left = max(row0 - REACH, 0), max(part.start - REACH, 0)
                strength = line_strength(rgb[above : row1 + REACH, left : part.stop + REACH])
                strength = strength[row0 - above :, part.start - left :][: row1 - row0, : part.stop - part.start]
                lines[row0:row1, part] = strength * (features.grade <= ROAD_GRADE)
        np.take(CLASS_OF_READINGS, readings[row0:row1], out=classes[row0:row1])

    in_bands(rows, work, "classifying the photo", progress)
    lakes = _lakes(wetness, elevation_m, resolution_m)
    if lines.any():
        lines[spread(lakes, SHORE)] = 0
        classes[long_lines(lines)] = TerrainClass.ROAD
    classes[lakes] = TerrainClass.WATER
    readings *= classes == TerrainClass.UNKNOWN
    return ByRules(classes, readings)


def _lakes(wetness: Bytes, elevation_m: Floats, resolution_m: float) -> Bools:
    """Patches of likely water of which a fifth is certain, and that are level. If a shadow covers a shore the patch
    is no lake; then its still part, and the shore of that."""
    likely = (wetness & LIKELY) > 0
    lakes, tilted = _patches(likely, wetness, elevation_m, resolution_m)
    if tilted.any():
        still, _ = _patches(tilted & ((wetness & STILL) > 0), wetness, elevation_m, resolution_m)
        lakes |= tilted & spread(still, SHORE)
    return np.asarray(ndimage.binary_fill_holes(lakes), np.bool_) if lakes.any() else lakes


def _patches(likely: Bools, wetness: Bytes, elevation_m: Floats, resolution_m: float) -> tuple[Bools, Bools]:
    """(level, tilted) patches; small ones are puddles or shadows of houses and are neither."""
    labels, count = ndimage.label(likely)
    sizes = counted(labels, count + 1)
    certain = counted(labels, count + 1, (wetness & CERTAIN) > 0)
    wet = (sizes >= SMALLEST_LAKE) & (5 * certain >= sizes)
    wet[0] = False
    tilted = np.zeros(count + 1, np.bool_)
    if wet.any():
        of_cell = labels[likely]
        heights = np.nan_to_num(elevation_m[likely].astype(np.float64))
        mean = np.bincount(of_cell, heights, count + 1) / np.maximum(sizes, 1)
        variance = np.bincount(of_cell, (heights - mean[of_cell]) ** 2, count + 1) / np.maximum(sizes, 1)
        tilted = wet & (variance > (LEVEL_M + LEVEL_PER_CELL * resolution_m) ** 2)
    return looked_up(wet & ~tilted, labels), looked_up(tilted, labels)


# --- learnt -------------------------------------------------------------------------------------------------

NEAREST, MOST_OF_A_CLASS = 15, 300
"""Number of labelled cells that are compared, and of those of one class that are kept. On polygons that it has not
seen the learner is right on 80 % of the labelled cells of Davos with these, and on 79 with twice as many kept."""


class Learner:
    """The classes of the nearest labelled cells, by their features; each class counts alike, however many cells of
    it are labelled."""

    def __init__(self, columns: Floats, kinds: Bytes) -> None:
        """Parameters
        ----------
        columns : float32 (cells, 11), `Features.columns`
        kinds : uint8 (cells,), TerrainClass
        """
        of_class = [np.flatnonzero(kinds == kind) for kind in np.unique(kinds)]
        some = [at[np.linspace(0, len(at) - 1, min(len(at), MOST_OF_A_CLASS)).astype(np.intp)] for at in of_class]
        kept = np.concatenate(some)
        stretched = _stretched(columns[kept])
        self._scale = np.maximum(stretched.std(axis=0), np.float32(1e-6))
        self._tree = cKDTree(stretched / self._scale)
        self.kinds, self._number = np.unique(kinds[kept], return_inverse=True)
        self._weights = 1 / np.bincount(self._number)

    def predict(self, columns: Floats) -> Bytes:
        """The class of each cell, uint8 (cells,); water only where the ground is level: no label teaches what a
        shadow is."""
        _, nearest = self._tree.query(_stretched(columns) / self._scale, min(NEAREST, self._tree.n))
        votes = np.zeros((len(columns), len(self.kinds)))
        for number, weight in enumerate(self._weights):
            votes[:, number] = weight * (self._number[nearest] == number).sum(axis=1)
        if len(self.kinds) > 1:
            votes[np.ix_(columns[:, -1] >= SHORE_GRADE, self.kinds == TerrainClass.WATER)] = -1.0
        return np.asarray(self.kinds[np.argmax(votes, axis=1)], np.uint8)


def _stretched(columns: Floats) -> Floats:
    """Texture and grade enter by their square roots: most ground is even, and differs in the small remainder."""
    stretched = columns.copy()
    stretched[:, (5, -1)] = np.sqrt(stretched[:, (5, -1)])
    return stretched


def learnt(
    rgb: Bytes, elevation_m: Floats, resolution_m: float, labels: Bytes, progress: Progress = no_progress
) -> Bytes:
    """Classes of a photo learnt from labelled cells.

    Parameters
    ----------
    rgb, elevation_m, resolution_m, progress
        As in `class_readings`.
    labels : uint8 (rows, cols), TerrainClass
        UNKNOWN where there is no label; at least one cell has one.

    Returns
    -------
    uint8 (rows, cols), TerrainClass
        One of the labelled classes.
    """
    learner = Learner(*_samples(rgb, elevation_m, resolution_m, labels))
    classes = np.empty(rgb.shape[:2], np.uint8)

    def work(row0: int, row1: int) -> None:
        for part, features in tiles(rgb, elevation_m, resolution_m, row0, row1):
            classes[row0:row1, part] = learner.predict(features.columns()).reshape(features.red.shape)

    in_bands(len(classes), work, "classifying the photo", progress)
    return classes


def _samples(rgb: Bytes, elevation_m: Floats, resolution_m: float, labels: Bytes) -> tuple[Floats, Bytes]:
    """Features and class of each labelled cell."""
    columns, kinds = [], []
    for row in np.flatnonzero((labels != TerrainClass.UNKNOWN).any(axis=1)).tolist():
        for part, features in tiles(rgb, elevation_m, resolution_m, row, row + 1):
            labelled = labels[row, part]
            here = labelled != TerrainClass.UNKNOWN
            columns.append(features.columns()[here])
            kinds.append(labelled[here])
    return np.concatenate(columns), np.concatenate(kinds)


def held_out(
    rgb: Bytes, elevation_m: Floats, resolution_m: float, labels: Bytes, groups: NDArray[np.int32]
) -> tuple[Bytes, Bytes]:
    """Returns the prediction for each labelled cell of a learner that was trained without its polygon.

    Parameters
    ----------
    rgb, elevation_m, resolution_m, labels
        As in `learnt`.
    groups : int32 (rows, cols)
        Number of the polygon of each labelled cell; at least two. Up to five parts of about as many cells are held
        out in turn.

    Returns
    -------
    true, predicted : uint8 (labelled cells,), TerrainClass
    """
    columns, kinds = _samples(rgb, elevation_m, resolution_m, labels)
    labelled = groups[labels != TerrainClass.UNKNOWN]
    names, of_cell, cells = np.unique(labelled, return_inverse=True, return_counts=True)
    parts = min(5, len(names))
    part = np.empty(len(names), np.intp)
    part[np.argsort(-cells, kind="stable")] = np.arange(len(names)) % parts
    predicted = np.empty_like(kinds)
    for number in range(parts):
        out = part[of_cell] == number
        predicted[out] = Learner(columns[~out], kinds[~out]).predict(columns[out])
    return kinds, predicted


def confusion(true: Bytes, predicted: Bytes) -> NDArray[np.int64]:
    """Returns the confusion matrix: int64 (classes, classes), by true (row) and predicted class."""
    counts = np.zeros((max(TerrainClass) + 1,) * 2, np.int64)
    np.add.at(counts, (true, predicted), 1)
    return counts


# --- labels ---------------------------------------------------------------------------------------------------


class Label(Section, frozen=True, kw_only=True, rename={"kind": "class"}):
    """A polygon, or points, of one class."""

    kind: ClassName
    polygon_m: Polygon | None = None
    points_m: Annotated[tuple[Point, ...], Meta(max_length=10_000)] = ()


class _File(Section, frozen=True, kw_only=True):
    labels: Annotated[tuple[Label, ...], Meta(min_length=1, max_length=10_000)]


@dataclass(frozen=True, eq=False)
class Labels:
    """Labels on a grid.

    classes  uint8 (rows, cols), TerrainClass; UNKNOWN where there is no label
    groups   int32 (rows, cols), number of the polygon or point; -1 where there is none
    count    how many polygons and points there are
    """

    classes: Bytes
    groups: NDArray[np.int32]
    count: int


def read_labels(path: Path, grid: GridSpec) -> Labels:
    """Labels of a file on a grid; of labels that overlap, the later one counts.

    Parameters
    ----------
    path : Path
        TOML, as the head of this module shows it.
    grid : GridSpec
        Of the terrain; metres in the file count from its north-west corner.

    Raises
    ------
    TerrainError
        If the file cannot be read or is not as it must be, if a label covers no cell, or if all labels left are of
        one class.
    """
    raw = parse_toml(read_text(path, FileKind.LABELS), f"labels {path}", TerrainError)
    found = converted(raw, _File, f"labels {path}", "labels", TerrainError)
    classes = np.zeros((grid.rows, grid.cols), np.uint8)
    groups = np.full((grid.rows, grid.cols), -1, np.int32)
    count = 0
    for n, label in enumerate(found.labels):
        kind = TerrainClass[label.kind.upper()]
        covered = False
        for place in _places(label, grid):
            covered = covered or bool(classes[place].size)
            classes[place], groups[place] = kind, count
            count += 1
        if not covered:
            raise TerrainError(f"labels {path}: label {n} ({label.kind}) covers no cell of the terrain")
    if len(np.unique(classes[groups >= 0])) < 2:
        raise TerrainError(f"labels {path}: all labels are of one class; two are needed to tell them apart")
    return Labels(classes, groups, count)


def _places(label: Label, grid: GridSpec) -> Iterator[tuple[slice, slice] | NDArray[np.bool_]]:
    """Indices of the cells of each point, its eight neighbours included, and of the polygon."""
    for east_m, south_m in label.points_m:
        col, row = int(east_m // grid.resolution_m), int(south_m // grid.resolution_m)
        if grid.inside(row, col):
            yield slice(max(row - 1, 0), row + 2), slice(max(col - 1, 0), col + 2)
        else:
            yield slice(0), slice(0)
    if label.polygon_m is not None:
        yield polygon_mask(label.polygon_m, grid)
