"""Lies that differ from the truth in one number: who may speak for all agents can stop vehicles, but only while it
speaks."""

import random

import pytest
from msgspec.structs import replace

from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.worlds import seeded
from swarm.bus.bus import Event, Heard
from swarm.errors import ProtocolError
from swarm.wire.codec import decode, encode
from swarm.wire.messages import Message
from swarm.wire.messages.traffic import Entry, Fence, Granted, Held, HostState, Left, Stored, Table
from swarm.wire.topics import GRANTED, HOST_STATE, LEFT, STORED, TABLE
from vehicle_agent.service import AgentService

LEAPS = (-1, 1, 2, 3, 100, 1 << 20, 1 << 32, (1 << 33) + 5, 1 << 40, 1 << 47)


def near_the_truth(said: Message, cells: int, chance: random.Random) -> Message:
    """The same with another number, or without what it held."""
    leap = chance.choice(LEAPS)
    match said:
        case HostState():
            return chance.choice(
                (
                    replace(said, generation=said.generation + leap),
                    replace(said, seq=said.seq + leap),
                    replace(said, seq=said.seq + abs(leap), knows=(said.knows[0] + 3, leap), vehicles=[]),
                    replace(said, dead=[said.generation]),
                    replace(said, ended=True),
                )
            )
        case Table():
            later = {agent: (generation + leap, seq + abs(leap)) for agent, (generation, seq) in said.hosts.items()}
            anywhere = {"a0-00": Held.of([(chance.randrange(cells), 0, 1) for _ in range(5)])}
            return chance.choice(
                (
                    replace(said, epoch=said.epoch + 3 * abs(leap)),
                    replace(said, seq=said.seq + leap),
                    replace(said, seq=said.seq + 1, grants={}),
                    replace(said, seq=said.seq + 1, hosts=later),
                    replace(said, seq=said.seq + 1, fences=[Fence(each, 1, anywhere) for each in said.hosts]),
                )
            )
        case Granted():
            somewhere = [Entry((chance.randrange(cells), 0, 1), [(0, 1, "a1-00")]) for _ in range(5)]
            held = Held.of([entry.number for entry in somewhere])
            grants, waits = dict.fromkeys(said.grants, held), dict.fromkeys(said.grants, somewhere)
            return chance.choice(
                (
                    replace(said, epoch=said.epoch + 3 * abs(leap)),
                    replace(said, seq=said.seq + abs(leap)),
                    replace(said, seq=said.seq + 1, generation=said.generation + leap),
                    replace(said, seq=said.seq + 1, heard=said.heard + abs(leap), grants={}),
                    replace(said, seq=said.seq + 1, grants=grants, waits=waits),
                )
            )
        case Left():
            return replace(said, entries=[(cell, epoch + leap, seq) for cell, epoch, seq in said.entries])
        case Stored():
            return replace(said, epoch=said.epoch + leap) if leap % 2 else replace(said, seq=said.seq + leap)
    raise TypeError(said)


def lied_to(simulation: Simulation, seconds: float, chance: random.Random) -> int:
    """Tell one such lie for each true message about right of way. Returns the number of processes that were lied
    to."""
    bus = simulation.network.bus("liar", simulation.scenario.network.namespace, simulation.authenticator)
    heard: list[Heard] = []
    lies: set[bytes] = set()

    def post(event: Event) -> None:
        if isinstance(event, Heard) and encode(event.message) not in lies:
            heard.append(event)

    for topic in (HOST_STATE, TABLE, GRANTED, LEFT, STORED):
        bus.subscribe(topic, post)
    end_s = simulation.now_s + seconds
    while simulation.now_s < end_s:
        simulation.run_until(simulation.now_s + 0.1)
        truths = list(heard)
        heard.clear()
        for truth in truths:
            lie = near_the_truth(truth.message, simulation.terrain.grid.cells, chance)
            try:
                decode(encode(lie), type(lie))
            except ProtocolError:
                continue
            lies.add(encode(lie))
            bus.publish(truth.topic, lie, **truth.fields)
    bus.close()
    return len(lies)


@pytest.mark.seeds(3)
def test_vehicles_go_on_once_the_lies_end(seed: int) -> None:
    simulation = Simulation(seeded(seed))
    simulation.run_until(5)
    assert lied_to(simulation, 2.0, random.Random(seed)) > 50
    simulation.run_until(simulation.now_s + 2.0)
    agents = [node.service.agent for node in simulation.nodes.values() if isinstance(node.service, AgentService)]
    before = {id: vehicle.motion.place_m() for agent in agents for id, vehicle in agent.vehicles.items()}
    simulation.run_until(simulation.now_s + 4.0)
    moved = [id for agent in agents for id, v in agent.vehicles.items() if v.motion.place_m() != before[id]]
    assert len(before) == simulation.scenario.vehicle_count
    assert len(moved) > 0.8 * len(before)
