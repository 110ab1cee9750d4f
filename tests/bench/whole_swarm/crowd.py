"""The movement of crowds: dense worlds over many seeds, without faults, observed through the messages of agents.

A step is the time in which a vehicle drives one straight cell. A vehicle waits while it stands on one cell and has
its target not within reach, whatever the reason.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any

import typer

from bench.harness import benchmark, names_of, track
from bench.isolated import TimeLimit, isolated
from bench.whole_swarm.ideal_crowd import drive_ideal
from launch_scripts.parent_death import end_with_parent
from launch_scripts.simulation import sample_worlds as crowded
from launch_scripts.simulation.sample_worlds import CROWDS
from launch_scripts.simulation.trials import parse_seeds
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.runtime.process import collected_rarely
from swarm.wire.fields import column
from swarm.wire.messages.vehicles import Fleet, VehicleState

STEP_S = 0.1
"""The pace of `sample_worlds.crowd`: seconds a cell, and the period of its agents' ticks."""
LONG_S = 10.0
WANTED_LONGEST_S, WANTED_LONG_SHARE = 15.0, 0.005
"""Goals of the project."""
COLUMNS = (
    "world",
    "cells_per_step",
    "over_ideal",
    "over_ideal_without_following",
    "longest_wait_s",
    "waited_long_share",
    "arrivals_per_vehicle_and_100_s",
    "cpu_ms_per_cell",
    "deliveries_per_cell",
)
_NOTES = (
    "Cells a step: while the target is not within reach; 1 is a straight drive at full speed.",
    "Ideal: PIBT in lockstep with four neighbours, all known at once, no messages.",
    f"A wait: on one cell, target not within reach; long is over {LONG_S:g} s. Confined: within 5 x 5 cells.",
    "Deliveries: messages to each process which takes them; CPU: of all processes, planners included.",
    f"Wanted: no wait over {WANTED_LONGEST_S:g} s, at most {100 * WANTED_LONG_SHARE:g} % of vehicles ever so long.",
)
LIMIT_S = 120.0
"""Seconds of CPU for a drive; the rest is left out."""
_BOX_CELLS = 2
"""A vehicle is confined while it stays within this many cells of one cell, in every direction."""


class Drives:
    """The movement of vehicles, from the reports of their agents, one for each tick. Pure."""

    def __init__(self, cols: int) -> None:
        self._cols = cols
        self._last: dict[str, tuple[int, int, bool]] = {}
        """Vehicle -> row, column, whether its target is within reach."""
        self._waits: dict[str, int] = {}
        """Vehicle -> ticks for which it has waited."""
        self._boxes: dict[str, tuple[int, int, int]] = {}
        """Vehicle -> row and column of its box, ticks in it."""
        self.longest_wait: dict[str, int] = {}
        self.longest_confined: dict[str, int] = {}
        self.driven_cells = 0.0
        self.ticks_out_of_reach = 0
        self.arrivals = 0

    def hear(self, fleet: Fleet) -> None:
        for id, cell, state in zip(fleet.ids, column(fleet.cells, "<u4").tolist(), fleet.states, strict=True):
            row, col = divmod(cell, self._cols)
            self._report(id, row, col, state == VehicleState.ARRIVED)

    def _report(self, id: str, row: int, col: int, reached: bool) -> None:
        last_row, last_col, had_reached = self._last.get(id, (row, col, reached))
        self._last[id] = (row, col, reached)
        moved = math.hypot(row - last_row, col - last_col)
        if not reached:
            self.ticks_out_of_reach += 1
            self.driven_cells += moved
        elif not had_reached:
            self.arrivals += 1
        waited = self._waits[id] = self._waits.get(id, -1) + 1 if not reached and not moved else 0
        self.longest_wait[id] = max(self.longest_wait.get(id, 0), waited)
        box_row, box_col, inside = self._boxes.get(id, (row, col, -1))
        if reached or max(abs(row - box_row), abs(col - box_col)) > _BOX_CELLS:
            box_row, box_col, inside = row, col, -1
        self._boxes[id] = (box_row, box_col, inside + 1)
        self.longest_confined[id] = max(self.longest_confined.get(id, 0), inside + 1)


def drive_crowd(vehicles: int, agents: int, side: int, seconds: float, which: tuple[str, int]) -> dict[str, Any]:
    """Drives one crowd: a world and a seed."""
    from launch_scripts.simulation.simulate import Simulation
    from swarm.bus.bus import Event, Heard
    from swarm.wire.topics import FLEET

    end_with_parent(signal.SIGKILL)
    kind, seed = which
    scenario, terrain = crowded.crowd(kind, seed, vehicles, -(-vehicles // agents), side)
    began_s = time.perf_counter()
    simulation, limit = Simulation(scenario, terrain=terrain), TimeLimit(LIMIT_S)
    drives = Drives(terrain.grid.cols)
    steps: dict[str, int] = {}
    deliveries = 0
    ideal, alone = (
        drive_ideal(terrain.pace_s_per_m, vehicles, seed, int(seconds / STEP_S), follow) for follow in (True, False)
    )

    def hear(event: Event) -> None:
        assert isinstance(event, Heard)
        assert isinstance(event.message, Fleet)
        # Agents report between ticks, too: the first report of each step counts.
        step = int(event.message.stamp_ns / NS_PER_S / STEP_S)
        if steps.get(event.message.author) != step:
            steps[event.message.author] = step
            drives.hear(event.message)

    def deliver(now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
        nonlocal deliveries
        deliveries += 1

    simulation.network.bus("crowd-0", scenario.network.namespace).subscribe(FLEET, hear)
    simulation.network.trace = deliver
    began_cpu_s = time.process_time()
    with collected_rarely():
        while simulation.now_s < seconds and not limit.is_up:
            simulation.run_until(min(simulation.now_s + 0.5, seconds))
    cpu_s = time.process_time() - began_cpu_s
    report = simulation.report(simulation.now_s)
    waits_s = [STEP_S * ticks for ticks in drives.longest_wait.values()]
    confined_s = [STEP_S * ticks for ticks in drives.longest_confined.values()]
    return {
        "world": kind,
        "seed": seed,
        "simulated_s": simulation.now_s,
        "cut_short": simulation.now_s < seconds - 1e-6,
        "wall_s": time.perf_counter() - began_s,
        "cpu_s": cpu_s,
        "deliveries": deliveries,
        "driven_cells": drives.driven_cells,
        "vehicles": len(waits_s),
        "cells_per_step": drives.driven_cells / max(drives.ticks_out_of_reach, 1),
        "ideal_cells_per_step": ideal["cells_per_step"],
        "ideal_cells_per_step_without_following": alone["cells_per_step"],
        "ideal_longest_wait_s": STEP_S * ideal["longest_wait"],
        "ideal_arrivals": ideal["arrivals"],
        "longest_wait_s": max(waits_s, default=0.0),
        "waited_long": sum(each > LONG_S for each in waits_s),
        "confined_long": sum(each > LONG_S for each in confined_s),
        "arrivals": drives.arrivals,
        "captures": report["captures"],
        "collisions": report["collisions"],
        "lethal_entries": report["lethal_entries"],
    }


@benchmark(fails=("collisions", "lethal_entries"), columns=COLUMNS)
def crowd(
    worlds: Annotated[str, typer.Option(help="open, doors, corridor, maze; several with commas.")] = (
        "open,doors,corridor,maze"
    ),
    seeds: Annotated[str, typer.Option(metavar="A:B", help="The seeds A to B - 1, each in every world.")] = "0:5",
    vehicles: Annotated[int, typer.Option(min=2, max=1000, help="Vehicles.")] = 200,
    agents: Annotated[int, typer.Option(min=1, max=100, help="Agents that host them.")] = 8,
    size: Annotated[int, typer.Option(min=16, max=256, help="Cells a side.")] = 40,
    seconds: Annotated[float, typer.Option(min=1, max=3600, help="Simulated seconds of each drive.")] = 40.0,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Drives at the same time.")] = 2,
) -> dict[str, Any]:
    """Movement of crowds: cells per step, longest waits, arrivals, in dense worlds over many seeds. Some seven
    minutes.

    \b
    ./launch_scripts/bench crowd
    ./launch_scripts/bench crowd --worlds doors --seeds 0:20 --jobs 4 --json

    Simulated, without faults. 200 vehicles on 40 x 40 cells are an eighth of all cells: a hall, rooms with doors of
    one cell, halls joined by corridors of one cell, pillars. A drive gets 120 seconds of CPU at most. Exit code
    1 if vehicles met or entered lethal cells.
    """
    chosen = names_of(worlds, "worlds", CROWDS)
    some = parse_seeds(seeds)
    if agents > vehicles:
        raise ConfigError(f"--agents is {agents}, expected at most as many as --vehicles, {vehicles}")
    if 4 * vehicles > size * size:
        raise ConfigError(f"--vehicles is {vehicles}, expected at most a quarter of {size} x {size} cells")
    items = [(kind, seed) for seed in some for kind in chosen]
    with ThreadPoolExecutor(jobs) as pool:
        work = [pool.submit(isolated, drive_crowd, vehicles, agents, size, seconds, each) for each in items]
        drives = [each.result() for each in track(work)]
    drives.sort(key=lambda each: (chosen.index(each["world"]), each["seed"]))
    rows = [row_of(kind, [each for each in drives if each["world"] == kind]) for kind in chosen]
    if len(chosen) > 1:
        rows.append(row_of("all", drives))
    notes = list(_NOTES)
    if cut := sum(each["cut_short"] for each in drives):
        notes.append(f"Not measured to their end: {cut} drives, for each of which {LIMIT_S:g} s of CPU were up.")
    return {
        "vehicles": vehicles,
        "agents": agents,
        "side": size,
        "seconds": seconds,
        "seeds": seeds,
        "collisions": sum(each["collisions"] or 0 for each in drives),
        "lethal_entries": sum(each["lethal_entries"] or 0 for each in drives),
        "rows": rows,
        "drives": drives,
        "shown": {"rows": rows},
        "notes": notes,
    }


def row_of(name: str, drives: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The summary of several drives."""
    vehicles = sum(each["vehicles"] for each in drives) or 1
    simulated_s = sum(each["vehicles"] * each["simulated_s"] for each in drives) or 1.0
    cells = sum(each["driven_cells"] for each in drives) or 1.0
    worst = max(drives, key=lambda each: each["longest_wait_s"])
    flow, ideal, alone = (
        sum(each[key] for each in drives) / len(drives)
        for key in ("cells_per_step", "ideal_cells_per_step", "ideal_cells_per_step_without_following")
    )
    return {
        "world": name,
        "drives": len(drives),
        "cut_short": sum(each["cut_short"] for each in drives),
        "cells_per_step": flow,
        "over_ideal": flow / max(ideal, 1e-9),
        "over_ideal_without_following": flow / max(alone, 1e-9),
        "ideal_longest_wait_s": max(each["ideal_longest_wait_s"] for each in drives),
        "longest_wait_s": worst["longest_wait_s"],
        "longest_wait_seed": f"{worst['world']} {worst['seed']}",
        "waited_long_share": sum(each["waited_long"] for each in drives) / vehicles,
        "confined_long_share": sum(each["confined_long"] for each in drives) / vehicles,
        "arrivals_per_vehicle_and_100_s": 100 * sum(each["arrivals"] for each in drives) / simulated_s,
        "cpu_ms_per_cell": 1000 * sum(each["cpu_s"] for each in drives) / cells,
        "deliveries_per_cell": sum(each["deliveries"] for each in drives) / cells,
        "collisions": sum(each["collisions"] or 0 for each in drives),
        "lethal_entries": sum(each["lethal_entries"] or 0 for each in drives),
    }
