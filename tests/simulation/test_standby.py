"""Planners and the targets process die for good, and their standbys go on."""

import itertools
from typing import Any

import msgspec
import pytest

from launch_scripts.simulation.faults import Crash, FaultPlan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import SMALL, seeded
from launch_scripts.simulation.simulate import Node, Simulation
from planner_service.service import PlannerService
from swarm.bus.bus import Event, Heard, Replied
from swarm.config.scenario import StandbyConfig
from swarm.wire.messages.planning import RouteReply, RouteRequest, TargetPose
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import POSE, ROUTE

STANDING_BY = msgspec.structs.replace(SMALL, standbys=StandbyConfig(planner=1, targets=1))
ASK_S = 0.1
TOLD_AGAIN_S = 0.5
"""Seconds until the next pose of a target after a lost one."""
LONGEST_GAP_S = 1.0
"""Longest time without an answer, simulated. A leader's death is noticed after 0.6 s, at the next tick."""


class Asker:
    """A client that asks every planner for a route ten times a second, and notes when it was answered."""

    def __init__(self, simulation: Simulation, until_s: float) -> None:
        self.simulation = simulation
        self.answered_s: dict[str, list[float]] = {id: [] for id in simulation.scenario.target_ids}
        self.bus = simulation.network.bus("asker-0", simulation.scenario.network.namespace)
        for n in range(int(until_s / ASK_S)):
            simulation.at(n * ASK_S, self.ask)

    def ask(self) -> None:
        for target in self.answered_s:
            request = RouteRequest(row=20, col=20)
            self.bus.ask(ROUTE, request, self.take, tag="asker", timeout_s=1.0, target=target)

    def take(self, event: Event) -> None:
        if isinstance(event, Replied) and isinstance(event.message, RouteReply):
            reply = event.message
            if reply.routes[0].status is not RouteStatus.NO_TARGET:
                self.answered_s[reply.target].append(self.simulation.now_s)

    def longest_gap_s(self, target: str, from_s: float, until_s: float) -> float:
        times = [from_s, *(each for each in self.answered_s[target] if from_s <= each <= until_s), until_s]
        return max(late - early for early, late in itertools.pairwise(times))


def leaders(simulation: Simulation, target: str) -> list[str]:
    found = []
    for node in simulation.nodes.values():
        service: Any = node.service
        if isinstance(service, PlannerService) and service._target == target and service._planner.leads:
            found.append(node.name)
    return found


@pytest.mark.seeds(2)
def test_the_leader_of_each_target_dies_for_good_and_queries_are_answered_again_within_a_second(
    seed: int,
) -> None:
    crashes = tuple(Crash(8 + 2.3 * n, f"planner-t{n}", for_good=True) for n in range(2))
    plan = FaultPlan(drop=0.02, jitter_ms=10, crashes=crashes)
    simulation = Simulation(seeded(seed, STANDING_BY), faults=plan)
    laws, asker = LawBook(simulation), Asker(simulation, 20)
    simulation.run_until(7)
    assert [leaders(simulation, id) for id in ("t0", "t1")] == [["planner-t0"], ["planner-t1"]]
    simulation.run_until(20)
    assert [leaders(simulation, id) for id in ("t0", "t1")] == [["planner-t0.r1"], ["planner-t1.r1"]]
    gaps_s = [asker.longest_gap_s(id, 5, 20) for id in ("t0", "t1")]
    assert max(gaps_s) <= LONGEST_GAP_S, gaps_s
    assert min(gaps_s) > 0.4  # they did die
    simulation.finish()
    report = simulation.report(20)
    assert report["lost"] == 0
    assert laws.collisions == laws.lethal == []


def test_vehicles_are_pushed_routes_by_a_standby_as_soon_as_it_leads() -> None:
    simulation = Simulation(
        seeded(3, STANDING_BY), faults=FaultPlan(crashes=(Crash(8, "planner-t0", for_good=True),))
    )
    simulation.run_until(7.9)
    standby: Any = simulation.nodes["planner-t0.r1"].service
    assert standby.counters.counts["pushes"] == standby.counters.counts["routes_served"] == 0
    followers = len(standby._planner.followers)
    assert followers > 0
    simulation.run_until(8.9)
    assert standby.counters.counts["pushes"] >= followers // 2
    known = standby._planner.followers.all_items()
    assert all(each.route is not None for _, each in known if not each.stale)


class Poses:
    """The poses of targets as an observer hears them, in order, and the true places."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.heard: dict[str, list[tuple[float, TargetPose]]] = {id: [] for id in simulation.scenario.target_ids}
        simulation.network.bus("poses-0", simulation.scenario.network.namespace).subscribe(POSE, self.take)

    def take(self, event: Event) -> None:
        if isinstance(event, Heard) and isinstance(event.message, TargetPose):
            self.heard[event.message.target].append((self.simulation.now_s, event.message))


def leads(node: Node) -> bool:
    service: Any = node.service
    return service is not None and bool(service._world.leads)


@pytest.mark.seeds(2)
def test_the_targets_go_on_from_where_they_are_and_captures_count_on(seed: int) -> None:
    plan = FaultPlan(drop=0.02, jitter_ms=10, crashes=(Crash(10, "targets-0", for_good=True),))
    simulation = Simulation(seeded(seed, STANDING_BY), faults=plan)
    poses = Poses(simulation)
    simulation.run_until(9.9)
    assert leads(simulation.nodes["targets-0"])
    assert not leads(simulation.nodes["targets-0.r1"])
    simulation.run_until(24)
    assert leads(simulation.nodes["targets-0.r1"])
    grid = simulation.terrain.grid
    for heard in poses.heard.values():
        numbers = [(pose.incarnation, pose.seq) for _, pose in heard]
        before = max((each for each in heard if each[0] < 10), key=lambda each: each[1].seq)
        after = min((each for each in heard if each[0] > 10.2), key=lambda each: each[1].seq)
        assert after[0] - before[0] <= LONGEST_GAP_S + TOLD_AGAIN_S
        assert after[1].incarnation > before[1].incarnation or after[1].incarnation == max(numbers)[0]
        if after[1].jumps == before[1].jumps:
            assert grid.distance_cells(before[1].cell, after[1].cell) <= 3
        last = max(heard, key=lambda each: (each[1].incarnation, each[1].seq))[1]
        assert last.captures >= after[1].captures >= before[1].captures
        assert len([each for each in heard if each[0] > 12]) > 10
    simulation.finish()
    told = sum(max(pose.captures for _, pose in heard) for heard in poses.heard.values())
    assert told > 0
    # The report lacks the counts since the last publication of the dead process, a second before at most.
    assert told - 1 <= simulation.report(24)["captures"] <= told
