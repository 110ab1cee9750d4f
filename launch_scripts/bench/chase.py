"""Moving targets and vehicles over a field, frame by frame: what a strategy costs and how far from optimal it
drives."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.bench.fields import Pace, largest_area, random_walk
from planner_service.ground import Ground
from planner_service.strategies import GrownTree, TargetTree
from planner_service.tree import CostToGoTree
from swarm.config import PlannerConfig, Strategy
from swarm.grid import GridSpec
from swarm.messages import Route, RouteStatus


@dataclass
class Tally:
    """What was measured. Gaps are cost over optimum; proven ones are cost over the certificate's bound."""

    frame_ms: list[float] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    proven: list[float] = field(default_factory=list)
    kinds: dict[str, int] = field(default_factory=dict)

    def report(self) -> dict[str, Any]:
        gaps, proven = np.array(self.gaps), np.array(self.proven)
        return {
            "frame_ms_mean": round(float(np.mean(self.frame_ms)), 3),
            "frame_ms_p50": round(float(np.median(self.frame_ms)), 3),
            "frame_ms_max": round(float(np.max(self.frame_ms)), 3),
            "gap_mean": _figure(gaps, np.mean),
            "gap_p95": _figure(gaps, lambda x: np.quantile(x, 0.95)),
            "gap_max": _figure(gaps, np.max),
            "proven_p50": _figure(proven, np.median),
            "proven_p95": _figure(proven, lambda x: np.quantile(x, 0.95)),
            "updates": dict(sorted(self.kinds.items())),
        }


def _figure(values: NDArray[np.float64], of: Any) -> float | None:
    return round(float(of(values)), 5) if values.size else None


def chase(
    pace: Pace,
    config: PlannerConfig,
    targets: int,
    vehicles: int,
    frames: int,
    seed: int = 1,
    max_cells: int = 0,
    gap_every: int = 10,
) -> Tally:
    """Every target moves one cell a frame; every tree follows; every vehicle's route is read each frame.

    A frame's time is CPU time of one core and includes the full growths that a service would leave to its worker;
    `auto` is told what they took. Each `gap_every` frames one target's routes are held against an exact tree.
    """
    rng = np.random.default_rng(seed)
    grid = GridSpec(pace.shape[0], pace.shape[1], 1.0)
    area = largest_area(pace)
    roots = rng.choice(area, targets).tolist()
    walks = [random_walk(pace, root, np.random.default_rng(seed * 1000 + n)) for n, root in enumerate(roots)]
    trees = [TargetTree(grid, config) for _ in range(targets)]
    for tree, root in zip(trees, roots, strict=True):
        _follow(tree, pace, root, [], None)
    spread = np.array_split(rng.choice(area, vehicles), targets)
    judge = CostToGoTree(Ground(grid, config))
    judge.ground.load(pace)
    tally = Tally()
    for frame in range(frames):
        cells = [next(walk) for walk in walks]
        answers: list[list[Route]] = []
        begin = time.thread_time()
        for n, tree in enumerate(trees):
            # Full growths are staggered, so that they do not all fall into one frame.
            due = (frame + n) % targets == 0 or targets > 10
            _follow(tree, pace, cells[n], spread[n], tally, due)
            answers.append(tree.routes(pace, spread[n], max_cells))
        tally.frame_ms.append(1e3 * (time.thread_time() - begin))
        if frame % gap_every == gap_every - 1:
            n = (frame // gap_every) % targets
            judge.grow(cells[n])
            _judge(judge, answers[n], tally)
    return tally


def _follow(
    tree: TargetTree,
    pace: Pace,
    cell: int,
    followed: Any,
    tally: Tally | None,
    may_grow: bool = True,
) -> None:
    begin = time.thread_time_ns()
    update = tree.update(pace, cell, [], 0)
    if update.kind == "full":
        tree.observe_full_ns(time.thread_time_ns() - begin)
    if tally is not None:
        tally.kinds[update.kind] = tally.kinds.get(update.kind, 0) + 1
    if update.wants_full and may_grow:
        begin = time.thread_time_ns()
        grown: GrownTree = tree.full_job(pace, cell, 0)()
        tree.observe_full_ns(time.thread_time_ns() - begin)
        tree.adopt(grown, pace, cell, [], 0, followed)
        if tally is not None:
            tally.kinds["job"] = tally.kinds.get("job", 0) + 1


def _judge(judge: CostToGoTree, routes: list[Route], tally: Tally) -> None:
    for route in routes:
        if route.status is not RouteStatus.OK or route.cost_s <= 0:
            continue
        optimum = float(judge.cost[judge.ground.pad(route.start)])
        tally.gaps.append(max(1.0, route.cost_s / optimum))
        tally.proven.append(route.gap)


def config_of(strategy: Strategy, **settings: Any) -> PlannerConfig:
    return PlannerConfig(strategy=strategy, **settings)
