"""The true ground: the ground of the map, changed by what the map does not know.

These changes are closed roads, rubble, a flooded valley and painted zones. Sensors find them; planners never see
them. They follow from the seed, and leave most of the passable ground connected.
"""

from __future__ import annotations

import heapq

import numpy as np

from shared_map.array_files import Bools, CellsOf, Floats
from shared_map.terrain.pace_layers import LETHAL, TerrainClass, largest_part
from shared_map.terrain.synthetic import fractal_noise
from shared_map.terrain.terrain import Terrain
from shared_map.terrain.zones import paint_zones
from swarm.config.scenario import Scenario
from swarm.grid import STEP_COL, STEP_ROW
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST

RUBBLE_FACTOR = np.float32(3.0)
"""True pace over the map's, as `rubble_fields` of a scenario says."""
CONNECTED_SHARE = 0.85
"""At least this share of the largest passable part stays passable and connected, besides flooded cells."""


def build_truth(scenario: Scenario, terrain: Terrain) -> Floats:
    """The true pace of the ground: the prior ground changed by what `terrain.hidden` asks for.

    True pace in s/m, float32 (rows, cols), a new array. Without inflation: it is what a sensor sees of each cell.
    Never shown to planners.
    """
    hidden, elevation_m, classes = scenario.terrain.hidden, terrain.elevation_m, terrain.classes
    truth = np.array(terrain.ground_s_per_m, np.float32)
    for name, factor in hidden.class_factor.items():
        there = (classes == TerrainClass[name.upper()]) & np.isfinite(truth)
        truth[there] = np.clip(truth[there] * np.float32(factor), PACE_LEAST, PACE_MOST)
    rng = np.random.default_rng([scenario.seed, 5])
    least = (CONNECTED_SHARE - hidden.flooded_share) * _largest(truth)
    _rubble(truth, hidden.rubble_fields, rng)
    _close_valley(truth, elevation_m, hidden.flooded_share, rng, least)
    _close_roads(truth, classes == TerrainClass.ROAD, hidden.closed_roads, rng, least)
    void = np.isnan(elevation_m)
    paint_zones(truth, hidden.zones, terrain.grid, scenario.cost, void, key="terrain.hidden.zones")
    return truth


def _largest(truth: Floats) -> int:
    """Cells of the largest connected passable part."""
    return int(largest_part(np.isfinite(truth)).sum())


def _close_valley(truth: Floats, elevation_m: Floats, share: float, rng: np.random.Generator, least: float) -> None:
    """Makes a valley lethal, as much of it as leaves `least` cells in the largest part."""
    flood = _flood(truth, elevation_m, share, rng)
    while flood:
        wet = np.array(flood, np.intp)
        kept = truth.reshape(-1)[wet]
        truth.reshape(-1)[wet] = LETHAL
        if _largest(truth) >= least:
            return
        truth.reshape(-1)[wet] = kept
        flood = flood[: len(flood) // 2]


def _close_roads(truth: Floats, road: Bools, count: int, rng: np.random.Generator, least: float) -> None:
    """Makes stretches of road and the cells beside them lethal. Up to 20 places are tried for each; none fits if
    each would leave fewer than `least` cells in the largest part."""
    cols = truth.shape[1]
    roads = np.flatnonzero(road) if count else np.empty(0, np.intp)
    for _ in range(count):
        roads = roads[np.isfinite(truth.reshape(-1)[roads])]
        if len(roads) == 0:
            return
        for _ in range(20):
            row, col = divmod(int(roads[rng.integers(len(roads))]), cols)
            half = int(rng.integers(1, 3))
            block = (slice(max(row - half, 0), row + half + 1), slice(max(col - half, 0), col + half + 1))
            kept = truth[block].copy()
            truth[block] = LETHAL
            if _largest(truth) >= least:
                break
            truth[block] = kept


def _rubble(truth: Floats, count: int, rng: np.random.Generator) -> None:
    """Multiply the pace by three in ragged fields of 4 to 10 cells in radius."""
    if count == 0:
        return
    rows, cols = truth.shape
    ragged = fractal_noise(rng, rows, cols, 8.0)
    passable = CellsOf(np.isfinite(truth))
    most = max(2.0, min(10.0, min(rows, cols) / 8))
    rubble = np.zeros(truth.shape, np.bool_)
    for _ in range(count):
        row, col = divmod(passable.cell(int(rng.integers(len(passable)))), cols)
        radius = float(rng.uniform(0.4, 1.0)) * most
        reach = int(radius * 1.5) + 1
        row0, col0 = max(row - reach, 0), max(col - reach, 0)
        box = (slice(row0, row + reach + 1), slice(col0, col + reach + 1))
        height, width = truth[box].shape
        north = np.arange(row0, row0 + height)[:, None] - row
        west = np.arange(col0, col0 + width)[None, :] - col
        edge = radius * (1.0 + 0.8 * ragged.part(row0, row0 + height, col0, col0 + width))
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
    # A memoryview reads single values in half the time that an array takes.
    flat, open_ = height.reshape(-1).data, passable.reshape(-1).data
    shore: list[tuple[float, int]] = [(flat[start], start)]
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
                heapq.heappush(shore, (flat[other], other))
    return wet
