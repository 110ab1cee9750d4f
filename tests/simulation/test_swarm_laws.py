"""The laws hold in the whole swarm, whatever the network and the processes do: a failing seed replays exactly."""

import numpy as np
import pytest
from support.simulated import agents, cells

from launch_scripts.check.scenario_check import one_way_ground
from launch_scripts.simulation.faults import Crash, FaultPlan, Partition, random_plan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import SMALL, seeded, world
from launch_scripts.simulation.simulate import Node, Simulation
from vehicle_agent.service import AgentService

SECONDS = 24.0


def check_all(simulation: Simulation) -> LawBook:
    """Runs to the end; every law holds."""
    trial = LawBook(simulation)
    assert trial.run(SECONDS) == []
    planners: list[np.ndarray] = [
        simulation.nodes[name].service._cost_maps["ground"].pace_s_per_m  # type: ignore[union-attr]
        for name in ("planner-t0", "planner-t1")
    ]
    np.testing.assert_array_equal(*planners)
    simulation.finish()
    return trial


def test_a_run_in_which_nothing_goes_wrong_keeps_every_law_and_does_its_work():
    simulation = Simulation(seeded(1))
    check_all(simulation)
    report = simulation.report(SECONDS)
    assert report["vehicles_routed"] == report["vehicles"] == 10
    assert report["captures"] > 0
    assert report["marks"] > 0
    assert report["reroute_requests"] > 0
    assert report["collisions"] == report["lethal_entries"] == 0
    assert report["lost"] == report["restarts"] == report["payloads_dropped"] == 0
    assert report["startup_s"] < 3.0
    assert report["gap"]["mean"] >= 1.0


@pytest.mark.seeds(4)
def test_the_laws_hold_under_seeded_faults(seed):
    simulation = Simulation(seeded(seed), faults=random_plan(SMALL, seed, SECONDS))
    check_all(simulation)
    report = simulation.report(SECONDS)
    assert report["vehicles_routed"] == 10
    assert report["captures"] > 0
    assert report["lethal_entries"] == report["payloads_dropped"] == 0


@pytest.mark.parametrize("seed", [0, pytest.param(4, marks=pytest.mark.thorough)])
def test_vehicles_among_one_way_slopes_have_a_route_or_say_that_they_are_stranded_and_check_warns(seed):
    scenario, terrain = world("slopes", seed)
    simulation = Simulation(scenario, faults=random_plan(scenario, seed, SECONDS), terrain=terrain)
    assert "the ground where vehicles start" in next(one_way_ground(scenario, terrain, simulation.truth)).sentence
    assert LawBook(simulation).run(SECONDS) == []


def test_an_agent_cut_off_enters_nothing_new_and_goes_on_when_it_is_back():
    plan = FaultPlan(partitions=(Partition(4, 12, ("agent-a1",)),), quiet_s=16)
    simulation = Simulation(seeded(2), faults=plan)
    laws = LawBook(simulation)
    simulation.run_until(4)
    agent = agents(simulation)["agent-a1"].agent
    simulation.run_until(4.2)  # a message in transit before the cut may still be granted
    held = {id: list(agent.holdings.path(id)) for id in agent.vehicles}
    simulation.run_until(12)
    assert all(vehicle.cell in held[id] for id, vehicle in agent.vehicles.items())
    simulation.run_until(20)
    assert not all(vehicle.cell in held[id] for id, vehicle in agent.vehicles.items())
    assert laws.collisions == []


def test_an_agent_restarted_while_cut_off_waits_until_someone_tells_where_its_vehicles_stood():
    plan = FaultPlan(partitions=(Partition(4, 12, ("agent-a1",)),), crashes=(Crash(9, "agent-a1"),), quiet_s=16)
    simulation = Simulation(seeded(1), faults=plan)
    laws = LawBook(simulation)
    simulation.run_until(8.9)
    stood = {id: cell for id, cell in cells(simulation).items() if id.startswith("a1")}
    simulation.run_until(12)
    assert agents(simulation)["agent-a1"].agent.vehicles == {}
    simulation.run_until(13)
    back = {id: cell for id, cell in cells(simulation).items() if id.startswith("a1")}
    assert back.keys() == stood.keys()
    # On one of the cells that had been granted, of which there are 16 ahead at most.
    assert max(simulation.terrain.grid.distance_cells(cell, stood[id]) for id, cell in back.items()) <= 16
    simulation.run_until(20)
    assert laws.collisions == []


WITHIN_S = 1.3
"""Seats, a leader, a table on file, costs and routes are a tick of an agent each, and a claim may come to nothing
once."""


@pytest.mark.seeds(6)
def test_every_vehicle_has_a_route_soon_after_the_last_process_has_started_whatever_their_order(seed):
    simulation = Simulation(seeded(seed, SMALL))
    begun_s: list[float] = []
    simulation.after_boot.append(lambda node: begun_s.append(simulation.now_s))
    routed_s: dict[str, float] = {}

    def look(node: Node) -> None:
        if isinstance(node.service, AgentService) and node.name not in routed_s:
            agent = node.service.agent
            routed = [id for id, each in agent.vehicles.items() if each.route.left or each.in_reach]
            if set(routed) == set(agent.plan.vehicle_ids):
                routed_s[node.name] = simulation.now_s

    simulation.after_tick.append(look)
    simulation.run_until(3.0)
    agents = [name for name in simulation.nodes if name.startswith("agent-")]
    assert len(agents) >= 3
    assert routed_s.keys() == set(agents)
    assert max(routed_s.values()) - max(begun_s) < WITHIN_S
