"""A colour photo from a file, brought onto the grid of the elevation; and whether it is a true-colour photo at all:
rules that know what grass looks like know nothing of other images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.gdal_rasters import middle_of, opened, sampled
from shared_map.importers.georeference import place_on
from shared_map.importers.water_and_voids import CODES
from shared_map.terrain.row_bands import Progress, no_progress
from swarm.errors import TerrainError
from swarm.grid import GridSpec

_MOST_SIDE = 1024
"""The million pixels in the middle tell the kind of an image; a larger look takes longer in proportion."""
_STRETCHED_CELLS = 1 << 18
"""Sample of 512 x 512 pixels, from which a percentile is known to a thousandth."""
_DARK = 30
"""Out of 765, the sum of three bytes: in darker pixels one step of a byte is a tenth of a channel, and ratios of
channels have no meaning."""
_LEGEND_COLOURS, _LEGEND_SAME = 64, 0.6
"""A drawn map has few colours, though CORINE's legend has 44, and most of its pixels are as those to the left and
above. A photo has noise, and thousands of colours."""
_RED_OVER_GREEN, _LIKE_BLUE, _FALSE_SHARE = 1.4, 0.15, 0.25
"""A pixel is as red as plants are in near infrared if red exceeds green by this factor, and green differs from blue
by less than this share of red; red ground and roofs have more green than blue. An image is in false colour where
more than this share of it is so."""


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo on the terrain's grid.

    rgb    uint8 (rows, cols, 3): red, green, blue; black where it shows nothing
    seen   bool (rows, cols): where it shows anything
    notes  processing steps, for people
    other  the kind of an image that is no true-colour photo, for people; None if it may be one
    """

    rgb: Bytes
    seen: Bools
    notes: tuple[str, ...]
    other: str | None = None


def read_photo(path: Path, grid: GridSpec, given_crs: str | None, progress: Progress = no_progress) -> Photo:
    """The photo on the terrain's grid.

    Parameters
    ----------
    path : Path
        Any raster. Values which are not bytes are stretched from its 2nd to its 98th percentile.
    grid : GridSpec
        Of the terrain.
    given_crs : str or None
        Coordinate system of a photo that has a place but does not name its system.
    progress : callable
        Called with the current step and the share of it that is done.

    Raises
    ------
    TerrainError
        If the file cannot be read or names no coordinate system, if it does not overlap the terrain or shows
        nothing of it, or if one of the two has no place on earth and they differ in size.
    """
    what = f"photo {path}"
    with opened(path, "photo", exact=False) as dataset:
        placed = place_on(dataset, grid, given_crs, what)
        size = f"{dataset.height} x {dataset.width} pixels"
        notes = [str(path), f"photo: {size}, covers {placed.share:.1%} of the terrain"]
        if dataset.transform.is_identity:
            notes.append("the photo has no place of its own: its pixels are taken for the terrain's cells")
        indexes, palette = _colour_bands(dataset)
        low, high = (0.0, 0.0) if palette is not None else _stretch(dataset, indexes, notes, what)
        if len(indexes) == 1 and palette is None:
            notes.append("the photo is grey: without colour, what covers the ground is a guess")

        def colours(raw: Floats) -> tuple[Bytes, Bools]:
            """(colours, black where there are none; where there are any)."""
            seen = np.asarray(np.isfinite(raw).all(axis=0), np.bool_)
            raw = np.where(seen, raw, np.float32(0))
            if high > low:
                raw = np.clip((raw - np.float32(low)) * np.float32(255 / (high - low)), 0, 255)
            if palette is not None:
                looked_up = palette.take(raw[0].astype(np.intp), axis=0, mode="wrap")
                return looked_up[..., :3] * seen[..., None], seen & (looked_up[..., 3] > 0)
            return np.moveaxis(raw.astype(np.uint8), 0, -1) * seen[..., None], seen

        rgb = np.empty((grid.rows, grid.cols, 3), np.uint8)
        seen = np.empty((grid.rows, grid.cols), np.bool_)
        how = "nearest" if palette is not None else "average" if placed.grows else "bilinear"
        for rows, raw in placed.on_grid(how, indexes, "reading photo", progress):
            rgb[rows], seen[rows] = colours(raw)
        if not seen.any():
            raise TerrainError(f"{what} shows nothing of the terrain: all of it is nodata or transparent")
        if not seen.all():
            notes.append(f"the photo shows nothing of {1 - seen.mean():.1%} of the terrain, whose class is unknown")
        # Looked for in the file's own pixels: between two colours of a legend an interpolation makes others.
        middle = middle_of(dataset, _MOST_SIDE)
        own, shows = colours(dataset.read(indexes, window=middle).astype(np.float32))
        own = np.broadcast_to(own, (*shows.shape, 3))
        other = why_not_true_colour(own, shows & (dataset.dataset_mask(window=middle) > 0))
        return Photo(rgb, seen, tuple(notes), other)


def _colour_bands(dataset: Any) -> tuple[list[int], NDArray[np.uint8] | None]:
    """Returns which bands are red, green and blue; one grey band stands for all three; a palette is looked up."""
    meanings = list(dataset.colorinterp)
    wanted = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if all(colour in meanings for colour in wanted):
        return [meanings.index(colour) + 1 for colour in wanted], None
    if meanings[0] == ColorInterp.palette:
        table = np.zeros((1 << 16, 4), np.uint8)
        table[list(dataset.colormap(1))] = list(dataset.colormap(1).values())
        return [1], table
    return ([1, 2, 3] if dataset.count >= 3 else [1]), None


def _stretch(dataset: Any, indexes: list[int], notes: list[str], what: str) -> tuple[float, float]:
    """Darkest and brightest of a photo that is not in bytes; (0, 0) for bytes. Raises TerrainError if it holds a
    code for no data that it does not declare."""
    if all(dataset.dtypes[index - 1] == "uint8" for index in indexes):
        return 0.0, 0.0
    sample = sampled(dataset, tuple(indexes), _STRETCHED_CELLS).compressed().astype(np.float64)
    sample = sample[(np.abs(sample) <= np.finfo(np.float32).max) & (sample != 0)]
    if sample.size == 0:
        return 0.0, 1.0
    if sample.min() in CODES and sample.min() < 0:
        void = f"{sample.min():g}"
        raise TerrainError(f"{what} holds {void}, no brightness: gdal_edit.py -a_nodata {void} declares it")
    low, high = (float(value) for value in np.percentile(sample, (2, 98)))
    notes.append(f"photo stretched from {low:.4g}..{high:.4g} to bytes")
    return low, max(high, low + 1e-9)


def why_not_true_colour(rgb: Bytes, seen: Bools) -> str | None:
    """Returns the kind of an image that is not a true-colour photo, for people; None if it may be one.

    Parameters
    ----------
    rgb : uint8 (rows, cols, 3), red, green, blue
    seen : bool (rows, cols)
        Where it shows anything.

    Returns
    -------
    str or None
        A map with a legend has few colours, in areas. In images that show near infrared as red, plants are red,
        with as much green as blue; the reds of true ground have more green than blue.
    """
    same = (rgb[1:, 1:] == rgb[:-1, 1:]).all(axis=2) & (rgb[1:, 1:] == rgb[1:, :-1]).all(axis=2)
    red, green, blue = np.moveaxis(rgb.astype(np.int32), -1, 0)
    count = np.unique((red << 16 | green << 8 | blue)[seen]).size
    if 1 < count <= _LEGEND_COLOURS and same.sum() > _LEGEND_SAME * same.size:
        return f"a drawn map: it has {count} colours, in areas"
    lit = seen & (red + green + blue > _DARK)
    false = (red > _RED_OVER_GREEN * green) & (np.abs(green - blue) < _LIKE_BLUE * red) & lit
    share = false.sum() / max(int(lit.sum()), 1)
    if share > _FALSE_SHARE:
        return f"in false colour: {share:.0%} of it is as red as plants are where near infrared is shown as red"
    return None
