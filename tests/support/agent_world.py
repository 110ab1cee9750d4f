"""Agents on a simulated network, with their planners, and targets that stand where they are put."""

import math
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from support.makers import target_pose
from support.planner_swarm import planning
from support.swarm_model import SwarmModel

from planner_service.service import PlannerService
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.scenario import plan_agents
from swarm.config.scenario_files import parse_scenario
from swarm.right_of_way.promise_store import PromiseStore
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.vehicles import Followed, VehicleState
from swarm.wire.topics import FOLLOWED, POSE
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


FORK = [
    "###################",
    "#.................#",
    "#.####.##########.#",
    "#.####.##########.#",
    "#.................#",
    "###################",
]
"""Two ways, which part in column 6."""
CLOSED_FORK = [FORK[0], "#............#....#", *FORK[2:]]
OPEN = ["." * 20] * 20
"""A picture for `pace_of`: level ground without an obstacle."""


def pace_of(picture: Sequence[str]) -> NDArray[np.float32]:
    """Pace from a picture: '#' is lethal, '~' is three times as slow, anything else is level ground."""
    values = {"#": math.inf, "~": 0.3}
    return np.array([[values.get(sign, 0.1) for sign in line] for line in picture], np.float32)


class AgentWorld(SwarmModel):
    """A terrain, its agents, a planner per target, and a watchman who sees every vehicle at every tick."""

    def __init__(self, scenario: str, prior: NDArray[np.float32], truth: NDArray[np.float32] | None = None) -> None:
        super().__init__(terrain=terrain_of_pace(prior, 10.0), scenario=parse_scenario(scenario))
        self.truth = np.array(self.terrain.ground_s_per_m if truth is None else truth, np.float32)
        self.agents: dict[str, AgentService] = {}
        self.poses: dict[str, TargetPose] = {}
        self.followed: list[Followed] = []
        self.meetings: list[str] = []
        self.lethal: list[str] = []
        self.after_tick.append(self._look_around)
        self._watch = self.bus("watch")
        self._watch.subscribe(FOLLOWED, lambda event: self.followed.append(event.message))

    # --- who is there ---------------------------------------------------------------------------------------

    def begin(self, **targets: tuple[int, int]) -> Self:
        """Puts targets in their places, and starts all."""
        for target, (row, col) in targets.items():
            self.put_target(target, row, col)
        self.start_all()
        return self

    def start_all(self) -> None:
        for target in self.scenario.target_ids:
            self.start_planner(target)
        for plan in plan_agents(self.scenario):
            self.start_agent(plan.id)

    def start_planner(self, target: str) -> None:
        plans = planning(self, "planner", target)
        self.start(f"planner-{target}", lambda bus, post: PlannerService(plans(bus, post)))

    def start_agent(self, id: str) -> AgentService:
        setup, store = self.setup("agent", id, self.now_ns), PromiseStore(len(self.agents) + 1)
        hz = self.scenario.vehicles.tick_hz
        self.agents[id] = self.start(
            f"agent-{id}",
            lambda bus, post: AgentService(setup, self.terrain, self.truth, bus, post, store),
            hz,
            int(NS_PER_S / hz) * (2 + len(self.agents)) // 7,  # agents tick at different moments
        )
        return self.agents[id]

    def _look_around(self) -> None:
        where: dict[int, str] = {}
        for vehicle in self.vehicles():
            if vehicle.cell in where:
                self.meetings.append(f"{where[vehicle.cell]} and {vehicle.id} on {vehicle.cell} at {self.now_ns}")
            where[vehicle.cell] = vehicle.id
            if not math.isfinite(self.truth.reshape(-1)[vehicle.cell]):
                self.lethal.append(f"{vehicle.id} on {vehicle.cell}")

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
