"""What the live view costs: CPU time of a frame, and bytes of recording, by the number of vehicles.

Made-up vehicles drive down real trees on made-up ground. What they say goes straight into the monitor's service,
which draws to a real file, ten times a second by the wall clock: rerun packs by it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.table import Table

from bench.machine import machine
from bench.tables import Progress, number, table
from launch_scripts.monitor.blueprint import make_blueprint
from launch_scripts.monitor.ground.terrain_mesh import TerrainMesh
from launch_scripts.monitor.loading import FRAME_HZ
from launch_scripts.monitor.service import MonitorService
from launch_scripts.monitor.serving.sinks import Sinks
from planner_service.tree.bounds import LowerBounds
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.route_reading import read_routes
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.bus.bus import Heard
from swarm.bus.memory_bus import MemoryNetwork
from swarm.bus.memory_links import PerfectLinks
from swarm.bus.scheduler import Scheduler
from swarm.clock import NS_PER_S, ManualClock
from swarm.config.agents import AgentPlan, plan_agents
from swarm.config.ground import TerrainConfig
from swarm.config.scenario import GroupConfig, MonitorConfig, PlannerConfig, Scenario, TargetConfig, VehicleConfig
from swarm.grid import STEP_COL, STEP_ROW, walk
from swarm.liveness import Peer
from swarm.runtime.role import RoleSetup
from swarm.wire.fields import pack_column
from swarm.wire.messages.base import Message
from swarm.wire.messages.targets import TargetPose
from swarm.wire.messages.vehicles import Fleet, Followed, VehicleState
from swarm.wire.topics import FLEET, FOLLOWED, POSE, Topic

SIDE_CELLS = 512
_CELLS_PER_S = 2.0
_RENEWED_S = 8.0
"""Each vehicle begins a new route so often: its target moves."""
_WARM_UP_S = 3.0
"""The first frames draw the ground and begin all routes; they are not measured."""
_MOST_STATES = (VehicleState.FOLLOWING,) * 16 + (VehicleState.WAITING, VehicleState.IDLE)


def scenario_of(vehicles: int, targets: int, groups: int, seed: int) -> Scenario:
    """Many vehicles on made-up mountains of 10 km x 10 km."""
    shares = [vehicles // groups + (n < vehicles % groups) for n in range(groups)]
    names = ["all"] if groups == 1 else [f"group{n + 1}" for n in range(groups)]
    return Scenario(
        name=f"view-{vehicles}",
        seed=seed,
        terrain=TerrainConfig(
            source="synthetic", rows=SIDE_CELLS, cols=SIDE_CELLS, resolution_m=20, relief_m=400, roads=24, rivers=2
        ),
        targets=(TargetConfig(name="t", count=targets),),
        groups=tuple(GroupConfig(name=name, vehicles=n) for name, n in zip(names, shares, strict=True) if n),
        vehicles=VehicleConfig(per_agent=25),
        monitor=MonitorConfig(live=False),
    )


class _MadeUpSwarm:
    """Says what vehicles and targets would say, frame by frame."""

    def __init__(self, scenario: Scenario, terrain: Terrain) -> None:
        self._scenario = scenario
        self._grid = terrain.grid
        self._rng = np.random.default_rng(scenario.seed)
        self._cost_grid = CostGrid(terrain.grid, PlannerConfig())
        self._cost_grid.load(terrain.pace_s_per_m)
        self._tree = CostToGoTree(self._cost_grid)
        self._bounds = LowerBounds(self._cost_grid)
        self._plans = plan_agents(scenario)
        self._open = np.flatnonzero(np.isfinite(terrain.pace_s_per_m))
        self._is_open = frozenset(self._open.tolist())
        self._targets = {id: int(self._rng.choice(self._open)) for id in scenario.target_ids}
        ids = [id for plan in self._plans for id in plan.vehicle_ids]
        self._cells = dict(zip(ids, self._rng.choice(self._open, len(ids)).tolist(), strict=True))
        self._chased = {id: self._nearest(cell) for id, cell in self._cells.items()}
        self._states = dict(zip(ids, self._rng.choice(_MOST_STATES, len(ids)).tolist(), strict=True))
        self._ways: dict[str, tuple[list[int], float]] = {}
        """Vehicle -> the cells of its route, and how many of them it has driven."""

    def frames(self, count: int) -> Iterator[list[tuple[Topic, Message]]]:
        """What is said before each frame. Of every target's chasers a share begins a new route in each."""
        renewing_s = _RENEWED_S / len(self._targets)
        due_s = dict.fromkeys(self._targets, 0.0)
        for frame in range(count):
            now_s = frame / FRAME_HZ
            said: list[tuple[Topic, Message]] = []
            for n, id in enumerate(self._targets):
                if now_s >= due_s[id]:
                    due_s[id] = now_s + (_RENEWED_S if now_s > 0 else _RENEWED_S / 2 + n * renewing_s)
                    self._wander(id)
                    said += self._renewed(id)
            said += [(FLEET, self._fleet(plan, frame + 1)) for plan in self._plans]
            said += [(POSE, self._pose(id, frame + 1)) for id in self._targets]
            yield said

    def _nearest(self, cell: int) -> str:
        return min(self._targets, key=lambda id: self._grid.distance_cells(self._targets[id], cell))

    def _wander(self, id: str) -> None:
        row, col = self._grid.row_col(self._targets[id])
        for direction in self._rng.permutation(8).tolist():
            there = row + 2 * STEP_ROW[direction], col + 2 * STEP_COL[direction]
            if self._grid.inside(*there) and self._grid.cell(*there) in self._is_open:
                self._targets[id] = self._grid.cell(*there)
                return

    def _renewed(self, target: str) -> list[tuple[Topic, Message]]:
        self._tree.grow(self._targets[target])
        ids = [id for id, chased in self._chased.items() if chased == target]
        asked = np.array([self._cells[id] for id in ids], np.int64)
        batch = read_routes(self._tree, self._bounds, asked, self._scenario.vehicles.route_cells)
        said: list[tuple[Topic, Message]] = []
        for n, id in enumerate(ids):
            route = batch[n]
            if len(route.directions) < 2:
                self._cells[id] = int(self._rng.choice(self._open))
                continue
            self._ways[id] = (walk(self._grid, int(asked[n]), route.directions), 0.0)
            begun = Followed(
                vehicle=id,
                target=target,
                start=int(asked[n]),
                directions=route.directions,
                cost_s=route.cost_s,
                lower_bound_s=route.lower_bound_s,
            )
            said.append((FOLLOWED, begun))
        return said

    def _fleet(self, plan: AgentPlan, seq: int) -> Fleet:
        places: list[tuple[float, float]] = []
        for id in plan.vehicle_ids:
            way, driven = self._ways.get(id, ([self._cells[id]], 0.0))
            if self._states[id] == VehicleState.FOLLOWING:
                driven = min(driven + _CELLS_PER_S / FRAME_HZ, len(way) - 1.0)
            self._ways[id] = way, driven
            self._cells[id] = way[int(driven)]
            here, there = (
                self._grid.row_col(cell) for cell in (way[int(driven)], way[min(int(driven) + 1, len(way) - 1)])
            )
            share = driven % 1
            row, col = (a + (b - a) * share + 0.5 for a, b in zip(here, there, strict=True))
            places.append((col * self._grid.resolution_m, row * self._grid.resolution_m))
        ids = plan.vehicle_ids
        target_ids = sorted({self._chased[id] for id in ids})
        east_m, south_m = zip(*places, strict=True)
        return Fleet(
            author=f"{plan.id}.1",
            group=plan.group.name,
            region=0,
            seq=seq,
            stamp_ns=int(seq / FRAME_HZ * NS_PER_S),
            ids=ids,
            target_ids=target_ids,
            cells=pack_column([self._cells[id] for id in ids], "<u4"),
            east_m=pack_column(east_m, "<f4"),
            south_m=pack_column(south_m, "<f4"),
            heading_rad=pack_column([0.0] * len(ids), "<f4"),
            states=bytes(int(self._states[id]) for id in ids),
            targets=bytes(target_ids.index(self._chased[id]) for id in ids),
        )

    def _pose(self, id: str, seq: int) -> TargetPose:
        x_m, y_m = self._grid.centre_m(self._targets[id])
        return TargetPose(target=id, incarnation=1, seq=seq, stamp_ns=seq, cell=self._targets[id], x_m=x_m, y_m=y_m)


def run_view(
    vehicles: tuple[int, ...],
    targets: int,
    groups: int,
    seconds: float,
    seed: int,
    keep: Path | None,
    progress: Progress,
) -> dict[str, Any]:
    """A row for each number of vehicles."""
    rows = []
    for done, count in enumerate(vehicles):
        progress(done, len(vehicles))
        scenario = scenario_of(count, targets, groups, seed)
        if keep is not None:
            rows.append(_measured(scenario, seconds, keep))
            continue
        with TemporaryDirectory() as folder:
            rows.append(_measured(scenario, seconds, Path(folder, "run.rrd")))
    return {"view": rows, **machine()}


def _measured(scenario: Scenario, seconds: float, path: Path) -> dict[str, Any]:
    terrain = build_terrain(scenario)
    frames = int((seconds + _WARM_UP_S) * FRAME_HZ)
    told = list(_MadeUpSwarm(scenario, terrain).frames(frames))
    mesh = TerrainMesh(terrain)
    sinks = Sinks(
        "bench",
        path,
        scenario.monitor,
        make_blueprint(mesh, vehicles=scenario.vehicle_count),
    )
    network = MemoryNetwork(Scheduler(ManualClock(0)), PerfectLinks())
    setup = RoleSetup(scenario, "bench", "monitor", "0", 1, 0)
    service = MonitorService(setup, terrain, network.bus("monitor"), lambda event: None, sinks.streams, mesh=mesh)
    service.start(0)
    for role, id in [("keeper", "k0"), ("targets", "0"), *(("planner", id) for id in scenario.target_ids)]:
        service.figures.alive(Peer(role, id, 1), True, 0)
    took_ms, told_ms = np.zeros(frames), np.zeros(frames)
    first = int(_WARM_UP_S * FRAME_HZ)
    sinks.rec.flush(timeout_sec=10)
    began_s, before, process_s = time.monotonic(), 0, 0.0
    for frame, messages in enumerate(told):
        time.sleep(max(0.0, began_s + frame / FRAME_HZ - time.monotonic()))
        if frame == first:
            sinks.rec.flush(timeout_sec=10)
            before, process_s = path.stat().st_size, time.process_time()
        now_ns = int((frame + 1) / FRAME_HZ * NS_PER_S)
        begin_ns = time.thread_time_ns()
        for topic, message in messages:
            service.handle(Heard(topic, {}, message), now_ns)
        middle_ns = time.thread_time_ns()
        service.tick(now_ns)
        told_ms[frame] = (middle_ns - begin_ns) / 1e6
        took_ms[frame] = (time.thread_time_ns() - middle_ns) / 1e6
    sinks.rec.flush(timeout_sec=10)
    process_ms = (time.process_time() - process_s) * 1e3 / (frames - first)
    wrote = path.stat().st_size - before
    sinks.close()
    return {
        "vehicles": scenario.vehicle_count,
        "frames": frames - first,
        "frame_ms_mean": float(took_ms[first:].mean()),
        "frame_ms_p99": float(np.quantile(took_ms[first:], 0.99)),
        "hear_ms_mean": float(told_ms[first:].mean()),
        "process_ms": process_ms,
        "mb_per_minute": wrote / 1e6 / ((frames - first) / FRAME_HZ) * 60,
    }


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    shown = table(
        "The live view at 10 frames a second",
        *("vehicles", "frame, ms", "p99, ms", "hearing, ms", "process, ms", "recording, MB/min"),
    )
    for row in report["view"]:
        shown.add_row(
            str(row["vehicles"]),
            *(
                number(row[name])
                for name in ("frame_ms_mean", "frame_ms_p99", "hear_ms_mean", "process_ms", "mb_per_minute")
            ),
        )
    yield shown
    yield (
        "CPU time of each frame: frame, on the monitor's thread, without taking messages in (hearing); process, of "
        "all threads, with rerun's, which pack and write."
    )
