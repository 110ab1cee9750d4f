"""Targets that the run does not move: trackers from outside come, die, meet a second one, and hand over."""

from dataclasses import dataclass, field
from typing import Any

import msgspec
import pytest
from support.makers import target_pose
from support.simulated import vehicles

from launch_scripts.simulation.faults import FaultPlan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import SMALL, seeded
from launch_scripts.simulation.simulate import EPOCH_NS, Simulation
from launch_scripts.simulation.world.service import TargetsService
from planner_service.service import PlannerService
from swarm.bus.bus import Event, Heard, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import TargetConfig
from swarm.runtime.tracker_ownership import Tracking
from swarm.wire.messages.planning import (
    CostReply,
    CostRequest,
    PlannerStatus,
    RouteReply,
    RouteRequest,
    Sighted,
)
from swarm.wire.messages.processes import Note
from swarm.wire.messages.vehicles import VehicleState
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import COST, POSE, ROUTE, SIGHTED, STATUS
from vehicle_agent.service import AgentService

EXTERNAL = msgspec.structs.replace(
    SMALL, targets=(TargetConfig(name="x", walk="external", caught="stay"), TargetConfig(name="t", walk="still"))
)
LOSSY = FaultPlan(drop=0.1, duplicate=0.05, reorder=0.05, jitter_ms=30)
HOUR_S = 3600.0


@dataclass(eq=False)
class OutsideTracker:
    """A process that is not ours: tells five times a second where target x is, by a clock that may be wrong."""

    simulation: Simulation
    name: str
    rows: int
    from_s: float
    until_s: float
    clock_off_s: float = 0.0
    hands_over: bool = False
    seq: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.bus = self.simulation.network.bus(f"{self.name}-{self.from_s}", EXTERNAL.network.namespace)
        times = [self.from_s + n / 5 for n in range(int(5 * (self.until_s - self.from_s)))]
        for at_s in times:
            self.simulation.at(at_s, lambda last=at_s == times[-1]: self.tell(last and self.hands_over))  # type: ignore[misc]

    def tell(self, over: bool) -> None:
        grid = self.simulation.terrain.grid
        cell = grid.cell(self.rows, grid.cols // 2)
        self.seq += 1
        pose = target_pose(
            "x", cell, grid, tracker=self.name, incarnation=self.stamp_ns(self.from_s), seq=self.seq,
            stamp_ns=self.stamp_ns(self.simulation.now_s), lease_s=0.0 if over else 2.0,
        )  # fmt: skip
        self.bus.publish(POSE, pose, target="x")

    def stamp_ns(self, at_s: float) -> int:
        return EPOCH_NS + int((at_s + self.clock_off_s) * NS_PER_S)


class Ear:
    """A client that hears the planner of x, and asks it."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.bus = simulation.network.bus("ear-0", EXTERNAL.network.namespace, simulation.authenticator)
        self.status: PlannerStatus | None = None
        self.route: RouteReply | None = None
        self.cost: CostReply | None = None
        self.bus.subscribe(STATUS, self.take, target="x")

    def take(self, event: Event) -> None:
        match event:
            case Heard(message=PlannerStatus() as status):
                self.status = status
            case Replied(message=RouteReply() as reply):
                self.route = reply
            case Replied(message=CostReply() as reply):
                self.cost = reply

    def ask(self) -> RouteReply:
        """The planner's answer to a route and to a cost, which tell the same age."""
        for _ in range(5):  # a query may be lost, or a pose heard between the two
            self.route = self.cost = None
            self.bus.ask(ROUTE, RouteRequest(row=20, col=20), self.take, tag="route", timeout_s=1.0, target="x")
            self.bus.ask(COST, CostRequest(row=20, col=20), self.take, tag="cost", timeout_s=1.0, target="x")
            self.simulation.run_until(self.simulation.now_s + 0.2)
            if self.route is None or self.cost is None:
                continue
            assert self.route.tracker_lost == self.cost.tracker_lost
            if self.route.pose_age_s == pytest.approx(self.cost.pose_age_s, abs=0.2):
                return self.route
        raise AssertionError(f"no two answers that agree: {self.route}, {self.cost}")


def notes(simulation: Simulation) -> list[Note]:
    """Sentences of planners for people."""
    return [note for _, note in simulation.recorder.notes if note.role == "planner"]


def kinds(simulation: Simulation) -> list[str]:
    return [note.kind for note in notes(simulation)]


def receivers(simulation: Simulation) -> dict[str, Tracking | None]:
    """The knowledge of all receivers of poses about the trackers of x."""
    found: dict[str, Tracking | None] = {"recorder": simulation.recorder.observed._trackings.of("x")}
    for node in simulation.nodes.values():
        service: Any = node.service
        match service:
            case PlannerService() if service._target == "x":
                found[node.name] = service._watch._tracking
            case AgentService():
                found[node.name] = service.agent._trackings.of("x")
            case TargetsService():
                found[node.name] = service._world._trackings.of("x")
    return found


def owners(simulation: Simulation) -> set[str | None]:
    everybody = receivers(simulation)
    assert len(everybody) == 6  # the recorder, a planner, three agents, the referee
    lost = {name for name, each in everybody.items() if each is None or each.lost(simulation.now_ns)}
    return {None if name in lost else each.pose.tracker for name, each in everybody.items()}  # type: ignore[union-attr]


def captures_of_x(simulation: Simulation) -> int:
    return sum(note.text.endswith("captured x") for _, note in simulation.recorder.notes)


def states(simulation: Simulation) -> set[VehicleState]:
    """States of the vehicles that chase x."""
    return {each.state for each in vehicles(simulation).values() if each.target == "x"}


@pytest.mark.parametrize("clock_off_s", [pytest.param(0.0, marks=pytest.mark.thorough), HOUR_S])
def test_a_dead_tracker_s_target_is_served_with_its_age_and_its_chasers_know(clock_off_s: float) -> None:
    simulation = Simulation(seeded(1, EXTERNAL), faults=LOSSY)
    laws, ear = LawBook(simulation), Ear(simulation)
    OutsideTracker(simulation, "radar", 20, 3, 12, clock_off_s)
    simulation.run_until(2.5)
    assert (ear.status.target_cell, ear.status.pose_age_s, ear.status.tracker_lost) == (None, None, False)
    simulation.run_until(11)
    reply = ear.ask()
    assert not reply.tracker_lost
    assert reply.pose_age_s is not None
    assert reply.pose_age_s < 1
    assert owners(simulation) == {"radar"}
    assert VehicleState.OUTDATED not in states(simulation)
    simulation.run_until(16)
    assert owners(simulation) == {None}
    reply = ear.ask()
    assert reply.tracker_lost
    assert reply.pose_age_s == pytest.approx(simulation.now_s - 12, abs=0.8)
    assert reply.target_cell == simulation.terrain.grid.cell(20, simulation.terrain.grid.cols // 2)
    assert states(simulation) == {VehicleState.OUTDATED}
    assert ear.status.tracker_lost
    line = next(each for each in simulation.recorder.summary(simulation.now_ns).targets if each.id == "x")
    assert line.lost
    assert line.pose_age_s == pytest.approx(simulation.now_s - 12, abs=0.8)
    assert line.title == f"x (lost for {line.pose_age_s:.0f} s)"
    before = captures_of_x(simulation)
    simulation.run_until(25)
    assert captures_of_x(simulation) == before, "nobody captures a target that is lost"
    OutsideTracker(simulation, "radar", 22, 25, 32, clock_off_s)
    simulation.run_until(30)
    assert owners(simulation) == {"radar"}
    assert not ear.ask().tracker_lost
    assert VehicleState.OUTDATED not in states(simulation)
    assert kinds(simulation) == ["tracker-lost", "tracker-back"]
    simulation.finish()
    tracking = simulation.report(30)["tracking"]
    assert tracking["lost"] == 1
    assert tracking["lost_at_end"] == []
    assert laws.collisions == laws.lethal == []


def test_a_target_whose_tracker_stays_lost_is_searched_for_until_it_or_a_vehicle_tells_where_it_is() -> None:
    simulation = Simulation(seeded(1, EXTERNAL))
    laws, ear = LawBook(simulation), Ear(simulation)
    OutsideTracker(simulation, "radar", 20, 3, 12)
    simulation.run_until(30)
    assert states(simulation) == {VehicleState.OUTDATED}
    assert next(iter(ear.ask().routes)).status is RouteStatus.OK, "it may be back soon"
    simulation.run_until(50)
    reply = ear.ask()
    assert next(iter(reply.routes)).status is RouteStatus.SEARCHING
    assert reply.tracker_lost
    assert VehicleState.SEARCHING in states(simulation)
    assert VehicleState.OUTDATED not in states(simulation)
    now_ns, grid = simulation.now_ns, simulation.terrain.grid
    cell = grid.cell(24, grid.cols // 2)
    x_m, y_m = grid.centre_m(cell)
    seen = Sighted(
        author="all.a0.9", group="all", target="x", seq=1, stamp_ns=now_ns, until_ns=now_ns + 5 * NS_PER_S,
        cell=cell, x_m=x_m, y_m=y_m, uncertainty_m=1.0,
    )  # fmt: skip
    ear.bus.publish(SIGHTED, seen, target="x", author="all.a0.9")
    simulation.run_until(simulation.now_s + 1)
    assert ear.status.target_cell == cell
    OutsideTracker(simulation, "radar", 22, 53, 62)
    simulation.run_until(58)
    assert next(iter(ear.ask().routes)).status is RouteStatus.OK
    assert owners(simulation) == {"radar"}
    assert not {VehicleState.OUTDATED, VehicleState.SEARCHING} & states(simulation)
    assert laws.collisions == laws.lethal == []


@pytest.mark.seeds(3)
@pytest.mark.parametrize("clock_off_s", [pytest.param(0.0, marks=pytest.mark.thorough), -HOUR_S])
def test_a_second_tracker_is_refused_by_everybody_until_the_first_is_dead(seed: int, clock_off_s: float) -> None:
    simulation = Simulation(seeded(seed, EXTERNAL), faults=LOSSY)
    OutsideTracker(simulation, "m", 20, 3, 15)
    OutsideTracker(simulation, "a", 30, 6, 30, clock_off_s)
    simulation.run_until(14)
    assert owners(simulation) == {"m"}
    assert kinds(simulation) == ["tracker-refused"]
    assert notes(simulation)[0].text == "target x: poses of tracker a are refused, as tracker m owns it"
    simulation.run_until(19)
    assert owners(simulation) == {"a"}
    assert {"tracker-changed", "tracker-lost"} & set(kinds(simulation))
    report = simulation.report(19)["tracking"]
    assert report["poses_refused"] > 30
