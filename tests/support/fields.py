"""Fields of paces for laws and benchmarks: synthetic ones, files, and costs of any ratio."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

from launch_scripts.simulation.world.walks import TrueTerrain
from swarm.errors import ConfigError, TerrainError
from swarm.grid import GridSpec

Pace = NDArray[np.float32]
FIELDS = ("terrain", "uniform", "maze")


def make_field(name: str, size: int, seed: int = 1) -> Pace:
    """A field by name, `size` cells a side, or the pace of a file as it is. Raises ConfigError on neither."""
    rng = np.random.default_rng(seed)
    if name == "terrain":
        return rough_terrain(size, rng)
    if name == "uniform":
        return (1.0 + 0.1 * rng.random((size, size))).astype(np.float32)
    if name == "maze":
        return maze(size, rng)
    if Path(name).is_file():
        return from_file(Path(name))
    raise ConfigError(f"field {name!r} is neither of {', '.join(FIELDS)} nor a file")


def rough_terrain(size: int, rng: np.random.Generator) -> Pace:
    """Hills at three scales, cheap roads across, walls and lakes that are lethal."""
    coarse = -(-size // 8) + 2
    relief = zoom(gaussian_filter(rng.standard_normal((coarse, coarse)), 4), 8, order=1)[:size, :size]
    relief = relief / relief.std() + 0.5 * gaussian_filter(rng.standard_normal((size, size)), 2) * 2
    pace: Pace = (0.1 + 0.12 * np.abs(relief) ** 1.5).astype(np.float32)
    walls = gaussian_filter(rng.standard_normal((size, size)), 6)
    pace[walls > 1.5 * walls.std()] = np.inf
    along = np.arange(size)
    for _ in range(max(2, size // 64)):
        across = np.clip(rng.integers(size) + np.cumsum(rng.integers(-1, 2, size)), 0, size - 1)
        where = (along, across) if rng.random() < 0.5 else (across, along)
        pace[where] = 0.05
    return pace


def maze(size: int, rng: np.random.Generator, corridor: int = 3) -> Pace:
    """Corridors between walls one cell thick, carved depth first; about one wall in ten has a second door."""
    pitch = corridor + 1
    many = max(1, (size - 1) // pitch)
    passable = np.zeros((size, size), bool)
    corners = np.arange(many) * pitch + 1
    for top in corners:
        for left in corners:
            passable[top : top + corridor, left : left + corridor] = True
    seen = np.zeros((many, many), bool)
    seen[0, 0] = True
    trail = [(0, 0)]

    def open_wall(row: int, col: int, dr: int, dc: int) -> None:
        r, c = row * pitch + 1, col * pitch + 1
        if dr:
            passable[r + (corridor if dr > 0 else -1), c : c + corridor] = True
        else:
            passable[r : r + corridor, c + (corridor if dc > 0 else -1)] = True

    while trail:
        row, col = trail[-1]
        ways = [
            (dr, dc)
            for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0))
            if 0 <= row + dr < many and 0 <= col + dc < many and not seen[row + dr, col + dc]
        ]
        if not ways:
            trail.pop()
            continue
        dr, dc = ways[int(rng.integers(len(ways)))]
        open_wall(row, col, dr, dc)
        seen[row + dr, col + dc] = True
        trail.append((row + dr, col + dc))
    for _ in range(many * many // 10):
        row, col = int(rng.integers(many)), int(rng.integers(many - 1)) if many > 1 else 0
        if col + 1 < many:
            open_wall(row, col, 0, 1)
    return np.where(passable, np.float32(1.0), np.float32(np.inf)).astype(np.float32)


def from_file(path: Path) -> Pace:
    """The pace of a file: .npy holds paces as they are (s/m, inf is lethal), a MovingAI .map costs 1 where it can
    be driven, and of everything else `swarm` makes what it would drive on. Raises TerrainError."""
    match path.suffix.lower():
        case ".npy":
            pace = _read_npy(path)
        case ".map":
            from shared_map.importers.grids_without_gdal import read_map

            pace = read_map(path).numbers
        case _:
            from shared_map.terrain.terrain import build_terrain
            from swarm.config.ground import TerrainConfig
            from swarm.config.scenario import Scenario

            pace = build_terrain(Scenario(terrain=TerrainConfig(source=str(path)))).pace_s_per_m
    return np.array(pace, np.float32, order="C")  # arrays of files may be read-only, which kernels refuse


def _read_npy(path: Path) -> NDArray[np.floating[Any]]:
    try:
        pace: NDArray[np.floating[Any]] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise TerrainError(f"field {path} is no .npy array: {error}") from error
    if pace.ndim != 2 or not pace.size or pace.dtype.kind not in "fiu":
        raise TerrainError(
            f"field {path} has shape {pace.shape} of {pace.dtype}; expected rows x cols of paces in s/m"
        )
    wrong = np.argwhere(~(pace > 0))
    if len(wrong):
        row, col = wrong[0]
        raise TerrainError(
            f"field {path}, row {row}, column {col}: a pace of {pace[row, col]}; expected more than 0, or inf"
        )
    return pace


class Field:
    """A pace and its largest connected area.

    pace    (rows, cols) float32, s/m, inf is lethal; cells are taken as a metre wide, which scales all costs alike
    terrain for walks; its `home` is the largest connected passable area, from which roots and vehicles are drawn

    Raises TerrainError if every cell is lethal.
    """

    def __init__(self, pace: Pace) -> None:
        self.pace = pace
        self.grid = GridSpec(pace.shape[0], pace.shape[1], 1.0)
        self.terrain = TrueTerrain(self.grid, pace)

    def draw(self, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Random cells of the largest area, without repetition where there are enough."""
        home = self.terrain.home
        return rng.choice(home, count, replace=count > len(home))


def paces_of_any_ratio(pace: Pace, rng: np.random.Generator) -> Iterator[tuple[str, Pace]]:
    """Fields as on real maps, and fields made against a queue of buckets. Lethal cells stay so."""
    rows, cols = pace.shape
    usual = np.float32(np.median(pace[np.isfinite(pace)]))
    middle = int(np.flatnonzero(np.isfinite(pace))[np.isfinite(pace).sum() // 3])
    for name, value in (("one dear cell, x 1e5", 1e5), ("one cheap cell, x 1e-5", 1e-5)):
        marked = pace.copy()
        marked.flat[middle] = usual * np.float32(value)
        yield name, marked
    marked = pace.copy()
    marked[rows // 2] = usual * np.float32(1e-3)
    yield "a road, x 1e-3", marked
    yield "one cell in 35, x 30,000", pace * np.where(rng.random(pace.shape) < 1 / 35, 30_000, 1).astype(np.float32)
    for value in (1e-3, 1e-5):
        yield (
            f"the left half, x {value:g}",
            pace * np.where(np.arange(cols) < cols // 2, value, 1).astype(np.float32),
        )
        yield (
            f"every other cell, x {value:g}",
            pace * np.where(rng.random(pace.shape) < 0.5, value, 1).astype(np.float32),
        )
    for ratio in (1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7):
        random = (ratio ** rng.random(pace.shape)).astype(np.float32)
        yield f"log-uniform, 1 to {ratio:g}", np.where(np.isfinite(pace), random, pace)
