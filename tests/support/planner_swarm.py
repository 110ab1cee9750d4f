"""Planners on a simulated network: a tracker of targets, an agent that marks, and a client that asks and hears."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from support.makers import target_pose
from support.scripted_planner import chasers
from support.slow_twins import cost_to_go, drive
from support.swarm_model import SwarmModel

from planner_service.growth_times import MODEL_EXACT_NS_PER_CELL
from planner_service.planning_process import Planning
from planner_service.service import PlannerService
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.bus.bus import AskEnded, Event, Heard, Post, Replied
from swarm.bus.memory_bus import MemoryBus
from swarm.bus.scheduler import InlineWorker
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig, Scenario, Strategy, TargetConfig
from swarm.grid import GridSpec
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.planning import RouteReply, RouteRequest
from swarm.wire.messages.processes import Stats
from swarm.wire.route_columns import Route, RouteBatch
from swarm.wire.topics import CHASERS, POSE, PUSHED_ROUTE, ROUTE, STATS, STATUS, Topic

ROWS, COLS, RES = 40, 50, 10.0
GRID = GridSpec(ROWS, COLS, RES)
TICK = NS_PER_S // 10
RENEWS = GRID.cells * MODEL_EXACT_NS_PER_CELL * 1e-9 / 2.5 * PlannerConfig().tick_hz
"""A `cpu_budget` with which `auto` grows windows and makes the tree exact every third move."""


def flat() -> NDArray[np.float32]:
    return np.full((ROWS, COLS), 0.1, np.float32)


def rough(seed: int, lethal: float = 0.2, rows: int = ROWS, cols: int = COLS) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    pace = rng.uniform(0.05, 0.6, (rows, cols)).astype(np.float32)
    pace[rng.random((rows, cols)) < lethal] = np.inf
    pace[rows // 2] = 0.1
    return pace


def optimum_s(pace: NDArray[np.float32], target: int) -> NDArray[np.float64]:
    """Travel time of every cell to the target, by an independent Dijkstra."""
    return cost_to_go(pace, target).ravel() * RES


def driven_s(pace: NDArray[np.float32], route: Route) -> float:
    """Time that a whole route takes, step by step."""
    return float(drive(GRID, PlannerConfig(), pace, None, RouteBatch.of([route])).time_s[0])


class Ear:
    """A client that asks, and hears everything on some topics."""

    def __init__(self, world: SwarmModel, topics: tuple[Topic, ...] = (PUSHED_ROUTE, STATUS, STATS)) -> None:
        self.world = world
        self.bus = world.bus("ear")
        self.heard: list[Message] = []
        self.replies: list[Message] = []
        self.ended: list[AskEnded] = []
        for topic in topics:
            self.bus.subscribe(topic, self._post)

    def _post(self, event: Event) -> None:
        match event:
            case Heard(message=message):
                self.heard.append(message)
            case Replied(message=message):
                self.replies.append(message)
            case AskEnded():
                self.ended.append(event)
            case _:
                raise AssertionError(event)

    def ask(self, topic: Topic, request: Message, **fields: Any) -> list[Any]:
        self.replies = []
        self.bus.ask(topic, request, self._post, tag="q", **fields)
        self.world.run(0.01)
        return self.replies

    def answer(self, topic: Topic, request: Message, **fields: Any) -> Any:
        """The one answer, once the question has ended; None if it was refused."""
        self.ended.clear()
        self.ask(topic, request, **fields)
        while not self.ended:
            self.world.run(0.1)
        return self.replies[0] if self.replies else None

    def routes(self, *cells: int, target: str = "t", **fields: Any) -> RouteReply:
        (reply,) = self.ask(ROUTE, RouteRequest(cells=list(cells), **fields), target=target)
        assert isinstance(reply, RouteReply)
        return reply

    def of(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.heard if isinstance(message, kind)]

    def last_stats(self) -> Stats:
        return [stats for stats in self.of(Stats) if stats.role == "planner"][-1]  # type: ignore[no-any-return]


def planning(world: SwarmModel, role: str, id: str, incarnation: int = 1) -> Callable[[MemoryBus, Post], Planning]:
    """A maker of the common part of a process that plans; its worker runs on the world's scheduler."""
    setup, worker = world.setup(role, id, incarnation), InlineWorker(world.scheduler)
    return lambda bus, post: Planning(setup, world.terrain, bus, post, worker)


class Planners(SwarmModel):
    """A terrain, planners, a tracker of targets, and a client.

    cells  target -> where it has been put
    """

    def __init__(self, terrain: Terrain, scenario: Scenario, all_kernels: Callable[[], bool] | None = None) -> None:
        super().__init__(terrain=terrain, scenario=scenario)
        self.ear = Ear(self)
        self._all_kernels = all_kernels
        self.planners = {id: self.planner(id) for id in scenario.target_ids}
        self.cells: dict[str, int] = {}
        self._seq = 0
        self._track()

    def planner(self, target: str, incarnation: int = 1) -> PlannerService:
        plans = planning(self, "planner", target, incarnation)
        name = f"planner-{target}-{incarnation}"
        return self.start(name, lambda bus, post: PlannerService(plans(bus, post), self._all_kernels), phase_ns=0)

    def _track(self) -> None:
        """Ten poses a second of every target that has been put somewhere."""
        self._seq += 1
        for id, cell in self.cells.items():
            self.ear.bus.publish(POSE, target_pose(id, cell, seq=self._seq), target=id)
        self.scheduler.after(TICK, self._track)


class Swarm(Planners):
    """The same, and an agent that marks."""

    def __init__(
        self,
        pace: NDArray[np.float32] | None = None,
        strategy: Strategy = "auto",
        targets: int = 1,
        cpu_budget: float = 0.1,
    ) -> None:
        self.pace = flat() if pace is None else pace
        scenario = Scenario(
            targets=(TargetConfig(count=targets),),
            planner=PlannerConfig(strategy=strategy, k_min=1, cpu_budget=cpu_budget),
        )
        super().__init__(terrain_of_pace(self.pace, RES), scenario)
        self.author = self.writer("a0.1")

    def mark(self, *cells: int, kind: MarkKind = MarkKind.LETHAL, pace: float = 0.0) -> None:
        self.author.sync.publish(self.author.replica.write(list(cells), kind, pace, self.now_ns))

    def report(self, *vehicles: tuple[str, int]) -> None:
        told = chasers(*vehicles, target="t", stamp_ns=self.now_ns)
        self.ear.bus.publish(CHASERS, told, target="t", author=told.author)
