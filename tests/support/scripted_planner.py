"""A planner on a map, without a bus or a worker, with a tree that does what the test says."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from support.makers import target_pose

from planner_service.growth_times import GrowthTimes
from planner_service.planner import Action, Planner, Work
from planner_service.target_search import Hidden, TargetSearch
from planner_service.target_tree import TargetTree, Update
from planner_service.tracker_notes import TargetWatch
from planner_service.tree.partitioned_tree import GrownTree
from shared_map.cost_map import CostMap
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, Window
from swarm.runtime.stats import Counters
from swarm.wire.fields import pack_column
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.planning import PlannerStatus, RouteReply, RouteRequest, TargetPose
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus

ROWS, COLS = 20, 30
GRID = GridSpec(ROWS, COLS, 10.0)
TICK = NS_PER_S // 10
TRACKED = Hidden(True, sense_range_m=1.0, capture_range_m=1.0, slowness=1.0, jumps=False, seed="")


class NotedTimes(GrowthTimes):
    """Notes the observed times, and goes by the model."""

    def __init__(self, calls: list[tuple[Any, ...]]) -> None:
        super().__init__(GRID, PlannerConfig(), False, False, None)
        self._calls = calls

    def observe_full_ns(self, took_ns: int) -> None:
        self._calls.append(("observe", took_ns))

    def observe_exact_ns(self, took_ns: int) -> None:
        self._calls.append(("observe exact", took_ns))


class ScriptedTree(TargetTree):
    """Straight routes without any growth; each call is noted, and answers what the test says."""

    def __init__(self) -> None:
        super().__init__(GRID, PlannerConfig())
        self.calls: list[tuple[Any, ...]] = []
        self.times = NotedTimes(self.calls)
        self.answers: list[Update] = []
        self.told_version = -1
        self.gap = 1.0
        self.gaps: NDArray[np.float64] = np.empty(0)

    def update(
        self, pace: NDArray[np.float32], target_cell: int, dirty: Sequence[Window], map_version: int
    ) -> Update:
        self.calls.append(("update", target_cell, list(dirty), map_version))
        return self._answer(target_cell, map_version, Update("full", GRID.window, GRID.cells))

    def full_job(self, target_cell: int) -> Callable[[], GrownTree]:
        map_version = self.told_version
        self.calls.append(("full_job", target_cell, map_version))
        cost, parent = np.zeros(1, np.float32), np.zeros(1, np.uint8)
        return lambda: GrownTree(target_cell, map_version, cost, cost, parent, cost, 1.0, None)

    def adopt(
        self,
        grown: GrownTree,
        pace: NDArray[np.float32],
        target_cell: int,
        dirty: Sequence[Window],
        map_version: int,
        followed_cells: Any,
    ) -> Update:
        self.calls.append(("adopt", grown.map_version, target_cell, list(dirty), map_version))
        self.last_gaps = self.gaps
        return self._answer(target_cell, map_version, Update("full", GRID.window, GRID.cells))

    def force(self, cells: Any) -> Update:
        self.calls.append(("force", list(cells)))
        return Update("forced", GRID.window, len(cells))

    def routes(self, cells: Any, max_cells: int = 0) -> RouteBatch:
        return RouteBatch.of([self._route(int(cell), max_cells) for cell in cells])

    def cost_to_go_at(self, cells: Any) -> NDArray[np.float32]:
        return np.array([cell if 0 <= cell < GRID.cells else math.inf for cell in cells], np.float32)

    def named(self, name: str) -> list[tuple[Any, ...]]:
        return [call for call in self.calls if call[0] == name]

    def _answer(self, target_cell: int, map_version: int, otherwise: Update) -> Update:
        self.told_version = map_version
        update = self.answers.pop(0) if self.answers else otherwise
        if update.kind != "none":
            self.target_cell, self.map_version = target_cell, map_version
        return update

    def _route(self, cell: int, max_cells: int) -> Route:
        if self.target_cell is None:
            return Route(status=RouteStatus.NO_TARGET, start=cell)
        if not 0 <= cell < GRID.cells:
            return Route(status=RouteStatus.OUTSIDE, start=cell)
        steps = straight(cell, self.target_cell)
        part = steps[: max_cells or None]
        return Route(
            status=RouteStatus.OK,
            start=cell,
            directions=bytes(part),
            cost_s=float(max(len(steps), 1)),
            lower_bound_s=max(len(steps), 1) / self.gap,
            remaining_s=float(len(steps) - len(part)),
        )


def straight(start: int, end: int) -> list[int]:
    (row, col), (to_row, to_col) = GRID.row_col(start), GRID.row_col(end)
    codes = {step: code for code, step in enumerate(zip(STEP_ROW, STEP_COL, strict=True))}
    steps: list[int] = []
    while (row, col) != (to_row, to_col):
        step = (int(np.sign(to_row - row)), int(np.sign(to_col - col)))
        row, col = row + step[0], col + step[1]
        steps.append(codes[step])
    return steps


class World:
    """A planner with its map and its tree."""

    def __init__(self, stopwatch: Callable[[], int] | None = None) -> None:
        self.map = CostMap(terrain_of_pace(np.full((ROWS, COLS), 0.1, np.float32)))
        self.tree = ScriptedTree()
        self.counters = Counters()
        self.newest_mark_ns: int | None = None
        self.watch = TargetWatch("t0", GRID, self.counters)
        self.planner = Planner(
            self.watch,
            7,
            PlannerConfig(),
            self.tree,
            self.map,
            self.counters,
            stopwatch=stopwatch,
            newest_mark_ns=self._newest,
            target_search=TargetSearch(TRACKED, self.tree.cost_grid, 1.0),
        )
        self.now_ns = 0
        self.told: list[PlannerStatus] = []

    def _newest(self) -> int | None:
        stamp_ns, self.newest_mark_ns = self.newest_mark_ns, None
        return stamp_ns

    def pose(self, row: int, col: int, seq: int = 1) -> None:
        self.watch.on_pose(pose(GRID.cell(row, col), seq), self.now_ns)

    def mark(self, *cells: int, stamp_ns: int | None = None) -> None:
        kinds = np.full(len(cells), MarkKind.LETHAL, np.uint8)
        self.map.apply(np.array(cells, np.uint32), kinds, np.zeros(len(cells), np.float32))
        self.newest_mark_ns = stamp_ns

    def tick(self) -> list[Action]:
        """All actions of a tick, except the status twice a second."""
        self.now_ns += TICK
        actions = self.planner.tick(self.now_ns)
        self.told.extend(action for action in actions if isinstance(action, PlannerStatus))
        return [action for action in actions if not isinstance(action, PlannerStatus)]

    def ask(self, *cells: int, **fields: Any) -> RouteReply:
        request = RouteRequest(cells=list(cells), **fields)
        reply = self.planner.answer(request, self.now_ns)
        assert isinstance(reply, RouteReply)
        return reply

    def chasers(self, *vehicles: tuple[str, int]) -> None:
        self.planner.on_chasers(chasers(*vehicles, stamp_ns=self.now_ns), self.now_ns)

    def grow(self, action: Action, took_ns: int = 5_000_000) -> list[Action]:
        """Does a growth that was asked for."""
        assert isinstance(action, Work)
        return self.planner.adopt(action.job(), took_ns, self.now_ns)


def pose(cell: int, seq: int = 1, incarnation: int = 1, target: str = "t0") -> TargetPose:
    return target_pose(target, cell, tracker="radar", seq=seq, incarnation=incarnation)


def chasers(*vehicles: tuple[str, int], stamp_ns: int, target: str = "t0") -> Chasers:
    return Chasers(
        target=target,
        author="all.a0.1",
        stamp_ns=stamp_ns,
        ids=[id for id, _ in vehicles],
        cells=pack_column([cell for _, cell in vehicles], "<u4"),
    )
