"""The true ground: the ground of the map, changed by what the map does not know.

These changes are closed roads, rubble, a flooded valley and painted zones. Sensors find them; planners never see
them. They follow from the seed, and leave most of the passable ground connected.
"""

from __future__ import annotations

import heapq

import numpy as np

from shared_map.arrays import Bools, Bytes, Floats
from shared_map.terrain.layers import LETHAL, TerrainClass, paint_zones
from shared_map.terrain.synthetic.noise import fractal
from swarm.config.scenario import CostConfig, HiddenConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

RUBBLE_FACTOR = np.float32(3.0)
CONNECTED_SHARE = 0.85
"""At least this share of the largest passable part stays passable and connected, besides what is flooded."""


def true_ground(
    hidden: HiddenConfig,
    cost: CostConfig,
    grid: GridSpec,
    ground: Floats,
    elevation_m: Floats,
    classes: Bytes,
    seed: int,
) -> Floats:
    """True pace in s/m, float32 (rows, cols), without inflation. A new array.

    ground       float32  (rows, cols)  s/m; the map's ground, without inflation; inf is lethal
    elevation_m  float32  (rows, cols)  NaN is a void
    classes      uint8    (rows, cols)  TerrainClass
    """
    truth = np.array(ground, np.float32)
    rng = np.random.default_rng([seed, 5])
    whole = _largest(np.isfinite(truth))
    _rubble(truth, hidden.rubble_fields, rng)
    flood = _flood(truth, elevation_m, hidden.flooded_share, rng)
    while flood:
        wet = np.array(flood, np.intp)
        kept = truth.reshape(-1)[wet]
        truth.reshape(-1)[wet] = LETHAL
        if _largest(np.isfinite(truth)) >= (CONNECTED_SHARE - hidden.flooded_share) * whole:
            break
        truth.reshape(-1)[wet] = kept
        flood = flood[: len(flood) // 2]
    roads = classes == TerrainClass.ROAD
    for _ in range(hidden.closed_roads):
        _close_a_road(truth, roads, rng, whole * (CONNECTED_SHARE - hidden.flooded_share))
    paint_zones(truth, hidden.zones, grid, cost, np.isnan(elevation_m))
    return truth


def _largest(passable: Bools) -> int:
    """Cells of the largest connected passable part."""
    from scipy import ndimage

    labels, count = ndimage.label(passable)
    return int(np.bincount(labels.ravel())[1:].max()) if count else 0


def _close_a_road(truth: Floats, road: Bools, rng: np.random.Generator, least: float) -> None:
    """Make a stretch of road and the cells beside it lethal. Up to 20 places are tried; none fits if each would cut
    the largest passable part to fewer than `least` cells."""
    roads = np.flatnonzero((road & np.isfinite(truth)).reshape(-1))
    if len(roads) == 0:
        return
    cols = truth.shape[1]
    for _ in range(20):
        row, col = divmod(int(roads[rng.integers(len(roads))]), cols)
        half = int(rng.integers(1, 3))
        block = (slice(max(row - half, 0), row + half + 1), slice(max(col - half, 0), col + half + 1))
        kept = truth[block].copy()
        truth[block] = LETHAL
        if _largest(np.isfinite(truth)) >= least:
            return
        truth[block] = kept


def _rubble(truth: Floats, count: int, rng: np.random.Generator) -> None:
    """Multiply the pace by three in ragged fields of 4 to 10 cells in radius."""
    if count == 0:
        return
    rows, cols = truth.shape
    ragged = fractal(rng, rows, cols, 8.0)
    passable = np.flatnonzero(np.isfinite(truth.reshape(-1)))
    most = max(2.0, min(10.0, min(rows, cols) / 8))
    rubble = np.zeros(truth.shape, np.bool_)
    for _ in range(count):
        row, col = divmod(int(passable[rng.integers(len(passable))]), cols)
        radius = float(rng.uniform(0.4, 1.0)) * most
        reach = int(radius * 1.5) + 1
        row0, col0 = max(row - reach, 0), max(col - reach, 0)
        box = (slice(row0, row + reach + 1), slice(col0, col + reach + 1))
        height, width = truth[box].shape
        north = np.arange(row0, row0 + height)[:, None] - row
        west = np.arange(col0, col0 + width)[None, :] - col
        edge = radius * (1.0 + 0.8 * ragged[box])
        rubble[box] |= north * north + west * west <= edge * edge
    truth[rubble] *= RUBBLE_FACTOR


def _flood(truth: Floats, height: Floats, share: float, rng: np.random.Generator) -> list[int]:
    """Flat indices of the cells of one valley, in the order in which rising water reaches them from a seeded low
    cell."""
    passable = np.isfinite(truth)
    wanted = int(share * passable.sum())
    if wanted == 0:
        return []
    rows, cols = height.shape
    low = np.flatnonzero(passable.reshape(-1) & (height <= np.quantile(height[passable], 0.2)).reshape(-1))
    start = int(low[rng.integers(len(low))])
    flat, open_ = height.reshape(-1), passable.reshape(-1)
    shore: list[tuple[float, int]] = [(float(flat[start]), start)]
    seen = {start}
    wet: list[int] = []
    while shore and len(wet) < wanted:
        _, cell = heapq.heappop(shore)
        wet.append(cell)
        row, col = divmod(cell, cols)
        for dr, dc in zip(STEP_ROW, STEP_COL, strict=True):
            r, c = row + dr, col + dc
            other = r * cols + c
            if 0 <= r < rows and 0 <= c < cols and other not in seen and open_[other]:
                seen.add(other)
                heapq.heappush(shore, (float(flat[other]), other))
    return wet
