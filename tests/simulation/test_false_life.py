"""One message that names a younger life of an agent stops it for a moment, not for good."""

from __future__ import annotations

import msgspec
import pytest

from launch_scripts.simulation.laws import Laws
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.worlds import seeded
from swarm.bus.bus import Event, Heard
from swarm.wire.messages.traffic import Standing
from swarm.wire.topics import STANDING
from vehicle_agent.agent import Agent
from vehicle_agent.service import AgentService

LIFE = 1 << 32
"""From one life to the next."""


def agent_of(simulation: Simulation) -> Agent:
    service = simulation.nodes["agent-a1"].service
    assert isinstance(service, AgentService)
    return service.agent


@pytest.mark.parametrize("seed", range(3))
def test_vehicles_that_a_false_life_stopped_drive_again_within_three_seconds(seed):
    simulation = Simulation(seeded(seed))
    laws = Laws(simulation)
    heard: list[Standing] = []

    def hear(event: Event) -> None:
        if isinstance(event, Heard) and isinstance(event.message, Standing) and event.message.agent == "a1":
            heard.append(event.message)

    stranger = simulation.network.bus("stranger")
    stranger.subscribe(STANDING, hear)
    simulation.run_until(6)
    before = agent_of(simulation)
    assert len(before.vehicles) == 4
    for plot in {each.plot for each in heard}:
        last = [each for each in heard if each.plot == plot][-1]
        false = msgspec.structs.replace(last, life=last.life + LIFE, seq=last.seq + 1)
        stranger.publish(STANDING, false, plot=plot, agent="a1")
    simulation.run_until(7)
    assert before.vehicles == {}  # it must not drive before it knows
    simulation.run_until(10)
    again = agent_of(simulation)
    assert again is not before
    assert len(again.vehicles) == 4
    assert not again.holdings.replaced
    places = {id: vehicle.motion.place_m() for id, vehicle in again.vehicles.items()}
    simulation.run_until(14)
    assert any(vehicle.motion.place_m() != places[id] for id, vehicle in again.vehicles.items())
    assert laws.collisions == []
