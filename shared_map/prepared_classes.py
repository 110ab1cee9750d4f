"""The grounds of classes of vehicles, prepared once in a run's folder for all processes of a machine.

What all classes share (heights, photo, classes of ground) lies beside, with the terrain of the run.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats, save_array
from shared_map.class_grounds import ClassGround, class_grounds, give_known, least_pace
from shared_map.terrain.kept import fetch_kept, keep, kept_key
from shared_map.terrain.step_climb import ENTRIES, Climb
from shared_map.terrain.terrain import FORMAT, Terrain, read_array, scenario_key
from swarm.config.classes import class_named, driven_classes, of_class
from swarm.config.input_files import FileKind, read_text
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError
from swarm.runtime.role import RoleSetup

_META = "class.json"


def prepare_classes(run_dir: Path, scenario: Scenario, common: Terrain, truth: Floats) -> None:
    """Leave the ground of every class that vehicles belong to in a run's folder, as `prepare` does for the terrain;
    made-up ones are kept for later runs."""
    for name in driven_classes(scenario):
        folder, key = _folder(run_dir, name), _key(scenario, name)
        if _load(folder, key, scenario, common, name) is not None:
            continue
        kept = _kept_key(scenario, name)
        if kept is None or not fetch_kept(kept, folder):
            _save(folder, key, class_grounds(scenario, common, truth)[name])
            if kept is not None:
                keep(kept, [folder / _META, *folder.glob("*.npy")])
    _open(run_dir, scenario, common)


def load_classes(setup: RoleSetup, common: Terrain) -> None:
    """Let `class_grounds` and `class_terrains` take what is prepared in a run's folder, instead of making it."""
    if setup.run_dir is not None:
        _open(setup.run_dir, setup.scenario, common)


def _open(run_dir: Path, scenario: Scenario, common: Terrain) -> None:
    for name in driven_classes(scenario):
        ground = _load(_folder(run_dir, name), _key(scenario, name), scenario, common, name)
        if ground is not None:
            give_known(scenario, common, name, ground)


def _folder(run_dir: Path, name: str) -> Path:
    return run_dir / "classes" / name


def _key(scenario: Scenario, name: str) -> str:
    parts = [scenario_key(scenario), scenario_key(of_class(scenario, name)), class_named(scenario, name)]
    return hashlib.blake2b(msgspec.json.encode(parts, order="sorted"), digest_size=8).hexdigest()


def _kept_key(scenario: Scenario, name: str) -> str | None:
    common, own = kept_key(scenario), kept_key(of_class(scenario, name))
    if common is None or own is None:
        return None
    # What is kept of one name is not that of another, as it stands in the description.
    payload = msgspec.json.encode([common, own, _key(scenario, name)])
    return hashlib.blake2b(payload, digest_size=16).hexdigest()


def _save(folder: Path, key: str, ground: ClassGround) -> None:
    terrain = ground.terrain
    arrays: dict[str, NDArray[Any]] = {
        "pace": terrain.pace_s_per_m,
        "truth": ground.truth,
        "homes": ground.homes,
    }
    if terrain.ground_s_per_m is not terrain.pace_s_per_m:
        arrays["ground"] = terrain.ground_s_per_m
    if terrain.climb is not None:
        arrays["climb"] = terrain.climb.factors
    if terrain.flight_m is not None:
        arrays["flight"] = terrain.flight_m
    meta = {
        "format": FORMAT,
        "key": key,
        "digest": terrain.digest,
        "vehicle_radius_m": terrain.vehicle_radius_m,
        "steepest": None if terrain.climb is None else terrain.climb.steepest,
        "arrays": sorted(arrays),
        "notes": list(terrain.notes),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _META).unlink(missing_ok=True)
        for name, array in arrays.items():
            save_array(folder / f"{name}.npy", array)
        (folder / _META).write_text(json.dumps(meta, indent=1), encoding="utf-8")
    except OSError as error:
        raise TerrainError(f"cannot write the prepared class to {folder}: {error.strerror or error}") from error


def _load(folder: Path, key: str, scenario: Scenario, common: Terrain, name: str) -> ClassGround | None:
    """None if there is none, or one of another key. Raises TerrainError if it is damaged."""
    if not (folder / _META).exists():
        return None
    try:
        meta = json.loads(read_text(folder / _META, FileKind.PREPARED))
        if meta["format"] != FORMAT or meta["key"] != key:
            return None
        arrays, steepest, notes = meta["arrays"], meta["steepest"], tuple(map(str, meta["notes"]))
        digest, radius_m = str(meta["digest"]), float(meta["vehicle_radius_m"])
    except (TerrainError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise TerrainError(f"prepared class {folder / _META} is damaged ({error}); delete the folder") from error
    shape = (common.grid.rows, common.grid.cols)
    pace = read_array(folder, "pace", shape, np.float32)
    flight_m = read_array(folder, "flight", shape, np.float32) if "flight" in arrays else None
    climb = None
    if steepest is not None:
        factors = read_array(folder, "climb", (2 * ENTRIES + 1,), np.float32)
        heights_m = common.elevation_m if flight_m is None else flight_m
        climb = Climb(common.grid, heights_m, factors, float(steepest))
    terrain = replace(
        common,
        pace_s_per_m=pace,
        ground_s_per_m=read_array(folder, "ground", shape, np.float32) if "ground" in arrays else pace,
        digest=digest,
        vehicle_radius_m=radius_m,
        climb=climb,
        flight_m=flight_m,
        zones=common.zones if flight_m is None else (),
        notes=notes,
        least_s_per_m=least_pace(class_named(scenario, name)),
    )
    truth = read_array(folder, "truth", shape, np.float32)
    return ClassGround(terrain, truth, read_array(folder, "homes", shape, np.bool_))
