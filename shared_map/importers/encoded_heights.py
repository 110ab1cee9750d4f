"""Heights that are stored as colours: Terrain-RGB and Terrarium tiles, decoded before anything is interpolated.

Between two colours lies no height: one step of red is 6,553.6 m in Terrain-RGB and 256 m in Terrarium.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats
from shared_map.importers.raster_files import READ_ROWS, middle_of
from shared_map.terrain.row_bands import bands
from swarm.config.input_files import size
from swarm.errors import TerrainError

Encoding = Literal["terrain-rgb", "terrarium"]
ENCODINGS: tuple[Encoding, ...] = ("terrain-rgb", "terrarium")
TITLES = {"terrain-rgb": "Terrain-RGB", "terrarium": "Terrarium"}

_LOWEST_M, _HIGHEST_M = -11_500.0, 9_500.0
_RED_M = {"terrain-rgb": 6553.6, "terrarium": 256.0}
"""Height of one step of red (m)."""
_MOST_TORN = 0.7
"""Share of the steps of red. In a photo nearly all are tears, as green follows red; in heights few are."""
_MOST_ROUGH = 0.5
_MOST_SIDE = 1024
_MOST_CELLS = 1 << 26
"""All are decoded at once. Tiles have 256 or 512 cells a side; a mosaic of this width has 32 of them."""


def decoded(rgb: NDArray[np.uint8], encoding: Encoding) -> Floats:
    """Heights of colours.

    Parameters
    ----------
    rgb : uint8 (3, rows, cols)
    encoding : str
        terrain-rgb: -10000 + 0.1 (65536 R + 256 G + B); terrarium: 256 R + G + B / 256 - 32768.

    Returns
    -------
    float32 (rows, cols), m
        NaN where the colour is black, which stands for no height in both.
    """
    red, green, blue = rgb.astype(np.int32)
    number = red << 16 | green << 8 | blue
    # Whole numbers below 2**24 are exact in float32, so that each height is rounded once.
    if encoding == "terrain-rgb":
        heights: Floats = (number - 100_000).astype(np.float32) / np.float32(10)
    else:
        heights = (number - (32_768 << 8)).astype(np.float32) / np.float32(256)
    heights[number == 0] = np.nan
    return heights


def is_plausible(rgb: NDArray[np.uint8], shown: NDArray[np.bool_], encoding: Encoding) -> bool:
    """Returns True if colours, decoded, are the heights of a landscape: within those of the Earth, and without a
    tear where red changes by a step, as green and blue make up for it.

    Parameters
    ----------
    rgb : uint8 (3, rows, cols)
        Neighbours as in the file.
    shown : bool (rows, cols)
        Where the image shows anything.
    """
    heights = decoded(rgb, encoding)
    heights[~shown] = np.nan
    known = heights[~np.isnan(heights)]
    if not known.size or known.min() < _LOWEST_M or known.max() > _HIGHEST_M:
        return False
    red = rgb[0].astype(np.int16)
    torn = steps = 0
    rough_m = pairs = 0.0
    for axis in (0, 1):
        rise_m = np.abs(np.diff(heights, axis=axis))
        beside = ~np.isnan(rise_m)
        stepped = beside & (np.diff(red, axis=axis) != 0)
        steps += int(stepped.sum())
        torn += int((rise_m[stepped] > _RED_M[encoding] / 2).sum())
        rough_m += float(rise_m[beside].sum())
        pairs += float(beside.sum())
    # Noise differs from cell to cell by as much as from one end to the other.
    # One colour is no landscape.
    spread_m = float(known.std())
    return spread_m > 0 and torn <= _MOST_TORN * steps and rough_m <= _MOST_ROUGH * spread_m * pairs


def encodings_of(dataset: Any) -> list[Encoding]:
    """The encodings in which an image of three or four bands may be heights: none, one or both."""
    if not _is_colours(dataset):
        return []
    window = middle_of(dataset, _MOST_SIDE)
    rgb = dataset.read((1, 2, 3), window=window)
    shown = dataset.dataset_mask(window=window) > 0
    return [encoding for encoding in ENCODINGS if is_plausible(rgb, shown, encoding)]


def _is_colours(dataset: Any) -> bool:
    return dataset.count in (3, 4) and all(dtype == "uint8" for dtype in dataset.dtypes)


def heights_decoded(dataset: Any, encoding: Encoding, path: Path) -> tuple[Floats, list[str]]:
    """(heights of an image, float32 (rows, cols), m, NaN for none; what people should know of them).

    Raises TerrainError if the image is no such one, too large, or was compressed with loss, which leaves no height
    as it was.
    """
    what = f"terrain {path}"
    if not _is_colours(dataset):
        raise TerrainError(
            f"{what} has {dataset.count} bands of {dataset.dtypes[0]}; {TITLES[encoding]} is three bands of uint8"
        )
    if _is_lossy(dataset):
        raise TerrainError(
            f"{what} is compressed with loss, which spoils heights stored as colours; fetch it as PNG or"
            " lossless WebP"
        )
    rows, cols = dataset.height, dataset.width
    if rows * cols > _MOST_CELLS:
        raise TerrainError(f"{what} has {rows} x {cols} pixels, {size(4 * rows * cols)} of heights; crop it")
    heights = np.empty((rows, cols), np.float32)
    for row0, row1 in bands(rows, READ_ROWS):
        window = ((row0, row1), (0, cols))
        heights[row0:row1] = decoded(dataset.read((1, 2, 3), window=window), encoding)
        heights[row0:row1][dataset.dataset_mask(window=window) == 0] = np.nan
    void = float(np.isnan(heights).mean())
    return heights, [f"{void:.1%} of the image is black or transparent: no height"] if void else []


def _is_lossy(dataset: Any) -> bool:
    structure = dataset.tags(ns="IMAGE_STRUCTURE")
    packed = structure.get("COMPRESSION", "").upper()
    return (
        dataset.driver == "JPEG"
        or packed in ("JPEG", "YCBCR JPEG")
        or structure.get("COMPRESSION_REVERSIBILITY", "").upper().startswith("LOSSY")
    )
