"""The ground of each class of vehicles: the terrain by its own rule of cost, what that is in truth, and where its
vehicles may start; and its cost map, one for each class over one set of marks.

A mark says what the ground of a cell is for the class "ground", as sensors and operators tell it. Another class
reads it by its own rule. A lethal mark is lethal for all; a pace that is three times the prior is so for that
class, too, and so is a learned factor. No mark opens a cell that a class cannot drive by its own rule. A mark for
one class alone counts for that class before a mark for all, unless that is lethal.

The ground of what flies is a surface over the terrain, no lower than a clearance and no steeper than can be
climbed. A vehicle of an air class drives on that surface as others do on the ground, by the same trees and routes:
pace is that of level flight, and a step costs by what it climbs. One surface that follows the terrain comes within
a tenth to a quarter of the best way through a stack of 64 levels, at a 64th of its cells
(`./launch_scripts/bench air`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Floats
from shared_map.cost_map import CostMap
from shared_map.terrain import store
from shared_map.terrain.slope_and_climb import ENTRIES, STILL, Climb, Wind, wind_of
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.terrain.zones import paint_zones
from swarm.config.ground import CostConfig
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import (
    GROUND,
    AirConfig,
    ClassConfig,
    WindConfig,
    class_named,
    driven_classes,
    flies,
    of_class,
)
from swarm.errors import TerrainError
from swarm.grid import GridSpec
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST, MarkKind, MarkSet

_GRADES = 0.1, 0.5
"""Least and greatest grade of a surface. Chosen, not measured."""
_GRADE_OF_RELIEF = 1.8
"""Share of the relief over the shorter side: steep terrain needs a steep surface, over gentle terrain it only
costs."""
_ROOM = 1.02
"""Margin of the table of factors beyond the grade of a surface: rounding makes steps a hair steeper."""


@dataclass(frozen=True, eq=False)
class AirGround:
    """Input of a search for an air class.

    height_m      float32 (rows, cols), above the same zero as the terrain; NaN where no vehicle flies
    pace_s_per_m  float32 (rows, cols); inf where no vehicle flies
    climb         the factor of a step by its rise, and by the wind
    grade         of the surface
    """

    height_m: Floats
    pace_s_per_m: Floats
    climb: Climb
    grade: float


def air_ground(
    grid: GridSpec, elevation_m: Floats, air: AirConfig, wind: Wind = STILL, closed: Bools | None = None
) -> AirGround:
    """The ground of an air class.

    Parameters
    ----------
    elevation_m : (rows, cols) float32, m; NaN is a void. No vehicle flies over a no-data cell or beside one, as its
    height is unknown closed : (rows, cols) bool, no-fly zones; none if not given
    """
    grade = grade_of(elevation_m, grid.resolution_m) if air.grade is None else air.grade
    lifted = lifted_floor(clearance_floor(elevation_m, air.clearance_m), grade, grid.resolution_m)
    unknown = np.isnan(lifted)
    lethal = unknown if closed is None else unknown | closed
    pace = np.where(lethal, np.float32(np.inf), np.float32(1.0 / air.speed_m_per_s))
    steepest = grade * _ROOM
    rises = np.linspace(-steepest, steepest, 2 * ENTRIES + 1)
    metres_s = np.where(rises > 0, rises * (1 / air.climb_m_per_s), -rises * (1 / air.descent_m_per_s))
    factors = (1.0 + air.speed_m_per_s * metres_s).astype(np.float32)
    return AirGround(lifted, pace, Climb(grid, lifted, factors, steepest, wind), grade)


def clearance_floor(elevation_m: Floats, clearance_m: float) -> NDArray[np.float64]:
    """The lowest height that keeps the clearance, float64 (rows, cols), m; NaN at voids and beside them.

    It is taken over a cell and its neighbours: so a straight flight between the centres of two neighbours keeps it,
    too, over any ground that is nowhere higher than the cells around it.
    """
    around_m = np.lib.stride_tricks.sliding_window_view(np.pad(elevation_m, 1, mode="edge"), (3, 3))
    highest: NDArray[np.float64] = around_m.max(axis=(2, 3)).astype(np.float64)  # NaN stays
    return highest + clearance_m


def lifted_floor(floor_m: NDArray[np.float64], grade: float, resolution_m: float) -> Floats:
    """The lowest surface over a floor that no step of a grid climbs by more than a grade, float32 (rows, cols), m.

    The greatest of `floor - grade x way` over all cells, by the length of the way in steps of eight directions: two
    passes over the rows (chamfer distance; Borgefors, 1986), as ways bend to one side of a row or the other.
    Rounded up to float32, so that no rounding takes from the clearance. NaN is no floor, and stays NaN.
    """
    void = np.isnan(floor_m)
    lifted = np.where(void, -np.inf, floor_m)
    straight_m = grade * resolution_m
    for rows in (range(len(lifted)), range(len(lifted) - 1, -1, -1)):
        before: NDArray[np.float64] | None = None
        for row in rows:
            here = lifted[row]
            if before is not None:
                np.maximum(here, before - straight_m, out=here)
                np.maximum(here[1:], before[:-1] - math.sqrt(2) * straight_m, out=here[1:])
                np.maximum(here[:-1], before[1:] - math.sqrt(2) * straight_m, out=here[:-1])
            _along_the_row(here, straight_m)
            before = here
    lifted[void] = np.nan
    rounded = lifted.astype(np.float32)
    up: Floats = np.where(rounded < lifted, np.nextafter(rounded, np.float32(np.inf)), rounded)
    return up


def _along_the_row(heights: NDArray[np.float64], step_m: float) -> None:
    """Lift a row where its own cells need it, to both sides."""
    fallen = step_m * np.arange(len(heights))
    for way in (slice(None), slice(None, None, -1)):
        there = heights[way]
        np.maximum(there, np.maximum.accumulate(there + fallen) - fallen, out=there)


def grade_of(elevation_m: Floats, resolution_m: float) -> float:
    """The grade of a surface over a terrain: 0.1 over gentle ones, up to 0.5 where relief is 0.28 of the side."""
    relief_m = float(np.nanmax(elevation_m) - np.nanmin(elevation_m)) if np.isfinite(elevation_m).any() else 0.0
    low, high = _GRADES
    side_m = min(elevation_m.shape) * resolution_m
    return float(min(max(_GRADE_OF_RELIEF * relief_m / side_m, low), high))


# --- as a terrain of its own ----------------------------------------------------------------------------------


def air_terrain(common: Terrain, air: AirConfig, wind: WindConfig, named: str) -> Terrain:
    """The surface on which a class flies, as a terrain of its own. Raises TerrainError if it can be nowhere.

    common  the terrain of the run, for the class "ground"
    named   the class, for errors
    """
    level = np.zeros((common.grid.rows, common.grid.cols), np.float32)
    paint_zones(level, air.no_fly, common.grid, CostConfig(), key=f"{named}: air.no_fly")
    blown = wind_of(wind.speed_m_per_s, wind.from_deg, air.speed_m_per_s)
    flown = air_ground(common.grid, common.elevation_m, air, blown, np.isinf(level))
    if np.isinf(flown.pace_s_per_m).all():
        raise TerrainError(f"{named}: it can fly nowhere: no cell is outside of its no-fly zones and of voids")
    digest = hashlib.blake2b(digest_size=8)
    digest.update(common.digest.encode() + msgspec.json.encode([air, wind], order="sorted"))
    digest.update(np.ascontiguousarray(flown.height_m).data)
    blows: tuple[str, ...] = ()
    if wind.speed_m_per_s:
        low, high = air.speed_m_per_s - wind.speed_m_per_s, air.speed_m_per_s + wind.speed_m_per_s
        where = f"in a wind of {wind.speed_m_per_s:g} m/s from {wind.from_deg:g} degrees"
        blows = (f"{where}: {low:.3g} m/s over the ground against it, {high:.3g} m/s with it",)
    over = f"flies at {np.nanmin(flown.height_m):,.0f} to {np.nanmax(flown.height_m):,.0f} m"
    return replace(
        common,
        pace_s_per_m=flown.pace_s_per_m,
        ground_s_per_m=flown.pace_s_per_m,
        digest=digest.hexdigest(),
        vehicle_radius_m=0.0,
        climb=flown.climb,
        least_s_per_m=1 / air.speed_m_per_s,
        flight_m=flown.height_m,
        notes=(f"{over}, no steeper than {flown.grade:.3g}", flown.climb.note, *blows),
        zones=(),
    )


@dataclass(frozen=True, eq=False)
class ClassGround:
    """The ground as vehicles of one class find it.

    truth  float32 (rows, cols), s/m: the pace at which they really drive, without inflation; inf is lethal
    homes  bool (rows, cols): where they may start (`homes_of`)
    """

    terrain: Terrain
    truth: Floats
    homes: Bools


_MADE: WeakKeyDictionary[Terrain, dict[str, Terrain]] = WeakKeyDictionary()
"""Grounds made beside a terrain, so that the processes of a simulation make them once."""
_KNOWN: WeakKeyDictionary[Terrain, dict[str, ClassGround]] = WeakKeyDictionary()
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
    return {GROUND: truth} | {
        name: _ground(scenario, common, truth, name).truth for name in driven_classes(scenario)
    }


def class_grounds(
    scenario: Scenario, common: Terrain, truth: Floats, homes: Bools | None = None
) -> dict[str, ClassGround]:
    """Class -> its ground, of "ground" and of every class that vehicles of the scenario belong to.

    common, truth, homes  those of "ground"; `homes_of` the other two, if that is known
    """
    known = store.homes_of(common.pace_s_per_m, truth) if homes is None else homes
    grounds = {GROUND: ClassGround(common, truth, known)}
    return grounds | {name: _ground(scenario, common, truth, name) for name in driven_classes(scenario)}


def least_pace(own: ClassConfig | None) -> float:
    """The pace below which no vehicle of a class comes, s/m."""
    if own is not None and own.air is not None:
        return 1 / own.air.speed_m_per_s
    return PACE_LEAST if own is None or own.max_speed_m_per_s is None else 1 / own.max_speed_m_per_s


def _ground(scenario: Scenario, common: Terrain, truth: Floats, name: str) -> ClassGround:
    prepared = _KNOWN.get(common, {}).get(_key(scenario, name))
    if prepared is not None:
        return prepared
    own = _terrain(scenario, common, name)
    own_truth = own.ground_s_per_m
    if own.flight_m is None:  # nothing is hidden in the air
        priors = own_truth.reshape(-1), common.ground_s_per_m.reshape(-1)
        own_truth = read_by(*priors, truth.reshape(-1), own.least_s_per_m).reshape(truth.shape)
    homes = store.homes_of(own.pace_s_per_m, own_truth)
    if not homes.any():
        raise TerrainError(f"class {name}: no cell that it can drive by the map is so in truth")
    return ClassGround(own, own_truth, homes)


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


def _key(scenario: Scenario, name: str) -> str:
    """Digest of all that the ground of a class is made from."""
    keys = [store.scenario_key(scenario), store.scenario_key(of_class(scenario, name))]
    payload = msgspec.json.encode([*keys, class_named(scenario, name), scenario.wind], order="sorted")
    return hashlib.blake2b(payload, digest_size=8).hexdigest()


# --- prepared once in a run's folder for all processes of a machine -------------------------------------------

_META = "class.json"
"""Describes the arrays beside it. Arrays that all classes share (heights, photo, terrain classes) are stored with
the terrain of the run."""


def prepare_classes(run_dir: Path, scenario: Scenario, common: Terrain, truth: Floats) -> None:
    """Leaves the ground of every class that vehicles belong to in a run's folder, as `prepare` does for the
    terrain."""
    for name in driven_classes(scenario):
        ground = _ground(scenario, common, truth, name)
        arrays: dict[str, NDArray[Any]] = {"truth": ground.truth, "homes": ground.homes}
        if ground.terrain.flight_m is not None:
            arrays["flight"] = ground.terrain.flight_m
        store.save_ground(_folder(run_dir, name) / _META, ground.terrain, arrays, _key(scenario, name))
    _open(run_dir, scenario, common)


def load_classes(setup: RoleSetup, common: Terrain) -> None:
    """Makes `class_grounds` and `class_terrains` take prepared files in a run's folder, instead of making them."""
    if setup.run_dir is not None:
        _open(setup.run_dir, setup.scenario, common)


def _open(run_dir: Path, scenario: Scenario, common: Terrain) -> None:
    for name in driven_classes(scenario):
        key = _key(scenario, name)
        ground = _load(_folder(run_dir, name), key, scenario, common, name)
        if ground is not None:
            _KNOWN.setdefault(common, {})[key] = ground
            _MADE.setdefault(common, {})[key] = ground.terrain


def _folder(run_dir: Path, name: str) -> Path:
    return run_dir / "classes" / name


def _load(folder: Path, key: str, scenario: Scenario, common: Terrain, name: str) -> ClassGround | None:
    """None if there is none, or one of another key. Raises TerrainError if it is damaged."""
    meta = store.read_meta(folder / _META, key)
    if meta is None:
        return None
    shape = common.grid.shape
    flight_m = store.read_array(folder, "flight", meta, shape, np.float32) if flies(scenario, name) else None
    terrain = replace(
        common,
        **store.read_ground(folder / _META, meta, common.elevation_m if flight_m is None else flight_m),
        flight_m=flight_m,
        zones=common.zones if flight_m is None else (),
        least_s_per_m=least_pace(class_named(scenario, name)),
    )
    truth = store.read_array(folder, "truth", meta, shape, np.float32)
    return ClassGround(terrain, truth, store.read_array(folder, "homes", meta, shape, np.bool_))


# --- marks as each class reads them ---------------------------------------------------------------------------


def read_by(own_prior: Floats, prior: Floats, paces: Floats, least: float = PACE_LEAST) -> Floats:
    """Returns paces of the class "ground" as another class reads them, s/m.

    Parameters
    ----------
    own_prior, prior, paces : (n,) float32, s/m
        The prior ground of that class and of "ground", and what a mark or the truth gives; inf is lethal.
    least : float, s/m
        No vehicle of that class is quicker.

    Returns
    -------
    (n,) float32
        The same bits as `paces` where both priors are the same and finite; inf wherever `own_prior` is.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = np.clip(own_prior.astype(np.float64) * paces / prior, PACE_LEAST, PACE_MOST).astype(np.float32)
    marked = np.maximum(np.where(own_prior == prior, paces, scaled), np.float32(least))
    read = np.where(np.isinf(prior) | (paces == prior), own_prior, marked)
    lethal = np.isinf(own_prior) | (np.isinf(paces) & np.isfinite(prior))
    return np.where(lethal, np.float32(np.inf), read).astype(np.float32)


def read_marks(
    own: Terrain, common: Terrain, cells: NDArray[Any], kinds: NDArray[np.uint8], paces: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], Floats]:
    """Returns marks for "ground" as another class reads them: kinds and paces.

    own, common  the terrain of that class, and of "ground"
    """
    where = np.asarray(cells, np.int64)
    if own.flight_m is not None:  # whatever lies on the ground
        return np.full(kinds.shape, np.uint8(MarkKind.CLEAR)), own.ground_s_per_m.reshape(-1)[where]
    own_prior = own.ground_s_per_m.reshape(-1)[where]
    prior = common.ground_s_per_m.reshape(-1)[where]
    stated = np.where(kinds == MarkKind.PACE, paces, prior).astype(np.float32)
    closed = np.isinf(own_prior) | np.isinf(prior)  # no pace is read here: it is as it was before any mark
    own_kinds = np.where((kinds == MarkKind.PACE) & closed, np.uint8(MarkKind.CLEAR), kinds).astype(np.uint8)
    return own_kinds, read_by(own_prior, prior, stated, own.least_s_per_m)


def for_class(
    own: Terrain,
    cells: NDArray[np.int64],
    kinds: NDArray[np.uint8],
    paces: Floats,
    own_kinds: NDArray[np.uint8],
    own_paces: Floats,
) -> tuple[NDArray[np.uint8], Floats]:
    """Returns the marks that hold for a class: those for it alone, or else those for all. Cells that are lethal to
    all stay so, and so do cells that the class cannot drive by its own rule.

    own                   the terrain of the class
    kinds, paces          marks for all, as `read_marks` has them for the class
    own_kinds, own_paces  marks for the class alone; CLEAR where there is none
    """
    closed = (own_kinds == MarkKind.PACE) & np.isinf(own.ground_s_per_m.reshape(-1)[cells])
    stated = (own_kinds != MarkKind.CLEAR) & (kinds != MarkKind.LETHAL) & ~closed
    bounded = np.maximum(own_paces, np.float32(own.least_s_per_m))
    return np.where(stated, own_kinds, kinds).astype(np.uint8), np.where(stated, bounded, paces).astype(np.float32)


class ClassMaps:
    """The cost maps of all classes of a process, which takes in marks for them together.

    terrains  class -> the ground by its own rule, of the classes beside "ground"
    numbers   class -> its number among those of the scenario, from 1 on

    common    that of the class "ground"
    of        class -> its cost map, of the others
    """

    def __init__(self, common: CostMap, terrains: Mapping[str, Terrain], numbers: Mapping[str, int]) -> None:
        self.common = common
        learns = common.keys is not None
        self.of = {
            name: CostMap(terrain, learning=learns and terrain.flight_m is None)
            for name, terrain in terrains.items()
        }
        self._by_number = {numbers[name]: cost_map for name, cost_map in self.of.items()}
        self._kinds = np.full(common.grid.cells if self.of else 0, MarkKind.CLEAR, np.uint8)
        """Marks of each cell for all vehicles. A pace is that of the common ground."""
        self._own: dict[int, dict[int, tuple[int, float]]] = {number: {} for number in self._by_number}
        """Class number -> cell -> kind and pace of the marks for that class alone."""

    def learn(self, words: Sequence[MarkSet]) -> bool:
        """Like `CostMap.learn`: ground that is three times as slow as its prior is so for every class."""
        return any([cost_map.learn(words) for cost_map in (self.common, *self.of.values())])  # noqa: C419 - all do

    def apply(
        self,
        cells: NDArray[np.uint32],
        kinds: NDArray[np.uint8],
        paces: NDArray[np.float32],
        class_number: int = 0,
    ) -> None:
        """Applies marks as `CostMap.apply` does. A mark for all vehicles changes the map of each class, in the way
        that the class reads it. A mark for one class changes only its map, if there is one here."""
        if class_number == 0:
            self.common.apply(cells, kinds, paces)
            if not self.of:
                return
            self._kinds[cells] = kinds
            for number in self._by_number:
                self._show(number, cells, kinds, paces)
        elif (own := self._own.get(class_number)) is not None:
            for cell, kind, pace in zip(cells.tolist(), kinds.tolist(), paces.tolist(), strict=True):
                if kind == MarkKind.CLEAR:
                    own.pop(cell, None)
                else:
                    own[cell] = kind, pace
            paces = self.common.ground_s_per_m.reshape(-1)[cells]
            self._show(class_number, cells, self._kinds[cells], paces)

    def _show(self, number: int, cells: NDArray[np.uint32], kinds: NDArray[np.uint8], paces: Floats) -> None:
        """Brings the marks that hold for a class onto its map, from those for all."""
        cost_map, own = self._by_number[number], self._own[number]
        kinds, paces = read_marks(cost_map.terrain, self.common.terrain, cells, kinds, paces)
        if own and len(cells):
            own_kinds, own_paces = zip(*(own.get(cell, _NOTHING) for cell in cells.tolist()), strict=True)
            stated = np.array(own_kinds, np.uint8), np.array(own_paces, np.float32)
            kinds, paces = for_class(cost_map.terrain, np.asarray(cells, np.int64), kinds, paces, *stated)
        cost_map.apply(cells, kinds, paces)


_NOTHING = (int(MarkKind.CLEAR), 0.0)
