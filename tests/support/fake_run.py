"""The messages of a run that never was: vehicles that walk down a cost-to-go to targets that wander."""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec
import numpy as np
from numpy.typing import NDArray
from skimage.graph import MCP_Geometric

from launch_scripts.observe.recorder import Recorder
from shared_map.terrain.terrain import Terrain
from swarm.clock import NS_PER_S
from swarm.config.agents import plan_agents
from swarm.config.scenario import Scenario
from swarm.grid import STEP_COL, STEP_ROW, TILE_CELLS, walk
from swarm.liveness import Peer
from swarm.runtime.stats import CAPTURES_BY, CAPTURES_OF, GAPS_OF, GAPS_TO, Counters
from swarm.wire.fields import column, pack_column
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkKind, MarkSet
from swarm.wire.messages.planning import PlannerStatus, TargetPose
from swarm.wire.messages.processes import Note, Stats
from swarm.wire.messages.vehicles import Fleet, Followed, VehicleState

Heard = tuple[int, Message | Peer]


def fake_run(terrain: Terrain, truth: NDArray[np.float32], scenario: Scenario, hz: float = 2.0) -> Iterator[Heard]:
    """(time, message or peer that came up) in order of time, from 0 on."""
    rng = np.random.default_rng(scenario.seed)
    grid = terrain.grid
    passable = np.flatnonzero(np.isfinite(truth) & np.isfinite(terrain.pace_s_per_m))
    agents = plan_agents(scenario)
    target_cells = {id: int(rng.choice(passable)) for id in scenario.target_ids}
    vehicles = {id: int(rng.choice(passable)) for plan in agents for id in plan.vehicle_ids}
    chased: dict[str, str] = {}
    captures = dict.fromkeys(target_cells, 0)
    marked: dict[int, dict[int, tuple[MarkKind, float, int]]] = {}
    counters = {name: Counters() for name in ("planner", "agent", "targets")}
    for role, id in [("keeper", "k0"), ("targets", "d0"), *(("planner", id) for id in target_cells)]:
        yield 0, Peer(role, id, 1)
    for plan in agents:
        yield 0, Peer("agent", plan.id, 1)
    costs: dict[str, NDArray[np.float64]] = {}
    known = terrain.pace_s_per_m.copy()
    for step in range(int(scenario.seconds * hz)):
        now_ns, seqs = int((0.5 + step / hz) * NS_PER_S), step + 1
        for index, (id, cell) in enumerate(target_cells.items()):
            if step % 4 == index % 4 or id not in costs:
                row, col = grid.row_col(cell)
                costs[id] = MCP_Geometric(np.where(np.isfinite(known), known, -1)).find_costs([(row, col)])[0]
            heading = int(rng.integers(8)) if rng.random() < 0.2 else (index + step // 20) % 8
            row, col = grid.row_col(cell)
            row, col = row + STEP_ROW[heading], col + STEP_COL[heading]
            if grid.inside(row, col) and np.isfinite(truth[row, col]):
                target_cells[id] = row * grid.cols + col
        moves = max(1, round(16 / hz))
        states: dict[str, VehicleState] = {}
        for id, cell in vehicles.items():
            if id not in chased or rng.random() < 0.01:
                chased[id] = min(costs, key=lambda target: float(costs[target].flat[cell]))
                route = _descend(costs[chased[id]], cell, 400)
                cost_s = float(costs[chased[id]].flat[cell]) * grid.resolution_m
                excess = abs(float(rng.normal(0, 0.01)))
                counters["agent"].observe("followed_gap_excess", excess)
                counters["agent"].observe_by(GAPS_TO, chased[id], excess)
                counters["agent"].observe_by(GAPS_OF, id, excess)
                yield now_ns, Followed(
                    vehicle=id, target=chased[id], start=cell, directions=route,
                    cost_s=cost_s, lower_bound_s=cost_s / (1 + excess),
                )  # fmt: skip
            states[id] = VehicleState.WAITING if step < 3 and rng.random() < 0.5 else VehicleState.FOLLOWING
            route = _descend(costs[chased[id]], cell, moves)
            for ahead in walk(grid, cell, route)[1:]:
                window = grid.around(ahead, 3)
                _sense(grid, window, truth, known, marked, now_ns, counters["agent"])
                if np.isinf(truth.flat[ahead]):
                    counters["agent"].count("reroute_requests")
                    break
                vehicles[id] = ahead
            target = chased[id]
            if grid.distance_cells(vehicles[id], target_cells[target]) <= 3:
                states[id] = VehicleState.ARRIVED
                if rng.random() < 0.3:
                    captures[target] += 1
                    counters["targets"].count("captures")
                    counters["targets"].count_by(CAPTURES_OF, target)
                    counters["targets"].count_by(CAPTURES_BY, id)
                    yield (
                        now_ns,
                        _note(
                            "targets",
                            "d0",
                            now_ns,
                            "capture",
                            f"{id} captured {target}",
                            target_cells[target],
                            target,
                        ),
                    )
                    target_cells[target] = int(rng.choice(passable))
                    costs.pop(target)
                    row, col = grid.row_col(target_cells[target])
                    costs[target] = MCP_Geometric(np.where(np.isfinite(known), known, -1)).find_costs([(row, col)])[
                        0
                    ]
        for id, cell in target_cells.items():
            x_m, y_m = grid.centre_m(cell)
            yield now_ns, TargetPose(
                target=id, incarnation=1, seq=seqs, stamp_ns=now_ns, cell=cell, x_m=x_m, y_m=y_m,
                captures=captures[id], jumps=captures[id],
            )  # fmt: skip
        for plan in agents:
            yield (
                now_ns,
                _fleet(
                    grid.resolution_m, grid.cols, plan.id, plan.vehicle_ids, vehicles, states, chased, seqs, now_ns
                ),
            )
        for tile in sorted(marked):
            yield now_ns, _mark_set(tile, marked[tile], seqs)
        if step % max(1, int(hz)) == 0:
            counters["agent"].count("messages_out", int(rng.normal(1400, 60)))
            counters["agent"].gauge("messages_per_s", float(rng.normal(1400, 60)))
            counters["agent"].observe("route_query_ms", float(rng.lognormal(0.6, 0.5)))
            for _ in range(20):
                counters["planner"].observe("growth_ms", float(rng.lognormal(0.3, 0.25)))
                counters["planner"].observe("gap_excess", float(abs(rng.normal(0, 0.006))))
                counters["planner"].observe("mark_to_tree_ms", float(rng.lognormal(4.2, 0.4)))
                counters["agent"].observe("route_query_ms", float(rng.lognormal(0.6, 0.5)))
            counters["planner"].count("routes_served", int(rng.integers(20, 60)))
            for name in ("collisions", "lethal_entries"):
                counters["targets"].count(name, 0)
            for name in ("stranded", "lost"):
                counters["agent"].gauge(name, 0.0)
            for role, id in (("planner", "t0"), ("agent", "a0"), ("targets", "d0")):
                yield now_ns, _stats(role, id, counters[role], now_ns)
            for id, cell in target_cells.items():
                gap = 1.0 + abs(float(rng.normal(0.002, 0.004)))
                window = grid.around(cell, 16)
                yield now_ns, PlannerStatus(
                    target=id, incarnation=1, stamp_ns=now_ns, strategy="auto", target_cell=cell, map_version=step,
                    tree_age_ms=40.0, window=[window.row0, window.col0, window.row1, window.col1], growths=step,
                    window_growths=step * 3, growth_ms=float(rng.lognormal(0.3, 0.25)), routes_served=step * 4,
                    following=sum(1 for t in chased.values() if t == id), gap_mean=gap, gap_p95=gap * 1.01,
                    gap_max=gap * 1.03,
                )  # fmt: skip
    for role, id in (("planner", "t0"), ("agent", "a0"), ("targets", "d0")):
        yield now_ns, _stats(role, id, counters[role], now_ns)


def _descend(cost: NDArray[np.float64], cell: int, steps: int) -> bytes:
    rows, cols = cost.shape
    row, col = divmod(cell, cols)
    directions = bytearray()
    for _ in range(steps):
        best, direction = float(cost[row, col]), -1
        for code in range(8):
            r, c = row + STEP_ROW[code], col + STEP_COL[code]
            if 0 <= r < rows and 0 <= c < cols and cost[r, c] < best:
                best, direction = float(cost[r, c]), code
        if direction < 0:
            break
        directions.append(direction)
        row, col = row + STEP_ROW[direction], col + STEP_COL[direction]
    return bytes(directions)


def _sense(grid, window, truth, known, marked, now_ns, counters) -> None:  # type: ignore[no-untyped-def]
    part = (slice(window.row0, window.row1), slice(window.col0, window.col1))
    rows, cols = np.nonzero(truth[part] != known[part])
    for row, col in zip((rows + window.row0).tolist(), (cols + window.col0).tolist(), strict=True):
        pace = float(truth[row, col])
        known[row, col] = pace
        cell = row * grid.cols + col
        inside = (row % TILE_CELLS) * TILE_CELLS + col % TILE_CELLS
        kind = MarkKind.LETHAL if math.isinf(pace) else MarkKind.PACE
        marked.setdefault(grid.tile_of(cell), {})[inside] = (kind, 0.0 if math.isinf(pace) else pace, now_ns)
        counters.count("marks")


def _mark_set(tile: int, statements: dict[int, tuple[MarkKind, float, int]], seq: int) -> MarkSet:
    cells = sorted(statements)
    return MarkSet(
        author="a0.1", group="all", tile=tile, epoch=1, seq=seq,
        cells=pack_column(cells, "<u2"),
        kinds=bytes(int(statements[cell][0]) for cell in cells),
        paces=pack_column([statements[cell][1] for cell in cells], "<f4"),
        stamps_ns=pack_column([statements[cell][2] for cell in cells], "<i8"),
    )  # fmt: skip


def _fleet(resolution_m, cols, agent, ids, vehicles, states, chased, seq, now_ns) -> Fleet:  # type: ignore[no-untyped-def]
    cells = [vehicles[id] for id in ids]
    targets = sorted({chased[id] for id in ids})
    return Fleet(
        author=f"{agent}.1", group="all", region=0, seq=seq, stamp_ns=now_ns, ids=list(ids), target_ids=targets,
        cells=pack_column(cells, "<u4"),
        east_m=pack_column([(cell % cols + 0.5) * resolution_m for cell in cells], "<f4"),
        south_m=pack_column([(cell // cols + 0.5) * resolution_m for cell in cells], "<f4"),
        heading_rad=pack_column([(cell * 0.7) % 6.28 for cell in cells], "<f4"),
        states=bytes(states[id] for id in ids),
        targets=bytes(targets.index(chased[id]) for id in ids),
    )  # fmt: skip


def _note(role: str, id: str, now_ns: int, kind: str, text: str, cell: int | None, target: str) -> Note:
    return Note(role=role, id=id, stamp_ns=now_ns, kind=kind, text=text, cell=cell, target=target)


def _stats(role: str, id: str, counters: Counters, now_ns: int) -> Stats:
    return Stats(
        role=role, id=id, incarnation=1, stamp_ns=now_ns,
        counts=dict(counters.counts), gauges=dict(counters.gauges),
        histograms={name: dict(histogram.buckets) for name, histogram in counters.histograms.items()},
        counts_by={name: dict(counts) for name, counts in counters.counts_by.items()},
        histograms_by={
            name: {id: dict(histogram.buckets) for id, histogram in each.items()}
            for name, each in counters.histograms_by.items()
        },
    )  # fmt: skip


def played(
    terrain: Terrain, truth: NDArray[np.float32], scenario: Scenario, began_ns: int = 0, hz: float = 2.0
) -> Recorder:
    """The recorder of a fake run which began then: it has heard all of it."""
    recorder = Recorder(scenario, terrain.grid)
    for now_ns, told in fake_run(terrain, truth, scenario, hz):
        if isinstance(told, Peer):
            recorder.alive(told, True, began_ns + now_ns)
            continue
        if isinstance(told, MarkSet):
            stamps_ns = pack_column(column(told.stamps_ns, "<i8") + began_ns, "<i8")
            told = msgspec.structs.replace(told, stamps_ns=stamps_ns)
        recorder.heard(told, began_ns + now_ns)
    return recorder
