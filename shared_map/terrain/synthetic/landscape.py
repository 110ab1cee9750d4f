"""Seeded landscapes: heights, what covers them, and a photograph of it.

Only additions, products and square roots of seeded numbers, so that a seed gives the same landscape everywhere.
"""

from __future__ import annotations

import numpy as np

from shared_map.array_files import Bytes, Floats
from shared_map.terrain.pace_layers import TerrainClass, grade, gradient_of_padded
from shared_map.terrain.row_bands import Progress, in_bands, no_progress, padded_rows
from shared_map.terrain.synthetic.noise import fractal_noise, mountain_noise
from shared_map.terrain.synthetic.rivers_and_roads import carve

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
        [104, 116, 66],  # SHRUB
        [88, 108, 94],  # WETLAND
    ],
    np.uint8,
)
"""Natural colours of the classes, as in a photograph."""


def synthetic_elevation(rows: int, cols: int, relief_m: float, seed: int) -> Floats:
    """Mountains with sharp crests, broad valleys and plains.

    Parameters
    ----------
    rows, cols : int
        Cells; at least 1 each.
    relief_m : float
        From the lowest cell, which is at 0, to the highest.
    seed : int
        Not negative.

    Returns
    -------
    float32 (rows, cols), m
    """
    rng = np.random.default_rng([seed, 1])
    broad = max(min(rows, cols) / 2.5, 8.0)
    ridges = mountain_noise(rng, rows, cols, broad, ridged=True)
    where = mountain_noise(rng, rows, cols, broad * 1.5).whole()
    hills = mountain_noise(rng, rows, cols, broad / 2)
    low = np.float32(where.min())
    span = np.float32(max(float(np.float32(where.max()) - low), 1e-6))
    height = where

    def work(row0: int, row1: int) -> None:
        share = (where[row0:row1] - low) / span
        height[row0:row1] = ridges.band(row0, row1) * share * share + hills.band(row0, row1) * np.float32(0.15)

    in_bands(rows, work)
    height -= np.float32(height.min())
    height *= np.float32(relief_m / max(float(height.max()), 1e-6))
    return height


def landscape(
    rows: int, cols: int, resolution_m: float, relief_m: float, seed: int, rivers: int = 0
) -> tuple[Floats, Bytes]:
    """Heights and classes of a synthetic terrain.

    Parameters
    ----------
    rows, cols, relief_m, seed
        As in `synthetic_elevation`.
    resolution_m : float
        Side of a cell.
    rivers : int
        How many cross the terrain; see `carve`.

    Returns
    -------
    elevation_m : float32 (rows, cols), m
    classes : uint8 (rows, cols), TerrainClass
    """
    elevation_m = synthetic_elevation(rows, cols, relief_m, seed)
    if rivers == 0:
        return elevation_m, cover(elevation_m, resolution_m, seed)
    elevation_m, water, fords = carve(elevation_m, rivers, resolution_m, seed)
    classes = cover(elevation_m, resolution_m, seed)
    classes[water] = TerrainClass.WATER
    classes[fords] = TerrainClass.SOIL
    return elevation_m, classes


def cover(elevation_m: Floats, resolution_m: float, seed: int) -> Bytes:
    """Returns plausible classes without a photo: rock on steep cells, forest on slopes, grass between, bare soil
    here and there.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        NaN is a void; its class is UNKNOWN.
    resolution_m : float
        Side of a cell.
    seed : int
        Seed of the random pattern of forest and soil.

    Returns
    -------
    uint8 (rows, cols), TerrainClass
    """
    rows, cols = elevation_m.shape
    rng = np.random.default_rng([seed, 2])
    steepness = grade(elevation_m, resolution_m)
    patches = fractal_noise(rng, rows, cols, max(min(rows, cols) / 12, 4.0))
    known = steepness[~np.isnan(elevation_m)]
    steep = np.quantile(known, 0.985) if known.size else 1.0
    gentle = np.quantile(known, 0.30) if known.size else 0.0
    classes = np.full((rows, cols), TerrainClass.GRASS, np.uint8)

    def work(row0: int, row1: int) -> None:
        here, slope, patch = classes[row0:row1], steepness[row0:row1], patches.band(row0, row1)
        here[(slope > gentle) & (patch > -0.12)] = TerrainClass.FOREST
        here[(slope <= gentle) & (patch < -0.35)] = TerrainClass.SOIL
        here[slope > max(float(steep), 0.3)] = TerrainClass.ROCK
        here[np.isnan(elevation_m[row0:row1])] = TerrainClass.UNKNOWN

    in_bands(rows, work)
    return classes


LEVEL_LIGHT = 0.70710678
"""Brightness of flat ground."""


def shade(east: Floats, north: Floats, exaggeration: float = 1.0) -> Floats:
    """Light from the north-west, 45 degrees high, on a gradient.

    Parameters
    ----------
    east, north : float32 (rows, cols), m/m
        Rise to the east and to the north.
    exaggeration : float
        How many times higher the ground is made.

    Returns
    -------
    float32 (rows, cols), 0 dark to 1 bright
    """
    east = east * np.float32(exaggeration)
    north = north * np.float32(exaggeration)
    light = (east - north) * np.float32(0.5) + np.float32(LEVEL_LIGHT)
    light /= np.sqrt(east * east + north * north + np.float32(1))
    return np.clip(light, 0, 1, out=light)


def paint_photo(
    elevation_m: Floats, classes: Bytes, resolution_m: float, seed: int, progress: Progress = no_progress
) -> Bytes:
    """A photograph of what covers the ground, lit from the north-west, paler in the heights.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        NaN is a void, which is black; not all may be voids.
    classes : uint8 (rows, cols), TerrainClass
    resolution_m : float
        Side of a cell.
    seed : int
        Of the grain.
    progress : callable
        Called with the current step and the share of it that is done.

    Returns
    -------
    uint8 (rows, cols, 3), red, green, blue
    """
    rows, cols = elevation_m.shape
    texture = fractal_noise(np.random.default_rng([seed, 3]), rows, cols, 16.0)
    low, high = float(np.nanmin(elevation_m)), float(np.nanmax(elevation_m))
    photo = np.empty((rows, cols, 3), np.uint8)

    def work(row0: int, row1: int) -> None:
        here, grain = elevation_m[row0:row1], texture.band(row0, row1)
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
