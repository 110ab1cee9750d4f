"""How crowds drive: dense worlds over many seeds, without faults, seen through what agents publish.

A step is the time in which a vehicle drives one straight cell. A vehicle waits while it stands on one cell and has
its target not within reach, whatever the reason.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from rich.table import Table

from bench.isolated import TimeLimit
from bench.machine import machine
from bench.tables import Progress, table
from launch_scripts.simulation.campaign import in_processes
from swarm.runtime.garbage import collected_rarely
from swarm.wire.fields import column
from swarm.wire.messages.vehicles import Fleet, VehicleState

STEP_S = 0.1
"""The pace of `worlds.crowd`: seconds a cell, and the period of its agents' ticks."""
LONG_S = 10.0
WANTED_LONGEST_S, WANTED_LONG_SHARE = 15.0, 0.005
"""Goals of the project."""
LIMIT_S = 120.0
"""Seconds of CPU for a drive; what is not done by then is left out."""
_BOX_CELLS = 2
"""A vehicle is confined while it stays within so many cells of one, in every direction."""


class Drives:
    """How vehicles drive, from the reports of their agents, one for each tick. Pure."""

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


def try_crowd(vehicles: int, agents: int, side: int, seconds: float, which: tuple[str, int]) -> dict[str, Any]:
    """Drive one crowd: a world and a seed."""
    from launch_scripts.simulation.simulate import Simulation
    from launch_scripts.simulation.worlds import crowd
    from swarm.bus.bus import Event, Heard
    from swarm.wire.topics import FLEET

    kind, seed = which
    scenario, terrain = crowd(kind, seed, vehicles, -(-vehicles // agents), side)
    began_s = time.perf_counter()
    simulation, limit = Simulation(scenario, terrain=terrain), TimeLimit(LIMIT_S)
    drives = Drives(terrain.grid.cols)

    def hear(event: Event) -> None:
        assert isinstance(event, Heard)
        assert isinstance(event.message, Fleet)
        drives.hear(event.message)

    simulation.network.bus("crowd-0", scenario.network.namespace).subscribe(FLEET, hear)
    with collected_rarely():
        while simulation.now_s < seconds and not limit.is_up:
            simulation.run_until(min(simulation.now_s + 0.5, seconds))
    report = simulation.report(simulation.now_s)
    waits_s = [STEP_S * ticks for ticks in drives.longest_wait.values()]
    confined_s = [STEP_S * ticks for ticks in drives.longest_confined.values()]
    return {
        "world": kind,
        "seed": seed,
        "simulated_s": simulation.now_s,
        "cut_short": simulation.now_s < seconds - 1e-6,
        "wall_s": time.perf_counter() - began_s,
        "vehicles": len(waits_s),
        "cells_per_step": drives.driven_cells / max(drives.ticks_out_of_reach, 1),
        "longest_wait_s": max(waits_s, default=0.0),
        "waited_long": sum(each > LONG_S for each in waits_s),
        "confined_long": sum(each > LONG_S for each in confined_s),
        "arrivals": drives.arrivals,
        "captures": report["captures"],
        "collisions": report["collisions"],
        "lethal_entries": report["lethal_entries"],
    }


def run(
    worlds: Sequence[str],
    seeds: Sequence[int],
    *,
    vehicles: int,
    agents: int,
    side: int,
    seconds: float,
    jobs: int,
    progress: Progress,
) -> dict[str, Any]:
    """Every seed of every world; a row for each world, and one for all. The single drives are in `drives`."""
    items = [(kind, seed) for seed in seeds for kind in worlds]
    drives = []
    for drive in in_processes(functools.partial(try_crowd, vehicles, agents, side, seconds), items, jobs):
        drives.append(drive)
        progress(len(drives), len(items))
    drives.sort(key=lambda each: (worlds.index(each["world"]), each["seed"]))
    rows = [row_of(kind, [each for each in drives if each["world"] == kind]) for kind in worlds]
    if len(worlds) > 1:
        rows.append(row_of("all", drives))
    return {
        "vehicles": vehicles,
        "agents": agents,
        "side": side,
        "seconds": seconds,
        "seeds": [seeds[0], seeds[-1] + 1],
        "wanted": {"longest_wait_s": WANTED_LONGEST_S, "waited_long_share": WANTED_LONG_SHARE},
        "rows": rows,
        "drives": drives,
        **machine(),
    }


def row_of(name: str, drives: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What several drives come to."""
    vehicles = sum(each["vehicles"] for each in drives) or 1
    simulated_s = sum(each["vehicles"] * each["simulated_s"] for each in drives) or 1.0
    worst = max(drives, key=lambda each: each["longest_wait_s"])
    return {
        "world": name,
        "drives": len(drives),
        "cut_short": sum(each["cut_short"] for each in drives),
        "cells_per_step": sum(each["cells_per_step"] for each in drives) / len(drives),
        "longest_wait_s": worst["longest_wait_s"],
        "longest_wait_seed": f"{worst['world']} {worst['seed']}",
        "waited_long_share": sum(each["waited_long"] for each in drives) / vehicles,
        "confined_long_share": sum(each["confined_long"] for each in drives) / vehicles,
        "arrivals_per_vehicle_and_100_s": 100 * sum(each["arrivals"] for each in drives) / simulated_s,
        "collisions": sum(each["collisions"] or 0 for each in drives),
        "lethal_entries": sum(each["lethal_entries"] or 0 for each in drives),
    }


_MEANING = (
    "Cells a step: while the target is not within reach; 1 is a straight drive at full speed. A wait: on one cell, "
    "target not within reach. Confined: within 5 x 5 cells. Arrivals: a vehicle and 100 s."
)
COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("world", lambda row: str(row["world"])),
    ("cells\na step", lambda row: f"{row['cells_per_step']:.2f}"),
    ("longest\nwait, s", lambda row: f"{row['longest_wait_s']:.1f}"),
    ("in\nseed", lambda row: str(row["longest_wait_seed"])),
    ("waited\n> 10 s, %", lambda row: f"{100 * row['waited_long_share']:.2f}"),
    ("confined\n> 10 s, %", lambda row: f"{100 * row['confined_long_share']:.2f}"),
    ("arri-\nvals", lambda row: f"{row['arrivals_per_vehicle_and_100_s']:.2f}"),
    ("colli-\nsions", lambda row: str(row["collisions"])),
    ("lethal\nentries", lambda row: str(row["lethal_entries"])),
)
"""Heading and value of each column."""


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    headings = (f"<{heading}" if heading in ("world", "in\nseed") else heading for heading, _ in COLUMNS)
    found = table("How crowds drive", *headings)
    for row in report["rows"]:
        found.add_row(*(write(row) for _, write in COLUMNS))
    yield found
    yield from remarks(report)


def remarks(report: dict[str, Any]) -> list[str]:
    """What has to be known to read the figures."""
    first, end = report["seeds"]
    which = (
        f"{report['vehicles']} vehicles of {report['agents']} agents on {report['side']} x {report['side']} cells, "
        f"seeds {first} to {end - 1}, {report['seconds']:g} simulated seconds each, no faults."
    )
    wanted = (
        f"Wanted: no wait over {WANTED_LONGEST_S:g} s, at most {100 * WANTED_LONG_SHARE:g} % of vehicles ever over "
        f"{LONG_S:g} s."
    )
    found = [which, _MEANING, wanted]
    if cut := sum(each["cut_short"] for each in report["drives"]):
        found.append(f"Not measured to their end: {cut} drives, for each of which {LIMIT_S:g} s of CPU were up.")
    return found


def broken(report: dict[str, Any]) -> bool:
    """Whether vehicles met or drove where nobody can."""
    return any(each["collisions"] or each["lethal_entries"] for each in report["drives"])
