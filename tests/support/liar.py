"""A sender of well-formed lies on a memory bus."""

import random
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator

from support.message_fuzzer import MessageFuzzer

from swarm.bus.bus import Asked, Event, Heard, Replied
from swarm.bus.memory_bus import MemoryBus
from swarm.wire.codec import encode
from swarm.wire.messages import Message
from swarm.wire.topics import TOPICS, Topic

_KEPT = 20
"""Number of kept samples of each topic."""


class Liar:
    """Tells lies from a bus of its own."""

    def __init__(self, bus: MemoryBus, fuzzer: MessageFuzzer, seed: int) -> None:
        self.bus = bus
        self.fuzzer = fuzzer
        self._chance = random.Random(f"liar/{seed}")
        self._heard: dict[str, deque[tuple[dict[str, str], Message]]] = defaultdict(lambda: deque(maxlen=_KEPT))
        """Topic -> last put and last answer, with the fields of its key."""
        self._own: set[bytes] = set()
        """Payloads of its own lies, which it hears, too."""
        self.told = 0
        self.altered = 0
        self.serving = True

    def listen(self) -> None:
        """Hears everything from now on, and tells it again with one thing in it altered, half of the time."""
        for topic in published():
            self.bus.subscribe(topic, self.hear)

    def hear(self, event: Event) -> None:
        if isinstance(event, Heard | Replied) and encode(event.message) not in self._own:
            self._heard[event.topic.name].append((event.fields, event.message))

    def _message(self, topic: Topic, kind: type[Message]) -> tuple[Message, dict[str, str]]:
        """A lie of this type, and the fields of its key."""
        known = [(fields, each) for fields, each in self._heard[topic.name] if type(each) is kind]
        if not known or self._chance.random() < 0.5:
            message = self.fuzzer.message(kind)
            self._own.add(encode(message))
            return message, self.fuzzer.fields(topic, message)
        fields, heard = self._chance.choice(known)
        message = self.fuzzer.altered(heard)
        self._own.add(encode(message))
        said = {name: value for name in topic.fields if (value := getattr(message, name, None)) is not None}
        self.altered += 1
        return message, {**fields, **said}

    def put(self, topic: Topic) -> None:
        """A lie on its own key: access is granted by key, so this is what a sender may do at worst."""
        message, fields = self._message(topic, topic.message)
        self.bus.publish(topic, message, **fields)
        self.told += 1

    def ask(self, topic: Topic, post: Callable[[Event], None]) -> None:
        assert topic.request is not None
        request, named = self._message(topic, topic.request)
        fields = {name: value for name, value in named.items() if self._chance.random() < 0.5}
        self.bus.ask(topic, request, post, tag="lie", timeout_s=0.5, **fields)
        self.told += 1

    def serve(self, topics: Iterable[Topic], *, refuses: bool = True) -> None:
        """Answers everybody's questions with lies, several at a time."""

        def answer(event: Event) -> None:
            assert isinstance(event, Asked)
            self._heard[event.topic.name].append((event.fields, event.request))
            for _ in range(self._chance.randrange(4) if self.serving else 0):
                kind = self._chance.choice([each for each in (event.topic.message, event.topic.bulk) if each])
                message, fields = self._message(event.topic, kind)
                event.answer(message, **fields)
                self.told += 1
            if refuses and self._chance.random() < 0.2:
                event.refuse("no")
            event.end()

        for topic in topics:
            self.bus.serve(topic, answer)

    def token(self, role: str) -> None:
        self.bus.declare_alive(self.fuzzer.token(role))


def published() -> Iterator[Topic]:
    return (topic for topic in TOPICS if topic.published)


def asked() -> Iterator[Topic]:
    return (topic for topic in TOPICS if topic.request is not None)
