"""Shared data of the planners of one map on one machine, in files of the run's folder.

One process computes them; all memory-map the file. A file's name is the digest of all that it follows from, so that
it cannot be another map's.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.tree.cost_grid import CostGrid
from shared_map import array_files as arrays
from shared_map.array_files import Floats, open_array, private_copy, save_array, source_digest
from shared_map.terrain.terrain import Terrain
from swarm.config.scenario import PlannerConfig
from swarm.errors import StoreError
from swarm.recording.service_boundary import ExternalCalls

log = logging.getLogger(__name__)


PREPARED_COSTS = ExternalCalls("prepared costs", calls={}, fixed=("cell_cost",))
"""The part of it that a planner uses."""


_DIGEST_BYTES = 16
"""Same length as in names of cached terrains: no two arrays of one machine have the same by chance."""


class PreparedCosts:
    """Cell costs before any mark.

    cell_cost  float32, padded, s: what a `CostGrid` loads; mapped read-only
    """

    def __init__(self, folder: Path, terrain: Terrain, config: PlannerConfig) -> None:
        cost_grid = CostGrid(terrain.grid, config, terrain.climb)
        of_costs = f"{terrain.digest} {terrain.grid} {cost_grid.metres}"
        path = folder / f"cell-costs-{_digest(of_costs)}.npy"
        with _locked(folder / "cell-costs.lock"):
            found = _read(path, cost_grid.size)
            if found is None:
                cost_grid.load(private_copy(terrain.pace_s_per_m))  # kernels know arrays that may be written only
                _save(path, cost_grid.time_cost)
                found = open_array(path)[: cost_grid.size]
        self.cell_cost: Floats = found


def prepared_costs(folder: Path | None, terrain: Terrain, config: PlannerConfig) -> PreparedCosts | None:
    """None where there is no folder or it cannot be written: then a planner computes its own."""
    if folder is None:
        return None
    try:
        return PreparedCosts(folder, terrain, config)
    except (OSError, StoreError) as error:
        log.warning("cannot share cell costs in %s: %s", folder, error)
        return None


def _digest(text: str) -> str:
    here = Path(__file__).parent
    code = source_digest(here / "tree", here / "kernels", Path(arrays.__file__).parent)
    return hashlib.blake2b(f"{code} {text}".encode(), digest_size=8).hexdigest()


def _digest_of(array: NDArray[Any]) -> NDArray[Any]:
    """The digest of an array, as elements of its type."""
    return np.frombuffer(hashlib.blake2b(array.data, digest_size=_DIGEST_BYTES).digest(), array.dtype)


def _save(path: Path, array: NDArray[Any]) -> None:
    """Writes an array with its digest, where `_read` reads it."""
    save_array(path, np.concatenate((array, _digest_of(array))))


def _read(path: Path, size: int) -> Floats | None:
    """None if the file is missing; a damaged one counts as missing, and is logged: kernels check no index that they
    read from it."""
    try:
        whole = open_array(path)
        if whole.ndim != 1 or whole.dtype != np.float32:
            raise ValueError(f"it is {whole.shape} {whole.dtype}")
        digest_size = _DIGEST_BYTES // whole.itemsize
        found, digest = whole[:-digest_size], whole[-digest_size:]
        if found.size != size:
            raise ValueError(f"it has {found.size} values")
        if digest.tobytes() != _digest_of(found).tobytes():
            raise ValueError("its digest is another")
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        log.warning("%s is damaged (%s): computing it again", path, error)
        return None
    return found


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
