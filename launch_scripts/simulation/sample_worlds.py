"""Small worlds in which swarms are tried: hills with hidden obstacles, several regions, one-way slopes, crowds.

A crowd is 8 agents with 200 vehicles on 40 x 40 cells: a hall, rooms with doors, halls joined by corridors of one
cell, pillars.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.terrain import Terrain, build_terrain, terrain_of_pace
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import parse_scenario

CROWDS = ("open", "doors", "corridor", "maze")


def of_file(name: str, settings: Mapping[str, Any] | None = None) -> Scenario:
    """A scenario in the folder `small_worlds`, with other values at dotted keys."""
    text = (Path(__file__).with_name("small_worlds") / f"{name}.toml").read_text(encoding="utf-8")
    return parse_scenario(text, settings=settings or {})


SMALL = of_file("small")
WIDE = of_file("wide")
ROVERS = "rovers"
"""A crowd with 20 rovers that avoid no vehicle."""
MIXED = ("small", "wide", *CROWDS)
WORLDS = (*MIXED, ROVERS, "slopes")


def crowd(kind: str, seed: int, vehicles: int, per_agent: int, side: int = 40) -> tuple[Scenario, Terrain]:
    """A scenario, and its terrain: one cell takes a vehicle a tenth of a second."""
    chance = random.Random(f"{kind}/{seed}")
    pace = np.full((side, side), 0.1, np.float32)
    if kind == "doors":
        _rooms(pace, chance)
    elif kind == "corridor":
        pace[:, 3 * side // 10 : 7 * side // 10] = np.inf
        for row in (side // 7, side // 2, 5 * side // 6):
            pace[row] = 0.1
    elif kind == "maze":
        for _ in range(side * side // 5):
            pace[chance.randrange(side), chance.randrange(side)] = np.inf
    settings = {"terrain.rows": side, "terrain.cols": side, "seed": seed}
    settings |= {"groups.0.vehicles": vehicles, "vehicles.per_agent": per_agent}
    return of_file("crowd", settings), terrain_of_pace(pace, 10.0)


def _rooms(pace: NDArray[np.float32], chance: random.Random) -> None:
    """Rooms of ten by ten cells, each with doors of one cell to its neighbours."""
    side = len(pace)
    walls = range(9, side - 1, 10)
    for wall in walls:
        pace[wall, :] = pace[:, wall] = np.inf
    for wall in walls:
        for room in range(0, side, 10):
            pace[wall, min(room + chance.randrange(1, 8), side - 1)] = 0.1
            pace[min(room + chance.randrange(1, 8), side - 1), wall] = 0.1


def seeded(seed: int, scenario: Scenario = SMALL) -> Scenario:
    return msgspec.structs.replace(scenario, seed=seed)


def world(name: str, seed: int) -> tuple[Scenario, Terrain]:
    """A world of `WORLDS` with a seed."""
    if name == ROVERS:
        kind = CROWDS[seed % len(CROWDS)]
        scenario, terrain = crowd(kind, seed, vehicles=200, per_agent=25)
        return msgspec.structs.replace(scenario, name=f"rovers-{kind}", rovers=of_file(ROVERS).rovers), terrain
    if name in CROWDS:
        return crowd(name, seed, vehicles=200, per_agent=25)
    scenario = seeded(seed, of_file(name))
    return scenario, build_terrain(scenario)
