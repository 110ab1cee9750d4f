"""The ground of a run in a file of its folder: how fast it can be driven, as the map knew it at the beginning."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.array_archive import arrays_in, packed
from shared_map.terrain.pyramid import Level
from shared_map.terrain.terrain import Terrain
from swarm.config.input_files import FileKind, read_bytes
from swarm.grid import GridSpec

GROUND_PACE_FILE = "ground.npz"


@dataclass(frozen=True, eq=False)
class GroundPace:
    """The ground in blocks of `side` x `side` cells, the last ones cut off by the border.

    pace_s_per_m  float16 (rows, cols)  mean of what can be driven in a block; inf where nothing can
    best_s_per_m  pace of the quickest cell
    """

    side: int
    pace_s_per_m: NDArray[np.float16]
    best_s_per_m: float


def packed_ground(terrain: Terrain, seen: Level) -> bytes:
    """The content of the file; of a large terrain, a level of it."""
    return packed(
        {
            "side": np.array(seen.side, np.int64),
            "pace_s_per_m": seen.pace_s_per_m.astype(np.float16),
            "best_s_per_m": np.array(terrain.pace_s_per_m.min(), np.float64),
        }
    )


def read_ground(folder: Path, grid: GridSpec) -> GroundPace | None:
    """The ground that a run left; None if it left none, as older builds. Raises StoreError if it is damaged."""
    path = folder / GROUND_PACE_FILE
    if not path.exists():
        return None
    with arrays_in(read_bytes(path, FileKind.RUN), path) as arrays:
        side, best_s_per_m = int(arrays["side"]), float(arrays["best_s_per_m"])
        pace = arrays["pace_s_per_m"].astype(np.float16)
        if side < 1 or pace.shape != (-(-grid.rows // side), -(-grid.cols // side)):
            raise ValueError(
                f"{pace.shape} blocks of {side} cells are not those of {grid.rows} x {grid.cols} cells"
            )
        if not 0 < best_s_per_m < np.inf or not (pace > 0).all():
            raise ValueError("a pace is no time per metre")
    return GroundPace(side, pace, best_s_per_m)
