"""Terrains that are stored: prepared in a run's folder for every process of a machine, and kept from run to run.

The launcher builds a terrain once, and all processes map what it left. Built-in terrains are kept in the user's
cache folder beside: making one again gives the same bits, slowly. One is kept under the digest of all that it is
made from: the scenario's part in it, and the code. Its files are linked into a run's folder where the file system
allows, so that they lie on the disk once. Each process checks each file against its sum before it uses it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import time
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Floats, give_back_memory, open_array, save_array, source_digest
from shared_map.terrain.pace_layers import largest_part
from shared_map.terrain.row_bands import Progress, no_progress
from shared_map.terrain.slope_and_climb import ENTRIES, Climb, Wind
from shared_map.terrain.terrain import FORMAT, Terrain, build_terrain
from shared_map.terrain.true_ground import build_truth
from shared_map.terrain.zones import files_of_zone
from swarm.config.input_files import FileKind, read_text
from swarm.config.plugin_names import cost_layers_of
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import BUILT_IN_TERRAINS
from swarm.errors import StoreError, SwarmError, TerrainError
from swarm.files import write_file, writing
from swarm.grid import GridSpec
from swarm.plugins import source_of
from swarm.runtime.role_setup import RoleSetup

log = logging.getLogger(__name__)

MOST_BYTES = 2 << 30
"""Limit for all cached terrains together; the least recently used go first."""
_ABANDONED_S = 3600.0
"""A folder that is still being written is younger: to write `MOST_BYTES` takes minutes on a slow disk."""
_META = "terrain.json"
_NEWEST = 50
"""The folders of runs in which a prepared terrain is looked for."""


def scenario_key(scenario: Scenario) -> str:
    """Fingerprint of all that a terrain is built from: a prepared one with another key is another terrain."""
    parts = {"format": FORMAT, "seed": scenario.seed, "terrain": scenario.terrain, "cost": scenario.cost}
    named = scenario.terrain
    names = (named.source, named.photo, named.labels, named.cover, named.cover_codes)
    files = [Path(name) for name in names if name]
    files += [path for zone in (*scenario.cost.zones, *named.hidden.zones) for path in files_of_zone(zone)]
    stamps = [[path.stat().st_size, path.stat().st_mtime_ns] for path in files if os.path.isfile(path)]
    layers = [source_of(named, scenario.plugin_folder) for named in cost_layers_of(scenario)]
    payload = msgspec.json.encode([parts, stamps, layers], order="sorted")
    return hashlib.blake2b(payload, digest_size=8).hexdigest()


class Description(msgspec.Struct, frozen=True, kw_only=True):
    """Metadata beside the arrays of a prepared terrain, or of the ground of a class, in a JSON file.

    key       `scenario_key` of what they were made from
    steepest  of its climb; None where steps cost the same both ways
    arrays    name of each file beside it -> sum of its values
    sum       of all the rest, by which damage is noticed
    """

    format: int
    key: str
    digest: str
    grid: GridSpec
    vehicle_radius_m: float
    steepest: float | None
    wind: Wind | None
    arrays: dict[str, int]
    notes: tuple[str, ...]
    sum: int = 0

    def sealed(self) -> Description:
        """Returns the same with its sum."""
        rest = msgspec.structs.replace(self, sum=0)
        return msgspec.structs.replace(self, sum=zlib.crc32(msgspec.json.encode(rest)))


def save_prepared(folder: Path, terrain: Terrain, truth: Floats, key: str = "") -> None:
    """Writes a terrain and its truth where `load_prepared` finds them. The description is written last."""
    arrays: dict[str, NDArray[Any]] = {
        "elevation": terrain.elevation_m,
        "photo": terrain.photo,
        "classes": terrain.classes,
        "truth": truth,
        "homes": homes_of(terrain.pace_s_per_m, truth),
    }
    save_ground(folder / _META, terrain, arrays, key)


def save_ground(meta_file: Path, terrain: Terrain, arrays: Mapping[str, NDArray[Any]], key: str) -> None:
    """Leaves the ground of a terrain, and other arrays, in the folder of a description, which is written last.

    Raises TerrainError if the folder cannot be written.
    """
    every = {**arrays, "pace": terrain.pace_s_per_m}
    if terrain.ground_s_per_m is not terrain.pace_s_per_m:
        every["ground"] = terrain.ground_s_per_m
    climb = terrain.climb
    if climb is not None:
        every["climb"] = climb.factors
    meta = Description(
        format=FORMAT,
        key=key,
        digest=terrain.digest,
        grid=terrain.grid,
        vehicle_radius_m=terrain.vehicle_radius_m,
        steepest=None if climb is None else climb.steepest,
        wind=None if climb is None else climb.wind,
        arrays={name: _sum(array) for name, array in sorted(every.items())},
        notes=terrain.notes,
    )
    folder = meta_file.parent
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        meta_file.unlink(missing_ok=True)
    for name, array in every.items():
        save_array(folder / f"{name}.npy", array)  # a process that has the old one mapped keeps it
    write_file(meta_file, msgspec.json.format(msgspec.json.encode(meta.sealed()), indent=1))


def read_ground(meta_file: Path, meta: Description, heights_m: Floats) -> dict[str, Any]:
    """Returns the content of `save_ground`, as fields of a `Terrain`; arrays are mapped read-only.

    heights_m  by which steps climb

    Raises TerrainError if it is damaged.
    """
    folder, shape = meta_file.parent, meta.grid.shape
    pace = read_array(folder, "pace", meta, shape, np.float32)
    climb = None
    if meta.steepest is not None:
        factors = read_array(folder, "climb", meta, (2 * ENTRIES + 1,), np.float32)
        climb = Climb(meta.grid, heights_m, factors, meta.steepest, meta.wind)
    return {
        "pace_s_per_m": pace,
        "ground_s_per_m": (
            read_array(folder, "ground", meta, shape, np.float32) if "ground" in meta.arrays else pace
        ),
        "digest": meta.digest,
        "vehicle_radius_m": meta.vehicle_radius_m,
        "climb": climb,
        "notes": meta.notes,
    }


def load_prepared(folder: Path, key: str = "") -> Terrain | None:
    """The terrain that `save_prepared` left, mapped read-only; None if there is none, or one of another key.

    Raises TerrainError if it is damaged."""
    meta = read_meta(folder / _META, key)
    if meta is None:
        return None
    elevation_m = read_array(folder, "elevation", meta, meta.grid.shape, np.float32)
    return Terrain(
        grid=meta.grid,
        elevation_m=elevation_m,
        photo=read_array(folder, "photo", meta, (*meta.grid.shape, 3), np.uint8),
        classes=read_array(folder, "classes", meta, meta.grid.shape, np.uint8),
        **read_ground(folder / _META, meta, elevation_m),
    )


def find_prepared(digest: str, folder: Path | None, runs: Path) -> Terrain | None:
    """The terrain with this digest: in a folder, or in that of any run of this machine, for terrains of one digest
    are equal. None if none is here.

    folder  None: the newest folders in `runs` are looked at

    Raises TerrainError if the folder that was named has none, or another.
    """
    if folder is not None:
        terrain = load_prepared(folder)
        if terrain is None:
            raise TerrainError(
                f"no prepared terrain in {folder}: expected the folder of a run, which holds {_META}"
            )
        if terrain.digest != digest:
            raise TerrainError(f"{folder} holds terrain {terrain.digest}, and the run has {digest}")
        return terrain
    metas: list[Path] = []
    with suppress(OSError):
        metas = sorted(runs.glob(f"*/{_META}"), key=lambda each: each.stat().st_mtime_ns, reverse=True)
    for meta in metas[:_NEWEST]:
        with suppress(SwarmError):  # another run's damage is no business of ours
            known = read_meta(meta, "")
            if known is not None and known.digest == digest and (found := load_prepared(meta.parent)):
                return found
    return None


def load_beside(folder: Path | None, name: str, key: str = "") -> NDArray[Any] | None:
    """The "truth", or "homes" (`homes_of` terrain and truth), that `save_prepared` left beside a terrain, mapped
    read-only; None if it is not there, or there is no folder."""
    meta = None if folder is None else read_meta(folder / _META, key)
    if folder is None or meta is None or name not in meta.arrays:
        return None
    return read_array(folder, name, meta, meta.grid.shape, np.bool_ if name == "homes" else np.float32)


def read_meta(meta_file: Path, key: str) -> Description | None:
    """A description that `save_ground` left; None if there is none, or one of another key. Raises TerrainError if
    it is unreadable."""
    if not meta_file.exists():
        return None
    try:
        stated = msgspec.json.decode(read_text(meta_file, FileKind.PREPARED), type=dict[str, Any])
        # `FORMAT` does not tell builds which wrote no sum: it counts in the digest of a terrain, which neighbouring
        # builds in one run share.
        if stated.get("format") != FORMAT or stated.get("sum") is None or (key and stated.get("key") != key):
            return None
        meta = msgspec.convert(stated, Description)
        if meta != meta.sealed():
            raise TerrainError("its sum is that of another description")
        return meta
    except (TerrainError, msgspec.MsgspecError, RecursionError) as error:
        raise TerrainError(
            f"prepared {meta_file.stem} {meta_file} is damaged ({error}); delete the folder"
        ) from error


def read_array(folder: Path, name: str, meta: Description, shape: Iterable[int], dtype: type[Any]) -> NDArray[Any]:
    """An array of a prepared folder, mapped read-only. Raises TerrainError if it is not as described."""
    path = folder / f"{name}.npy"
    try:
        array = open_array(path)
    except (OSError, ValueError, EOFError, SyntaxError, RecursionError, MemoryError) as error:
        raise TerrainError(f"prepared terrain {path} is unreadable ({error}); delete the folder") from error
    if array.shape != tuple(shape) or array.dtype != dtype or _sum(array) != meta.arrays.get(name):
        raise TerrainError(f"prepared terrain {path} is damaged: expected the values described; delete the folder")
    return array


def _sum(array: NDArray[Any]) -> int:
    """The CRC-32 of an array's values: 0.3 s a GB, so each process can afford it."""
    return zlib.crc32(np.ascontiguousarray(array).data)


def load_terrain(setup: RoleSetup) -> Terrain:
    """The terrain of a run: prepared in its folder if it is there, else built."""
    if setup.run_dir is not None:
        terrain = load_prepared(setup.run_dir, scenario_key(setup.scenario))
        if terrain is not None:
            return terrain
    return build_terrain(setup.scenario)


def load_truth(setup: RoleSetup, terrain: Terrain) -> Floats:
    """The truth of a run, as `load_terrain`. The caller must not write to it."""
    found = load_beside(setup.run_dir, "truth", scenario_key(setup.scenario))
    return build_truth(setup.scenario, terrain) if found is None else found


def load_homes(setup: RoleSetup, terrain: Terrain, truth: Floats) -> Bools:
    """`homes_of` the terrain and truth of a run, as `load_terrain`. The caller must not write to it."""
    found = load_beside(setup.run_dir, "homes", scenario_key(setup.scenario))
    return homes_of(terrain.pace_s_per_m, truth) if found is None else found


def homes_of(prior: Floats, truth: Floats) -> Bools:
    """Returns the start cells of vehicles: the largest connected part that is passable by the map and by ground
    truth, bool (rows, cols).

    prior, truth  float32 (rows, cols), s/m; inf is lethal
    """
    return largest_part(np.isfinite(prior) & np.isfinite(truth))


def prepare(folder: Path, scenario: Scenario, progress: Progress = no_progress) -> tuple[Terrain, Floats]:
    """Builds terrain and truth of a scenario, unless they are kept from an earlier run, and leaves them in a folder
    for the other processes. The result is mapped, as theirs."""
    key, kept = scenario_key(scenario), kept_key(scenario)
    if kept is None or not fetch_kept(kept, folder):
        terrain = build_terrain(scenario, progress)
        save_prepared(folder, terrain, build_truth(scenario, terrain), key)
        del terrain
        give_back_memory()
        if kept is not None:
            keep(kept, [folder / _META, *folder.glob("*.npy")])
    mapped, truth = load_prepared(folder, key), load_beside(folder, "truth", key)
    if mapped is None or truth is None:
        raise TerrainError(f"the prepared terrain in {folder} has gone: it is another run's; start again")
    return mapped, truth


# --- kept from run to run -----------------------------------------------------------------------------------


def kept_root() -> Path:
    """Returns the folder of cached terrains."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "terrain-swarm" / "terrain"


def kept_key(scenario: Scenario) -> str | None:
    """Digest of all that a terrain and its truth follow from; None where files of the user's have a part in it."""
    terrain, cost = scenario.terrain, scenario.cost
    zones = (*cost.zones, *terrain.hidden.zones)
    files = terrain.photo or terrain.labels or terrain.cover or cost.layers or any(z.mask or z.file for z in zones)
    if terrain.source not in BUILT_IN_TERRAINS or files:
        return None
    here = Path(__file__).parent
    rooms = (here, here.parent / "importers")
    code = source_digest(here.parent, *sorted(each.parent for room in rooms for each in room.rglob("__init__.py")))
    # One of them brings the elevation of "jacksboro".
    libraries = " ".join(map(version, ("scipy", "matplotlib", "rasterio")))
    payload = msgspec.json.encode([code, libraries, scenario.seed, terrain, cost], order="sorted")
    return hashlib.blake2b(payload, digest_size=16).hexdigest()


def fetch_kept(key: str, into: Path) -> bool:
    """Puts the files of a kept terrain into a folder. False if there is none; a damaged one is dropped, and
    said."""
    folder = kept_root() / key
    if not folder.is_dir():
        return False
    try:
        into.mkdir(parents=True, exist_ok=True)
        for path in folder.iterdir():
            _link(path, into / path.name)
        if load_prepared(into) is None or any(load_beside(into, name) is None for name in ("truth", "homes")):
            raise TerrainError("a file is missing")
        os.utime(folder)
    except (OSError, TerrainError) as error:
        log.warning("the kept terrain %s is damaged (%s): rebuilding it", folder, error)
        shutil.rmtree(folder, ignore_errors=True)
        return False
    return True


def keep(key: str, files: Iterable[Path]) -> None:
    """Keeps these files of a terrain. If that is not possible, no terrain is cached, without an error."""
    files = list(files)
    root = kept_root()
    partial = root / f"{key}.{os.getpid()}.part"
    try:
        if sum(path.stat().st_size for path in files) > MOST_BYTES:
            return
        partial.mkdir(parents=True)
        for path in files:
            _link(path, partial / path.name)
        partial.rename(root / key)
        _evict(root)
    except (OSError, StoreError) as error:
        log.info("the terrain is not kept in %s: %s", root, error)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _evict(root: Path) -> None:
    """Drops the least recently used terrains, down to `MOST_BYTES`, and partial files of killed processes."""
    left = MOST_BYTES
    for folder in sorted(root.iterdir(), key=lambda each: each.stat().st_mtime, reverse=True):
        left -= sum(path.stat().st_size for path in folder.iterdir())
        abandoned = folder.suffix == ".part" and time.time() - folder.stat().st_mtime > _ABANDONED_S
        if left < 0 or abandoned:
            shutil.rmtree(folder, ignore_errors=True)


def _link(source: Path, to: Path) -> None:
    to.unlink(missing_ok=True)
    try:
        os.link(source, to)
    except OSError:  # another file system
        shutil.copyfile(source, to)
