"""How soon vehicles see a target again that nobody sees: a light loop over a scenario's terrain.

The planner's own search says who looks where. Vehicles drive its routes at the pace of the ground; there are no
claims, no messages and no hidden ground, and a target within range is seen.
"""

from __future__ import annotations

import math
import random
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from rich.table import Table

from bench.tables import Progress, table
from launch_scripts.simulation.world.walks import WALKS, Budget, TrueTerrain, Walker, WalkWorld, slowness_of
from planner_service.search.searcher import Searcher
from planner_service.search.ways import Ways
from planner_service.tree.cost_grid import CostGrid
from shared_map.terrain.terrain import build_terrain
from swarm.config.scenario import Scenario, TargetConfig
from swarm.grid import walk
from swarm.wire.routes import Route

STRATEGIES = ("stay", "random", "belief")
"""Nobody moves; all to the last sighting, then to random places within reach of it; the planner's search."""
TICK_S = 10.0


@dataclass(slots=True)
class Driver:
    """A vehicle on its way, cell by cell."""

    cell: int
    cells: list[int] = field(default_factory=list)
    left_s: float = 0.0

    def drive(self, terrain: TrueTerrain, seconds: float) -> None:
        """Drive on; what is left of a step is kept."""
        self.left_s += seconds
        while self.cells:
            needed_s = terrain.step_s(self.cell, self.cells[0])
            if needed_s > self.left_s:
                return
            self.left_s -= needed_s
            self.cell = self.cells.pop(0)
        self.left_s = 0.0


@dataclass(frozen=True)
class Ground:
    """The terrain that all runs share."""

    scenario: Scenario
    terrain: TrueTerrain
    costs: CostGrid

    @classmethod
    def of(cls, scenario: Scenario) -> Ground:
        """Raises ConfigError or TerrainError as `build_terrain`."""
        built = build_terrain(scenario)
        costs = CostGrid(built.grid, scenario.planner, built.climb)
        costs.load(built.pace_s_per_m)
        return cls(scenario, TrueTerrain(built.grid, built.pace_s_per_m, built.climb), costs)

    def metres(self, cell: int) -> tuple[float, float]:
        """(east, south) of a cell's middle from the grid's corner."""
        row, col = divmod(cell, self.terrain.grid.cols)
        return (col + 0.5) * self.terrain.grid.resolution_m, (row + 0.5) * self.terrain.grid.resolution_m


class Run:
    """One run: a target is lost, and searched for until it is seen or the time is over.

    near  vehicles start within the sensor's range of where it was lost, instead of anywhere
    """

    def __init__(self, ground: Ground, name: str, vehicles: int, lost_s: float, seed: int, near: bool) -> None:
        scenario, terrain = ground.scenario, ground.terrain
        chance = random.Random(f"{seed}")
        self.ground = ground
        self.range_m = scenario.vehicles.sense_range_m
        config = TargetConfig(name="t", walk=name, speed_m_per_s=scenario.targets[0].speed_m_per_s)
        homes = [terrain.random_home(chance) for _ in range(vehicles)]
        self.last = terrain.random_home(chance)
        if near:
            cells = terrain.home
            rows, cols = np.divmod(cells, terrain.grid.cols)
            row, col = divmod(self.last, terrain.grid.cols)
            close = cells[np.hypot(rows - row, cols - col) * terrain.grid.resolution_m <= self.range_m]
            homes = [int(close[chance.randrange(len(close))]) for _ in range(vehicles)]
        self.drivers = [Driver(cell) for cell in homes]
        self.budget = Budget()
        world = WalkWorld("t", terrain, random.Random(f"{seed}/walk"), self.budget)
        self.slowness = slowness_of(config, scenario.cost)
        self.target = Walker("t", WALKS[name](world), self.slowness, self.last)
        self.lost_s = lost_s
        self.move(lost_s)
        self.chance = chance
        self.seed = f"{seed}"
        self.decisions = 0
        self.cpu_s: list[float] = []

    def move(self, seconds: float) -> None:
        """The target walks on."""
        cells = np.array([driver.cell for driver in self.drivers], np.int64)
        self.target.advance(self.ground.terrain, seconds, cells)

    @property
    def seen(self) -> bool:
        grid = self.ground.terrain.grid
        row, col = divmod(self.target.cell, grid.cols)
        return any(
            math.hypot(driver.cell // grid.cols - row, driver.cell % grid.cols - col) * grid.resolution_m
            <= self.range_m
            for driver in self.drivers
        )

    def time_s(self, strategy: str, hours: float) -> float:
        """Seconds until it is seen; inf if it is not."""
        send = {"stay": lambda now_s: None, "random": self._random(), "belief": self._belief()}[strategy]
        now_s = 0.0
        while now_s < hours * 3600.0:
            if self.seen:
                return now_s
            send(now_s)
            for driver in self.drivers:
                driver.drive(self.ground.terrain, TICK_S)
            self.move(TICK_S)
            now_s += TICK_S
        return math.inf

    def _random(self) -> Callable[[float], None]:
        ways = Ways(self.ground.costs)
        ways.grow(self.last)
        reach_s = ways.costs_s.reshape(-1).astype(np.float64) * self.slowness
        sent: set[int] = set()

        def send(now_s: float) -> None:
            for number, driver in enumerate(self.drivers):
                if driver.cells:
                    continue
                cells = np.flatnonzero(reach_s <= now_s + self.lost_s)
                goal = int(cells[self.chance.randrange(len(cells))]) if number in sent else self.last
                sent.add(number)
                ways.grow(driver.cell)
                self.decisions += 1
                if goal != driver.cell and np.isfinite(ways.costs_s.flat[goal]):
                    driver.cells = list(ways.way_to(goal).cells[1:])

        return send

    def _belief(self) -> Callable[[float], None]:
        ways = Ways(self.ground.costs)
        searcher = Searcher(ways, self.range_m, self.slowness, self.seed)
        searcher.begin(self.ground.terrain.pace_s_per_m, self.last, self.lost_s)
        grid = self.ground.terrain.grid

        def send(now_s: float) -> None:
            searcher.tick(TICK_S if now_s else 0.0, [self.ground.metres(driver.cell) for driver in self.drivers])
            for number, driver in enumerate(self.drivers):
                if (driver.cells and not searcher.wants_place(f"{number}")) or not searcher.may_decide:
                    continue
                began_s = time.thread_time()
                route: Route = searcher.route(ways, f"{number}", driver.cell, 0, 0)[0]
                self.cpu_s.append(time.thread_time() - began_s)
                driver.cells = list(walk(grid, route.start, route.directions))[1:]
            self.decisions = searcher.decisions

        return send


def run(
    scenario: Scenario,
    walks: Sequence[str],
    strategies: Sequence[str],
    seeds: range,
    vehicles: int,
    lost_s: float,
    hours: float,
    near: bool,
    progress: Progress,
) -> dict[str, Any]:
    """A report: of each walk and strategy the seconds of each seed, null for never."""
    ground = Ground.of(msgspec.structs.replace(scenario))
    rows, done, total = [], 0, len(walks) * len(strategies) * len(seeds)
    for name in walks:
        for strategy in strategies:
            times: list[float] = []
            decisions: list[int] = []
            cpu_s: list[float] = []
            for seed in seeds:
                each = Run(ground, name, vehicles, lost_s, seed, near)
                times.append(each.time_s(strategy, hours))
                decisions.append(each.decisions)
                cpu_s += each.cpu_s
                done += 1
                progress(done, total)
            rows.append(
                {
                    "walk": name,
                    "strategy": strategy,
                    **_figures(times),
                    "decisions": statistics.mean(decisions),
                    "decision_ms": 1e3 * statistics.median(cpu_s) if cpu_s else None,
                    "times_s": [None if math.isinf(each) else each for each in times],
                }
            )
    return {
        "runs": rows,
        "seeds": f"{seeds.start}:{seeds.stop}",
        "vehicles": vehicles,
        "lost_s": lost_s,
        "hours": hours,
    }


def joined(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One report of several with other seeds."""
    together: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for report in reports:
        for row in report["runs"]:
            together.setdefault((row["walk"], row["strategy"]), []).append(row)
    rows = []
    for (name, strategy), parts in together.items():
        times = [math.inf if each is None else each for part in parts for each in part["times_s"]]
        counts = [len(part["times_s"]) for part in parts]
        decisions = sum(part["decisions"] * many for part, many in zip(parts, counts, strict=True)) / sum(counts)
        cpu = [part["decision_ms"] for part in parts if part["decision_ms"] is not None]
        rows.append(
            {
                "walk": name,
                "strategy": strategy,
                **_figures(times),
                "decisions": decisions,
                "decision_ms": statistics.median(cpu) if cpu else None,
                "times_s": [None if math.isinf(each) else each for each in times],
            }
        )
    return {**reports[0], "runs": rows, "seeds": ", ".join(report["seeds"] for report in reports)}


def _figures(times: Sequence[float]) -> dict[str, Any]:
    """The median lies between the two of `median_95_s` with 95 %, whatever the times are distributed like: so many
    ranks from the middle of the runs (null: never)."""
    ordered, many = sorted(times), len(times)
    off = 0.98 * math.sqrt(many)
    between = (ordered[max(math.floor(many / 2 - off), 0)], ordered[min(math.ceil(many / 2 + off), many) - 1])
    median, *ends = (None if math.isinf(each) else each for each in (statistics.median(ordered), *between))
    never = sum(map(math.isinf, times)) / many
    return {"runs": many, "median_s": median, "median_95_s": ends, "never": never}


def tables(report: dict[str, Any]) -> list[Table | str]:
    """For people."""
    title = f"{report['vehicles']} vehicles, lost for {report['lost_s']:g} s, {report['hours']:g} h"
    found = table(title, "<walk", "<strategy", "runs", "median s", "95 %", "never %", "decisions", "ms each")
    for row in report["runs"]:
        median, cpu = row["median_s"], row["decision_ms"]
        found.add_row(
            row["walk"],
            row["strategy"],
            str(row["runs"]),
            "-" if median is None else f"{median:,.0f}",
            " to ".join("-" if each is None else f"{each:,.0f}" for each in row["median_95_s"]),
            f"{100 * row['never']:.0f}",
            f"{row['decisions']:.0f}",
            "-" if cpu is None else f"{cpu:.1f}",
        )
    return [found]
