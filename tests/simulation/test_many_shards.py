"""The laws on a map of several regions and many shards, the borders of which vehicles cross all the time."""

import msgspec
import pytest
from support.simulated import agents

from launch_scripts.simulation.faults import Crash, FaultPlan, Partition, random_plan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import WIDE, seeded
from launch_scripts.simulation.simulate import Simulation

SECONDS = 24.0


def test_agents_listen_to_the_shards_near_their_vehicles_and_keep_every_law():
    simulation = Simulation(seeded(1, WIDE))
    laws = LawBook(simulation)
    simulation.run_until(6)
    shards = [len(service._right_of_way.core.host.watched) for service in agents(simulation).values()]
    assert len(shards) == 8
    assert sum(shards) < 48  # of 64
    simulation.run_until(15.0)
    simulation.finish()
    report = simulation.report(15.0)
    assert report["vehicles_routed"] == 24
    assert report["captures"] > 0
    assert laws.collisions == laws.lethal == []
    assert report["collisions"] == report["lost"] == report["payloads_dropped"] == 0


@pytest.mark.seeds(2)
def test_no_one_meets_where_shards_are_larger_than_regions(seed):
    wide = msgspec.structs.replace(WIDE, map=msgspec.structs.replace(WIDE.map, shard_regions=2))
    simulation = Simulation(seeded(seed, wide), faults=random_plan(wide, seed, SECONDS))
    laws = LawBook(simulation)
    messages = {"host_state": 0, "table": 0}
    simulation.network.trace = lambda _, source, destination, topic, payload: messages.update(
        {topic: messages.get(topic, 0) + 1}
    )
    simulation.run_until(SECONDS)
    simulation.finish()
    report = simulation.report(SECONDS)
    assert laws.collisions == laws.lethal == []
    assert report["vehicles_routed"] == 24
    assert report["captures"] > 0
    assert min(messages.values()) > 0
    cores = [service._right_of_way.core for service in agents(simulation).values()]
    assert {core.shards.count for core in cores} == {2}  # 280 x 800 cells
    assert {shard for core in cores for shard in core.host.watched} <= set(cores[0].shards.all)


def test_agents_that_begin_while_they_are_cut_off_find_all_their_vehicles_afterwards():
    """No other agent can say then in which shards they are, so the question is repeated."""
    crashed = ["agent-a0", "agent-a3"]
    plan = FaultPlan(
        crashes=tuple(Crash(6.0, name) for name in crashed), partitions=(Partition(6.05, 8.0, tuple(crashed)),)
    )
    simulation = Simulation(seeded(3, WIDE), faults=plan)
    laws = LawBook(simulation)
    simulation.run_until(15.0)
    assert {name: len(service.agent.vehicles) for name, service in agents(simulation).items()} == {
        f"agent-a{n}": 3 for n in range(8)
    }
    assert laws.never_routed() == laws.collisions == laws.lethal == []
