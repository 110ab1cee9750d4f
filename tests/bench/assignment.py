"""How soon targets are captured by each rule that says which vehicle chases which target.

A light chase on jacksboro's terrain: the project's trees, targets and `Assignment` of each agent, without messages,
claims or hidden ground. All rules meet the same starts and the same targets.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
import statistics
import time
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from bench.machine import machine
from bench.tables import Progress, number, table
from launch_scripts.launcher.options import find_scenario
from launch_scripts.simulation.simulate import simulate
from launch_scripts.simulation.world.walks import WALKS, Budget, TrueTerrain, Walker, WalkWorld
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.terrain.terrain import build_terrain
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.config.values import Walk
from swarm.grid import STEP_COL, STEP_ROW
from vehicle_agent.assignment import ASSIGNERS, Assignment, AssignmentWorld, shares_costs
from vehicle_agent.driving.vehicle import Vehicle
from vehicle_agent.group_costs import GroupCosts
from vehicle_agent.matching import need_first

Cells = NDArray[np.int64]
RULES = ("cheapest", "spread", "balanced")
ALONE = "each alone"
"""No rule: every target as if it were the only one, and all vehicles after it, from the start."""
PERIOD_S = 150.0
"""Real vehicles ask every 5 s of a run that is 30 times as fast as time."""
_TICK_S = 10.0
_HORIZON_S = 4 * 3600.0
_RANGE_CELLS = 1.5
_RESOLUTION_M = 150.0
_NO_STEP = 8


@dataclasses.dataclass(frozen=True)
class Row:
    """One kind of chase: `pursuers` vehicles must be near a target at a time to capture it, and it is gone then."""

    start: str
    vehicles: int
    targets: int
    walk: Walk
    speed_m_per_s: float
    pursuers: int = 1

    @property
    def name(self) -> str:
        evading = f", evading {self.speed_m_per_s:g} m/s, {self.pursuers} near" if self.walk == "evade" else ""
        return f"{self.vehicles} {self.start}, {self.targets} targets{evading}"


ROWS = (
    Row("clustered", 20, 5, "waypoints", 3.0),
    Row("clustered", 100, 10, "waypoints", 3.0),
    Row("clustered", 20, 5, "evade", 6.0, 3),
    Row("spread", 20, 5, "waypoints", 3.0),
    Row("spread", 100, 10, "waypoints", 3.0),
)


@dataclasses.dataclass
class Result:
    """Of one chase: when each target was captured (s), how often vehicles changed theirs, and all their trails.

    trails  (ticks, vehicles) cells, where they are kept; captures (s, cell)
    """

    captured_s: list[float]
    changes: int
    trails: list[Cells]
    captures: list[tuple[float, int]]


class World:
    """The terrain of the scenario jacksboro on cells of 150 m.

    per_agent  vehicles that an agent hosts
    """

    def __init__(self, per_agent: int = 25) -> None:
        self.per_agent = per_agent
        scenario = find_scenario("jacksboro")
        self.flat_m_per_s = scenario.cost.flat_speed_m_per_s
        coarse = msgspec.structs.replace(scenario.terrain, resolution_m=_RESOLUTION_M)
        terrain = build_terrain(msgspec.structs.replace(scenario, terrain=coarse))
        self.grid = terrain.grid
        self.pace = np.ascontiguousarray(terrain.pace_s_per_m, np.float32)
        self.truth = TrueTerrain(self.grid, self.pace)
        self.cost_grid = CostGrid(self.grid, PlannerConfig())
        self.cost_grid.load(self.pace)

    def starts(self, row: Row, chance: random.Random) -> Cells:
        if row.start == "spread":
            return np.array([self.truth.random_home(chance) for _ in range(row.vehicles)], np.int64)
        home, cols = self.truth.home, self.grid.cols
        centre = self.truth.random_home(chance)
        apart = abs(home // cols - centre // cols) + abs(home % cols - centre % cols)
        return home[np.argsort(apart, kind="stable")[: row.vehicles * 4 : 4]]


class _Agents:
    """The agents of one group and what they have assigned."""

    def __init__(self, world: World, row: Row, rule: str, cells: Cells, targets: Sequence[str]) -> None:
        self.vehicles: list[Vehicle] = []
        self.changes = 0
        self._hosts: list[tuple[Assignment, dict[str, Vehicle], slice]] = []
        self._requests = itertools.count(1)
        for n, first in enumerate(range(0, row.vehicles, world.per_agent)):
            some = slice(first, min(first + world.per_agent, row.vehicles))
            id = f"a{n}"
            hosted = {
                f"{id}-{m:02d}": Vehicle(f"{id}-{m:02d}", world.grid, cell)
                for m, cell in enumerate(cells[some].tolist())
            }
            assigner = ASSIGNERS[rule](AssignmentWorld(id, "all", tuple(targets), 0, row.pursuers))
            group = GroupCosts(f"all.{id}.1", "all", id) if shares_costs(assigner) else None
            share = first / row.vehicles
            self._hosts.append((Assignment(list(targets), assigner, PERIOD_S, share, group), hosted, some))
            self.vehicles += hosted.values()

    def capture(self, targets: Sequence[str], now_ns: int) -> None:
        """Only these are left: whoever chases another looks for a new one at once."""
        for assignment, hosted, _ in self._hosts:
            assignment.set_targets(list(targets))
            for vehicle in hosted.values():
                if vehicle.target not in targets:
                    vehicle.release()
            assignment.ask_soon(now_ns)

    def reassign(self, costs_s: dict[str, NDArray[np.float32]], now_ns: int) -> None:
        """All agents whose time has come, one after the other, with costs (vehicles,) of each target."""
        alive = dict.fromkeys(costs_s, 1)
        for assignment, hosted, some in self._hosts:
            if not assignment.due(now_ns):
                continue
            request = next(self._requests)
            assignment.ask(request, hosted, now_ns)
            for target, column in costs_s.items():
                assignment.costs_given(request, target, column[some])
            had = [vehicle.target for vehicle in hosted.values()]
            told = assignment.costs_ended(request, hosted, alive, now_ns)
            for old, vehicle in zip(had, hosted.values(), strict=True):
                self.changes += vehicle.target != old
            for other, _, _ in self._hosts:
                if told is not None and other is not assignment:
                    other.hear(told, now_ns)


def chase(
    world: World, row: Row, rule: str, seed: int, only: int | None = None, keep_trails: bool = False
) -> Result:
    """One chase until the last target is captured, or for four hours.

    only  the one target that there is to chase; all if not given
    """
    grid, cost_grid = world.grid, world.cost_grid
    chance = random.Random(f"assignment/{row.start}/{row.vehicles}/{seed}")
    cells = world.starts(row, chance)
    ids = [f"t{n}" for n in range(row.targets)]
    slowness = max(1.0, world.flat_m_per_s / row.speed_m_per_s)
    walkers = [_walker(world, row, id, slowness, seed, world.truth.random_home(chance)) for id in ids]
    trees = [CostToGoTree(cost_grid) for _ in ids]
    parents = np.full((row.targets, cost_grid.size), _NO_STEP, np.int64)
    open_targets = list(range(row.targets)) if only is None else [only]
    agents = _Agents(world, row, rule, cells, [ids[n] for n in open_targets])
    steps_m = np.array([math.hypot(r, c) for r, c in zip(STEP_ROW, STEP_COL, strict=True)])
    offsets = np.array([r * cost_grid.stride + c for r, c in zip(STEP_ROW, STEP_COL, strict=True)])
    at, left_s = cost_grid.pad_all(cells), np.zeros(row.vehicles)
    result = Result([_HORIZON_S] * row.targets, 0, [], [])
    now_s = 0.0
    while open_targets and now_s < _HORIZON_S:
        for n in open_targets:
            if trees[n].root != walkers[n].cell:
                trees[n].grow(walkers[n].cell)
                parents[n] = np.minimum(trees[n].parent, _NO_STEP)
        agents.reassign({ids[n]: trees[n].cost[at] for n in open_targets}, int(now_s * NS_PER_S) + 1)
        chased = np.array([-1 if v.target is None else ids.index(v.target) for v in agents.vehicles])
        _drive(at, left_s, chased, parents, cost_grid.cell_cost, (offsets, steps_m))
        cells = cost_grid.unpad_all(at)
        for vehicle, cell in zip(agents.vehicles, cells.tolist(), strict=True):
            vehicle.motion.put(cell)
        for n in open_targets:
            walkers[n].advance(world.truth, _TICK_S, cells)
        now_s += _TICK_S
        if keep_trails:
            result.trails.append(cells.copy())
        rows, cols = np.divmod(cells, grid.cols)
        for n in list(open_targets):
            row_of, col_of = divmod(walkers[n].cell, grid.cols)
            if (np.hypot(rows - row_of, cols - col_of) <= _RANGE_CELLS).sum() >= row.pursuers:
                open_targets.remove(n)
                result.captured_s[n] = now_s
                result.captures.append((now_s, walkers[n].cell))
                agents.capture([ids[m] for m in open_targets], int((now_s - 1.0) * NS_PER_S))
    result.changes = agents.changes - row.vehicles
    return result


def _walker(world: World, row: Row, id: str, slowness: float, seed: int, cell: int) -> Walker:
    walk = WALKS[row.walk](WalkWorld(id, world.truth, random.Random(f"{seed}/{id}"), Budget()))
    return Walker(id, walk, slowness, cell)


def _drive(
    at: Cells,
    left_s: NDArray[np.float64],
    chased: Cells,
    parents: Cells,
    cell_cost: NDArray[np.float32],
    steps: tuple[Cells, NDArray[np.float64]],
) -> None:
    """Every vehicle drives for a tick along the tree of its target; `left_s` is what it has of the next step."""
    offsets, lengths = steps
    left_s += _TICK_S
    going = np.flatnonzero(chased >= 0)
    while going.size:
        direction = parents[chased[going], at[going]]
        there = direction == _NO_STEP
        left_s[going[there]] = 0.0
        going, direction = going[~there], direction[~there]
        to = at[going] + offsets[direction]
        cost_s = cell_cost[to] * lengths[direction]
        enough = cost_s <= left_s[going]
        going = going[enough]
        left_s[going] -= cost_s[enough]
        at[going] = to[enough]


def each_alone(world: World, row: Row, seed: int) -> Result:
    """Every target captured as if it were the only one."""
    alone = [chase(world, row, "cheapest", seed, n).captured_s[n] for n in range(row.targets)]
    return Result(alone, 0, [], [])


def run(world: World, rows: Sequence[Row], seeds: range, alone: bool, progress: Progress) -> dict[str, Any]:
    """Every rule on every row and seed: mean time to capture, time of the last and changes, beside `cheapest`."""
    found = []
    rules = (*RULES, ALONE) if alone else RULES
    done, total = 0, len(rows) * len(seeds) * len(rules)
    for row in rows:
        results: dict[str, list[Result]] = {rule: [] for rule in rules}
        for seed in seeds:
            for rule in rules:
                results[rule].append(
                    each_alone(world, row, seed) if rule == ALONE else chase(world, row, rule, seed)
                )
                done += 1
                progress(done, total)
        found += [_figures(row, rule, results[rule], results["cheapest"]) for rule in rules]
    return {"rows": found, "seeds": f"{seeds.start}:{seeds.stop}", "solve": solve_ms(), **machine()}


def _figures(row: Row, rule: str, mine: list[Result], base: list[Result]) -> dict[str, Any]:
    def mean(some: list[Result]) -> list[float]:
        return [statistics.fmean(each.captured_s) for each in some]

    def last(some: list[Result]) -> list[float]:
        return [max(each.captured_s) for each in some]

    gains = [a - b for a, b in zip(mean(mine), mean(base), strict=True)]
    spread = statistics.stdev(gains) / math.sqrt(len(gains)) if len(gains) > 1 else 0.0
    captured = [each for result in mine for each in result.captured_s]
    return {
        "row": row.name,
        "rule": rule,
        "mean_s": statistics.fmean(mean(mine)),
        "last_s": statistics.fmean(last(mine)),
        "mean_ratio": statistics.fmean(mean(mine)) / statistics.fmean(mean(base)),
        "last_ratio": statistics.fmean(last(mine)) / statistics.fmean(last(base)),
        "paired_s": statistics.fmean(gains),
        "paired_error_s": spread,
        "better": sum(gain < 0 for gain in gains),
        "changes_per_vehicle": statistics.fmean(each.changes for each in mine) / row.vehicles,
        "never": sum(each >= _HORIZON_S for each in captured) / len(captured),
    }


def run_simulated(seeds: range, progress: Progress) -> dict[str, Any]:
    """The scenario `clustered` in whole, by each rule: captures in its time, of every seed."""
    scenario = find_scenario("clustered")
    found: list[dict[str, Any]] = [{"rule": rule} for rule in RULES]
    for n, (seed, row) in enumerate(itertools.product(seeds, found)):
        groups = tuple(msgspec.structs.replace(group, assignment=row["rule"]) for group in scenario.groups)
        report = simulate(msgspec.structs.replace(scenario, groups=groups), seed).report
        row[f"captures_{seed}"] = report["captures"]
        progress(n + 1, len(seeds) * len(RULES))
    return {"captures": found, "seconds": scenario.seconds, **machine()}


def solve_ms(targets: int = 30, vehicles: int = 100, repeats: int = 20) -> dict[str, float]:
    """CPU time of one matching, ms, median: of vehicles spread and clustered, at first and with targets to keep."""
    chance = np.random.default_rng(1)
    near = chance.uniform(500, 2500, (targets, 1)) + chance.uniform(0, 150, (targets, vehicles))
    found = {}
    for name, costs_s in (("spread", chance.uniform(0, 1000, (targets, vehicles))), ("clustered", near)):
        first = [-1] * vehicles
        chosen = need_first(costs_s, first, 1)
        kept = np.where(chosen < 0, costs_s.argmin(0), chosen).tolist()
        moved = costs_s * chance.uniform(0.97, 1.03, costs_s.shape)
        for when, current in (("first", first), ("later", kept)):
            spent = []
            for _ in range(repeats):
                began_s = time.thread_time()
                need_first(moved, current, 1)
                spent.append(1e3 * (time.thread_time() - began_s))
            found[f"{name}_{when}"] = statistics.median(spent)
    return found


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    for name, rows in itertools.groupby(report["rows"], key=lambda row: str(row["row"])):
        shown = table(
            name, "<rule", "mean s", "last s", "mean x", "last x", "paired s", "better", "changes", "never"
        )
        for each in rows:
            shown.add_row(
                each["rule"],
                number(each["mean_s"]),
                number(each["last_s"]),
                f"{each['mean_ratio']:.2f}",
                f"{each['last_ratio']:.2f}",
                f"{each['paired_s']:+.0f} +- {each['paired_error_s']:.0f}",
                str(each["better"]),
                f"{each['changes_per_vehicle']:.1f}",
                f"{100 * each['never']:.0f} %",
            )
        yield shown
    solve = ", ".join(f"{name.replace('_', ' ')} {ms:.1f}" for name, ms in report["solve"].items())
    yield f"A matching of 100 vehicles and 30 targets, ms of CPU: {solve}. Seeds {report['seeds']}."
