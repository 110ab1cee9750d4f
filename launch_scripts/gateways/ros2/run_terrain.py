"""The prepared terrain of a run, where it is on this machine: what `swarm ros2` makes /map of."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from shared_map.terrain.prepared import load_prepared, read_meta
from shared_map.terrain.terrain import Terrain
from swarm.errors import SwarmError, TerrainError

_META = "terrain.json"
_NEWEST = 50
"""So many folders of runs are looked at."""


def find_terrain(digest: str, folder: Path | None, runs: Path) -> Terrain | None:
    """The terrain with this digest: in a folder, or in that of any run of this machine, for terrains of one digest
    are equal. None if none is here.

    folder  None: the newest folders in `runs` are looked at

    Raises TerrainError if the folder that was named has none, or another.
    """
    if folder is None:
        return next((found for each in _newest_first(runs) if (found := _of_digest(each, digest))), None)
    terrain = load_prepared(folder)
    if terrain is None:
        raise TerrainError(f"no prepared terrain in {folder}: expected the folder of a run, which holds {_META}")
    if terrain.digest != digest:
        raise TerrainError(f"{folder} holds terrain {terrain.digest}, and the run has {digest}")
    return terrain


def _of_digest(folder: Path, digest: str) -> Terrain | None:
    """The terrain of a folder if it has this digest, and is whole."""
    try:
        meta = read_meta(folder / _META, "")
        return load_prepared(folder) if meta is not None and meta.get("digest") == digest else None
    except SwarmError:
        return None  # another run's damage is no business of ours


def _newest_first(runs: Path) -> Iterator[Path]:
    try:
        folders = [each for each in runs.iterdir() if not each.is_symlink() and (each / _META).is_file()]
        folders.sort(key=lambda each: each.stat().st_mtime_ns, reverse=True)
    except OSError:
        return
    yield from folders[:_NEWEST]
