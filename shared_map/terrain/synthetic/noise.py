"""Seeded noise of many scales: what synthetic landscapes are made of.

Only additions, products and square roots of seeded numbers, so that a seed gives the same field everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats
from shared_map.terrain.row_bands import in_bands


@dataclass(frozen=True, eq=False)
class Noise:
    """Seeded noise of a whole terrain, of which any part can be computed by itself.

    octaves  amplitude and lattice of each scale, coarsest first
    total    what the sum of all octaves is divided by
    """

    rows: int
    cols: int
    octaves: Sequence[tuple[float, _ValueLattice | _GradientLattice]]
    total: float
    ridged: bool

    def part(self, row0: int, row1: int, col0: int, col1: int) -> Floats:
        """float32 (row1 - row0, col1 - col0): those cells of the whole, to the bit."""
        field = np.zeros((row1 - row0, col1 - col0), np.float32)
        for amplitude, lattice in self.octaves:
            octave = lattice.part(row0, row1, col0, col1)
            if self.ridged:
                np.abs(octave, out=octave)
                octave *= np.float32(-2)
                octave += np.float32(1)
            octave *= np.float32(amplitude)
            field += octave
        field /= np.float32(self.total)
        return field

    def band(self, row0: int, row1: int) -> Floats:
        return self.part(row0, row1, 0, self.cols)

    def whole(self) -> Floats:
        """float32 (rows, cols), band by band."""
        field = np.empty((self.rows, self.cols), np.float32)

        def work(row0: int, row1: int) -> None:
            field[row0:row1] = self.band(row0, row1)

        in_bands(self.rows, work)
        return field


def fractal_noise(rng: np.random.Generator, rows: int, cols: int, coarsest: float) -> Noise:
    """Smooth noise of many scales.

    Parameters
    ----------
    rng : numpy.random.Generator
        It is advanced.
    rows, cols : int
        Cells; at least 1 each.
    coarsest : float
        Cells across the broadest hills. Below 2 there is no noise: all is 0.

    Returns
    -------
    Noise, within -1..1
    """
    return _octaves(_ValueLattice, 0.5, rng, rows, cols, coarsest, ridged=False)


def mountain_noise(rng: np.random.Generator, rows: int, cols: int, coarsest: float, ridged: bool = False) -> Noise:
    """Like `fractal_noise`, from gradient noise (Perlin 1985): rounder, without the grain of the lattice, twice the
    work.

    ridged  crests are sharp and valleys broad

    Values are roughly within -1..1.
    """
    return _octaves(_GradientLattice, 0.45, rng, rows, cols, coarsest, ridged)


def _octaves(
    lattice: type[_ValueLattice | _GradientLattice],
    decay: float,
    rng: np.random.Generator,
    rows: int,
    cols: int,
    coarsest: float,
    ridged: bool,
) -> Noise:
    """The sum of noise at scales halved again and again, each `decay` as high as the one before."""
    octaves = []
    amplitude, scale, total = 1.0, float(coarsest), 0.0
    while scale >= 2.0 and amplitude > 0.01:
        octaves.append((amplitude, lattice.drawn(rng, rows, cols, scale)))
        total += amplitude
        amplitude *= decay
        scale /= 2.0
    return Noise(rows, cols, octaves, max(total, 1.0), ridged)


@dataclass(frozen=True, eq=False)
class _ValueLattice:
    """Each lattice point has a value; between points the values are blended (smoothstep)."""

    scale: float
    values: Floats
    offset: tuple[float, float]

    @staticmethod
    def drawn(rng: np.random.Generator, rows: int, cols: int, scale: float) -> _ValueLattice:
        high, wide = int(rows / scale) + 3, int(cols / scale) + 3
        values = rng.uniform(-1.0, 1.0, (high, wide)).astype(np.float32)
        offset = rng.uniform(0.0, 1.0, 2)
        return _ValueLattice(scale, values, (float(offset[0]), float(offset[1])))

    def part(self, row0: int, row1: int, col0: int, col1: int) -> Floats:
        low, part = self._along(row0, row1, self.offset[0])
        rows = self.values[low] * (np.float32(1) - part)[:, None] + self.values[low + 1] * part[:, None]
        low, part = self._along(col0, col1, self.offset[1])
        field: Floats = rows.take(low, 1)
        field *= np.float32(1) - part
        far = rows.take(low + 1, 1)
        far *= part
        field += far
        return field

    def _along(self, begin: int, end: int, offset: float) -> tuple[NDArray[np.intp], Floats]:
        """Lattice point before each cell, and the weight of the next."""
        at = np.arange(begin, end) / self.scale + offset
        low = at.astype(np.intp)
        part = (at - low).astype(np.float32)
        return low, part * part * (np.float32(3) - np.float32(2) * part)


@dataclass(frozen=True, eq=False)
class _GradientLattice:
    """Each lattice point has a slope; between points the four slopes are blended. Separable, hence two sums."""

    scale: float
    south: Floats
    east: Floats
    offset: tuple[float, float]

    @staticmethod
    def drawn(rng: np.random.Generator, rows: int, cols: int, scale: float) -> _GradientLattice:
        high, wide = int(rows / scale) + 3, int(cols / scale) + 3
        south, east = (rng.uniform(-1.0, 1.0, (high, wide)).astype(np.float32) for _ in range(2))
        return _GradientLattice(scale, south, east, (float(rng.uniform()), float(rng.uniform())))

    def part(self, row0: int, row1: int, col0: int, col1: int) -> Floats:
        low_row, near_row, far_row, row_part = _blend(row0, row1, self.scale, self.offset[0])
        low_col, near_col, far_col, col_part = _blend(col0, col1, self.scale, self.offset[1])
        near, far = (near_row * row_part)[:, None], (far_row * (row_part - np.float32(1)))[:, None]
        rising = self.south[low_row] * near + self.south[low_row + 1] * far
        across = self.east[low_row] * near_row[:, None] + self.east[low_row + 1] * far_row[:, None]
        field: Floats = rising.take(low_col, 1)
        field *= near_col
        for lattice, columns, weights in (
            (rising, low_col + 1, far_col),
            (across, low_col, near_col * col_part),
            (across, low_col + 1, far_col * (col_part - np.float32(1))),
        ):
            term = lattice.take(columns, 1)
            term *= weights
            field += term
        field *= np.float32(1.5)
        return field


def _blend(begin: int, end: int, scale: float, offset: float) -> tuple[NDArray[np.intp], Floats, Floats, Floats]:
    """Lattice point before each cell, weights of it and of the next, and how far along the cell lies."""
    at = np.arange(begin, end) / scale + offset
    low = at.astype(np.intp)
    part = (at - low).astype(np.float32)
    far = part * part * part * (part * (part * np.float32(6) - np.float32(15)) + np.float32(10))
    return low, (np.float32(1) - far).astype(np.float32), far.astype(np.float32), part
