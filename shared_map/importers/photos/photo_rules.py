"""What a photo shows of the ground, by rules without any labels, whatever its exposure; and how it shows water.

Everything is of one tile, and done in place where that spares memory traffic: this is most of what an import costs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Bytes, Floats
from shared_map.importers.photos.photo_features import Features, saturation
from shared_map.terrain.layers import READABLE, TerrainClass

LEVEL_GRADE, SHORE_GRADE = np.float32(0.05), np.float32(0.15)
"""About 3 and 8.5 degrees: water is level; beside it the bank already tilts the slope of a 3 x 3 window."""
LIKELY, CERTAIN, STILL = np.uint8(1), np.uint8(2), np.uint8(4)
STILL_GRADE = np.float32(0.004)
EXPOSURES = ((1.1, 1.03), (0.9, 0.97))
"""(gain, red over green): two photos of one place differ by as much, and more."""
LEVEL_SAND = np.float32(0.1)
"""On gentler ground what is as bright as snow, and not even, may be a beach, a roof or a quarry."""

_GRASS, _SOIL, _ROCK, _BUILT, _FOREST, _SNOW, _SHADE = (np.uint8(1 << n) for n in range(len(READABLE)))


def _table() -> Bytes:
    table = np.full(256, TerrainClass.UNKNOWN, np.uint8)
    for n, kind in enumerate(READABLE):
        table[1 << n] = kind
    return table


CLASS_OF_READINGS = _table()
"""uint8 (256,), TerrainClass by readings: UNKNOWN where they are several."""


def ground_readings(f: Features) -> Bytes:
    """What the photo shows, and would show if it were exposed a little differently: bits of `READABLE`."""
    steep = _Slopes(f.grade)
    readings = _ground(f.red, f.green, f.blue, f.light, f.around, f.texture, steep)
    doubtful = readings == _SNOW
    doubtful &= f.grade < LEVEL_SAND
    doubtful &= f.texture > 8
    for gain, warm in EXPOSURES:
        by = np.float32(gain)
        blue = f.blue * by
        blue /= np.float32(warm)
        colours = f.red * (by * np.float32(warm)), f.green * by, blue
        readings |= _ground(*colours, f.light * by, f.around * by, f.texture * by, steep)
    readings |= doubtful.view(np.uint8) * _SHADE
    return readings


class _Slopes:
    """Where a tile is steep, bool (rows, cols): the same at every exposure."""

    def __init__(self, grade: Floats) -> None:
        self.over_5, self.over_20, self.over_50, self.over_70 = (
            grade > np.float32(limit) for limit in (LEVEL_GRADE, 0.2, 0.5, 0.7)
        )
        self.under_20, self.under_25 = grade < np.float32(0.2), grade < np.float32(0.25)


def _ground(
    red: Floats, green: Floats, blue: Floats, light: Floats, around: Floats, texture: Floats, steep: _Slopes
) -> Bytes:
    """Everything but water, one bit of `READABLE` for each cell: the highest whose rule holds."""
    colour = saturation(red, green, blue)
    grey = colour < np.float32(0.16)
    found = np.full(red.shape, _GRASS, np.uint8)

    soil = red > np.float32(1.04) * green
    soil &= colour > np.float32(0.15)
    _raise(found, soil, _SOIL)

    rock = colour < np.float32(0.095)
    rock &= steep.over_20
    rock &= light > 105
    part = grey & steep.over_70
    part &= light > 100
    rock |= part
    _raise(found, rock, _ROCK)

    built = texture > 22
    built &= around > 95
    built &= steep.under_20
    speck = light > around + 12
    speck &= steep.under_25
    speck &= light > 110
    speck &= light < 215
    built |= speck
    built &= grey
    _raise(found, built, _BUILT)

    forest = around < 96
    forest &= texture > 17
    meadow = green >= red
    meadow &= green >= blue
    meadow &= light > 90
    forest &= np.logical_not(meadow, out=meadow)
    forest |= around < 78
    forest &= green >= np.float32(0.93) * red
    forest &= blue <= np.float32(1.2) * green
    _raise(found, forest, _FOREST)

    snow = light > 205
    snow &= colour < np.float32(0.12)
    _raise(found, snow, _SNOW)

    shade = around < 100
    shade &= blue > np.float32(1.18) * green
    shade &= steep.over_5
    if shade.any():
        _raise(found, shade, _SHADE)
        shade &= steep.over_50
        found &= shade.view(np.uint8) - np.uint8(1)
        found |= shade.view(np.uint8) * _ROCK
    return found


def _raise(found: Bytes, where: Bools, bit: NDArray[np.uint8] | np.uint8) -> None:
    np.maximum(found, where.view(np.uint8) * bit, out=found)


def water_signs(f: Features) -> Bytes:
    """Of each cell, which of LIKELY, CERTAIN and STILL it is."""
    dead_level = f.grade < STILL_GRADE
    more_green, more_blue = f.green > np.float32(1.02) * f.red, f.blue >= f.red
    # Sky light in a shadow is blue, not green: a lake is both.
    teal = (f.blue > np.float32(1.45) * f.red) & (f.green > np.float32(1.4) * f.red)
    coloured = f.blue > np.float32(1.2) * f.red
    coloured &= more_green
    coloured &= f.around < 170
    black = f.light < 40
    black &= more_blue
    coloured |= black
    more_blue &= f.light < 65
    more_blue &= dead_level
    coloured |= more_blue
    smooth = f.texture < 8
    smooth |= teal
    smooth &= f.grade < LEVEL_GRADE
    # The shore is drawn by single pixels: a mean of 3 x 3 is half land there.
    red, green, blue = f.sharp
    wet = blue > np.float32(1.2) * red
    wet &= green > np.float32(1.02) * red
    dark = green < 50
    dark &= blue >= red
    dark &= dead_level | black
    wet |= dark
    wet |= coloured & smooth
    wet &= f.grade < SHORE_GRADE
    smooth |= dead_level
    coloured &= smooth
    signs: Bytes = wet.view(np.uint8) * LIKELY
    signs |= coloured.view(np.uint8) * CERTAIN
    signs |= dead_level.view(np.uint8) * STILL
    return signs
