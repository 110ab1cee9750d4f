"""Layers: pure functions from arrays to pace, and the rule that merges them.

The merge rule, per cell, in this order:

1. pace = flat pace x slope factor x class factor; on a road the road pace instead.
   With `cost.directional` the slope factor is left out, and each step costs by its rise instead
   (`slope_and_climb`). No finite pace is above `PACE_MOST` or below `PACE_LEAST`.
2. Voids, ground steeper than `max_slope_deg`, and lethal classes are lethal.
   Then the scenario's own layers (`cost_layers`), one after the other; a void stays lethal.
3. Zones in the order written: a pace sets the pace of open ground, a factor multiplies it, preferred halves, rough
   doubles, slow water multiplies. A road sets the road pace, over cliffs and the terrain's own water too (a
   cutting, a causeway), but not over no-data; a road of a file only where that is quicker. Then water that is
   lethal closes what it touches, roads too; then bridges open the water beneath them; then every forbidden zone is
   lethal, whatever else was painted there.
4. This is the ground. The prior map is the ground with inflation: a cell is lethal where a vehicle of
   `vehicle_radius_m` in its middle would touch a lethal cell.
5. Marks replace the ground cell by cell (see `cost_map`), before inflation.

Costly is not lethal: a factor, however large, never makes a cell infinite. Slope factors are in `slope_and_climb`,
zones in `zones`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence

import numpy as np

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.terrain.row_bands import in_bands, padded_rows
from shared_map.terrain.slope_and_climb import slope_factor
from swarm.config.ground import CostConfig
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST

LETHAL = np.float32(np.inf)


class TerrainClass(enum.IntEnum):
    """Land cover of a cell: its number, factor and tint.

    factor  pace relative to open ground; a scenario may set others in `cost.class_factor`. Shrub is the heavy brush
            of Soule and Goldman (1972), for people on foot; wetland is a judgement: vehicles get stuck there
    tint    natural colour, as in a photograph: red, green, blue
    """

    factor: float
    tint: tuple[int, int, int]

    def __new__(cls, number: int, factor: float, tint: tuple[int, int, int]) -> TerrainClass:
        kind = int.__new__(cls, number)
        kind._value_, kind.factor, kind.tint = number, factor, tint
        return kind

    UNKNOWN = 0, 1.0, (122, 118, 100)
    WATER = 1, math.inf, (42, 74, 98)
    FOREST = 2, 1.8, (58, 84, 46)
    ROCK = 3, 2.5, (138, 130, 120)
    GRASS = 4, 1.0, (126, 142, 78)
    SOIL = 5, 1.2, (156, 134, 98)
    ROAD = 6, 1.0, (186, 178, 164)
    BUILT = 7, 3.0, (164, 122, 108)
    SNOW = 8, 2.5, (236, 240, 244)
    SHRUB = 9, 1.5, (104, 116, 66)
    WETLAND = 10, 5.0, (88, 108, 94)


READABLE = (
    TerrainClass.GRASS,
    TerrainClass.SOIL,
    TerrainClass.ROCK,
    TerrainClass.BUILT,
    TerrainClass.FOREST,
    TerrainClass.SNOW,
    TerrainClass.UNKNOWN,
)
"""Possible readings of a photo's cell, from general to particular: each is a bit of its readings, the first the
lowest."""


def gradient_of_padded(padded_m: Floats, resolution_m: float) -> tuple[Floats, Floats]:
    """Horn's derivative, metres per metre: (to the east, to the north), of an array that brings its own border of
    one cell (`row_bands.padded_rows`).

    The weights 1 2 1 over 3 x 3 cells, as in GDAL. A void (NaN) beside a cell counts as level with it.
    """
    if np.isnan(padded_m).any():
        return _gradient_beside_voids(padded_m, resolution_m)
    scale = np.float32(1.0 / (8.0 * resolution_m))
    # Neighbours are subtracted before they are summed: 4000 m in float32 has steps of a quarter millimetre.
    across = padded_m[:, 2:] - padded_m[:, :-2]
    east = across[1:-1] * np.float32(2)
    east += across[:-2]
    east += across[2:]
    east *= scale
    down = padded_m[:-2] - padded_m[2:]
    north = down[:, 1:-1] * np.float32(2)
    north += down[:, :-2]
    north += down[:, 2:]
    north *= scale
    return east, north


def _gradient_beside_voids(padded_m: Floats, resolution_m: float) -> tuple[Floats, Floats]:
    scale = np.float32(1.0 / (8.0 * resolution_m))
    centre = padded_m[1:-1, 1:-1]
    rows, cols = centre.shape
    east, north = np.zeros(centre.shape, np.float32), np.zeros(centre.shape, np.float32)
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            rise = padded_m[1 + dr : 1 + dr + rows, 1 + dc : 1 + dc + cols] - centre
            np.copyto(rise, np.float32(0), where=np.isnan(rise))
            east += np.float32(dc * (2 - abs(dr))) * rise
            north -= np.float32(dr * (2 - abs(dc))) * rise
    return east * scale, north * scale


def grade(elevation_m: Floats, resolution_m: float) -> Floats:
    """Steepest rise over run of each cell. At the border the ground goes on as steep as it is."""
    steepness = np.empty(elevation_m.shape, np.float32)

    def work(row0: int, row1: int) -> None:
        steepness[row0:row1] = grade_of_padded(padded_rows(elevation_m, row0, row1), resolution_m)

    in_bands(elevation_m.shape[0], work)
    return steepness


def grade_of_padded(padded_m: Floats, resolution_m: float) -> Floats:
    """`grade` of an array that brings its own border. NumPy's hypot costs ten times as much, and nothing here
    overflows."""
    east, north = gradient_of_padded(padded_m, resolution_m)
    east *= east
    east += north * north
    return np.sqrt(east, out=east)


def slope_deg(elevation_m: Floats, resolution_m: float) -> Floats:
    """Slope of each cell in degrees, for people; costs are taken from `grade`."""
    return np.degrees(np.arctan(grade(elevation_m, resolution_m))).astype(np.float32)


def class_factors(cost: CostConfig) -> Floats:
    """Factor of each class, indexed by its number: the built-in ones, replaced by the scenario's."""
    factors = np.ones(256, np.float32)
    for kind in TerrainClass:
        factors[kind] = kind.factor
    for name, value in cost.class_factor.items():
        factors[TerrainClass[name.upper()]] = LETHAL if value == "lethal" else value
    return factors


def doubt_factors(cost: CostConfig) -> Floats:
    """Returns the factor of an unknown cell by its readings, bits of `READABLE`: the highest of them.

    A lethal reading counts only where all are lethal, or doubt would wall off what may be driven on. Without
    readings, and where the scenario prices the unknown itself, `class_factors` has the factor."""
    factors = class_factors(cost)
    doubts = np.full(256, factors[TerrainClass.UNKNOWN], np.float32)
    if "unknown" in cost.class_factor:
        return doubts
    for readings in range(1, 1 << len(READABLE)):
        each = factors[[kind for n, kind in enumerate(READABLE) if readings >> n & 1]]
        passable = each[np.isfinite(each)]
        doubts[readings] = passable.max() if passable.size else LETHAL
    return doubts


def terrain_pace(
    grade_: Floats,
    classes: Bytes,
    cost: CostConfig,
    readings: Bytes | None = None,
) -> Floats:
    """Steps 1 and 2 of the merge rule. A NaN grade is a void; of unknown cells the readings count."""
    pace = slope_factor(grade_, cost)
    if cost.directional:
        pace[np.isfinite(pace)] = 1
    pace *= np.float32(1 / cost.flat_speed_m_per_s)
    if cost.classes:
        factors = np.take(class_factors(cost), classes)
        if readings is not None:
            doubtful = (classes == TerrainClass.UNKNOWN) & (readings > 0)
            factors[doubtful] = doubt_factors(cost)[readings[doubtful]]
        pace *= factors
    road = classes == TerrainClass.ROAD
    if road.any():
        np.copyto(pace, np.float32(1 / cost.road_speed_m_per_s), where=road & np.isfinite(pace))
    return np.clip(pace, np.float32(PACE_LEAST), np.float32(PACE_MOST), out=pace, where=np.isfinite(pace))


def polygon_mask(polygon_m: Sequence[tuple[float, float]], grid: GridSpec) -> Bools:
    """Cells whose middle lies in a polygon of [east, south] corners in metres (even-odd rule)."""
    inside = np.zeros((grid.rows, grid.cols), np.bool_)
    corners = [(x / grid.resolution_m, y / grid.resolution_m) for x, y in polygon_m]
    lowest = max(math.floor(min(y for _, y in corners)), 0)
    highest = min(math.ceil(max(y for _, y in corners)), grid.rows)
    for row in range(lowest, highest):
        middle = row + 0.5
        crossings = []
        for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], corners[0]], strict=True):
            if (y0 <= middle) != (y1 <= middle):
                crossings.append(x0 + (middle - y0) / (y1 - y0) * (x1 - x0))
        crossings.sort()
        for start, stop in zip(crossings[::2], crossings[1::2], strict=True):
            first, end = math.ceil(start - 0.5), math.ceil(stop - 0.5)
            inside[row, max(first, 0) : max(min(end, grid.cols), 0)] = True
    return inside


def inflation_halves(vehicle_radius_m: float, resolution_m: float) -> list[int]:
    """Per row distance 0, 1, 2, ...: how many cells to either side a lethal cell spreads.

    A vehicle in the middle of a cell touches a lethal cell if it reaches the nearest border of it. Empty if the
    vehicle fits into its own cell.
    """
    radius = vehicle_radius_m / resolution_m
    halves: list[int] = []
    while True:
        gap = max(len(halves) - 0.5, 0.0)
        if gap >= radius:
            break
        reach = math.sqrt(radius * radius - gap * gap)
        halves.append(max(math.ceil(reach + 0.5) - 1, 0))
    return halves if len(halves) > 1 else []


def spread(lethal: Bools, halves: Sequence[int]) -> Bools:
    """Every lethal cell widened by `halves` (see `inflation_halves`)."""
    if not halves or not lethal.any():
        return lethal.copy()
    rows, cols = lethal.shape
    wide = np.zeros_like(lethal)
    # Lethal cells west of each cell, and as far beyond both borders as anything spreads: slices, no look-ups.
    reach = max(halves)
    counts = np.zeros((rows, cols + 1 + 2 * reach), np.int32)
    np.cumsum(lethal, axis=1, out=counts[:, reach + 1 : reach + 1 + cols])
    counts[:, reach + 1 + cols :] = counts[:, reach + cols, None]
    for distance, half in enumerate(halves):
        if distance >= rows:
            break
        near = counts[:, reach + half + 1 :][:, :cols] > counts[:, reach - half :][:, :cols]
        if distance == 0:
            wide |= near
        else:
            wide[distance:] |= near[:-distance]
            wide[:-distance] |= near[distance:]
    return wide


def inflate(ground: Floats, halves: Sequence[int]) -> Floats:
    """Step 4 of the merge rule: the ground, lethal also where the vehicle would touch a lethal cell."""
    pace = ground.copy()
    if not halves:
        return pace
    rows, reach = ground.shape[0], len(halves) - 1

    def work(row0: int, row1: int) -> None:
        above, below = max(row0 - reach, 0), min(row1 + reach, rows)
        wide = spread(np.isinf(ground[above:below]), halves)
        pace[row0:row1][wide[row0 - above : row1 - above]] = LETHAL

    in_bands(rows, work)
    return pace


def nearest_open(is_open: Bools, row: int, col: int) -> tuple[int, int] | None:
    """Returns row and column of the open cell nearest to another; None if there is none."""
    rows, cols = np.nonzero(is_open)
    if not len(rows):
        return None
    best = int(((rows - row) ** 2 + (cols - col) ** 2).argmin())
    return int(rows[best]), int(cols[best])


def largest_part(passable: Bools) -> Bools:
    """The largest connected part of the cells that can be driven, bool (rows, cols); none if there are none.

    A diagonal step has passable cells beside it, so connected by eight-neighbour steps is exactly connected by
    four-neighbour steps.
    """
    # Imported here: it takes half a second, and no process of a run needs it where the terrain is prepared.
    from scipy import ndimage

    labels, count = ndimage.label(passable)
    if count == 0:
        return passable
    part: Bools = labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    return part
