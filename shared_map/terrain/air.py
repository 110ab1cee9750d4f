"""Ground of what flies: a surface over the terrain, no lower than a clearance and no steeper than can be climbed.

A vehicle of an air class drives on that surface as others do on the ground, by the same trees and routes: pace is
that of level flight, and a step costs by what it climbs. One surface that follows the terrain comes within a tenth
to a quarter of the best way through a stack of 64 levels, at a 64th of its cells (`./launch_scripts/bench air`).
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Floats
from shared_map.terrain.step_climb import ENTRIES, STILL, Climb, Wind, wind_of
from shared_map.terrain.terrain import Terrain
from shared_map.terrain.zones import paint_zones
from swarm.config.ground import CostConfig
from swarm.config.vehicle_classes import AirConfig, WindConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec

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
