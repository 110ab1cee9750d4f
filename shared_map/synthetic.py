"""Seeded landscapes: heights, what covers them, and a photograph of it.

Only additions, products and square roots of seeded numbers, so that a seed gives the same landscape everywhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from shared_map.bands import Progress, in_bands, no_progress, padded_rows
from shared_map.layers import Bools, Bytes, Floats, TerrainClass, gradient, gradient_of_padded

TINT = np.array(
    [
        [122, 118, 100],  # UNKNOWN
        [42, 74, 98],  # WATER
        [58, 84, 46],  # FOREST
        [138, 130, 120],  # ROCK
        [126, 142, 78],  # GRASS
        [156, 134, 98],  # SOIL
        [186, 178, 164],  # ROAD
        [164, 122, 108],  # BUILT
        [236, 240, 244],  # SNOW
    ],
    np.uint8,
)
"""Natural colours of the classes, as in a photograph."""


def fractal(rng: np.random.Generator, rows: int, cols: int, coarsest: float, ridged: bool = False) -> Floats:
    """Smooth noise of many scales, roughly -1..1, the broadest hills `coarsest` cells wide. Ridged has sharp crests
    and broad valleys."""
    return _octaves(_lattice_noise, 0.5, rng, rows, cols, coarsest, ridged)


def mountains(rng: np.random.Generator, rows: int, cols: int, coarsest: float, ridged: bool = False) -> Floats:
    """As `fractal`, of gradient noise (Perlin 1985): rounder, without the grain of the lattice, twice the work."""
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


def synthetic_elevation(rows: int, cols: int, relief_m: float, seed: int) -> Floats:
    """Mountains with sharp crests, broad valleys and plains, `relief_m` from lowest to highest."""
    rng = np.random.default_rng([seed, 1])
    broad = max(min(rows, cols) / 2.5, 8.0)
    ridges = mountains(rng, rows, cols, broad, ridged=True)
    where = mountains(rng, rows, cols, broad * 1.5)
    hills = mountains(rng, rows, cols, broad / 2)
    where -= np.float32(where.min())
    where /= np.float32(max(float(where.max()), 1e-6))
    height = ridges * where * where + hills * np.float32(0.15)
    height -= np.float32(height.min())
    height *= np.float32(relief_m / max(float(height.max()), 1e-6))
    return height


def landscape(
    rows: int, cols: int, resolution_m: float, relief_m: float, seed: int, rivers: int = 0
) -> tuple[Floats, Bytes]:
    """Heights and classes of a synthetic terrain."""
    elevation_m = synthetic_elevation(rows, cols, relief_m, seed)
    if rivers == 0:
        return elevation_m, cover(elevation_m, resolution_m, seed)
    from shared_map.rivers import carve

    elevation_m, water, fords = carve(elevation_m, rivers, resolution_m, seed)
    classes = cover(elevation_m, resolution_m, seed)
    classes[water] = TerrainClass.WATER
    classes[fords] = TerrainClass.SOIL
    return elevation_m, classes


def cover(elevation_m: Floats, resolution_m: float, seed: int) -> Bytes:
    """Plausible classes where nobody has looked: rock on what is steep, forest on slopes, grass between, bare soil
    here and there."""
    rows, cols = elevation_m.shape
    rng = np.random.default_rng([seed, 2])
    east, north = gradient(elevation_m, resolution_m)
    grade = np.sqrt(east * east + north * north)
    patches = fractal(rng, rows, cols, max(min(rows, cols) / 12, 4.0))
    known = ~np.isnan(elevation_m)
    steep = np.quantile(grade[known], 0.985) if known.any() else 1.0
    gentle = np.quantile(grade[known], 0.30) if known.any() else 0.0
    classes = np.full((rows, cols), TerrainClass.GRASS, np.uint8)
    classes[(grade > gentle) & (patches > -0.12)] = TerrainClass.FOREST
    classes[(grade <= gentle) & (patches < -0.35)] = TerrainClass.SOIL
    classes[grade > max(float(steep), 0.3)] = TerrainClass.ROCK
    classes[~known] = TerrainClass.UNKNOWN
    return classes


def flat_water(elevation_m: Floats, at_least: int = 4) -> Bools:
    """Level patches: cells exactly as high as all eight neighbours, in patches of `at_least`, and their shores.

    Elevation models are levelled on lakes; real ground is never as flat as that. A plain (more than a third of the
    terrain) is no lake."""
    from scipy import ndimage

    level = ndimage.maximum_filter(elevation_m, 3) == ndimage.minimum_filter(elevation_m, 3)
    labels, count = ndimage.label(level, structure=np.ones((3, 3), np.int8))
    if count == 0 or level.mean() > 1 / 3:
        return np.zeros(elevation_m.shape, np.bool_)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    lakes: NDArray[np.bool_] = sizes[labels] >= at_least
    return np.asarray(ndimage.binary_dilation(lakes, np.ones((3, 3), np.bool_)), np.bool_)


LEVEL_LIGHT = 0.70710678
"""How bright level ground is."""


def shade(east: Floats, north: Floats, exaggeration: float = 1.0) -> Floats:
    """Light from the north-west, 45 degrees high, on a gradient: 0 dark to 1 bright."""
    east = east * np.float32(exaggeration)
    north = north * np.float32(exaggeration)
    light = (east - north) * np.float32(0.5) + np.float32(LEVEL_LIGHT)
    light /= np.sqrt(east * east + north * north + np.float32(1))
    return np.clip(light, 0, 1, out=light)


def hillshade(elevation_m: Floats, resolution_m: float, exaggeration: float = 1.0) -> Floats:
    """`shade` of heights; a void is level."""
    return shade(*gradient(elevation_m, resolution_m), exaggeration)


def paint_photo(
    elevation_m: Floats, classes: Bytes, resolution_m: float, seed: int, progress: Progress = no_progress
) -> Bytes:
    """A photograph of what covers the ground, lit from the north-west, paler in the heights."""
    rows, cols = elevation_m.shape
    texture = fractal(np.random.default_rng([seed, 3]), rows, cols, 16.0)
    low, high = float(np.nanmin(elevation_m)), float(np.nanmax(elevation_m))
    photo = np.empty((rows, cols, 3), np.uint8)

    def work(row0: int, row1: int) -> None:
        here, grain = elevation_m[row0:row1], texture[row0:row1]
        colour = TINT[np.minimum(classes[row0:row1], len(TINT) - 1)].astype(np.float32)
        water = classes[row0:row1] == TerrainClass.WATER
        height = np.nan_to_num((here - np.float32(low)) / np.float32(max(high - low, 1e-3)))
        pale = np.where(water, np.float32(0), height * np.float32(0.25))[..., None]
        colour += (np.float32(190) - colour) * pale
        light = shade(*gradient_of_padded(padded_rows(elevation_m, row0, row1), resolution_m), 1.5)
        light = np.float32(0.35) + np.float32(0.65 / LEVEL_LIGHT) * light + grain * np.float32(0.18)
        light = np.where(water, np.float32(1) + grain * np.float32(0.04), light)
        colour *= light[..., None]
        colour[np.isnan(here)] = 0
        photo[row0:row1] = np.clip(colour, 0, 255)

    in_bands(rows, work, "painting the photo", progress)
    return photo
