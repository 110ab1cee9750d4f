"""Small worlds full of vehicles: halls, rooms with doors, corridors one cell wide, pillars."""

from __future__ import annotations

import random

import numpy as np
from numpy.typing import NDArray

from launch_scripts.simulation.faults import Crash, FaultPlan, Partition
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.config.load import parse_scenario
from swarm.config.scenario import Scenario

KINDS = ("open", "doors", "corridor", "maze")
_TEXT = """
name = "crowd"
time_scale = 10
seed = {seed}
[terrain]
source = "synthetic"
rows = {side}
cols = {side}
resolution_m = 10
[[targets]]
count = 4
speed_m_per_s = 2
walk = "random"
[[groups]]
vehicles = {vehicles}
[vehicles]
per_agent = {per_agent}
sense_range_m = 40
capture_range_m = 15
"""


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
    text = _TEXT.format(seed=seed, side=side, vehicles=vehicles, per_agent=per_agent)
    return parse_scenario(text), terrain_of_pace(pace, 10.0)


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


def rough_plan(seed: int, agents: int, quiet_s: float) -> FaultPlan:
    """Crashes, cuts that nobody notices and cuts that all do, and a network that loses and delays a lot."""
    chance = random.Random(f"crowd/{seed}")
    names = [f"agent-a{n}" for n in range(agents)]
    crashes = [Crash(chance.uniform(3, quiet_s), chance.choice([*names, "keeper-0"])) for _ in range(6)]
    partitions = []
    for lasts_s in (0.5, 2.0, 6.0):
        from_s = chance.uniform(2, max(3.0, quiet_s - lasts_s))
        cut_off = chance.sample(names, chance.randint(1, max(1, agents // 3)))
        partitions.append(Partition(from_s, from_s + lasts_s, tuple(sorted(cut_off))))
    return FaultPlan(
        drop=chance.choice((0.0, 0.02, 0.1)),
        duplicate=0.02,
        reorder=chance.choice((0.0, 0.05)),
        delay_ms=chance.choice((1.0, 20.0, 100.0)),
        jitter_ms=chance.choice((5.0, 50.0)),
        quiet_s=quiet_s,
        partitions=tuple(partitions),
        crashes=tuple(sorted(crashes, key=lambda crash: (crash.at_s, crash.node))),
        skews_ms={name: chance.uniform(-3.6e6, 3.6e6) for name in names},
    )
