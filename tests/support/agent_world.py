"""Agents on a simulated network, with planners and targets that are as simple as can be."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from support.makers import cost_reply, route_reply, target_pose
from support.swarm_model import SwarmModel

from planner_service.target_tree import TargetTree
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import Asked, Event, Heard
from swarm.bus.memory_bus import LinkModel
from swarm.clock import NS_PER_S
from swarm.config.scenario import AgentPlan, PlannerConfig, plan_agents
from swarm.config.scenario_files import parse_scenario
from swarm.peers import Peer
from swarm.right_of_way.promise_store import PromiseStore
from swarm.wire.fields import column
from swarm.wire.messages.map_data import MarkKind, MarkSet
from swarm.wire.messages.planning import CostReply, CostRequest, RouteReply, RouteRequest, TargetPose
from swarm.wire.messages.vehicles import Fleet, Followed, VehicleState
from swarm.wire.topics import COST, FLEET, FOLLOWED, MARKS, POSE, ROUTE
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.service import AgentService

SCENARIO = """
name = "test"
seed = 3
[[targets]]
name = "t"
walk = "still"
[[groups]]
vehicles = {vehicles}
cells = {cells}
[vehicles]
per_agent = {per_agent}
sense_range_m = 30.0
capture_range_m = {capture}
"""


def scenario(
    vehicles: int, cells: list[tuple[int, int]] | None = None, per_agent: int = 2, capture: float = 10.0
) -> str:
    given = [list(cell) for cell in cells or []]
    return SCENARIO.format(vehicles=vehicles, cells=given, per_agent=per_agent, capture=capture)


OPEN = ["." * 20] * 20
"""A picture for `pace_of`: level ground without an obstacle."""


def pace_of(picture: Sequence[str]) -> NDArray[np.float32]:
    """Pace from a picture: '#' is lethal, '~' is three times as slow, anything else is level ground."""
    values = {"#": math.inf, "~": 0.3}
    return np.array([[values.get(sign, 0.1) for sign in line] for line in picture], np.float32)


class FakePlanner:
    """Serves exact routes and costs to one target, from one tree and without any cores around it."""

    def __init__(self, world: AgentWorld, target: str, incarnation: int = 1) -> None:
        self.world = world
        self.target = target
        self.pace = np.array(world.terrain.pace_s_per_m)
        self.cell: int | None = None
        self.requests: list[RouteRequest] = []
        self.incarnation = incarnation
        self._tree = TargetTree(world.terrain.grid, PlannerConfig(strategy="full"))
        self.bus = world.bus(f"planner-{target}-{incarnation}")
        self.bus.subscribe(POSE, self.handle, target=target)
        self.bus.subscribe(MARKS, self.handle)
        self.bus.serve(ROUTE, self.handle, target=target)
        self.bus.serve(COST, self.handle, target=target)
        self.bus.declare_alive(Peer("planner", target, incarnation))

    def handle(self, event: Event) -> None:
        match event:
            case Heard(message=TargetPose() as pose):
                self.cell = pose.cell
                self._tree.update(self.pace, self.cell, [], 0)
            case Heard(message=MarkSet() as marks):
                self._mark(marks)
            case Asked(request=RouteRequest() as request):
                self.requests.append(request)
                event.answer(self._routes(request))
                event.end()
            case Asked(request=CostRequest() as costs):
                event.answer(self._costs(costs))
                event.end()
            case _:
                pass

    def _mark(self, marks: MarkSet) -> None:
        window = self.world.terrain.grid.tile_window(marks.tile)
        prior = self.world.terrain.pace_s_per_m
        for inner, kind, pace in zip(
            column(marks.cells, "<u2"), marks.kinds, column(marks.paces, "<f4"), strict=True
        ):
            row, col = window.row0 + int(inner) // 32, window.col0 + int(inner) % 32
            value = {MarkKind.PACE: float(pace), MarkKind.LETHAL: math.inf}.get(MarkKind(kind), prior[row, col])
            self.pace[row, col] = value
        if self.cell is not None:
            self._tree.update(self.pace, self.cell, [window], 0)

    def _routes(self, request: RouteRequest) -> RouteReply:
        routes = self._tree.routes(request.cells, request.max_cells)
        return route_reply(routes, self.world.terrain.grid, **self._fields)

    def _costs(self, request: CostRequest) -> CostReply:
        return cost_reply(self._tree.cost_to_go_at(np.array(request.cells)).tolist(), **self._fields)

    @property
    def _fields(self) -> dict[str, Any]:
        return {"target": self.target, "incarnation": self.incarnation, "target_cell": self.cell}


class AgentWorld(SwarmModel):
    """A terrain, its agents, a fake planner per target, and a watchman who sees every vehicle at every tick."""

    def __init__(
        self,
        scenario: str,
        prior: NDArray[np.float32],
        truth: NDArray[np.float32] | None = None,
        links: LinkModel | None = None,
    ) -> None:
        super().__init__(links, terrain_of_pace(prior, 10.0), parse_scenario(scenario))
        self.truth = np.array(self.terrain.ground_s_per_m if truth is None else truth, np.float32)
        self.agents: dict[str, AgentService] = {}
        self.stores: dict[str, PromiseStore] = {}
        self.planners: dict[str, FakePlanner] = {}
        self.poses: dict[str, TargetPose] = {}
        self.fleets: list[Fleet] = []
        self.followed: list[Followed] = []
        self.ghosts: dict[str, dict[str, int]] = {}
        self.meetings: list[str] = []
        self.lethal: list[str] = []
        self.after_tick.append(self._look_around)
        self._watch = self.bus("watch")
        self._watch.subscribe(FLEET, self._hear)
        self._watch.subscribe(FOLLOWED, self._hear)

    def _hear(self, event: Event) -> None:
        match event:
            case Heard(message=Fleet() as fleet):
                self.fleets.append(fleet)
            case Heard(message=Followed() as followed):
                self.followed.append(followed)
            case _:
                pass

    # --- who is there ---------------------------------------------------------------------------------------

    @property
    def plans(self) -> list[AgentPlan]:
        return plan_agents(self.scenario)

    def begin(self, **targets: tuple[int, int]) -> Self:
        """Puts targets in their places, and starts all."""
        for target, (row, col) in targets.items():
            self.put_target(target, row, col)
        self.start_all()
        return self

    def start_all(self) -> None:
        for target in self.scenario.target_ids:
            self.start_planner(target)
        for plan in self.plans:
            self.start_agent(plan.id)

    def start_planner(self, target: str, incarnation: int = 1) -> FakePlanner:
        self.planners[target] = FakePlanner(self, target, incarnation)
        return self.planners[target]

    def start_agent(self, id: str) -> AgentService:
        setup = self.setup("agent", id, self.now_ns)
        self.stores.setdefault(id, PromiseStore(len(self.stores) + 1))
        hz = self.scenario.vehicles.tick_hz
        self.agents[id] = self.start(
            f"agent-{id}",
            lambda bus, post: AgentService(setup, self.terrain, self.truth, bus, post, self.stores[id]),
            hz,
            int(NS_PER_S / hz) * (2 + len(self.agents)) // 7,  # agents tick at different moments
        )
        return self.agents[id]

    def crash_agent(self, id: str) -> None:
        """The process ends; its vehicles stay at their places."""
        service = self.agents.pop(id)
        if service.agent.vehicles:
            self.ghosts[id] = {v.id: v.cell for v in service.agent.vehicles.values()}
        self.kill(f"agent-{id}")

    def _look_around(self) -> None:
        where: dict[int, str] = {}
        standing = [(vehicle.id, vehicle.cell) for vehicle in self.vehicles()]
        for agent, vehicles in list(self.ghosts.items()):
            if agent in self.agents and self.agents[agent].agent.vehicles:
                del self.ghosts[agent]  # they are vehicles again
            else:
                standing += vehicles.items()
        for id, cell in standing:
            if cell in where:
                self.meetings.append(f"{where[cell]} and {id} on {cell} at {self.now_ns}")
            where[cell] = id
            if not math.isfinite(self.truth.reshape(-1)[cell]):
                self.lethal.append(f"{id} on {cell}")

    # --- targets and time -----------------------------------------------------------------------------------

    def put_target(self, target: str, row: int, col: int, *, jumped: bool = False) -> None:
        """A target is somewhere, and says so ten times a second from now on."""
        known = self.poses.get(target)
        cell = self.terrain.grid.cell(row, col)
        seq, jumps = (0, 0) if known is None else (known.seq, known.jumps + jumped)
        self.poses[target] = target_pose(
            target, cell, self.terrain.grid, seq=seq, stamp_ns=self.now_ns, jumps=jumps
        )
        if known is None:
            self._tell(target)

    def _tell(self, target: str) -> None:
        old = self.poses[target]
        self.poses[target] = replace(old, seq=old.seq + 1, stamp_ns=self.now_ns)
        self._watch.publish(POSE, self.poses[target], target=target)
        self.scheduler.after(NS_PER_S // 10, lambda: self._tell(target))

    def until(self, true: Callable[[], object], within_s: float = 5.0, step_s: float = 0.1) -> float:
        return super().until(true, within_s, step_s)

    def arrive(self, within_s: float) -> float:
        """Runs until all vehicles have arrived, by ways that break no law; returns the seconds that it took."""
        took_s = self.until(lambda: self.all_in(VehicleState.ARRIVED), within_s)
        self.assert_lawful()
        return took_s

    # --- what there is to see -------------------------------------------------------------------------------

    def vehicles(self) -> list[Vehicle]:
        return [vehicle for service in self.agents.values() for vehicle in service.agent.vehicles.values()]

    def states(self) -> dict[str, VehicleState]:
        return {vehicle.id: vehicle.state for vehicle in self.vehicles()}

    def all_in(self, state: VehicleState) -> bool:
        states = self.states()
        return len(states) == self.scenario.vehicle_count and all(found is state for found in states.values())

    def count(self, name: str) -> int:
        return sum(service.counters.counts.get(name, 0) for service in self.agents.values())

    def where(self) -> dict[str, tuple[int, int]]:
        grid = self.terrain.grid
        return {vehicle.id: grid.row_col(vehicle.cell) for vehicle in self.vehicles()}

    def describe(self) -> str:
        states = self.states()
        return ", ".join(f"{id} {states[id].name} at {place}" for id, place in self.where().items())

    def assert_lawful(self) -> None:
        assert self.meetings == []
        assert self.lethal == []
