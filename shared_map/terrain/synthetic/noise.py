"""Seeded noise of many scales: what synthetic landscapes are made of.

Only additions, products and square roots of seeded numbers, so that a seed gives the same field everywhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats


def fractal(rng: np.random.Generator, rows: int, cols: int, coarsest: float, ridged: bool = False) -> Floats:
    """Smooth noise of many scales.

    Parameters
    ----------
    rng : numpy.random.Generator
        It is advanced.
    rows, cols : int
        Cells; at least 1 each.
    coarsest : float
        Cells across the broadest hills. Below 2 there is no noise: all is 0.
    ridged : bool
        Whether crests are sharp and valleys broad.

    Returns
    -------
    float32 (rows, cols), within -1..1
    """
    return _octaves(_lattice_noise, 0.5, rng, rows, cols, coarsest, ridged)


def mountains(rng: np.random.Generator, rows: int, cols: int, coarsest: float, ridged: bool = False) -> Floats:
    """As `fractal`, of gradient noise (Perlin 1985): rounder, without the grain of the lattice, twice the work.

    Values are roughly within -1..1.
    """
    return _octaves(_gradient_noise, 0.45, rng, rows, cols, coarsest, ridged)


def _octaves(
    noise: Callable[[np.random.Generator, int, int, float], Floats],
    decay: float,
    rng: np.random.Generator,
    rows: int,
    cols: int,
    coarsest: float,
    ridged: bool,
) -> Floats:
    """The sum of noise at scales halved again and again, each `decay` as high as the one before."""
    field = np.zeros((rows, cols), np.float32)
    amplitude, scale, total = 1.0, float(coarsest), 0.0
    while scale >= 2.0 and amplitude > 0.01:
        octave = noise(rng, rows, cols, scale)
        if ridged:
            np.abs(octave, out=octave)
            octave *= np.float32(-2)
            octave += np.float32(1)
        octave *= np.float32(amplitude)
        field += octave
        total += amplitude
        amplitude *= decay
        scale /= 2.0
    field /= np.float32(max(total, 1.0))
    return field


def _lattice_noise(rng: np.random.Generator, rows: int, cols: int, scale: float) -> Floats:
    high, wide = int(rows / scale) + 3, int(cols / scale) + 3
    lattice = rng.uniform(-1.0, 1.0, (high, wide)).astype(np.float32)
    offset = rng.uniform(0.0, 1.0, 2)
    return _along(_along(lattice, rows, scale, float(offset[0])).T, cols, scale, float(offset[1])).T


def _along(lattice: Floats, count: int, scale: float, offset: float) -> Floats:
    """Smoothstep interpolation of rows."""
    at = np.arange(count) / scale + offset
    low = at.astype(np.intp)
    part = (at - low).astype(np.float32)
    part = (part * part * (np.float32(3) - np.float32(2) * part))[:, None]
    between: Floats = lattice[low] * (np.float32(1) - part) + lattice[low + 1] * part
    return between


def _gradient_noise(rng: np.random.Generator, rows: int, cols: int, scale: float) -> Floats:
    """Each lattice point has a slope; between points the four slopes are blended. Separable, hence two sums."""
    high, wide = int(rows / scale) + 3, int(cols / scale) + 3
    south, east = (rng.uniform(-1.0, 1.0, (high, wide)).astype(np.float32) for _ in range(2))
    low_row, near_row, far_row, row_part = _blend(rows, scale, float(rng.uniform()))
    low_col, near_col, far_col, col_part = _blend(cols, scale, float(rng.uniform()))
    near, far = (near_row * row_part)[:, None], (far_row * (row_part - np.float32(1)))[:, None]
    rising = south[low_row] * near + south[low_row + 1] * far
    across = east[low_row] * near_row[:, None] + east[low_row + 1] * far_row[:, None]
    field: Floats = rising[:, low_col] * near_col + rising[:, low_col + 1] * far_col
    field += across[:, low_col] * (near_col * col_part)
    field += across[:, low_col + 1] * (far_col * (col_part - np.float32(1)))
    field *= np.float32(1.5)
    return field


def _blend(count: int, scale: float, offset: float) -> tuple[NDArray[np.intp], Floats, Floats, Floats]:
    """Lattice point before each cell, the weights of it and of the next, and how far along the cell lies."""
    at = np.arange(count) / scale + offset
    low = at.astype(np.intp)
    part = (at - low).astype(np.float32)
    far = part * part * part * (part * (part * np.float32(6) - np.float32(15)) + np.float32(10))
    return low, (np.float32(1) - far).astype(np.float32), far.astype(np.float32), part
