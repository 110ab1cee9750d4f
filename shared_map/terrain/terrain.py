"""A terrain: elevation, photo, classes and prior pace on one metric grid; built once, prepared in a run's folder.

Agents import this, so nothing slow is imported at the top: what only building needs is imported where it is used.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Bytes, Floats, give_back_memory, open_array, save_array
from shared_map.terrain.cost_layers import apply_cost_layers, cost_world
from shared_map.terrain.hidden import true_ground
from shared_map.terrain.homes import homes_of
from shared_map.terrain.kept import fetch_kept, keep, kept_key
from shared_map.terrain.layers import (
    TerrainClass,
    along_slope_of_padded,
    class_factors,
    grade_of_padded,
    inflate,
    inflation_halves,
    roughness_of_padded,
    slope_deg,
    terrain_pace,
)
from shared_map.terrain.row_bands import Progress, in_bands, no_progress, padded_rows
from shared_map.terrain.slope_rules import said_of_cost
from shared_map.terrain.step_climb import ENTRIES, Climb, climb_of
from shared_map.terrain.zones import ZoneFacts, files_of_zone, paint_zones
from swarm.config.classes import GROUND, of_class
from swarm.config.ground import CostConfig
from swarm.config.input_files import FileKind, read_text
from swarm.config.plugin_names import cost_layers_of
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError
from swarm.grid import GridSpec
from swarm.plugins.find import source_of
from swarm.runtime.role import RoleSetup
from swarm.wire.statements import PACE_LEAST, PACE_MOST

if TYPE_CHECKING:
    from shared_map.terrain.importers.sources import Source

FORMAT = 4
"""Raised when what lies in a prepared folder, or how terrain is built, changes."""
_META = "terrain.json"
_ALL_LETHAL = "every cell of the terrain is lethal, no vehicle could stand anywhere:"


@dataclass(frozen=True, eq=False)
class Terrain:
    """The map before any vehicle has driven. Arrays are (rows, cols) and must not be written to.

    elevation_m       float32  NaN where there is a void
    photo             uint8    (rows, cols, 3)
    pace_s_per_m      float32  the prior: the ground with inflation; inf is lethal
    ground_s_per_m    float32  the ground itself, as a sensor sees it; the same array if the vehicle fits its cell
    classes           uint8    TerrainClass
    digest            16 hex digits of grid, prior pace and cost rules (and heights, where steps cost by them)
    climb             what a step costs for what it climbs; None if it costs the same both ways
    least_s_per_m     no vehicle is quicker, whatever is marked or learned
    flight_m          float32  of what flies, the height of the surface on which it does; None of what drives
    notes             sentences about where it came from and what was done to it
    zones             what each zone did to it; empty of a prepared one
    """

    grid: GridSpec
    elevation_m: Floats
    photo: Bytes
    pace_s_per_m: Floats
    classes: Bytes
    digest: str
    ground_s_per_m: Floats
    vehicle_radius_m: float = 0.0
    climb: Climb | None = None
    least_s_per_m: float = PACE_LEAST
    flight_m: Floats | None = None
    notes: tuple[str, ...] = field(default=())
    zones: tuple[ZoneFacts, ...] = field(default=())

    @property
    def lethal(self) -> NDArray[np.bool_]:
        return np.isinf(self.pace_s_per_m)


def build_terrain(scenario: Scenario, progress: Progress = no_progress, vehicle_class: str = GROUND) -> Terrain:
    """The terrain of a scenario, for one of its classes of vehicles. Raises TerrainError with one sentence."""
    from shared_map.terrain.importers.sources import load_source

    source = load_source(scenario.terrain, scenario.seed, progress)
    try:
        return _built(of_class(scenario, vehicle_class), source, progress, scenario.cost)
    except MemoryError as error:
        raise TerrainError(
            f"terrain {scenario.terrain.source} does not fit into memory; set a larger terrain.resolution_m"
        ) from error


def _built(scenario: Scenario, source: Source, progress: Progress, common: CostConfig) -> Terrain:
    """common  the cost by which roads are laid: they are the same for every class"""
    grid, classes, cost = source.grid, source.classes, scenario.cost
    notes = list(source.notes)
    ground = _ground(source, classes, cost, progress)
    if scenario.terrain.roads:
        open_ground = ground if cost is common else _ground(source, classes, common, progress)
        _check_passable(open_ground, source.elevation_m, classes, common, grid)
        from shared_map.terrain.synthetic.roads import lay_roads

        laid = lay_roads(open_ground, scenario.terrain.roads, grid, scenario.seed)
        classes = np.where(laid, np.uint8(TerrainClass.ROAD), classes)
        ground[laid] = np.float32(1 / cost.road_speed_m_per_s)
        notes.append(f"{scenario.terrain.roads} roads laid between seeded places, {int(laid.sum())} cells")
    if cost.layers:
        world = cost_world(grid, source.elevation_m, classes, source.photo, scenario.seed)
        ground = apply_cost_layers(scenario, ground, world)
        notes.append(f"cost layers: {', '.join(each.layer for each in cost.layers)}")
    zones: list[ZoneFacts] = []
    if cost.zones:
        if any(zone.file for zone in cost.zones):
            classes = classes.copy()
        zones = paint_zones(ground, cost.zones, grid, cost, np.isnan(source.elevation_m), classes)
        notes.extend(each.told(grid.cells) for each in zones if each.file is not None)
    if cost.directional and cost.cross_slope_factor > 1:
        _add_cross_slopes(ground, source.elevation_m, cost, grid, progress)
    notes.append(said_of_cost(cost))
    photo = source.photo
    if photo is None:
        from shared_map.terrain.synthetic.landscape import paint_photo

        photo = paint_photo(source.elevation_m, classes, grid.resolution_m, scenario.seed, progress)
        notes.append("photo painted from elevation and classes, as there is none")
    terrain = finished(grid, source.elevation_m, photo, classes, ground, cost, tuple(notes))
    return replace(terrain, zones=tuple(zones))


def _ground(source: Source, classes: Bytes, cost: CostConfig, progress: Progress) -> Floats:
    """Steps 1 and 2 of the merge rule, band by band."""
    ground = np.empty(source.elevation_m.shape, np.float32)

    def work(row0: int, row1: int) -> None:
        padded_m, resolution_m = padded_rows(source.elevation_m, row0, row1), source.grid.resolution_m
        steepness = grade_of_padded(padded_m, resolution_m)
        np.copyto(steepness, np.float32(np.nan), where=np.isnan(source.elevation_m[row0:row1]))
        rough_m = roughness_of_padded(padded_m, resolution_m) if cost.rough_per_m else None
        readings = None if source.readings is None else source.readings[row0:row1]
        pace = terrain_pace(steepness, classes[row0:row1], cost, rough_m, readings)
        if source.factor is not None:
            pace *= source.factor[row0:row1]
        ground[row0:row1] = pace

    in_bands(source.grid.rows, work, "slope and cost", progress)
    return ground


def _add_cross_slopes(
    ground: Floats, elevation_m: Floats, cost: CostConfig, grid: GridSpec, progress: Progress
) -> None:
    def work(row0: int, row1: int) -> None:
        padded_m, part = padded_rows(elevation_m, row0, row1), ground[row0:row1]
        dearer = part * along_slope_of_padded(padded_m, grid.resolution_m, cost)
        np.minimum(dearer, np.float32(PACE_MOST), out=part, where=np.isfinite(part))

    in_bands(grid.rows, work, "slope and cost", progress)


def finished(
    grid: GridSpec,
    elevation_m: Floats,
    photo: Bytes,
    classes: Bytes,
    ground: Floats,
    cost: CostConfig,
    notes: tuple[str, ...],
) -> Terrain:
    """A terrain of its ground: inflated, with its digest. Raises TerrainError where every cell is lethal."""
    _check_passable(ground, elevation_m, classes, cost, grid)
    # However wide a vehicle is said to be, wider than the terrain is the same.
    radius_m = min(cost.vehicle_radius_m, 2 * max(grid.rows, grid.cols) * grid.resolution_m)
    halves = inflation_halves(radius_m, grid.resolution_m)
    pace = inflate(ground, halves) if halves else ground
    if np.isinf(pace).all():
        raise TerrainError(
            f"{_ALL_LETHAL} cost.vehicle_radius_m = {cost.vehicle_radius_m:g} is too wide for every gap in it"
        )
    climb = climb_of(grid, elevation_m, cost)
    if climb is not None:
        notes = (*notes, climb.note)
    digest = _digest(grid, pace, cost, elevation_m if cost.directional else None)
    return Terrain(
        grid=grid,
        elevation_m=elevation_m,
        photo=photo,
        pace_s_per_m=pace,
        classes=classes,
        digest=digest,
        ground_s_per_m=ground,
        vehicle_radius_m=radius_m,
        climb=climb,
        notes=notes,
    )


def _check_passable(pace: Floats, elevation_m: Floats, classes: Bytes, cost: CostConfig, grid: GridSpec) -> None:
    """Raises TerrainError that says why, if a vehicle could stand nowhere."""
    if not np.isinf(pace).all():
        return
    slopes = slope_deg(elevation_m, grid.resolution_m)
    shares = {
        "void": np.isnan(elevation_m).mean(),
        f"steeper than cost.max_slope_deg = {cost.max_slope_deg:g}": (slopes > cost.max_slope_deg).mean(),
        "of a lethal class": np.isinf(class_factors(cost)[classes]).mean() if cost.classes else 0.0,
    }
    said = ", ".join(f"{share:.0%} is {what}" for what, share in shares.items() if share > 0)
    raise TerrainError(
        f"{_ALL_LETHAL} {said or 'the file itself or a forbidden zone says so of each'};"
        " check the units of the heights, the classes and the zones"
    )


def _digest(grid: GridSpec, pace: Floats, cost: CostConfig, elevation_m: Floats | None) -> str:
    digest = hashlib.blake2b(digest_size=8)
    digest.update(f"{FORMAT} {grid}".encode())
    digest.update(np.ascontiguousarray(pace).data)
    if elevation_m is not None:
        digest.update(np.ascontiguousarray(elevation_m).data)
    # Where a file lies differs between machines; what it painted is in the pace.
    zones = tuple(
        msgspec.structs.replace(z, mask=z.mask and Path(z.mask).name, file=z.file and Path(z.file).name)
        for z in cost.zones
    )
    digest.update(msgspec.json.encode(msgspec.structs.replace(cost, zones=zones), order="sorted"))
    return digest.hexdigest()


def terrain_of_pace(
    pace_s_per_m: Floats,
    resolution_m: float = 10.0,
    elevation_m: Floats | None = None,
    vehicle_radius_m: float = 0.0,
) -> Terrain:
    """A level terrain of given pace, for tests, benchmarks and maps that are no landscape."""
    ground = np.array(pace_s_per_m, np.float32)
    rows, cols = int(ground.shape[0]), int(ground.shape[1])
    grid = GridSpec(rows, cols, resolution_m)
    height = np.zeros((rows, cols), np.float32) if elevation_m is None else np.array(elevation_m, np.float32)
    cost = CostConfig(vehicle_radius_m=vehicle_radius_m)
    photo = np.full((rows, cols, 3), 128, np.uint8)
    return finished(grid, height, photo, np.zeros((rows, cols), np.uint8), ground, cost, ())


def build_truth(scenario: Scenario, terrain: Terrain) -> Floats:
    """The true pace of the ground: the prior ground changed by what `terrain.hidden` asks for.

    Without inflation: it is what a sensor sees of each cell. Never shown to planners."""
    return true_ground(
        scenario.terrain.hidden,
        scenario.cost,
        terrain.grid,
        terrain.ground_s_per_m,
        terrain.elevation_m,
        terrain.classes,
        scenario.seed,
    )


# --- prepared: built once by the launcher, read by every process in a blink -----------------------------------


def scenario_key(scenario: Scenario) -> str:
    """Fingerprint of all that a terrain is built from: a prepared one with another key is another terrain."""
    parts = {"format": FORMAT, "seed": scenario.seed, "terrain": scenario.terrain, "cost": scenario.cost}
    named = scenario.terrain
    names = (named.source, named.photo, named.labels, named.cover, named.cover_codes)
    files = [Path(name) for name in names if name]
    files += [path for zone in (*scenario.cost.zones, *named.hidden.zones) for path in files_of_zone(zone)]
    stamps = [[path.stat().st_size, path.stat().st_mtime_ns] for path in files if path.is_file()]
    layers = [source_of(named, scenario.plugin_folder) for named in cost_layers_of(scenario)]
    payload = msgspec.json.encode([parts, stamps, layers], order="sorted")
    return hashlib.blake2b(payload, digest_size=8).hexdigest()


def save_prepared(folder: Path, terrain: Terrain, truth: Floats, key: str = "") -> None:
    """Write a terrain and its truth where `load_prepared` finds them. The description is written last."""
    arrays: dict[str, NDArray[Any]] = {
        "elevation": terrain.elevation_m,
        "photo": terrain.photo,
        "pace": terrain.pace_s_per_m,
        "classes": terrain.classes,
        "truth": truth,
        "homes": homes_of(terrain.pace_s_per_m, truth),
    }
    if terrain.ground_s_per_m is not terrain.pace_s_per_m:
        arrays["ground"] = terrain.ground_s_per_m
    if terrain.climb is not None:
        arrays["climb"] = terrain.climb.factors
    meta = {
        "format": FORMAT,
        "key": key,
        "grid": msgspec.to_builtins(terrain.grid),
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
            save_array(folder / f"{name}.npy", array)  # a process that has the old one mapped keeps it
        partial = folder / f"{_META}.part"
        partial.write_text(json.dumps(meta, indent=1), encoding="utf-8")
        partial.rename(folder / _META)
    except OSError as error:
        raise TerrainError(f"cannot write the prepared terrain to {folder}: {error.strerror or error}") from error


def load_prepared(folder: Path, key: str = "") -> Terrain | None:
    """The terrain that `save_prepared` left, mapped read-only; None if there is none, or one of another key.

    Raises TerrainError if it is damaged."""
    meta = _read_meta(folder, key)
    if meta is None:
        return None
    try:
        grid = GridSpec(**meta["grid"])
        digest, radius, notes = str(meta["digest"]), float(meta["vehicle_radius_m"]), tuple(meta["notes"])
        has_ground, steepest = "ground" in meta["arrays"], meta["steepest"]
    except (KeyError, TypeError, ValueError) as error:
        raise TerrainError(f"prepared terrain {folder / _META} is damaged ({error}); delete the folder") from error
    shape = (grid.rows, grid.cols)
    pace = read_array(folder, "pace", shape, np.float32)
    elevation_m = read_array(folder, "elevation", shape, np.float32)
    climb = None
    if steepest is not None:
        factors = read_array(folder, "climb", (2 * ENTRIES + 1,), np.float32)
        climb = Climb(grid, elevation_m, factors, float(steepest))
    return Terrain(
        grid=grid,
        elevation_m=elevation_m,
        photo=read_array(folder, "photo", (*shape, 3), np.uint8),
        pace_s_per_m=pace,
        classes=read_array(folder, "classes", shape, np.uint8),
        digest=digest,
        ground_s_per_m=read_array(folder, "ground", shape, np.float32) if has_ground else pace,
        vehicle_radius_m=radius,
        climb=climb,
        notes=notes,
    )


def load_prepared_truth(folder: Path, key: str = "") -> Floats | None:
    """The truth beside a prepared terrain; None if there is none."""
    meta = _read_meta(folder, key)
    if meta is None:
        return None
    grid = GridSpec(**meta["grid"])
    return read_array(folder, "truth", (grid.rows, grid.cols), np.float32)


def _read_meta(folder: Path, key: str) -> dict[str, Any] | None:
    try:
        if not (folder / _META).exists():
            return None
        meta = json.loads(read_text(folder / _META, FileKind.PREPARED))
    except (TerrainError, ValueError, RecursionError) as error:
        raise TerrainError(
            f"prepared terrain {folder / _META} is unreadable ({error}); delete the folder"
        ) from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT or (key and meta.get("key") != key):
        return None
    return meta


def read_array(folder: Path, name: str, shape: Iterable[int], dtype: type[Any]) -> NDArray[Any]:
    """An array of a prepared folder, mapped read-only. Raises TerrainError if it is not as described."""
    path = folder / f"{name}.npy"
    try:
        array = open_array(path)
    except (OSError, ValueError, EOFError, SyntaxError, RecursionError, MemoryError) as error:
        raise TerrainError(f"prepared terrain {path} is unreadable ({error}); delete the folder") from error
    if array.shape != tuple(shape) or array.dtype != dtype:
        raise TerrainError(f"prepared terrain {path} is {array.shape} {array.dtype}, not as described; delete it")
    return array


def load_terrain(setup: RoleSetup) -> Terrain:
    """The terrain of a run: prepared in its folder if it is there, else built."""
    if setup.run_dir is not None:
        terrain = load_prepared(setup.run_dir, scenario_key(setup.scenario))
        if terrain is not None:
            return terrain
    return build_terrain(setup.scenario)


def load_truth(setup: RoleSetup, terrain: Terrain) -> Floats:
    """The truth of a run, as `load_terrain`."""
    if setup.run_dir is not None:
        truth = load_prepared_truth(setup.run_dir, scenario_key(setup.scenario))
        if truth is not None:
            return truth
    return build_truth(setup.scenario, terrain)


def load_homes(setup: RoleSetup, terrain: Terrain, truth: Floats) -> Bools:
    """`homes_of` the terrain and truth of a run, as `load_terrain`; the caller must not write to it."""
    meta = None if setup.run_dir is None else _read_meta(setup.run_dir, scenario_key(setup.scenario))
    if setup.run_dir is not None and meta is not None and "homes" in meta["arrays"]:
        return read_array(setup.run_dir, "homes", (terrain.grid.rows, terrain.grid.cols), np.bool_)
    return homes_of(terrain.pace_s_per_m, truth)


def prepare(folder: Path, scenario: Scenario, progress: Progress = no_progress) -> tuple[Terrain, Floats]:
    """Build terrain and truth of a scenario, unless they are kept from an earlier run, and leave them in a folder
    for the other processes. What is returned is mapped, as theirs."""
    key, kept = scenario_key(scenario), kept_key(scenario)
    if kept is None or not fetch_kept(kept, folder):
        terrain = build_terrain(scenario, progress)
        save_prepared(folder, terrain, build_truth(scenario, terrain), key)
        del terrain
        give_back_memory()
        if kept is not None:
            keep(kept, [folder / _META, *folder.glob("*.npy")])
    mapped, truth = load_prepared(folder, key), load_prepared_truth(folder, key)
    if mapped is None or truth is None:
        raise TerrainError(f"the prepared terrain in {folder} has gone: it is another run's; start again")
    return mapped, truth
