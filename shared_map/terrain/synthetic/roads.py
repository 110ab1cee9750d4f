"""Roads where there is no map of them: cheapest ways between seeded places."""

from __future__ import annotations

import numpy as np

from shared_map.array_files import Bools, Floats
from shared_map.terrain.layers import largest_part
from shared_map.terrain.synthetic.ways import Ways
from swarm.errors import TerrainError
from swarm.grid import GridSpec

_COARSE_CELLS = 1_000_000
"""Above this many cells roads are planned on every second, fourth, ... cell and then drawn."""


def lay_roads(pace: Floats, count: int, grid: GridSpec, seed: int) -> Bools:
    """Cells of `count` roads. Each leads from a new place to the nearest place that has one already, every fourth
    to another place instead, so that there are ways around. A road is cheap to follow, so later ones join it.

    Parameters
    ----------
    pace : float32 (rows, cols), s/m
        inf is lethal; no road crosses it.
    count : int
        Roads wanted. There are fewer where places do not connect, or do not suffice.
    grid : GridSpec
        Of `pace`.
    seed : int
        Not negative.

    Returns
    -------
    bool (rows, cols)

    Raises
    ------
    TerrainError
        If no two places are connected.
    """
    stride = 1
    while grid.cells // stride**2 > _COARSE_CELLS:
        stride *= 2
    price = _price(pace, stride)
    road_price = 0.35 * float(np.min(price[np.isfinite(price)], initial=1.0))
    rng = np.random.default_rng([seed, 4])
    places = _places(price, count + 1, rng)
    laid = np.zeros(price.shape, np.bool_)
    for number in range(1, len(places)):
        here, settled = places[number], places[:number]
        ends = sorted(settled, key=lambda p: (p[0] - here[0]) ** 2 + (p[1] - here[1]) ** 2)
        wanted = ends[0 if number % 4 else int(rng.integers(len(ends) // 2, len(ends)))]
        ways = Ways(price, here)
        if np.isinf(ways.cost[wanted]):
            continue
        rows, cols = ways.to(wanted)
        laid[rows, cols] = True
        price[rows, cols] = road_price
    if not laid.any():
        raise TerrainError(f"terrain.roads = {count}: no two places of the terrain are connected; set it to 0")
    return laid if stride == 1 else _drawn(laid, stride, pace)


def _price(pace: Floats, stride: int) -> Floats:
    """Returns the builders' price: the square of pace, so that roads bend around slopes; lethal ground is not
    entered."""
    coarse = pace
    if stride > 1:
        rows, cols = (pace.shape[0] // stride) * stride, (pace.shape[1] // stride) * stride
        blocks = pace[:rows, :cols].reshape(rows // stride, stride, cols // stride, stride)
        coarse = blocks.max(axis=(1, 3))
    base = np.min(coarse[np.isfinite(coarse)], initial=1.0)
    price = np.where(np.isfinite(coarse), coarse / base, np.float32(np.inf))
    return np.asarray(price * price, np.float32)


def _places(price: Floats, count: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Seeded places on cheap ground of the largest connected part, apart from each other."""
    rows, cols = price.shape
    passable = price[np.isfinite(price)]
    if passable.size == 0:
        return []
    candidates = np.flatnonzero((price <= np.quantile(passable, 0.3)) & largest_part(np.isfinite(price)))
    if len(candidates) == 0:
        return []
    apart = 0.5 * np.sqrt(rows * cols / count)
    places: list[tuple[int, int]] = []
    for attempt in range(count * 60):
        cell = int(candidates[rng.integers(len(candidates))])
        row, col = divmod(cell, cols)
        wanted = apart * (1.0 - attempt / (count * 60))
        if all((row - r) ** 2 + (col - c) ** 2 >= wanted * wanted for r, c in places):
            places.append((row, col))
            if len(places) == count:
                break
    return places


def _drawn(laid: Bools, stride: int, pace: Floats) -> Bools:
    """A coarse road drawn cell by cell between the middles of neighbouring coarse cells."""
    road = np.zeros(pace.shape, np.bool_)
    half = stride // 2
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        rows, cols = laid.shape
        here = laid[: rows - dr, max(-dc, 0) : cols - max(dc, 0)]
        there = laid[dr:, max(dc, 0) : cols + min(dc, 0)]
        at_row, at_col = np.nonzero(here & there)
        at_col = at_col + max(-dc, 0)
        for step in range(stride + 1):
            road[at_row * stride + half + dr * step, at_col * stride + half + dc * step] = True
    return road & np.isfinite(pace)
