"""Water and undeclared voids in a height model, found in the file's own cells: after resampling no lake is level.

Height models are levelled on lakes, reservoirs, wide rivers and the sea. Without a photo nothing else tells that
one cannot drive there, and a level plain is the cheapest ground of all.

Patches of equal height are connected cells, each as high as the next. Rows are cut into runs of equal cells, and
runs that touch are one patch: a sea is some thousand runs, and a steep slope has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Floats
from shared_map.importers.undo_resampling import surveyed
from shared_map.terrain.row_bands import neighbours
from swarm.config.ground import TerrainConfig

_LEAST_ALIKE, _LEAST_ALIKE_MEANS = 2, 3
"""Number of the eight neighbours that are as high as a cell of a patch: those of a creek one cell wide are two.
Among means of blocks a chain of equal ones is a contour line."""
_STEPS = ((0, 1), (1, -1), (1, 0), (1, 1))
"""(rows down, columns to the right) to four neighbours: each pair of the eight is compared once."""
_SHORE_CELLS, _UNDER, _OVER, _RIPPLED = 3, 0.25, 0.015, 0.1
"""Foot of a shore that a filter leaves on its water: cells within this distance, higher than it by less than this
share of the rise there, or lower by less than a quarter, if a tenth of the cells beside a patch is so. Unfiltered
cells next to water rise by up to a third of what they do within three: one in twenty is so low."""
_MIXED, _HALF = 0.2, 0.045
"""If a fifth of the cells beside a patch is so low, a filter has mixed water and shore in them. Where half
of a cell is water, it then rises by this share of the rise within three cells: on an even slope by 0.056 of it with
a linear filter, 0.042 in means, 0.033 with a cubic filter."""

Labels = NDArray[np.int32]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of equal height.

    labels    int32 (rows, cols), 1 .. count; 0 is no patch
    height_m  float32 (count + 1,), of the first cell of each; NaN of number 0
    spread_m  float32 (count + 1,), of an even slope whose heights vary as much: the lowest and the highest
              of many cells tell of their number
    cells     int64 (count + 1,)
    """

    labels: Labels
    height_m: Floats
    spread_m: Floats
    cells: Counts


def level_patches(elevation_m: Floats, same_m: float, least_cells: int, *, means: bool = False) -> Patches:
    """The patches of a height model.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        NaN is a void.
    same_m : float
        Neighbours that differ by no more are equally high.
    least_cells : int
        Smaller patches are none.
    means : bool
        Whether heights are means of blocks, in which no filter has left ripples at shores.
    """
    least_alike = _LEAST_ALIKE_MEANS if means else _LEAST_ALIKE
    labels, cells = labelled(elevation_m, np.float32(same_m), least_cells, least_alike)
    many = len(cells)
    first = np.full(many, np.nan, np.float32)
    at = np.flatnonzero(labels)[::-1]  # backwards: the value of a patch's first cell is written last
    first[labels.reshape(-1)[at]] = elevation_m.reshape(-1)[at]
    of_cell = labels[labels > 0]
    above_m = elevation_m[labels > 0] - first[of_cell]
    total_m, total_m2 = np.bincount(of_cell, above_m, many), np.bincount(of_cell, above_m**2, many)
    variance = total_m2 / np.maximum(cells, 1) - (total_m / np.maximum(cells, 1)) ** 2
    spread_m = np.sqrt(12 * np.maximum(variance, 0)).astype(np.float32)
    if not means:
        _grow(elevation_m, labels, first)
        cells = np.bincount(labels.reshape(-1), minlength=many)
        cells[0] = 0
    return Patches(labels, first, spread_m, cells)


def _grow(elevation_m: Floats, labels: Labels, height_m: Floats) -> None:
    """Adds to each patch the cells beside it that a filter has put there, at the foot of a shore."""
    from scipy import ndimage

    side = 2 * _SHORE_CELLS + 1
    near = ndimage.maximum_filter(labels, side)
    row, col = np.nonzero((near > 0) & (labels == 0))
    beside = ndimage.maximum_filter(labels, 3)[row, col] > 0
    near = near[row, col]
    rise_m = ndimage.maximum_filter(np.nan_to_num(elevation_m, nan=-np.inf), side)[row, col] - height_m[near]
    above_m = elevation_m[row, col] - height_m[near]

    def count(cells: NDArray[np.bool_]) -> Counts:
        return np.bincount(near[cells], minlength=len(height_m))

    low = (above_m < 0) & (above_m >= -_UNDER * rise_m)
    rippled = count(low) > _RIPPLED * count(np.ones_like(low))
    mixed = count(beside & (np.abs(above_m) <= _OVER * rise_m)) > _MIXED * count(beside)
    taken = (low & rippled[near]) | ((above_m >= 0) & (above_m <= np.where(mixed, _HALF, _OVER)[near] * rise_m))
    labels[row[taken], col[taken]] = near[taken]


def labelled(elevation_m: Floats, same_m: np.float32, least_cells: int, least_alike: int) -> tuple[Labels, Counts]:
    """(labels, cells of each patch), numbered as they come from the north-west."""
    sides = [neighbours(elevation_m.shape, *step) for step in _STEPS]
    same = [np.abs(elevation_m[other] - elevation_m[one]) <= same_m for one, other in sides]
    alike = np.zeros(elevation_m.shape, np.uint8)
    for (one, other), joined in zip(sides, same, strict=True):
        alike[one] += joined
        alike[other] += joined
    level = alike >= least_alike
    for (one, other), joined in zip(sides, same, strict=True):
        joined &= level[one] & level[other]
    begins = level.copy()
    begins[:, 1:] &= ~same[0]
    run = np.cumsum(begins, dtype=np.int32).reshape(elevation_m.shape) - 1
    pairs = []
    # A patch may change its height along two runs: they are joined wherever they are as high as each other.
    for (one, other), joined in zip(sides[1:], same[1:], strict=True):
        pair = np.stack((run[one][joined], run[other][joined]))
        pairs.append(pair[:, np.diff(pair, prepend=-1).any(axis=0)])
    of_run = _connected(int(run[-1, -1]) + 1, *np.hstack(pairs))
    cells = np.bincount(of_run[run[level]], minlength=1).astype(np.int64)
    kept = np.flatnonzero(cells >= least_cells)
    number = np.zeros(cells.size, np.int32)
    number[kept] = np.arange(1, kept.size + 1)
    labels = np.zeros(elevation_m.shape, np.int32)
    labels[level] = number[of_run[run[level]]]
    return labels, np.concatenate((np.zeros(1, np.int64), cells[kept]))


def _connected(count: int, one: Labels, other: Labels) -> Labels:
    """Returns for each of `count` runs the number of its patch, by pairs of runs that touch; patches are in the
    order of their first runs."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = coo_array((np.ones(one.size, np.uint8), (one, other)), shape=(count, count))
    return np.asarray(connected_components(pairs.tocsr(), directed=False)[1], np.int32)


MOST_SAMPLED = 1 << 24
"""Largest number of a file's cells in which level ground and undeclared voids are looked for: of a larger file
every second row and column is taken, or every third, and so on."""
_SAME_M = 0.005
"""Levelled water differs by rounding, or by what a resampling before ours left."""
_STILL_M = 0.02
"""From its highest to its lowest cell, a patch of still water differs by no more. If every step is too small to
see, a gentle slope is no lake: its far end is at another height."""
_COARSE_M = 0.25
"""In whole metres gentle ground is level, too."""
_LEAST_CELLS_REPORTED, _LEAST_CELLS_FINE, _LEAST_CELLS_COARSE = 5, 16, 40
"""Cells of the smallest level patch: of one that is told although it is no water, and of water where heights have
fine steps and coarse ones. In coarse steps more ground is level by chance. With 9 instead of 16, 0.5 % of the dry
ground beside a river in steps of 0.25 m is water. The others are chosen, not measured."""
_MOST_LOWER = 0.25
"""Water has a shore, above it but for an outlet. Level ground beside much lower ground is the top of something, or
a part of a rounded slope. The next step of a river that is levelled in steps does not count as lower ground."""
_LEAST_SHORE = 0.2
"""Share of a patch's border that must be visibly at another height."""
_MOST_BESIDE = 0.7
"""Terraces and the steps of a staircase have other level ground along all of their border."""
_MOST_TERRACES = 0.4
"""A plain whose heights are rounded is a stair of wide steps. Water has at most so much of its shore beside another
wide step; a river that is levelled in steps has its ends only."""
_LEAST_STEEP = 0.1
"""Share of a lake's shore that must rise by more than one rounding from a cell to the next."""
_SEA_M = 0.5
"""Level ground at the border so near to zero is the sea, however gentle the coast is."""
_BLOCK_CELLS = 4
_ROUGH_M, _BLOCK_SAME_M, _BLOCK_STILL_M, _LEAST_BLOCKS = 0.3, 0.06, 0.1, 6
_AROUND_BLOCKS = 5
_NOISY = 0.28
"""Water that a laser measured is rough by a decimetre or two, and level in the mean of 4 x 4 cells. From cell to
cell it differs by a third of its range there; on gentle ground by a sixth, or at most a fourth."""
_REPORTED_SHARE = 0.001
"""The note has one decimal of a percent: a smaller share would be shown as 0.0 or 0.1 %."""
_MUCH_WATER = 0.05
"""Share of the terrain from which on many small lakes are doubted: filled sinks. Chosen, not measured."""


@dataclass(frozen=True, eq=False)
class LevelGround:
    """Level patches with their shores, in a file's own cells.

    mask       bool (rows, cols)
    patches    (height in m, cells) of each, the largest first
    uncertain  share of the cells in other large level patches, or in those which rounding may have made
    """

    mask: Bools
    patches: tuple[tuple[float, int], ...]
    uncertain: float = 0.0


def level_ground(elevation_m: Floats) -> LevelGround:
    """Level areas with a shore above them, which are usually still water. Noise of a laser may make them uneven.

    A file may have been resampled finer than its survey. Its shores then have ripples and slopes that no survey
    has, so patches are looked for in the cells of the survey.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        As in the file. NaN is a void.

    Returns
    -------
    LevelGround
        Of patches that a rounding of heights does not explain.
    """
    elevation_m = elevation_m.copy()
    clear_voids(elevation_m)
    heights_m, row, col = surveyed(elevation_m)
    mask, patches, level = _at_one_scale(np.ascontiguousarray(heights_m))
    finer = elevation_m.size / heights_m.size
    mask, level = mask[np.ix_(row, col)], level[np.ix_(row, col)]
    least = max(min(int(_REPORTED_SHARE * elevation_m.size), _LEAST_CELLS_COARSE), _LEAST_CELLS_REPORTED)
    if finer > 1 or least < _LEAST_CELLS_COARSE:
        # No level patch of the file itself becomes ground in silence, even if the survey is estimated wrongly.
        own = level_patches(elevation_m, _SAME_M, least)
        missed = own.cells - np.bincount(own.labels[mask], minlength=own.cells.size)
        large = (own.cells > _REPORTED_SHARE * elevation_m.size) & (2 * missed > own.cells)
        large[0] = False
        level |= large[own.labels]
    patches = sorted(((height_m, round(cells * finer)) for height_m, cells in patches), key=lambda patch: -patch[1])
    return LevelGround(mask, tuple(patches), float(np.count_nonzero(level & ~mask) / elevation_m.size))


def _at_one_scale(elevation_m: Floats) -> tuple[Bools, list[tuple[float, int]], Bools]:
    """Returns (mask of water, (height in m, cells) of each patch of it, mask of large level patches)."""
    step_m = _step_m(elevation_m)
    least_cells = _LEAST_CELLS_COARSE if step_m >= _COARSE_M else _LEAST_CELLS_FINE
    found = level_patches(elevation_m, _SAME_M, least_cells)
    water, unsure = _judged(found, elevation_m, _SAME_M, _STILL_M, step_m)
    mask: Bools = water[found.labels]
    large = unsure | (found.cells > _REPORTED_SHARE * elevation_m.size)
    large[0] = False
    patches = [(float(found.height_m[n]), int(found.cells[n])) for n in np.flatnonzero(water).tolist()]
    if step_m < _ROUGH_M / _BLOCK_CELLS:
        patches += _rough_water(elevation_m, mask)
    return mask, patches, large[found.labels]


def _judged(
    found: Patches, elevation_m: Floats, same_m: float, still_m: float, step_m: float
) -> tuple[Bools, Bools]:
    """Returns for each patch: (whether it is water, whether that cannot be known), by what lies beyond its sides.

    elevation_m  heights also of cells that are no part of a patch
    same_m       patches are of neighbours that differ by no more
    step_m       what heights are rounded to; 0 if they are not
    """
    labels, cells = found.labels, found.cells
    sides = np.zeros((7, len(cells)), np.int64)
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        here, there = neighbours(labels.shape, down, right)
        at = (labels[here] > 0) & (labels[there] != labels[here])
        patch, beyond = labels[here][at], labels[there][at]
        above_m = elevation_m[there][at] - elevation_m[here][at]
        with np.errstate(invalid="ignore"):
            differs = np.abs(above_m) > 2 * same_m
            near = np.abs(above_m) <= 1.5 * step_m
            low = differs & (above_m < 0)
        level = differs & (beyond > 0) & (4 * cells[beyond] >= cells[patch])
        kinds = (np.ones_like(low), differs, low & ~level, differs & ~near, level, level & low, level & near)
        sides += [np.bincount(patch[kind], minlength=len(cells)) for kind in kinds]
    # Sides beyond which another cell lies; of these, those with another height beyond, the visible part of its
    # shore; of which lower, and no patch; of which more than one rounding away. Of the shore, those with another
    # patch beyond that is at least a quarter as large; of which lower; of which one rounding away.
    edge, differ, lower, steep, beside, below, terrace = sides
    border = np.isin(np.arange(len(cells)), np.concatenate((labels[[0, -1]].ravel(), labels[:, [0, -1]].ravel())))
    still = found.spread_m <= np.float32(still_m)
    # Without any shore to see, it is a floor, or a part of a slope.
    shore = (differ > _LEAST_SHORE * edge) & (lower <= _MOST_LOWER * differ)
    outlet = lower + below <= _MOST_LOWER * differ
    water = still & shore & (outlet | (beside <= _MOST_BESIDE * differ))
    water[0] = False
    sea = border & (np.abs(found.height_m) <= _SEA_M)
    unsure = water & ~sea & ((terrace > _MOST_TERRACES * differ) | (steep <= _LEAST_STEEP * differ))
    return water & ~unsure, unsure


def _rough_water(elevation_m: Floats, mask: Bools) -> list[tuple[float, int]]:
    """Adds areas to a mask of flat ground which are flat but for the roughness of their survey; (height, cells) of
    each."""
    from scipy import ndimage

    side = _BLOCK_CELLS
    rows, cols = (length // side for length in elevation_m.shape)
    if rows < 1 or cols < 1:
        return []
    blocks = elevation_m[: rows * side, : cols * side].reshape(rows, side, cols, side)
    mean_m = blocks.mean(axis=(1, 3))
    range_m = blocks.max(axis=(1, 3)) - blocks.min(axis=(1, 3))
    with np.errstate(invalid="ignore"):
        smooth = range_m <= np.float32(_ROUGH_M)
    # A rough block can be a shore, but no part of a patch.
    flat_m = np.where(smooth, mean_m, np.float32(np.nan))
    found = level_patches(flat_m, _BLOCK_SAME_M, _LEAST_BLOCKS, means=True)
    water, _ = _judged(found, mean_m, _BLOCK_SAME_M, _BLOCK_STILL_M, 0.0)
    row, col = np.nonzero(smooth)
    cells = blocks[row, :, col, :]
    steps_m = sum(np.abs(np.diff(cells, axis=axis)).mean(axis=(1, 2)) for axis in (1, 2))
    noisy = steps_m > np.float32(2 * _NOISY) * range_m[row, col]
    water &= 2 * np.bincount(found.labels[row, col][noisy], minlength=water.size) > found.cells
    if not water.any():
        return []
    total_m = np.bincount(found.labels.reshape(-1), np.nan_to_num(mean_m).reshape(-1), water.size)
    height_m = np.where(water, total_m / np.maximum(found.cells, 1), np.nan).astype(np.float32)

    def of_cells(blocks: NDArray[np.int32]) -> tuple[NDArray[np.int32], Floats]:
        """The number of each cell's block, the last one's beyond whole blocks; how far off its height a cell is."""
        whole = np.pad(blocks, ((0, 1), (0, 1)), "edge").repeat(side, axis=0).repeat(side, axis=1)
        of_cell = whole[: elevation_m.shape[0], : elevation_m.shape[1]]
        return of_cell, np.abs(elevation_m - height_m[of_cell])

    lakes = np.where(water[found.labels], found.labels, 0)
    of_cell, off_m = of_cells(lakes)
    taken = np.bincount(of_cell.reshape(-1), minlength=water.size)
    rough_m = np.zeros(water.size, np.float32)
    whole = np.s_[: rows * side, : cols * side]  # cells beyond whole blocks may be shore, or voids
    np.maximum.at(rough_m, of_cell[whole], off_m[whole])
    # Exactly flat areas have been found, with their shore to the cell.
    water &= 2 * np.bincount(of_cell[mask], minlength=water.size) < taken
    rough_m[~water] = -1
    of_cell, off_m = of_cells(ndimage.maximum_filter(lakes, _AROUND_BLOCKS))
    with np.errstate(invalid="ignore"):
        mask |= off_m <= rough_m[of_cell]
    return [(float(height_m[n]), int(taken[n])) for n in np.flatnonzero(water).tolist()]


def examined(
    stored: Floats, config: TerrainConfig, scale: float = 1.0, offset: float = 0.0
) -> tuple[tuple[float, ...], Bools, list[str]]:
    """Returns (values that are no heights, bool (rows, cols) of flat cells, notes for people on both).

    Parameters
    ----------
    stored : float32 (rows, cols)
        As in the file; `scale` and `offset` make metres of it.
    """
    unknown = undeclared_voids(voids_as_nan(stored, config.nodata_values), scale, offset)
    voids = (*config.nodata_values, *unknown)
    notes = [
        f"{code:g} is taken for no height: nothing else is near it, though the file does not declare it"
        " (terrain.nodata_values says so for good)"
        for code in unknown
    ]
    found = level_ground(voids_as_nan(stored, voids) * np.float32(scale) + np.float32(offset))
    if found.patches:
        (height_m, cells), many = found.patches[0], len(found.patches)
        taken = f"is taken for {config.level_is}, as terrain.level_is says"
        if config.level_is == "water":
            taken = "counts as water unless a photo shows dry ground; if it is dry, set terrain.level_is = 'ground'"
        # Filled sinks are many small lakes; they close much of a map.
        share = float(found.mask.mean())
        filled = share > _MUCH_WATER and 4 * cells < share * found.mask.size and config.level_is == "water"
        notes.append(
            f"{'! ' * filled}level ground: {share:.1%} of the file in {many} patch{'es' * (many > 1)},"
            f" the largest {cells} cells at {height_m:g} m, {taken}"
        )
    if found.uncertain > _REPORTED_SHARE and config.level_is == "water":
        notes.append(
            f"! level ground: {found.uncertain:.1%} of the file is level, but counts as ground, because its shore"
            " is not like that of water or its heights are rounded; if it is water, set terrain.water_below_m"
        )
    return voids, found.mask, notes


def _step_m(elevation_m: Floats) -> float:
    """The smallest difference between neighbours that differ, of some rows."""
    some = elevation_m[:: max(elevation_m.shape[0] // 64, 1)]
    steps = np.abs(np.diff(some.astype(np.float64), axis=1))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.quantile(steps, 0.01)) if steps.size else 0.0


# --- voids ----------------------------------------------------------------------------------------------------


HIGHEST_M = 20_000.0
"""Heights beyond this, up or down, are undeclared voids."""
_SEARCH_CELLS = 64
"""Distance over which a void is filled from heights around it; farther in it takes the nearest height."""
CODES = (-32768.0, -32767.0, -99999.0, -9999.0, -9998.0, -999.0, -500.0, 9999.0, 32767.0, 65535.0)
"""Values which programs write for an unknown height."""
_GAPS_M = {**dict.fromkeys(CODES, 100.0), 0.0: 30.0}
_ALONE = 3.0
"""A code is no-data if no other height is nearer to it than its gap, and than this multiple of the widest gap
between other heights: real ground never has an isolated height."""
_BIN_M = 0.25
"""Gaps between heights are measured in steps of this."""


def undeclared_voids(
    heights: NDArray[np.floating] | NDArray[np.integer], scale: float = 1.0, offset: float = 0.0
) -> tuple[float, ...]:
    """The values of a height model that stand for no height, though the file does not say so.

    Parameters
    ----------
    heights : (rows, cols), as stored
        NaN is a declared void.
    scale, offset : float
        They make metres of what is stored. Codes are looked for as they are stored, gaps are measured in metres.

    Returns
    -------
    tuple of float
        Usual codes for "no height", and 0, where no other height is near them.
    """
    codes = sorted(code for code in _GAPS_M if (heights == code).any())
    if not codes:
        return ()
    rest = heights[np.isfinite(heights) & ~np.isin(heights, np.array(codes, heights.dtype))].astype(np.float64)
    rest_m = rest * scale + offset
    there = np.abs(rest_m) <= HIGHEST_M  # what lies beyond is a void anyway
    if not there.any():
        # Nothing but the sea is a map; nothing but -9999 is none.
        return tuple(code for code in codes if code != 0)
    occupied = np.zeros(int(2 * HIGHEST_M / _BIN_M) + 1, np.bool_)
    occupied[((rest_m[there] + HIGHEST_M) / _BIN_M).astype(np.intp)] = True
    widest_m = float(np.diff(np.flatnonzero(occupied)).max(initial=0)) * _BIN_M
    nearest_m = {code: float(np.abs(rest[there] - code).min()) * abs(scale) for code in codes}
    return tuple(code for code in codes if nearest_m[code] >= _GAPS_M[code] and nearest_m[code] > _ALONE * widest_m)


def voids_as_nan(heights: Floats, voids: Sequence[float]) -> Floats:
    """The stored heights, with NaN in place of each value that means "no data"."""
    if not voids:  # as in most files: no copy
        return heights
    return np.where(np.isin(heights, np.array(voids, np.float32)), np.float32(np.nan), heights)


def clear_voids(elevation_m: Floats) -> int:
    """Replaces every value that is no height by NaN, and counts them.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        Changed in place: infinities, and what lies beyond `HIGHEST_M` up or down, become NaN.

    Returns
    -------
    int
        Cells that are NaN now.
    """
    with np.errstate(invalid="ignore"):
        void = ~(np.abs(elevation_m) <= np.float32(HIGHEST_M))
    elevation_m[void] = np.nan
    return int(np.count_nonzero(void))


def fill_voids(elevation_m: Floats) -> Floats:
    """Voids filled from their surroundings (GDAL's inverse distance), far from any height by the nearest one.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        NaN is a void; at least one cell has a height. It is not changed.

    Returns
    -------
    float32 (rows, cols), m
        A copy without NaN.
    """
    from rasterio.fill import fillnodata
    from scipy import ndimage

    known = ~np.isnan(elevation_m)
    filled: Floats = fillnodata(
        np.where(known, elevation_m, np.float32(0)), known.astype(np.uint8), max_search_distance=_SEARCH_CELLS
    )
    # If GDAL finds no cell near enough, it leaves the value as it was.
    distance, nearest = ndimage.distance_transform_edt(~known, return_indices=True)
    far = distance >= _SEARCH_CELLS
    filled[far] = elevation_m[tuple(nearest)][far]
    return filled
