"""What rules and learning look at of a photo: means of colours, texture and slope, a tile at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bytes, Floats
from shared_map.terrain.layers import grade_of_padded
from shared_map.terrain.row_bands import padded_rows

HALO = 2
"""Cells around a tile that its features look at."""
TILE_COLS = 512
"""Of a tile as high as a band: a dozen float32 arrays of its cells fit into the cache of a core."""
_RED_LIGHT, _GREEN_LIGHT, _BLUE_LIGHT = np.float32(0.299), np.float32(0.587), np.float32(0.114)
"""How bright red, green and blue are to the eye (Rec. 601)."""


class Features:
    """Features of a tile. Each is float32 (rows, cols).

    red, green, blue, light  mean of 3 x 3 cells, 0..255
    around, texture          mean and standard deviation of light over 5 x 5 cells, 0..255
    grade                    m/m
    sharp                    three of (rows, cols): red, green and blue of the photo itself, 0..255
    """

    def __init__(self, padded: Bytes, grade: Floats) -> None:
        """Parameters
        ----------
        padded : uint8 (rows + 2 HALO, cols + 2 HALO, 3), red, green, blue
        grade : float32 (rows, cols)
        """
        planes = [np.ascontiguousarray(padded[..., n]) for n in range(3)]
        self.red, self.green, self.blue = (_mean_of_nine(plane[1:-1, 1:-1]) for plane in planes)
        # The light of a mean is the mean of the light.
        self.light = _light(self.red, self.green, self.blue)
        colour = [plane.astype(np.float32) for plane in planes]
        light = _light(colour[0], colour[1], colour[2])
        per_cell = np.float32(1 / 25)
        self.around: Floats = box_sum(light, 2)
        self.around *= per_cell
        light *= light
        self.texture: Floats = box_sum(light, 2)
        self.texture *= per_cell
        self.texture -= self.around * self.around
        np.maximum(self.texture, np.float32(0), out=self.texture)
        np.sqrt(self.texture, out=self.texture)
        self.grade = grade
        self.sharp = [plane[HALO:-HALO, HALO:-HALO] for plane in colour]

    def columns(self) -> Floats:
        """float32 (cells, 11) for a learner, row by row; the last column is the grade."""
        total = np.maximum(self.red + self.green + self.blue, np.float32(1))
        colours = (self.red, self.green, self.blue)
        parts = (
            *(*colours, self.light, self.around, self.texture, saturation(*colours)),
            *(self.red / total, self.green / total, self.blue / total, self.grade),
        )
        return np.stack([part.reshape(-1) for part in parts], axis=1).astype(np.float32)


def saturation(red: Floats, green: Floats, blue: Floats) -> Floats:
    """0 grey to 1."""
    brightest = np.maximum(red, green)
    np.maximum(brightest, blue, out=brightest)
    darkest = np.minimum(red, green)
    np.minimum(darkest, blue, out=darkest)
    np.subtract(brightest, darkest, out=darkest)
    np.maximum(brightest, np.float32(1), out=brightest)
    darkest /= brightest
    return darkest


def _light(red: Floats, green: Floats, blue: Floats) -> Floats:
    light = red * _RED_LIGHT
    part = green * _GREEN_LIGHT
    light += part
    np.multiply(blue, _BLUE_LIGHT, out=part)
    light += part
    return light


def _mean_of_nine(plane: Bytes) -> Floats:
    # Sums of bytes are exact.
    mean = box_sum(plane.astype(np.uint16), 1).astype(np.float32)
    mean *= np.float32(1 / 9)
    return mean


def box_sum(padded: NDArray[Any], reach: int) -> NDArray[Any]:
    """Sums over squares of `reach` cells to each side, without the outer `reach` rows and columns; same type."""
    rows, cols = padded.shape[0] - 2 * reach, padded.shape[1] - 2 * reach
    down = padded[:rows] + padded[1 : 1 + rows]
    for n in range(2, 2 * reach + 1):
        down += padded[n : n + rows]
    across: NDArray[Any] = down[:, :cols] + down[:, 1 : 1 + cols]
    for n in range(2, 2 * reach + 1):
        across += down[:, n : n + cols]
    return across


def tiles(
    rgb: Bytes, elevation_m: Floats | None, resolution_m: float, row0: int, row1: int
) -> Iterator[tuple[slice, Features]]:
    """The tiles of a band: which columns, and the features. Beyond the photo it is mirrored.

    Parameters
    ----------
    rgb, elevation_m, resolution_m
        As in `classify.class_readings`.
    row0, row1 : int
        The band.
    """
    rows, cols = rgb.shape[:2]
    padded_m = None if elevation_m is None else padded_rows(elevation_m, row0, row1)
    above, below = max(row0 - HALO, 0), min(row1 + HALO, rows)
    pads = ((HALO - (row0 - above), HALO - (below - row1)), (HALO, HALO), (0, 0))
    padded = np.pad(rgb[above:below], pads, mode="symmetric")
    for col0 in range(0, cols, TILE_COLS):
        col1 = min(col0 + TILE_COLS, cols)
        if padded_m is None:
            grade = np.zeros((row1 - row0, col1 - col0), np.float32)
        else:
            grade = grade_of_padded(padded_m[:, col0 : col1 + 2], resolution_m)
            if not np.isfinite(grade).all():
                grade = np.nan_to_num(grade)
        yield slice(col0, col1), Features(padded[:, col0 : col1 + 2 * HALO], grade)
