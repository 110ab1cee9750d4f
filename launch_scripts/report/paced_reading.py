"""Hears at the pace at which it is used: no sample wakes a thread, and what is passed over is not decoded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from swarm.bus.bus import Bus, Heard
from swarm.clock import NS_PER_S
from swarm.wire.topics import Topic


class PacedReading:
    """Takes what a bus has collected; who owns the bus has it collect.

    every_s  topic -> how often the newest of each key is taken, in seconds; 0: each time that somebody looks
    """

    def __init__(self, bus: Bus, every_s: Mapping[Topic, float]) -> None:
        self._bus = bus
        self._topics = {topic.name: topic for topic in every_s}  # by name: a topic is slow to hash
        self._every_ns = {topic.name: int(seconds * NS_PER_S) for topic, seconds in every_s.items()}
        self._due_ns = dict.fromkeys(self._topics, 0)

    def pace(self, topic: Topic, every_s: float, now_ns: int) -> None:
        """Take a topic so often from now on."""
        self._every_ns[topic.name] = int(every_s * NS_PER_S)
        self._due_ns[topic.name] = now_ns + self._every_ns[topic.name]

    def take(self, now_ns: int) -> Iterator[Heard]:
        """What is due, one topic after the other: the bus keeps no order between topics either."""
        for name, topic in self._topics.items():
            if now_ns >= self._due_ns[name]:
                self._due_ns[name] = now_ns + self._every_ns[name]
                yield from self._bus.collected(topic)

    def take_all(self) -> Iterator[Heard]:
        """What has come, due or not."""
        for topic in self._topics.values():
            yield from self._bus.collected(topic)
