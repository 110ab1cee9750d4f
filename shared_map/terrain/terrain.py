"""A terrain: elevation, photo, classes and prior pace on one metric grid; built once, prepared in a run's folder.

Agents import this, so nothing slow is imported at the top: what only building needs is imported where it is used.

For pictures there are levels of detail, each at half the resolution of the one before. A wall or a road one cell
wide is in every level, however small its share of the cell there.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.terrain import pace_layers
from shared_map.terrain.cost_layers import apply_cost_layers, cost_world
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.row_bands import Progress, in_bands, no_progress, padded_rows
from shared_map.terrain.slope_and_climb import Climb, climb_of, cost_sentence
from shared_map.terrain.zones import ZoneFacts, paint_zones
from swarm.config.explain import converted
from swarm.config.ground import CostConfig
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND, of_class
from swarm.errors import ArgumentError, TerrainError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import PACE_LEAST

if TYPE_CHECKING:
    from shared_map.importers.terrain_sources import Source

FORMAT = 7
"""Raised when what lies in a prepared folder, or how terrain is built, changes."""
_ALL_LETHAL = "every cell of the terrain is lethal, so no vehicle has a place:"


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
    least_s_per_m     lowest pace of any vehicle, with any mark or learned factor
    flight_m          float32  height of the surface of a flying class; None for ground classes
    notes             sentences about its origin and processing
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
    """The terrain of a scenario, for one of its classes of vehicles. Raises TerrainError with one sentence, or
    ConfigError on a setting that no file may have."""
    from shared_map.importers.terrain_sources import load_source

    if not isinstance(scenario, Scenario):
        raise ArgumentError(f"scenario is of type {type(scenario).__name__}, expected Scenario")
    source_given = getattr(scenario.terrain, "source", "")
    if isinstance(source_given, str | PathLike):  # of an array the reader says what to do
        scenario = converted(scenario, Scenario, "the scenario")  # which may have been made in Python
    try:
        source = load_source(scenario.terrain, scenario.seed, progress)
        return _built(of_class(scenario, vehicle_class), source, progress, scenario.cost)
    except MemoryError as error:
        raise TerrainError(
            f"terrain {scenario.terrain.source} does not fit into memory; crop it, or set a larger"
            " terrain.resolution_m"
        ) from error


def _built(scenario: Scenario, source: Source, progress: Progress, common: CostConfig) -> Terrain:
    """Roads are laid by the cost `common`: they are the same for every class."""
    grid, classes, cost = source.grid, source.classes, scenario.cost
    notes = list(source.notes)
    ground = _ground(source, classes, cost, progress)
    if scenario.terrain.roads:
        open_ground = ground if cost is common else _ground(source, classes, common, progress)
        _check_passable(open_ground, source.elevation_m, classes, common, grid)
        from shared_map.terrain.synthetic import lay_roads

        laid = lay_roads(open_ground, scenario.terrain.roads, grid, scenario.seed)
        classes = np.where(laid, np.uint8(pace_layers.TerrainClass.ROAD), classes)
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
        notes.extend(each.sentence(grid.cells) for each in zones if each.file is not None)
    notes.append(cost_sentence(cost))
    photo = source.photo
    if photo is None:
        from shared_map.terrain.synthetic import paint_photo

        photo = paint_photo(source.elevation_m, classes, grid.resolution_m, scenario.seed, progress)
        notes.append("photo painted from elevation and classes, as there is none")
    terrain = finished(grid, source.elevation_m, photo, classes, ground, cost, tuple(notes))
    return replace(terrain, zones=tuple(zones))


def _ground(source: Source, classes: Bytes, cost: CostConfig, progress: Progress) -> Floats:
    """Steps 1 and 2 of the merge rule, band by band."""
    ground = np.empty(source.elevation_m.shape, np.float32)

    def work(row0: int, row1: int) -> None:
        padded_m, resolution_m = padded_rows(source.elevation_m, row0, row1), source.grid.resolution_m
        steepness = pace_layers.grade_of_padded(padded_m, resolution_m)
        np.copyto(steepness, np.float32(np.nan), where=np.isnan(source.elevation_m[row0:row1]))
        readings = None if source.readings is None else source.readings[row0:row1]
        pace = pace_layers.terrain_pace(steepness, classes[row0:row1], cost, readings)
        if source.factor is not None:
            pace *= source.factor[row0:row1]
        ground[row0:row1] = pace

    in_bands(source.grid.rows, work, "slope and cost", progress)
    return ground


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
    halves = pace_layers.inflation_halves(radius_m, grid.resolution_m)
    pace = pace_layers.inflate(ground, halves) if halves else ground
    if np.isinf(pace).all():
        raise TerrainError(
            f"{_ALL_LETHAL} cost.vehicle_radius_m = {cost.vehicle_radius_m:g} is too wide for every gap in it"
        )
    climb = climb_of(grid, elevation_m, cost)
    if climb is not None:
        notes = (*notes, climb.note)
    digest = terrain_digest(grid, pace, cost, elevation_m)
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
    slopes = pace_layers.slope_deg(elevation_m, grid.resolution_m)
    shares = {
        "void": np.isnan(elevation_m).mean(),
        f"steeper than cost.max_slope_deg = {cost.max_slope_deg:g}": (slopes > cost.max_slope_deg).mean(),
        "of a lethal class": np.isinf(pace_layers.class_factors(cost)[classes]).mean() if cost.classes else 0.0,
    }
    causes = ", ".join(f"{share:.0%} is {what}" for what, share in shares.items() if share > 0)
    raise TerrainError(
        f"{_ALL_LETHAL} {causes or 'the file itself or a forbidden zone says so of each'};"
        " check the units of the heights, the classes and the zones"
    )


def terrain_digest(grid: GridSpec, pace: Floats, cost: CostConfig, elevation_m: Floats) -> str:
    """The digest of a terrain with these arrays."""
    digest = hashlib.blake2b(digest_size=8)
    digest.update(f"{FORMAT} {grid}".encode())
    digest.update(np.ascontiguousarray(pace).data)
    if cost.directional:
        digest.update(np.ascontiguousarray(elevation_m).data)
    # The location of a file differs between machines; its effect is in the pace.
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


@dataclass(frozen=True, eq=False)
class Level:
    """A terrain at 1 / `side` of its resolution. A block which the border cuts off counts the cells that exist.

    side          cells of the terrain along one cell of this level, a power of two
    elevation_m   float32  mean of the heights that are known; NaN where none is
    photo         uint8    mean colour
    classes       uint8    the commonest class; road where there is any road
    pace_s_per_m  float32  mean of the cells that can be driven; inf where none can
    lethal_share  float32  0 to 1; of the cells below
    """

    side: int
    grid: GridSpec
    elevation_m: Floats
    photo: Bytes
    classes: Bytes
    pace_s_per_m: Floats
    lethal_share: Floats


def level_of(terrain: Terrain, most_cells: int) -> Level:
    """Returns the finest level that has at most this number of cells."""
    fine, side = terrain.grid, 1
    while -(-fine.rows // side) * -(-fine.cols // side) > most_cells:
        side *= 2
    lethal = np.isinf(terrain.pace_s_per_m)
    if side == 1:
        layers = terrain.elevation_m, terrain.photo, terrain.classes, terrain.pace_s_per_m
        return Level(1, fine, *layers, lethal.astype(np.float32))
    cells = _total(np.ones(fine.shape, np.int32), side)
    passable = _total(~lethal, side)
    colours = (_total(terrain.photo, side) + cells[..., None] // 2) // cells[..., None]
    of_classes = [_total(terrain.classes == kind, side) for kind in TerrainClass]
    is_road = of_classes[TerrainClass.ROAD] > 0
    rows, cols = cells.shape
    grid = GridSpec(rows, cols, side * fine.resolution_m, fine.west_m, fine.north_m, fine.crs)
    return Level(
        side,
        grid,
        _mean(terrain.elevation_m, ~np.isnan(terrain.elevation_m), side, np.nan),
        colours.astype(np.uint8),
        np.where(is_road, TerrainClass.ROAD, np.argmax(of_classes, axis=0)).astype(np.uint8),
        _mean(terrain.pace_s_per_m, ~lethal, side, np.inf),
        np.float32(1) - (passable / cells).astype(np.float32),
    )


def any_in_blocks(cells: Bools, side: int) -> Bools:
    """Returns which blocks of `side` x `side` cells contain any of these cells: bool, at the resolution of the
    level."""
    return cells if side == 1 else _total(cells, side) > 0


def _mean(values: Floats, where: Bools, side: int, without: float) -> Floats:
    """The mean of these cells in each block; `without` where there is none."""
    count, total = _total(where, side), _total(np.where(where, values, np.float32(0)), side)
    return np.where(count > 0, total / np.maximum(count, 1), without).astype(np.float32)


def _total(values: NDArray[Any], side: int) -> NDArray[Any]:
    """The sum of each block, which at the border may have fewer cells; whole numbers for what is none."""
    kind = values.dtype if values.dtype.kind == "f" else np.int32
    for axis in (1, 0):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], side), axis, kind)
    return values
