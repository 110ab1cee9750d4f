"""The ground of each class of vehicles: the terrain by its own rule of cost, what that is in truth, and where its
vehicles may start."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Floats
from shared_map.terrain.air import air_terrain
from shared_map.terrain.store import (
    homes_of,
    read_array,
    read_ground,
    read_meta,
    save_ground,
    scenario_key,
)
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.vehicle_class_maps import read_by
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND, ClassConfig, class_named, driven_classes, flies, of_class
from swarm.errors import TerrainError
from swarm.runtime.role import RoleSetup
from swarm.wire.messages.map_data import PACE_LEAST


@dataclass(frozen=True, eq=False)
class ClassGround:
    """The ground as vehicles of one class find it.

    truth  float32 (rows, cols), s/m: the pace at which they really drive, without inflation; inf is lethal
    homes  bool (rows, cols): where they may start (`homes_of`)
    """

    terrain: Terrain
    truth: Floats
    homes: Bools


_MADE: WeakKeyDictionary[Terrain, dict[bytes, Terrain]] = WeakKeyDictionary()
"""Grounds made beside a terrain, so that the processes of a simulation make them once."""
_KNOWN: WeakKeyDictionary[Terrain, dict[bytes, ClassGround]] = WeakKeyDictionary()
"""Grounds prepared beside a terrain, with its ground truth."""


def class_terrains(scenario: Scenario, common: Terrain, names: Iterable[str] | None = None) -> dict[str, Terrain]:
    """Class -> the terrain by its own rule, of these classes; of all beside "ground" if none are named. Raises
    TerrainError in one sentence.

    common  the terrain of the run, for the class "ground"
    """
    wanted = [each.name for each in scenario.classes] if names is None else list(names)
    return {name: _terrain(scenario, common, name) for name in wanted}


def class_truths(scenario: Scenario, common: Terrain, truth: Floats) -> dict[str, Floats]:
    """Class -> the truth for it, of "ground" and of every class that vehicles of the scenario belong to."""
    others = {name: _truth(scenario, common, truth, name) for name in driven_classes(scenario)}
    return {GROUND: truth, **others}


def class_grounds(
    scenario: Scenario, common: Terrain, truth: Floats, homes: Bools | None = None
) -> dict[str, ClassGround]:
    """Class -> its ground, of "ground" and of every class that vehicles of the scenario belong to.

    common, truth, homes  those of "ground"; `homes_of` the other two, if that is known
    """
    known = homes_of(common.pace_s_per_m, truth) if homes is None else homes
    grounds = {GROUND: ClassGround(common, truth, known)}
    for name in driven_classes(scenario):
        prepared = _KNOWN.get(common, {}).get(_key(scenario, name))
        grounds[name] = prepared or _ground(scenario, common, truth, name)
    return grounds


def least_pace(own: ClassConfig | None) -> float:
    """The pace below which no vehicle of a class comes, s/m."""
    if own is not None and own.air is not None:
        return 1 / own.air.speed_m_per_s
    return PACE_LEAST if own is None or own.max_speed_m_per_s is None else 1 / own.max_speed_m_per_s


def _ground(scenario: Scenario, common: Terrain, truth: Floats, name: str) -> ClassGround:
    own, own_truth = _terrain(scenario, common, name), _truth(scenario, common, truth, name)
    homes = homes_of(own.pace_s_per_m, own_truth)
    if not homes.any():
        raise TerrainError(f"class {name}: no cell that it can drive by the map is so in truth")
    return ClassGround(own, own_truth, homes)


def _truth(scenario: Scenario, common: Terrain, truth: Floats, name: str) -> Floats:
    prepared = _KNOWN.get(common, {}).get(_key(scenario, name))
    if prepared is not None:
        return prepared.truth
    own = _terrain(scenario, common, name)
    if own.flight_m is not None:  # nothing is hidden in the air
        return own.ground_s_per_m
    own_prior, prior = own.ground_s_per_m.reshape(-1), common.ground_s_per_m.reshape(-1)
    read: Floats = read_by(own_prior, prior, truth.reshape(-1), own.least_s_per_m).reshape(truth.shape)
    return read


def _terrain(scenario: Scenario, common: Terrain, name: str) -> Terrain:
    own = class_named(scenario, name)
    if own is None:
        return common
    made, key = _MADE.setdefault(common, {}), _key(scenario, name)
    if key not in made and own.air is not None:
        made[key] = air_terrain(common, own.air, scenario.wind, f"class {name}")
    elif key not in made:
        try:
            terrain = build_terrain(scenario, vehicle_class=name)
        except TerrainError as error:
            raise TerrainError(f"class {name}: {error}") from error
        if terrain.grid != common.grid:
            raise TerrainError(f"class {name}: its terrain is {terrain.grid}, that of the run {common.grid}")
        # The same ground is looked at: what a class has of its own is what it costs.
        made[key] = replace(
            terrain,
            elevation_m=common.elevation_m,
            photo=common.photo,
            classes=common.classes,
            least_s_per_m=least_pace(own),
        )
    return made[key]


def _key(scenario: Scenario, name: str) -> bytes:
    parts = [scenario.seed, scenario.terrain, scenario.cost, scenario.wind, class_named(scenario, name)]
    return msgspec.json.encode(parts)


# --- prepared once in a run's folder for all processes of a machine -------------------------------------------

_META = "class.json"
"""Describes the arrays beside it. Arrays that all classes share (heights, photo, terrain classes) are stored with
the terrain of the run."""


def prepare_classes(run_dir: Path, scenario: Scenario, common: Terrain, truth: Floats) -> None:
    """Leaves the ground of every class that vehicles belong to in a run's folder, as `prepare` does for the
    terrain."""
    for name in driven_classes(scenario):
        ground = _ground(scenario, common, truth, name)
        _save(_folder(run_dir, name), _prepared_key(scenario, name), ground)
    _open(run_dir, scenario, common)


def load_classes(setup: RoleSetup, common: Terrain) -> None:
    """Makes `class_grounds` and `class_terrains` take prepared files in a run's folder, instead of making them."""
    if setup.run_dir is not None:
        _open(setup.run_dir, setup.scenario, common)


def _open(run_dir: Path, scenario: Scenario, common: Terrain) -> None:
    for name in driven_classes(scenario):
        ground = _load(_folder(run_dir, name), _prepared_key(scenario, name), scenario, common, name)
        if ground is not None:
            key = _key(scenario, name)
            _KNOWN.setdefault(common, {})[key] = ground
            _MADE.setdefault(common, {})[key] = ground.terrain


def _folder(run_dir: Path, name: str) -> Path:
    return run_dir / "classes" / name


def _prepared_key(scenario: Scenario, name: str) -> str:
    parts = [
        scenario_key(scenario),
        scenario_key(of_class(scenario, name)),
        class_named(scenario, name),
        scenario.wind,
    ]
    return hashlib.blake2b(msgspec.json.encode(parts, order="sorted"), digest_size=8).hexdigest()


def _save(folder: Path, key: str, ground: ClassGround) -> None:
    arrays: dict[str, NDArray[Any]] = {"truth": ground.truth, "homes": ground.homes}
    if ground.terrain.flight_m is not None:
        arrays["flight"] = ground.terrain.flight_m
    save_ground(folder / _META, ground.terrain, arrays, key)


def _load(folder: Path, key: str, scenario: Scenario, common: Terrain, name: str) -> ClassGround | None:
    """None if there is none, or one of another key. Raises TerrainError if it is damaged."""
    meta = read_meta(folder / _META, key)
    if meta is None:
        return None
    shape = common.grid.shape
    flight_m = read_array(folder, "flight", shape, np.float32) if flies(scenario, name) else None
    terrain = replace(
        common,
        **read_ground(folder / _META, meta, common.elevation_m if flight_m is None else flight_m),
        flight_m=flight_m,
        zones=common.zones if flight_m is None else (),
        least_s_per_m=least_pace(class_named(scenario, name)),
    )
    truth = read_array(folder, "truth", shape, np.float32)
    return ClassGround(terrain, truth, read_array(folder, "homes", shape, np.bool_))
