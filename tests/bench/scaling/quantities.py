"""What the cost of a swarm depends on, as numbers: counts of processes, cells and rates, and how agents share the
map. Pure.

Two of them are no counts. Which agents hear a mark, and how many messages an agent needs to say where its vehicles
are, depends on how agents' vehicles lie over regions; vehicles are drawn at random as a start with
`start = "spread"` does, in the order of the Morton curve, and counted.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.whole_swarm.size import CELLS_PER_VEHICLE, Size
from swarm.grid import REGION_CELLS
from swarm.right_of_way.plots import FEWEST_FOR_MAJORITY

INTEREST_CELLS = 75
"""Within so many cells of a vehicle its agent holds the map: `map.interest_m` of the scenario, in cells."""
_ROAM_CELLS = 4
"""What a vehicle drives from its start in the first seconds, in which all runs are measured."""
LISTEN_TO_ALL = 5 / 90
"""The part of the time in which an agent hears everybody's digests: `shared_map/replication/digest_interest.py`."""
REASSIGN_S = 5.0
"""`vehicles.reassign_s`."""
_AFTER_CAPTURE_S = 0.5
_APART_S = 1 / 50
"""What `vehicle_agent/assignment.py` waits after a capture, so that several become one request; and after a
request, for each target."""
_CAPTURES_PER_TARGET_S = 0.05
"""At the density of `thousand`: 30 a minute of 10 targets."""
_SEED = 1


@dataclass(frozen=True, slots=True)
class Quantities:
    """The numbers that terms of the model are made of.

    vehicles, agents, planners, keepers, monitors, launchers
                  how many there are; a launcher stands for each machine
    cells         of the map
    side          cells a side of the map
    rate          ticks a second
    plots         plots of right of way; 0 of fewer than three agents, as their plots have one member, which tells
                  nobody
    shared        pairs of an agent and a region in which it has vehicles
    shared_plots  the same of plots
    hearers       agents that hold the region of a vehicle, on average; they hear its marks
    listeners     agents that hear an agent's digest, on average: those that hold a region in which it has vehicles,
                  and all agents a part of the time
    near          share of all regions that an agent holds, on average
    chases        pairs of an agent and a target which one of its vehicles chases, where each takes any target
    asks          requests a second, of all agents, for what their vehicles need to every target
    """

    vehicles: float
    agents: float
    planners: float
    keepers: float
    monitors: float
    launchers: float
    cells: float
    side: float
    rate: float
    plots: float
    shared: float
    shared_plots: float
    hearers: float
    listeners: float
    near: float
    chases: float
    asks: float


def quantities_of(size: Size, *, standbys: int = 0, monitors: int = 1, machines: int = 1) -> Quantities:
    """The numbers of a swarm of one size, with so many standbys of each planner."""
    plot_cells = size.plot_regions * REGION_CELLS
    shared, shared_plots, hearers, told, near = _spread(size.vehicles, size.agents, size.side, plot_cells)
    per_agent = size.vehicles / size.agents
    return Quantities(
        vehicles=size.vehicles,
        agents=size.agents,
        planners=size.targets * (1 + standbys),
        keepers=1,
        monitors=monitors,
        launchers=machines,
        cells=size.side**2,
        side=size.side,
        rate=size.tick_hz,
        plots=math.ceil(size.side / plot_cells) ** 2 if size.agents >= FEWEST_FOR_MAJORITY else 0,
        shared=shared,
        shared_plots=shared_plots,
        hearers=hearers,
        listeners=told + LISTEN_TO_ALL * (size.agents - told),
        near=near,
        chases=size.agents * size.targets * -math.expm1(-per_agent / size.targets),
        asks=size.agents * _asks_per_s(_captures_per_s(size), size.targets),
    )


def _captures_per_s(size: Size) -> float:
    """Captures of all targets. A captured target begins anew elsewhere, and the nearest vehicle's way to it is as
    long as vehicles lie apart."""
    apart = math.sqrt(size.side**2 / size.vehicles)
    return _CAPTURES_PER_TARGET_S * size.targets * math.sqrt(CELLS_PER_VEHICLE) / apart


def _asks_per_s(captures_per_s: float, targets: int) -> float:
    """Requests of one agent. It asks every `vehicles.reassign_s`; or half a second after a target was captured, and
    a 50th of a second for each target after it asked last; whichever is first: the mean of that, of captures which
    are independent of each other."""
    rests_s = min(max(targets * _APART_S, _AFTER_CAPTURE_S), REASSIGN_S)
    if not captures_per_s:
        return 1 / REASSIGN_S
    none_yet = math.exp(-captures_per_s * (rests_s - _AFTER_CAPTURE_S))
    none_at_all = math.exp(-captures_per_s * (REASSIGN_S - _AFTER_CAPTURE_S))
    return 1 / (rests_s + (none_yet - none_at_all) / captures_per_s)


@functools.lru_cache(1024)
def _spread(vehicles: int, agents: int, side: int, plot_cells: int) -> tuple[float, float, float, float, float]:
    """`shared`, `shared_plots`, `hearers`, agents that hold a region of an agent's vehicles, and `near`, as in
    `Quantities`, of vehicles anywhere on an empty square map."""
    rng = np.random.default_rng(_SEED)
    rows, cols = rng.integers(0, side, (2, vehicles))
    order = np.argsort(_morton(rows, cols), kind="stable")
    rows, cols = rows[order], cols[order]
    agent = np.arange(vehicles) * agents // vehicles
    driven = _squares_within(_ROAM_CELLS, rows, cols, agent, side)
    plots = (
        driven if plot_cells == REGION_CELLS else _squares_within(_ROAM_CELLS, rows, cols, agent, side, plot_cells)
    )
    held = _squares_within(INTEREST_CELLS, rows, cols, agent, side)
    hearers = held.sum(0)[rows // REGION_CELLS, cols // REGION_CELLS].mean()
    spoken_of, of_interest = (each.reshape(len(each), -1).astype(np.float32) for each in (driven, held))
    told = (spoken_of @ of_interest.T > 0).sum(1).mean()
    return float(driven.sum()), float(plots.sum()), float(hearers), float(told), float(held.mean())


def _squares_within(
    reach: int,
    rows: NDArray[np.int64],
    cols: NDArray[np.int64],
    agent: NDArray[np.int64],
    side: int,
    square: int = REGION_CELLS,
) -> NDArray[np.bool_]:
    """bool (agents, squares down, squares across), whether an agent has a vehicle so near to one, or in it."""
    across = -(-side // square)
    found = np.zeros((int(agent[-1]) + 1, across, across), np.bool_)
    for south in (-reach, 0, reach):
        for east in (-reach, 0, reach):
            row = np.clip(rows + south, 0, side - 1) // square
            col = np.clip(cols + east, 0, side - 1) // square
            found[agent, row, col] = True
    return found


def _morton(rows: NDArray[np.int64], cols: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of cells on the Morton curve."""
    place = np.zeros(len(rows), np.int64)
    for bit in range(16):
        place |= (cols >> bit & 1) << 2 * bit
        place |= (rows >> bit & 1) << 2 * bit + 1
    return place
