"""Water and undeclared voids in a height model, found in the file's own cells: after resampling no lake is level.

Height models are levelled on lakes, reservoirs, wide rivers and the sea. Without a photo nothing else tells that
one cannot drive there, and a level plain is the cheapest ground of all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Floats
from shared_map.terrain.importers.voids import HIGHEST_M
from swarm.config.scenario import TerrainConfig

MOST_SAMPLED = 1 << 24
"""Cells of a file in which level ground is looked for, and in rasters voids: of larger ones in every second, ..."""
_CODES = (-32768.0, -32767.0, -99999.0, -9999.0, -9998.0, -999.0, -500.0, 9999.0, 32767.0, 65535.0)
"""What programs write where they know no height."""
_CODE_GAP_M = 100.0
_ZERO_GAP_M = 30.0
_ALONE = 3.0
"""A code is a void if no other height is nearer to it than this, and than so many times the widest gap between
other heights: real ground is never alone in its height."""
_SAME_M = 0.005
"""Levelled water differs by rounding, or by what a resampling before ours left."""
_STILL_M = 0.05
"""From its highest to its lowest cell, a patch of still water differs by no more."""
_FINE_M = 0.25
"""Heights in smaller steps than this are equal by levelling only. In whole metres gentle ground is level, too."""
_LEAST_CELLS_FINE, _LEAST_CELLS_COARSE = 9, 40
_MOST_LOWER = 0.25
"""Water has a shore, above it but for an outlet: wide rivers are levelled in steps, each beside a lower one. Level
ground beside much lower ground is a terrace, or a rounded slope."""
_LEAST_SHORE = 0.2
"""So much of its border is at another height than the patch, as far as one can see."""
_SEA_M = 0.5
"""Level ground at the border so near to zero is the sea, however gentle the coast is."""
_AROUND_CELLS, _MOST_TERRACES = 15, 0.1
_TOLD_SHARE = 0.001
_NEXT = [(row, col) for row in (0, 1, 2) for col in (0, 1, 2) if (row, col) != (1, 1)]


@dataclass(frozen=True, eq=False)
class LevelGround:
    """Level patches with their shores, in a file's own cells.

    mask       bool (rows, cols)
    patches    (height in m, cells) of each, the largest first
    uncertain  share of the cells that is as level and as low, but among other level ground, as rounding makes it
    """

    mask: Bools
    patches: tuple[tuple[float, int], ...]
    uncertain: float = 0.0


def undeclared_voids(heights: NDArray[np.floating] | NDArray[np.integer]) -> tuple[float, ...]:
    """The values of a height model that stand for no height, though the file does not say so.

    Parameters
    ----------
    heights : (rows, cols), as stored
        NaN is a declared void.

    Returns
    -------
    tuple of float
        Usual codes for "no height", and 0, where no other height is near them.
    """
    known = heights[np.isfinite(heights)]
    gaps_m = {**dict.fromkeys(_CODES, _CODE_GAP_M), 0.0: _ZERO_GAP_M}
    is_code = np.isin(known, np.array(list(gaps_m), known.dtype))
    if not is_code.any():
        return ()
    if is_code.all():
        # Nothing but the sea is a map; nothing but -9999 is none.
        return tuple(code for code in np.unique(known.astype(np.float64)).tolist() if code != 0)
    rest = np.unique(known[~is_code].astype(np.float64))
    widest = np.diff(rest).max(initial=0.0)
    found = []
    for code in np.unique(known[is_code].astype(np.float64)).tolist():
        nearest = np.abs(rest - code).min()
        if nearest >= gaps_m[code] and nearest > _ALONE * widest:
            found.append(code)
    return tuple(found)


def level_ground(elevation_m: Floats) -> LevelGround:
    """The patches that are exactly level and lie no higher than what surrounds them: still water, as a rule.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        As in the file. NaN is a void.

    Returns
    -------
    LevelGround
        Of patches that a rounding of heights does not explain.
    """
    from scipy import ndimage

    around = np.ones((3, 3), np.int8)
    with np.errstate(invalid="ignore"):
        known = np.abs(elevation_m) <= np.float32(HIGHEST_M)
    if not known.all():
        elevation_m = np.where(known, elevation_m, np.float32(np.nan))
    rows, cols = elevation_m.shape
    padded = np.pad(elevation_m, 1, mode="edge")
    inner = np.ones((rows, cols), np.bool_)
    for row, col in _NEXT:
        inner &= np.abs(padded[row : row + rows, col : col + cols] - elevation_m) <= np.float32(_SAME_M)
    labels, count = ndimage.label(inner, structure=around)
    if count == 0:
        return LevelGround(inner, ())
    first = np.zeros(count + 1, np.intp)
    flat = labels.reshape(-1)
    at = np.flatnonzero(flat)
    first[flat[at][::-1]] = at[::-1]
    height_m = elevation_m.reshape(-1)[first]
    height_m[0] = np.nan
    # Where every step is too small to see, a gentle slope is no lake: its far end is at another height.
    spread_m = np.zeros(count + 1, np.float32)
    np.maximum.at(spread_m, flat[at], np.abs(elevation_m.reshape(-1)[at] - height_m[flat[at]]))
    still = spread_m <= _STILL_M
    with_shore = ndimage.grey_dilation(labels, footprint=around)
    lower, differ, edge = (np.zeros(count + 1) for _ in range(3))
    for axis in (0, 1):
        for this, that in ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))):
            here = (this, slice(None)) if axis == 0 else (slice(None), this)
            there = (that, slice(None)) if axis == 0 else (slice(None), that)
            patch = with_shore[here]
            out = (patch > 0) & (with_shore[there] != patch)
            above_m = elevation_m[there][out] - height_m[patch[out]]
            edge += np.bincount(patch[out], minlength=count + 1)
            lower += np.bincount(patch[out], above_m < -2 * _SAME_M, count + 1)
            differ += np.bincount(patch[out], np.abs(above_m) > 2 * _SAME_M, count + 1)
    inner_cells = np.bincount(flat, minlength=count + 1)
    coarse = _step_m(elevation_m) >= _FINE_M
    least = _LEAST_CELLS_COARSE if coarse else _LEAST_CELLS_FINE
    # Without any shore to see, it is a floor, or a part of a slope.
    shore = (differ > _LEAST_SHORE * edge) & (lower <= _MOST_LOWER * differ)
    water = (inner_cells >= least) & still & shore
    water[0] = False
    unsure = np.zeros_like(water)
    if coarse:
        border = np.unique(np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1])))
        sea = (np.abs(height_m) <= _SEA_M) & np.isin(np.arange(count + 1), border)
        unsure = water & ~sea & _among_terraces(inner, labels, water)
        water &= ~unsure
    cells = np.bincount(with_shore.reshape(-1), minlength=count + 1)
    found = np.flatnonzero(water)
    found = found[np.argsort(-cells[found], kind="stable")]
    patches = tuple((float(height_m[n]), int(cells[n])) for n in found.tolist())
    return LevelGround(water[with_shore], patches, float(cells[unsure].sum() / elevation_m.size))


def without(heights: Floats, voids: Sequence[float]) -> Floats:
    """Heights as stored, with NaN for each value that stands for no height."""
    if not voids:
        return heights
    return np.where(np.isin(heights, np.array(voids, np.float32)), np.float32(np.nan), heights)


def looked_at(
    stored: Floats, config: TerrainConfig, scale: float = 1.0, offset: float = 0.0
) -> tuple[tuple[float, ...], Bools, list[str]]:
    """(values that stand for no height, bool (rows, cols) of what is level, what people should know of both).

    Parameters
    ----------
    stored : float32 (rows, cols)
        As in the file; `scale` and `offset` make metres of it. Of a large one only some cells are looked at for
        what is level.
    """
    unknown = undeclared_voids(without(stored, config.nodata_values))
    voids = (*config.nodata_values, *unknown)
    rows, cols = stored.shape
    every = math.ceil(math.sqrt(max(stored.size / MOST_SAMPLED, 1.0)))
    some_m = without(stored[::every, ::every], voids) * np.float32(scale) + np.float32(offset)
    found = level_ground(some_m)
    level = found.mask.repeat(every, axis=0)[:rows].repeat(every, axis=1)[:, :cols]
    return voids, level, [*notes_of_voids(unknown), *notes_of_level(found, config)]


def notes_of_voids(voids: Sequence[float]) -> Iterator[str]:
    """What people should know of undeclared voids."""
    for code in voids:
        yield (
            f"{code:g} is taken for no height: nothing else is near it, though the file does not declare it"
            " (terrain.nodata_values says so for good)"
        )


def notes_of_level(found: LevelGround, config: TerrainConfig) -> Iterator[str]:
    """What people should know of level ground."""
    if found.patches:
        (height_m, cells), many = found.patches[0], len(found.patches)
        taken = f"is taken for {config.level_is}, as terrain.level_is says"
        if config.level_is == "water":
            taken = "is taken for water where no photo shows it; of dry ground say terrain.level_is = 'ground'"
        yield (
            f"level ground: {found.mask.mean():.1%} of the file in {many} patch{'es' * (many > 1)}, the largest"
            f" {cells} cells at {height_m:g} m, {taken}"
        )
    if found.uncertain > _TOLD_SHARE:
        yield (
            f"level ground: {found.uncertain:.1%} of the file is low and level among steps of the heights, which"
            " are rounded, and is taken for ground; of water say terrain.water_below_m"
        )


def _among_terraces(inner: Bools, labels: NDArray[Any], found: Bools) -> Bools:
    """Of each patch: whether much of the ground around it is level as well, at other heights, so that it is a plain
    whose heights were rounded."""
    from scipy import ndimage

    patches = np.where(found[labels], labels, 0)
    near = ndimage.grey_dilation(patches, size=(_AROUND_CELLS, _AROUND_CELLS))
    around = (near > 0) & (patches == 0)
    level = np.bincount(near[around], inner[around], found.size)
    of_all = np.bincount(near[around], minlength=found.size)
    return np.asarray(level > _MOST_TERRACES * of_all, np.bool_)


def _step_m(elevation_m: Floats) -> float:
    """The smallest difference between neighbours that differ, of some rows."""
    some = elevation_m[:: max(elevation_m.shape[0] // 64, 1)]
    steps = np.abs(np.diff(some.astype(np.float64), axis=1))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.quantile(steps, 0.01)) if steps.size else 0.0
