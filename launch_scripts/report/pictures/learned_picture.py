"""What was learned of kinds of ground, as a layer over the ground: slower than its prior, or quicker."""

from __future__ import annotations

import io
import math

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.palette import BLUE, ORANGE, rgb
from shared_map.arrays import Floats
from shared_map.learning.factors import keys_of
from shared_map.terrain.terrain import Terrain

LEARNED_FILE = "learned.png"
SLOWER, QUICKER = ORANGE, BLUE
_MOST_PIXELS = 1 << 20
_FULL = math.log(4)
"""|ln(factor)| that is drawn as strongly as can be: no factor is beyond 4 or a quarter."""
_WEAKEST, _STRONGEST = 60, 210


def learned_pixels(terrain: Terrain, factors: Floats) -> NDArray[np.uint8]:
    """uint8 (rows, cols, 4): nothing where the prior stands, and where it is lethal. Of a large terrain every n-th
    cell.

    factors  float32 (KEYS,)  of each kind of ground
    """
    grid = terrain.grid
    side = max(1, math.ceil(math.sqrt(grid.cells / _MOST_PIXELS)))
    keys = keys_of(terrain.classes, terrain.elevation_m, grid.resolution_m)[::side, ::side]
    off = np.log(factors)[keys]
    off[np.isinf(np.asarray(terrain.ground_s_per_m)[::side, ::side])] = 0.0
    pixels = np.zeros((*off.shape, 4), np.uint8)
    strength = _WEAKEST + (_STRONGEST - _WEAKEST) * np.minimum(np.abs(off) / _FULL, 1.0)
    for where, colour in ((off > 0, SLOWER), (off < 0, QUICKER)):
        pixels[where, :3] = rgb(colour)
        pixels[where, 3] = strength[where].astype(np.uint8)
    return pixels


def learned_overlay(terrain: Terrain, factors: Floats) -> bytes:
    """`learned_pixels` as PNG."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(learned_pixels(terrain, factors)).save(file, "PNG", optimize=True)
    return file.getvalue()
