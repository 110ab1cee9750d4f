"""One node that sends anything at all, on every key, harms no service: none raises, and the swarm does its work."""

import random

from support.wire_strategies import BY_TYPE

from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import seeded
from launch_scripts.simulation.simulate import Simulation
from swarm.wire.codec import encode
from swarm.wire.messages import Message
from swarm.wire.topics import TOPICS, Topic

KNOWN = ("t0", "t1", "a0", "a1", "a2", "a0-00", "a1-01", "0", "3", "keeper", "planner", "agent", "targets")
FORGEABLE = [topic for topic in TOPICS if topic.published]


def key_fields(topic: Topic, message: Message, chance: random.Random) -> dict[str, str]:
    """The fields that the message itself names, else those of an existing process."""
    named = {name: getattr(message, name, None) for name in topic.fields}
    return {name: str(chance.choice(KNOWN) if value is None else value) for name, value in named.items()}


def test_garbage_on_every_key_is_counted_and_dropped_and_the_swarm_does_its_work():
    simulation = Simulation(seeded(1))
    laws = LawBook(simulation)
    chance = random.Random(1)
    stranger = simulation.network.bus("stranger", authenticator=simulation.authenticator)
    for step in range(120):
        simulation.run_until(step * 0.1)
        for topic in FORGEABLE:
            payload = bytearray(encode(BY_TYPE[topic.message]))
            payload[chance.randrange(len(payload))] ^= 1 << chance.randrange(8)
            garbage = chance.choice([bytes(payload[: chance.randrange(len(payload))]), chance.randbytes(40), b""])
            stranger.publish_bytes(topic, garbage, key_fields(topic, BY_TYPE[topic.message], chance))
    simulation.finish()
    report = simulation.report(12)
    assert report["payloads_dropped"] > 1000
    assert report["vehicles_routed"] == 10
    assert report["captures"] > 0
    assert laws.collisions == laws.lethal == []
