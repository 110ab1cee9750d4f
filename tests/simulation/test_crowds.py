"""The whole swarm in dense traffic: no two vehicles meet and none waits for long, with crashes, cuts and double
starts."""

import pytest
from msgspec.structs import replace
from support.simulated import cells

from launch_scripts.simulation.faults import Crash, FaultPlan, Partition, Twin, random_plan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import CROWDS, crowd, seeded
from launch_scripts.simulation.simulate import Simulation
from swarm.config.scenario import TlsConfig
from swarm.wire.messages.vehicles import VehicleState

SECONDS = 20.0


def flows(scenario, terrain, plan):
    """Every law holds in a crowd, and it does its work."""
    simulation = Simulation(scenario, faults=plan, terrain=terrain)
    assert LawBook(simulation).run(SECONDS) == []
    assert simulation.report(SECONDS)["captures"] > 5


@pytest.mark.parametrize(
    "kind", [kind if kind == "maze" else pytest.param(kind, marks=pytest.mark.thorough) for kind in CROWDS]
)
def test_eight_agents_in_a_crowd_with_every_fault_at_once(kind):
    scenario, terrain = crowd(kind, 1, vehicles=40, per_agent=5, side=19)
    plan = random_plan(scenario, 1, SECONDS)
    assert plan.crashes and plan.partitions and plan.hangs  # noqa: PT018
    flows(scenario, terrain, plan)


@pytest.mark.seeds(1)
def test_a_crowd_with_certificates_and_every_fault_flows(seed):
    scenario, terrain = crowd("open", seed, vehicles=20, per_agent=5, side=13)
    tls = TlsConfig(ca="ca.pem", certificate="certs", key="certs")
    scenario = replace(scenario, network=replace(scenario.network, tls=tls))
    flows(scenario, terrain, random_plan(scenario, seed, SECONDS))


def test_vehicles_that_wait_because_two_of_three_members_are_gone_say_why_and_drive_on_when_one_is_back():
    simulation = Simulation(seeded(1))
    simulation.run_until(5)
    for name in ("agent-a0", "agent-a1"):
        simulation.nodes[name].crash()
    simulation.run_until(9)
    notes = [note for _, note in simulation.recorder.notes if note.kind == "waiting"]
    assert [note.id for note in notes] == ["a2"]
    assert "agents which grant the next cells (a0, a2, a1) do not answer" in notes[0].text
    before = cells(simulation)
    simulation.nodes["agent-a0"].boot()
    simulation.run_until(14)
    assert any(cells(simulation)[id] != cell for id, cell in before.items())


@pytest.mark.seeds(4)
def test_of_two_generations_of_one_agent_the_older_stops_until_the_younger_is_gone_and_no_one_is_met(seed):
    """An agent is cut off, and started again on another machine; then the cut heals. Later that machine dies."""
    plan = FaultPlan(partitions=(Partition(5, 9, ("agent-a1",)),), twins=(Twin(8, "agent-a1"),))
    simulation = Simulation(seeded(seed), faults=plan)
    laws = LawBook(simulation)
    simulation.run_until(22)
    older, younger = (simulation.nodes[name].service for name in ("agent-a1", "agent-a1.2"))
    assert laws.collisions == []
    assert older.agent.vehicles == {}
    assert len(younger.agent.vehicles) == 4
    assert any(vehicle.state is not VehicleState.IDLE for vehicle in younger.agent.vehicles.values())
    simulation.nodes["agent-a1.2"].crash()  # for good: the older one takes over again
    simulation.run_until(25)
    before = {id: vehicle.cell for id, vehicle in older.agent.vehicles.items()}
    simulation.run_until(34)  # some stand in a knot with others for several seconds
    assert len(before) == 4
    assert sum(older.agent.vehicles[id].cell != cell for id, cell in before.items()) >= 2
    assert laws.collisions == []


@pytest.mark.parametrize("skew_s", [3600.0, -1_799_999_000.0])
def test_an_agent_that_starts_again_with_another_clock_is_like_any_other(skew_s):
    """An hour forward, and in 1970."""
    simulation = Simulation(seeded(3), faults=FaultPlan(crashes=(Crash(6, "agent-a1"),)))
    laws = LawBook(simulation)
    simulation.run_until(6.1)
    simulation.nodes["agent-a1"].skew_ns = int(skew_s * 1e9)
    simulation.run_until(8)
    before = {id: cell for id, cell in cells(simulation).items() if id.startswith("a1")}
    assert len(before) == 4
    moved: set[str] = set()  # one may be back where it was, after its target was given to another
    while simulation.now_s < 14:
        simulation.run_until(simulation.now_s + 0.5)
        moved |= {id for id, cell in before.items() if cells(simulation)[id] != cell}
    assert moved == set(before)
    assert laws.collisions == []
