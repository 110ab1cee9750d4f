"""The grounds of classes of vehicles, prepared once in a run's folder for all processes of a machine.

What all classes share (heights, photo, classes of ground) lies beside, with the terrain of the run.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.class_grounds import ClassGround, class_grounds, give_known, least_pace
from shared_map.terrain.store import (
    fetch_kept,
    keep,
    kept_key,
    read_array,
    read_ground,
    read_meta,
    save_ground,
    scenario_key,
)
from shared_map.terrain.terrain import Terrain
from swarm.config.classes import class_named, driven_classes, flies, of_class
from swarm.config.scenario import Scenario
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
    parts = [
        scenario_key(scenario),
        scenario_key(of_class(scenario, name)),
        class_named(scenario, name),
        scenario.wind,
    ]
    return hashlib.blake2b(msgspec.json.encode(parts, order="sorted"), digest_size=8).hexdigest()


def _kept_key(scenario: Scenario, name: str) -> str | None:
    common, own = kept_key(scenario), kept_key(of_class(scenario, name))
    if common is None or own is None:
        return None
    # What is kept of one name is not that of another, as it stands in the description.
    payload = msgspec.json.encode([common, own, _key(scenario, name)])
    return hashlib.blake2b(payload, digest_size=16).hexdigest()


def _save(folder: Path, key: str, ground: ClassGround) -> None:
    arrays: dict[str, NDArray[Any]] = {"truth": ground.truth, "homes": ground.homes}
    if ground.terrain.flight_m is not None:
        arrays["flight"] = ground.terrain.flight_m
    save_ground(folder / _META, ground.terrain, arrays, {"key": key})


def _load(folder: Path, key: str, scenario: Scenario, common: Terrain, name: str) -> ClassGround | None:
    """None if there is none, or one of another key. Raises TerrainError if it is damaged."""
    meta_file, grid = folder / _META, common.grid
    meta = read_meta(meta_file, key)
    if meta is None:
        return None
    shape = (grid.rows, grid.cols)
    flight_m = read_array(folder, "flight", shape, np.float32) if flies(scenario, name) else None
    terrain = replace(
        common,
        **read_ground(meta_file, meta, grid, common.elevation_m if flight_m is None else flight_m),
        flight_m=flight_m,
        zones=common.zones if flight_m is None else (),
        least_s_per_m=least_pace(class_named(scenario, name)),
    )
    truth = read_array(folder, "truth", shape, np.float32)
    return ClassGround(terrain, truth, read_array(folder, "homes", shape, np.bool_))
