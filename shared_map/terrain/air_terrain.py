"""The terrain of a class that flies, made from that of the run."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import msgspec
import numpy as np

from shared_map.arrays import Bools
from shared_map.terrain.air_floor import AirGround, Flight, air_ground, grade_of
from shared_map.terrain.terrain import Terrain
from shared_map.terrain.wind import wind_of
from shared_map.terrain.zones import paint_zones
from swarm.config.classes import AirConfig, WindConfig
from swarm.config.ground import CostConfig
from swarm.errors import TerrainError


def air_terrain(common: Terrain, air: AirConfig, wind: WindConfig, named: str) -> Terrain:
    """The surface on which a class flies, as a terrain of its own. Raises TerrainError if it can be nowhere.

    common  the terrain of the run, for the class "ground"
    named   the class, for errors
    """
    level = np.zeros((common.grid.rows, common.grid.cols), np.float32)
    paint_zones(level, air.no_fly, common.grid, CostConfig(), key=f"{named}: air.no_fly")
    flown = flight_of(common, air, wind, np.isinf(level))
    if np.isinf(flown.pace_s_per_m).all():
        raise TerrainError(f"{named}: it can fly nowhere: no cell is outside of its no-fly zones and of voids")
    digest = hashlib.blake2b(digest_size=8)
    digest.update(common.digest.encode() + msgspec.json.encode([air, wind], order="sorted"))
    digest.update(np.ascontiguousarray(flown.height_m).data)
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
        notes=(f"{over}, no steeper than {flown.grade:.3g}", flown.climb.note, *_said_of(wind, air)),
        zones=(),
    )


def _said_of(wind: WindConfig, air: AirConfig) -> tuple[str, ...]:
    """What people are told of the wind; nothing where there is none."""
    if not wind.speed_m_per_s:
        return ()
    low, high = air.speed_m_per_s - wind.speed_m_per_s, air.speed_m_per_s + wind.speed_m_per_s
    blows = f"in a wind of {wind.speed_m_per_s:g} m/s from {wind.from_deg:g} degrees"
    return (f"{blows}: {low:.3g} m/s over the ground against it, {high:.3g} m/s with it",)


def flight_of(common: Terrain, air: AirConfig, wind: WindConfig, closed: Bools) -> AirGround:
    """What trees of the class are grown over."""
    flight = Flight(
        speed_mps=air.speed_m_per_s,
        clearance_m=air.clearance_m,
        grade=grade_of(common.elevation_m, common.grid.resolution_m) if air.grade is None else air.grade,
        climb_s_per_m=1 / air.climb_m_per_s,
        descent_s_per_m=1 / air.descent_m_per_s,
        wind=wind_of(wind.speed_m_per_s, wind.from_deg, air.speed_m_per_s),
    )
    return air_ground(common.grid, common.elevation_m, flight, closed)
