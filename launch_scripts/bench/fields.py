"""The paces that planners are measured on: synthetic fields, files, and walks of targets on them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

from swarm.errors import ConfigError

Pace = NDArray[np.float32]
FIELDS = ("terrain", "uniform", "maze")


def make_field(name: str, size: int, seed: int = 1) -> Pace:
    """A field by name, or the pace of an elevation or MovingAI file. Raises ConfigError on neither."""
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
    rooms = np.arange(many) * pitch + 1
    for top in rooms:
        for left in rooms:
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
    """The pace that `swarm` itself makes of a terrain file."""
    if path.suffix == ".map":
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = lines[lines.index("map") + 1 :]
        passable = np.array([[char in ".GS" for char in row] for row in rows if row])
        return np.where(passable, np.float32(1.0), np.float32(np.inf)).astype(np.float32)
    from shared_map.terrain import build_terrain
    from swarm.config import Scenario, TerrainConfig

    terrain = build_terrain(Scenario(terrain=TerrainConfig(source=str(path))))
    return np.ascontiguousarray(terrain.pace_s_per_m, np.float32)


def largest_area(pace: Pace) -> NDArray[np.int64]:
    """The cells of the largest connected passable area, from which roots and vehicles are drawn."""
    from scipy.ndimage import label

    areas, _ = label(np.isfinite(pace))
    sizes = np.bincount(areas.reshape(-1))
    sizes[0] = 0
    found: NDArray[np.int64] = np.flatnonzero(areas.reshape(-1) == sizes.argmax())
    return found


def random_walk(pace: Pace, start: int, rng: np.random.Generator) -> Iterator[int]:
    """One-cell moves of a target: it keeps its heading for a while and turns where it cannot go on."""
    rows, cols = pace.shape
    row, col = divmod(start, cols)
    dr, dc = 0, 1
    while True:
        for _ in range(32):
            if rng.random() < 0.1 or not (0 <= row + dr < rows and 0 <= col + dc < cols):
                dr, dc = int(rng.integers(-1, 2)), int(rng.integers(-1, 2))
            r, c = row + dr, col + dc
            inside = 0 <= r < rows and 0 <= c < cols
            if (dr or dc) and inside and np.isfinite([pace[r, c], pace[row, c], pace[r, col]]).all():
                row, col = r, c
                break
            dr, dc = int(rng.integers(-1, 2)), int(rng.integers(-1, 2))
        yield row * cols + col
