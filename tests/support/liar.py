"""A sender of well-formed lies on a memory bus."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

from launch_scripts.chaos.lies import Lies
from swarm.bus.bus import Asked, Event
from swarm.bus.memory_bus import MemoryBus
from swarm.wire.topics import TOPICS, Topic


class Liar:
    """Tells lies from a bus of its own. `cells` is how many the grid has."""

    def __init__(self, bus: MemoryBus, cells: int, seed: int) -> None:
        self.bus = bus
        self.lies = Lies(cells, seed)
        self._chance = random.Random(f"liar/{seed}")
        self.told = 0
        self.serving = True

    def put(self, topic: Topic) -> None:
        """A lie on its own key: access is granted by key, so this is what a sender may do at worst."""
        message = self.lies.lie(topic.message)
        self.bus.publish(topic, message, **self.lies.fields(topic, message))
        self.told += 1

    def ask(self, topic: Topic, post: Callable[[Event], None]) -> None:
        assert topic.request is not None
        request = self.lies.lie(topic.request)
        fields = {
            name: value for name, value in self.lies.fields(topic, request).items() if self._chance.random() < 0.5
        }
        self.bus.ask(topic, request, post, tag="lie", timeout_s=0.5, **fields)
        self.told += 1

    def serve(self, topics: tuple[Topic, ...]) -> None:
        """Answer everybody's questions with lies, several at a time."""

        def answer(event: Event) -> None:
            assert isinstance(event, Asked)
            for _ in range(self._chance.randrange(4) if self.serving else 0):
                kind = self._chance.choice([each for each in (event.topic.message, event.topic.bulk) if each])
                message = self.lies.lie(kind)
                event.answer(message, **self.lies.fields(event.topic, message))
                self.told += 1
            if self._chance.random() < 0.2:
                event.refuse("no")
            event.end()

        for topic in topics:
            self.bus.serve(topic, answer)

    def token(self, role: str) -> None:
        self.bus.declare_alive(self.lies.token(role))


def published() -> Iterator[Topic]:
    return (topic for topic in TOPICS if topic.published)


def asked() -> Iterator[Topic]:
    return (topic for topic in TOPICS if topic.request is not None)
