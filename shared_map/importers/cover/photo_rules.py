"""Readings of a photo by rules without labels, independent of its exposure; and signs of water.

Rules look at means of colours, at texture and at slope, a tile at a time: a tile's arrays fit into the cache of a
core, and this is most of what an import costs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.terrain.pace_layers import READABLE, TerrainClass, grade_of_padded, spread
from shared_map.terrain.row_bands import counted, looked_up, padded_rows

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
    """Returns for each cell its signs of LIKELY, CERTAIN and STILL water."""
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
_SIDE = 2.0
_TAPS = (-4, -2, 0, 2, 4)
_MARGIN = 6
"""Margin for side and tap together."""
_BRIGHTEST = 40
"""Grey levels over its sides that count at most: one bright roof is no road."""
_FIXED = 8
"""Parts of a grey level while strengths are summed in 16 bits, which is twice as fast as in floats."""
_STRONG = 60
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
