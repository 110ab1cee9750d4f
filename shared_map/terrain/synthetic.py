"""Made-up landscapes: seeded noise, heights, rivers and roads, what covers the ground, and a photograph of it.

Only additions, products and square roots of seeded numbers, so that a seed gives the same landscape everywhere.
Rivers follow the valleys from border to border and cut them deeper. Roads lead between seeded places, where there
is no map of them. Both follow the cheapest ways over a grid of prices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.terrain.pace_layers import TerrainClass, grade, gradient_of_padded, largest_part
from shared_map.terrain.row_bands import Progress, in_bands, neighbours, no_progress, padded_rows
from swarm.errors import TerrainError
from swarm.grid import GridSpec


class Noise:
    """Seeded noise of a whole terrain, of which any part can be computed by itself: a sum of lattices at scales
    halved again and again."""

    def __init__(
        self,
        lattice: type[_ValueLattice | _GradientLattice],
        decay: float,
        rng: np.random.Generator,
        rows: int,
        cols: int,
        coarsest: float,
        ridged: bool = False,
    ) -> None:
        """Parameters
        ----------
        lattice : type
            Of each scale.
        decay : float
            Height of a scale as a share of the one before.
        rng, rows, cols, coarsest, ridged
            As in `mountain_noise`.
        """
        self._rows, self._cols, self._ridged = rows, cols, ridged
        self._octaves: list[tuple[float, _ValueLattice | _GradientLattice]] = []
        amplitude, scale, total = 1.0, float(coarsest), 0.0
        while scale >= 2.0 and amplitude > 0.01:
            self._octaves.append((amplitude, lattice(rng, rows, cols, scale)))
            total += amplitude
            amplitude *= decay
            scale /= 2.0
        self._total = max(total, 1.0)

    def part(self, row0: int, row1: int, col0: int, col1: int) -> Floats:
        """float32 (row1 - row0, col1 - col0): those cells of the whole, to the bit."""
        field = np.zeros((row1 - row0, col1 - col0), np.float32)
        for amplitude, lattice in self._octaves:
            octave = lattice.part(row0, row1, col0, col1)
            if self._ridged:
                np.abs(octave, out=octave)
                octave *= np.float32(-2)
                octave += np.float32(1)
            octave *= np.float32(amplitude)
            field += octave
        field /= np.float32(self._total)
        return field

    def band(self, row0: int, row1: int) -> Floats:
        return self.part(row0, row1, 0, self._cols)

    def whole(self) -> Floats:
        """float32 (rows, cols), band by band."""
        field = np.empty((self._rows, self._cols), np.float32)

        def work(row0: int, row1: int) -> None:
            field[row0:row1] = self.band(row0, row1)

        in_bands(self._rows, work)
        return field


def fractal_noise(rng: np.random.Generator, rows: int, cols: int, coarsest: float) -> Noise:
    """Smooth noise of many scales.

    Parameters
    ----------
    rng : numpy.random.Generator
        It is advanced.
    rows, cols : int
        Cells; at least 1 each.
    coarsest : float
        Cells across the broadest hills. Below 2 there is no noise: all is 0.

    Returns
    -------
    Noise, within -1..1
    """
    return Noise(_ValueLattice, 0.5, rng, rows, cols, coarsest)


def mountain_noise(rng: np.random.Generator, rows: int, cols: int, coarsest: float, ridged: bool = False) -> Noise:
    """Like `fractal_noise`, from gradient noise (Perlin 1985): rounder, without the grain of the lattice, twice the
    work.

    ridged  crests are sharp and valleys broad

    Values are roughly within -1..1.
    """
    return Noise(_GradientLattice, 0.45, rng, rows, cols, coarsest, ridged)


class _Lattice:
    """Random numbers at points that are `scale` cells apart, in `LAYERS` arrays; what lies between is blended."""

    LAYERS = 1

    def __init__(self, rng: np.random.Generator, rows: int, cols: int, scale: float) -> None:
        shape = int(rows / scale) + 3, int(cols / scale) + 3
        self._layers = [rng.uniform(-1.0, 1.0, shape).astype(np.float32) for _ in range(self.LAYERS)]
        self._scale, self._offset = scale, rng.uniform(0.0, 1.0, 2).tolist()

    def _along(self, begin: int, end: int, axis: int) -> tuple[NDArray[np.intp], Floats]:
        """Lattice point before each cell of a line, and how far along to the next the cell lies."""
        at = np.arange(begin, end) / self._scale + self._offset[axis]
        low = at.astype(np.intp)
        return low, (at - low).astype(np.float32)


class _ValueLattice(_Lattice):
    """Each lattice point has a value; between points the values are blended (smoothstep)."""

    def part(self, row0: int, row1: int, col0: int, col1: int) -> Floats:
        (values,), one = self._layers, np.float32(1)
        low, part = self._along(row0, row1, 0)
        part = part * part * (np.float32(3) - np.float32(2) * part)
        rows = values[low] * (one - part)[:, None] + values[low + 1] * part[:, None]
        low, part = self._along(col0, col1, 1)
        part = part * part * (np.float32(3) - np.float32(2) * part)
        field: Floats = rows.take(low, 1)
        field *= one - part
        far = rows.take(low + 1, 1)
        far *= part
        field += far
        return field


class _GradientLattice(_Lattice):
    """Each lattice point has a slope to the south and to the east; between points the four slopes are blended.
    Separable, hence two sums."""

    LAYERS = 2

    def part(self, row0: int, row1: int, col0: int, col1: int) -> Floats:
        (south, east), one = self._layers, np.float32(1)
        low_row, row_part = self._along(row0, row1, 0)
        low_col, col_part = self._along(col0, col1, 1)
        far_row, far_col = (
            (part * part * part * (part * (part * np.float32(6) - np.float32(15)) + np.float32(10))).astype(
                np.float32
            )
            for part in (row_part, col_part)
        )
        near_row, near_col = ((one - far).astype(np.float32) for far in (far_row, far_col))
        near, far = (near_row * row_part)[:, None], (far_row * (row_part - one))[:, None]
        rising = south[low_row] * near + south[low_row + 1] * far
        across = east[low_row] * near_row[:, None] + east[low_row + 1] * far_row[:, None]
        field: Floats = rising.take(low_col, 1)
        field *= near_col
        for lattice, columns, weights in (
            (rising, low_col + 1, far_col),
            (across, low_col, near_col * col_part),
            (across, low_col + 1, far_col * (col_part - one)),
        ):
            term = lattice.take(columns, 1)
            term *= weights
            field += term
        field *= np.float32(1.5)
        return field


FORD_EVERY, FORD_LENGTH = 64, 4
"""Cells along a river from one shallow place to the next, and how long it is: a river never cuts a map in two."""
_RIVER_CELLS, _ROAD_CELLS = 250_000, 1_000_000
"""Above this many cells rivers and roads are planned on every second, fourth, ... cell. One river takes 0.1 s of
CPU on 250,000 cells, and 0.7 s on a million, and a terrain may have fifty."""
_BANK_GRADE = 0.03
"""Rise of a bank beside the water, 1.7 degrees, and 3.4 over the first 12 cells: far below the slopes that are
lethal."""

Cell = tuple[int, int]
Course = tuple[NDArray[np.intp], NDArray[np.intp]]


class Ways:
    """The cheapest ways from one cell to all others (Dijkstra, 1959).

    A step to one of eight neighbours costs its length in cells times the mean of both prices; cells with an
    infinite price are not entered.
    """

    def __init__(self, price: NDArray[np.floating[Any]], start: Cell) -> None:
        """Parameters
        ----------
        price : (rows, cols), not negative
        start : (row, column)
        """
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra

        cells, price = np.arange(price.size, dtype=np.int32).reshape(price.shape), price.astype(np.float64)
        steps = []
        # East, south, and both diagonals to the south: each pair of neighbours once, walked both ways.
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here, there = neighbours(price.shape, down, right)
            cost = (price[here] + price[there]) * (0.5 * np.hypot(down, right))
            open_ = np.isfinite(cost)
            steps.append((cost[open_], cells[here][open_], cells[there][open_]))
        costs, tails, heads = (np.concatenate(each) for each in zip(*steps, strict=True))
        graph = csr_array((costs, (tails, heads)), shape=(price.size, price.size))
        from_cell = start[0] * price.shape[1] + start[1]
        cost, self._before = dijkstra(graph, directed=False, indices=from_cell, return_predecessors=True)
        self.cost: NDArray[np.float64] = cost.reshape(price.shape)
        """float64 (rows, cols); inf where no way leads"""

    def to(self, cell: Cell) -> Course:
        """Rows and columns of the cells from the start to a cell, which can be reached."""
        cols = self.cost.shape[1]
        way = [cell[0] * cols + cell[1]]
        while (before := int(self._before[way[-1]])) >= 0:
            way.append(before)
        row, col = np.divmod(np.array(way[::-1], np.intp), cols)
        return row, col


def _stride(cells: int, most: int) -> int:
    """Returns a power of two: every how many rows and columns a way is planned, to look at no more cells."""
    stride = 1
    while cells // stride**2 > most:
        stride *= 2
    return stride


# --- rivers ---------------------------------------------------------------------------------------------------


def carve(elevation_m: Floats, count: int, resolution_m: float, seed: int) -> tuple[Floats, Bools, Bools]:
    """Rivers, three cells wide, and the valleys that they cut.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        Without voids; it is not changed.
    count : int
        Rivers; every other one flows between the northern and southern border, the others between west and east.
    resolution_m : float
        Side of a cell.
    seed : int
        Not negative.

    Returns
    -------
    elevation_m : float32 (rows, cols), m
        Nowhere higher than before.
    water, fords : bool (rows, cols)
        Deep cells, and shallow ones every `FORD_EVERY` cells along a river. No cell is both.
    """
    rng = np.random.default_rng([seed, 6])
    courses = _courses(elevation_m, count, rng)
    water, fords = np.zeros(elevation_m.shape, np.bool_), np.zeros(elevation_m.shape, np.bool_)
    level = np.full(elevation_m.shape, np.inf, np.float32)
    for rows, cols in courses:
        heights = np.minimum.accumulate(elevation_m[rows, cols]) - np.float32(1.0)
        np.minimum.at(level, (rows, cols), heights)
        water[rows, cols] = True
        shallow = (np.arange(len(rows)) + int(rng.integers(FORD_EVERY))) % FORD_EVERY < FORD_LENGTH
        fords[rows[shallow], cols[shallow]] = True
    from scipy import ndimage

    water = ndimage.binary_dilation(water)
    fords = ndimage.binary_dilation(fords, iterations=2) & water
    return _cut(elevation_m, level, resolution_m), water & ~fords, fords


def _courses(elevation_m: Floats, count: int, rng: np.random.Generator) -> list[Course]:
    """Cells of each river from its spring down: the lowest way between two opposite borders, with bends."""
    stride = _stride(elevation_m.size, _RIVER_CELLS)
    coarse = elevation_m[::stride, ::stride]
    rows, cols = coarse.shape
    spread = max(float(coarse.max() - coarse.min()), 1e-3)
    bends = fractal_noise(rng, rows, cols, max(min(rows, cols) / 8, 4.0)).whole()
    price = ((coarse - coarse.min()) / spread * 6) ** 2 + 0.5 + (2.5 * (bends + 0.8)) ** 2
    courses = []
    for number in range(count):
        upright = number % 2 == 0
        # A penalty near the borders that it runs along: rivers would follow the border otherwise.
        off = np.linspace(-1.0, 1.0, cols)[None, :] if upright else np.linspace(-1.0, 1.0, rows)[:, None]
        begin = _lowest(coarse[0], rng) if upright else _lowest(coarse[:, 0], rng)
        ways = Ways(price + 12.0 * off**4, (0, begin) if upright else (begin, 0))
        far = ways.cost[-1] if upright else ways.cost[:, -1]
        end = int(np.argmin(far))
        at_row, at_col = ways.to((rows - 1, end) if upright else (end, cols - 1))
        price[at_row, at_col] *= 0.3
        course = _finer(at_row, at_col, stride, elevation_m.shape)
        if elevation_m[course[0][0], course[1][0]] < elevation_m[course[0][-1], course[1][-1]]:
            course = (course[0][::-1], course[1][::-1])
        courses.append(course)
    return courses


def _lowest(border: Floats, rng: np.random.Generator) -> int:
    """A low place in the middle three fifths of a border."""
    first, last = len(border) // 5, max(len(border) * 4 // 5, len(border) // 5 + 1)
    order = np.argsort(border[first:last], kind="stable")
    return first + int(order[int(rng.integers(max(len(order) // 6, 1)))])


def _finer(at_row: NDArray[Any], at_col: NDArray[Any], stride: int, shape: tuple[int, ...]) -> Course:
    """A coarse course as cells that touch each other: smoothed, so that it bends instead of turning corners, and
    drawn out to the very border."""
    half = 3
    weights = np.ones(2 * half + 1) / (2 * half + 1)
    places = []
    for at, size in ((at_row, shape[0]), (at_col, shape[1])):
        fine = np.concatenate([at * stride, [size - 1 if at[-1] >= (size - 1) // stride else at[-1] * stride]])
        smooth = np.convolve(np.pad(fine.astype(np.float64), half, mode="edge"), weights, mode="valid")
        smooth[0], smooth[-1] = fine[0], fine[-1]
        places.append(smooth)
    gaps = np.maximum(np.abs(np.diff(places[0])), np.abs(np.diff(places[1])))
    along = np.concatenate([[0.0], np.cumsum(gaps)])
    steps = np.arange(0.0, along[-1] + 0.5, 0.5)
    rows, cols = (np.rint(np.interp(steps, along, place)).astype(np.intp) for place in places)
    new = np.concatenate([[True], (np.diff(rows) != 0) | (np.diff(cols) != 0)])
    return rows[new], cols[new]


def _cut(elevation_m: Floats, level: Floats, resolution_m: float) -> Floats:
    """A valley: nowhere higher above the river than its banks rise, steeper the farther away."""
    from scipy import ndimage

    rows, cols = elevation_m.shape
    dry = np.isinf(level)
    lowered = elevation_m.copy()
    if dry.all():
        return lowered
    # A river cuts nothing that is farther away than this, so that parts of the terrain can be cut by themselves.
    most_m = float(elevation_m.max()) - float(level.min())
    reach = 1
    while reach < rows and _rise(np.float32(reach * resolution_m), resolution_m) <= most_m:
        reach *= 2

    def work(row0: int, row1: int) -> None:
        above, below = max(row0 - reach, 0), min(row1 + reach, rows)
        if dry[above:below].all():
            return
        nearest = ndimage.distance_transform_edt(dry[above:below], return_distances=False, return_indices=True)[
            :, row0 - above : row1 - above
        ]
        south = nearest[0] - np.arange(row0 - above, row1 - above, dtype=np.int32)[:, None]
        east = nearest[1] - np.arange(cols, dtype=np.int32)
        away = np.sqrt((south * south + east * east).astype(np.float64)).astype(np.float32)
        away *= np.float32(resolution_m)
        bank = level[above:below][tuple(nearest)] + _rise(away, resolution_m)
        np.minimum(elevation_m[row0:row1], bank, out=lowered[row0:row1])

    in_bands(rows, work, band_rows=max(2 * reach, -(-rows // 4)))
    return lowered


def _rise(away_m: Any, resolution_m: float) -> Any:
    """Returns the height of a bank above the river, m."""
    return away_m * np.float32(_BANK_GRADE) * (np.float32(1) + away_m / np.float32(12 * resolution_m))


# --- roads ----------------------------------------------------------------------------------------------------


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
    stride = _stride(grid.cells, _ROAD_CELLS)
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
    """Random places, from the seed, on low-cost ground of the largest connected part, apart from each other."""
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
        here, there = neighbours(laid.shape, dr, dc)
        at_row, at_col = np.nonzero(laid[here] & laid[there])
        at_col = at_col + max(-dc, 0)
        for step in range(stride + 1):
            road[at_row * stride + half + dr * step, at_col * stride + half + dc * step] = True
    return road & np.isfinite(pace)


TINT = np.array([kind.tint for kind in TerrainClass], np.uint8)


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
