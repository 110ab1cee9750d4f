"""Moving targets and vehicles on a field, frame by frame: CPU time and gap of each strategy.

All strategies follow the same moves and are asked from the same cells, in turn within each frame, so that whatever
else the machine is busy with falls on all of them alike.
"""

from __future__ import annotations

import dataclasses
import math
import random
import time
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import psutil
from numpy.typing import NDArray
from support.fields import Field, Pace
from support.slow_twins import drive

from bench.harness import cpu_ms, track
from launch_scripts.simulation.world.walks import WALKS, Budget, Walker, WalkWorld
from planner_service.strategy import ROWS, STAGES
from planner_service.target_tree import TargetTree, Update
from swarm.config.scenario import PlannerConfig, Strategy, Walk
from swarm.errors import ConfigError
from swarm.grid import walk
from swarm.wire.route_columns import OK, RouteBatch

Cells = NDArray[np.int64]

TREE_BYTES_PER_CELL = 40
"""Bytes per cell of one target's tree, of what its strategy keeps beside it, and of a job's snapshot; measured."""
RUN_IN = 10
"""Frames before the measured ones, which spread the full growths of a strategy's trees over time."""
FEWEST = 4
"""Frames for which every strategy is measured, however long they take."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """Targets, vehicles and frames of a chase.

    targets     each moves one cell a frame; vehicles are shared out among them
    frames      upper bound on the number of measured frames
    walk        how targets move; those that evade flee from the vehicles
    speed       cells that a vehicle drives a frame, on the cheapest route; one that arrives turns up elsewhere.
                0: vehicles stand, and are asked for from where they stand
    max_cells   steps that a route is given for; 0 is the whole route
    judge_every period, in frames, of the check of one target's tree against an exact one
    probes      cells of that check, drawn again each time; vehicles that drive are asked instead
    within      cells; vehicles and probes are drawn so near to their target. 0: anywhere
    seconds     a strategy that has taken so much CPU time is measured no further; `FEWEST` frames it always gets
    """

    targets: int = 1
    vehicles: int = 100
    frames: int = 300
    walk: Walk = "random"
    speed: int = 0
    max_cells: int = 0
    judge_every: int = 1
    probes: int = 200
    within: int = 0
    seconds: float = float("inf")
    seed: int = 1


BROKEN = ("below_own_bound", "bound_above_optimum", "below_optimum", "stated_is_not_driven")
"""Laws, by how a violation is called. An exact tree's routes are upper bounds of the optimum, and what it proves is
a lower one: neither needs a tolerance. A stated cost is driven within 1e-6."""


@dataclasses.dataclass
class Tally:
    """Measurements of one strategy.

    frame_ms   CPU time of each frame: all trees follow their targets, all vehicles' routes are read, and full
               growths are done that a service would leave to its worker
    start_ms   CPU time a target before the first frame: the first growth, and what is found once for a map
    updates    how often each kind of update ran; `job` is a full growth that a worker of the service would run
    batches    in how many groups the targets were run, as their trees did not fit into memory together
    gaps       one array per judged frame: cost of each route over the optimum
    proven     the same over the certificate's lower bound
    broken     how often a route broke a law of `BROKEN`: of each a figure, that should be 0
    """

    frame_ms: list[float] = dataclasses.field(default_factory=list)
    start_ms: float = 0.0
    gaps: list[NDArray[np.float64]] = dataclasses.field(default_factory=list)
    proven: list[NDArray[np.float64]] = dataclasses.field(default_factory=list)
    updates: dict[str, int] = dataclasses.field(default_factory=dict)
    batches: int = 1
    broken: dict[str, int] = dataclasses.field(default_factory=lambda: dict.fromkeys(BROKEN, 0))

    def count(self, kind: str) -> None:
        self.updates[kind] = self.updates.get(kind, 0) + 1

    def judge(self, routes: RouteBatch, driven_s: NDArray[np.float64], exact: RouteBatch) -> None:
        """Compares routes, whole or with the cost that remains after them, with those of an exact tree.

        driven_s  float64 (n,), s; what driving each of them takes, by an oracle; inf where one breaks a rule
        """
        # The target's own cell has no gap, and cells without a route have none either.
        counts = (routes.statuses == OK) & (routes.cost_s > 0)
        cost, bound = routes.cost_s[counts], routes.lower_bound_s[counts]
        best, driven = exact.cost_s[counts], driven_s[counts]
        laws = (cost < bound, bound > best, cost < exact.lower_bound_s[counts], ~(np.abs(cost / driven - 1) < 1e-6))
        for law, broken in zip(BROKEN, laws, strict=True):
            self.broken[law] += int(np.count_nonzero(broken))
        with np.errstate(divide="ignore"):
            self.gaps.append(cost / best)
            self.proven.append(cost / bound)

    def add(self, other: Tally) -> None:
        """Adds another run of the same strategy."""
        self.frame_ms += other.frame_ms
        self.start_ms = max(self.start_ms, other.start_ms)
        self.gaps += other.gaps
        self.proven += other.proven
        for law, many in other.broken.items():
            self.broken[law] += many
        for kind, count in other.updates.items():
            self.updates[kind] = self.updates.get(kind, 0) + count

    def row(self) -> dict[str, Any]:
        ms = np.array(self.frame_ms)
        gaps = np.concatenate([np.empty(0), *self.gaps])
        proven = np.concatenate([np.empty(0), *self.proven])
        return {
            "frames": len(ms),
            "frame_ms_mean": round(float(ms.mean()), 3),
            **{f"frame_ms_{name}": round(float(np.quantile(ms, share)), 3) for name, share in _SHARES.items()},
            "start_ms": round(self.start_ms, 1),
            "gap_mean": _rounded(float(gaps.mean()) if gaps.size else math.inf),
            **{f"gap_{name}": _quantile(gaps, share) for name, share in _SHARES.items()},
            **{f"proven_{name}": _quantile(proven, share) for name, share in _SHARES.items()},
            "routes_judged": int(gaps.size),
            "violations": dict(self.broken),
            "batches": self.batches,
            "updates": dict(sorted(self.updates.items())),
        }


_SHARES = {"p50": 0.5, "p95": 0.95, "max": 1.0}


def chase(field: Field, entrants: Mapping[Strategy, PlannerConfig], plan: Plan) -> dict[Strategy, Tally]:
    """Measures each entrant. Targets that do not fit into half of the free memory follow in batches: they do not
    depend on each other, and a frame's time is the sum over them. Raises ConfigError on more targets or vehicles
    than there are cells to stand on."""
    home = len(field.terrain.home)
    for name, count in (("targets", plan.targets), ("vehicles", plan.vehicles)):
        if count > home:
            raise ConfigError(f"--{name} is {count}; the field has {home} connected cells to stand on")
    rng = np.random.default_rng(plan.seed)
    roots = field.draw(plan.targets, rng).tolist()
    places = np.array_split(field.draw(plan.vehicles, rng), plan.targets)
    trees_in_memory = psutil.virtual_memory().available // 2 // (TREE_BYTES_PER_CELL * field.grid.cells)
    at_once = max(1, trees_in_memory // len(entrants))
    batches = [range(plan.targets)[n : n + at_once] for n in range(0, plan.targets, at_once)]
    tallies = {name: Tally(batches=len(batches)) for name in entrants}
    for done, batch in enumerate(batches):
        walkers = [_walker(field, plan, n, roots[n]) for n in batch]
        exact = msgspec.structs.replace(next(iter(entrants.values())), strategy="full")
        crowd = _Crowd(field, plan, exact, walkers, [places[n] for n in batch], rng)
        racers = [
            _Racer(config, field, len(batch), tallies[name], plan, first=not done)
            for name, config in entrants.items()
        ]
        _race(crowd, racers, plan, len(batches))
    return tallies


def _race(crowd: _Crowd, racers: Sequence[_Racer], plan: Plan, batches: int) -> None:
    for racer in racers:
        racer.start(crowd.targets)
    for frame in range(RUN_IN):
        crowd.step()
        for racer in racers:
            racer.run_in(frame, crowd.targets)
    running = list(racers)
    for frame in track(range(plan.frames)):
        crowd.step()
        for racer in running:
            racer.frame(frame, crowd)
        if frame % plan.judge_every == plan.judge_every - 1:
            n = frame // plan.judge_every % len(crowd.targets)
            exact = crowd.exact_routes(n)
            for racer in running:
                racer.judged(n, exact)
        running = [racer for racer in running if not racer.done(frame, plan.seconds / batches)]
        if not running:
            break


def _walker(field: Field, plan: Plan, n: int, cell: int) -> Walker:
    world = WalkWorld(f"t{n}", field.terrain, random.Random(plan.seed * 1000 + n), Budget())
    return Walker(world.terrain, WALKS[plan.walk](world), 1.0, cell)


class _Crowd:
    """Places of targets and vehicles, and optimal costs between them."""

    def __init__(
        self,
        field: Field,
        plan: Plan,
        exact: PlannerConfig,
        walkers: list[Walker],
        places: list[Cells],
        rng: np.random.Generator,
    ) -> None:
        self.places = places
        self.targets: list[int] = [walker.cell for walker in walkers]
        self._field = field
        self._plan = plan
        self._walkers = walkers
        self._rng = rng
        self._exact = TargetTree(field.grid, exact)
        if plan.within:
            self.places = [self._near(n, len(each)) for n, each in enumerate(places)]

    def step(self) -> None:
        """Moves targets and vehicles by one frame."""
        vehicles = np.concatenate(self.places)
        for n, walker in enumerate(self._walkers):
            to = walker.walk.choose(walker.cell, vehicles)
            walker.cell = walker.cell if to is None else to
            self.targets[n] = walker.cell
            if self._plan.speed:
                self.places[n] = self._driven(n)

    def exact_routes(self, n: int) -> RouteBatch:
        """The first steps of optimal routes to target n, from where it is judged."""
        cells = self.places[n] if self._plan.speed else self._near(n, self._plan.probes)
        return self._tree_of(n).routes(cells, 1)

    def _near(self, n: int, count: int) -> Cells:
        """Cells to ask from, as near to a target as the plan says."""
        if not self._plan.within:
            return self._field.draw(count, self._rng)
        window = self._field.grid.around(self.targets[n], self._plan.within)
        rows, cols = np.divmod(self._field.terrain.home, self._field.grid.cols)
        inside = (rows >= window.row0) & (rows < window.row1) & (cols >= window.col0) & (cols < window.col1)
        return self._rng.choice(self._field.terrain.home[inside], count)

    def _driven(self, n: int) -> Cells:
        routes = self._tree_of(n).routes(self.places[n], self._plan.speed)
        ends = [walk(self._field.grid, route.start, route.directions)[-1] for route in routes]
        fresh = self._field.draw(len(ends), self._rng)
        return np.where(np.array(ends) == self.targets[n], fresh, ends)

    def _tree_of(self, n: int) -> TargetTree:
        if self._exact.target_cell != self.targets[n]:
            self._exact.update(self._field.pace, self.targets[n], [], 0)
        return self._exact


def follow(tree: TargetTree, pace: Pace, cell: int) -> Update:
    """Follows a move of the target. The tree learns how long it took, as in a planner."""
    began_ns = time.thread_time_ns()
    update = tree.update(pace, cell, [], 0)
    if update.kind in ("full", "bounded", "exact"):
        tree.times.observe(update.kind, time.thread_time_ns() - began_ns)
    return update


class _Racer:
    """The trees of one entrant, one per target."""

    def __init__(
        self, config: PlannerConfig, field: Field, targets: int, tally: Tally, plan: Plan, first: bool
    ) -> None:
        self.tally = tally
        self._field = field
        self._config = config
        self._plan = plan
        self._strategy = config.strategy
        self._trees = [TargetTree(field.grid, config) for _ in range(targets)]
        # All batches run the same frames: a frame's time is the sum over batches.
        self._frames = None if first else len(tally.frame_ms)
        self._spent_ms = 0.0

    def start(self, targets: list[int]) -> None:
        def grow() -> None:
            for n, cell in enumerate(targets):
                self._follow(n, cell, count=False)

        self.tally.start_ms += cpu_ms(grow) / self._plan.targets

    def run_in(self, frame: int, targets: list[int]) -> None:
        """Strategies that grow the whole tree now and then do so once now, one target after the other, or all would
        in the same frame ever after."""
        # The row of `auto` is that of the stage in which it has windows.
        row = ROWS.get(self._strategy, STAGES["rotate"])
        if row.is_exact:
            return
        grows = row.renews_within_budget or row.thins_far_cells

        def follow() -> None:
            for n, cell in enumerate(targets):
                self._follow(n, cell, grow=grows and frame == n % RUN_IN, count=False)

        self.tally.start_ms += cpu_ms(follow) / self._plan.targets

    def frame(self, frame: int, crowd: _Crowd) -> None:
        def follow_and_read() -> None:
            for n, cell in enumerate(crowd.targets):
                self._follow(n, cell, followed=crowd.places[n])
                self._trees[n].routes(crowd.places[n], self._plan.max_cells)

        took_ms = cpu_ms(follow_and_read)
        self._spent_ms += took_ms
        if self._frames is None:
            self.tally.frame_ms.append(took_ms)
        else:
            self.tally.frame_ms[frame] += took_ms

    def judged(self, n: int, exact: RouteBatch) -> None:
        routes = self._trees[n].routes(exact.starts, self._plan.max_cells)
        whole = self._trees[n].routes(exact.starts) if self._plan.max_cells else routes
        driven = drive(self._field.grid, self._config, self._field.pace, None, whole)
        there = driven.last == self._trees[n].target_cell
        self.tally.judge(routes, np.where(there, driven.time_s, math.inf), exact)

    def done(self, frame: int, seconds: float) -> bool:
        if self._frames is not None:
            return frame + 1 >= self._frames
        return frame + 1 >= FEWEST and self._spent_ms > 1e3 * seconds

    def _follow(self, n: int, cell: int, followed: Any = (), grow: bool = False, count: bool = True) -> None:
        """Follows a move of the target. A full growth, asked for or due by `grow`, is adopted at once."""
        tree = self._trees[n]
        update = follow(tree, self._field.pace, cell)
        if tree.wants_strides:
            tree.take_strides(tree.stride_job()())
        if count:
            self.tally.count(update.kind)
        if not (update.wants_full or grow):
            return
        began_ns = time.thread_time_ns()
        grown = tree.full_job(cell)()
        tree.times.observe_full_ns(time.thread_time_ns() - began_ns)
        tree.adopt(grown, self._field.pace, cell, [], 0, followed)
        if count:
            self.tally.count("job")


def _quantile(values: NDArray[np.float64], share: float) -> float | None:
    # One of the values, not an interpolation: a proven gap may be infinite.
    return _rounded(float(np.quantile(values, share, method="inverted_cdf")) if values.size else math.inf)


def _rounded(value: float) -> float | None:
    """None where there is no value or an infinite one."""
    return round(value, 5) if math.isfinite(value) else None
