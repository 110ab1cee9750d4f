"""The whole swarm in dense traffic: no two vehicles meet and none waits for long, with crashes, cuts and double
starts."""

import pytest
from msgspec.structs import replace
from support.simulated import cells

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import CROWDS, crowd, seeded
from launch_scripts.simulation.simulate import Simulation
from swarm.config.scenario import TlsConfig

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
