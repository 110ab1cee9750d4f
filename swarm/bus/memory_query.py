"""One query on the simulated network: which queryables have not ended yet, and how their answers travel."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from swarm.bus.bus import AskEnded, Post, Replied
from swarm.clock import NS_PER_S
from swarm.errors import ProtocolError
from swarm.wire.access import check_code, code_of
from swarm.wire.codec import decode_either, encode
from swarm.wire.messages import Message
from swarm.wire.topics import Topic

if TYPE_CHECKING:
    from swarm.bus.memory_bus import MemoryBus
    from swarm.bus.memory_declarations import Declaration


@dataclass(eq=False)
class Asking:
    """One query under way.

    waiting   queryables that have not ended yet, by number; the query ends with the last
    replies   how many were posted
    failure   the last refusal, or "timeout"
    asked     the question's payload
    over      whether `AskEnded` was posted: what comes later is dropped
    began_ns  when it was asked
    """

    bus: MemoryBus
    topic: Topic
    wanted: dict[str, str]
    tag: str
    post: Post
    timeout_s: float
    waiting: set[int] = field(default_factory=set)
    replies: int = 0
    failure: str | None = None
    asked: bytes = b""
    over: bool = False
    began_ns: int = field(init=False)

    def __post_init__(self) -> None:
        self.began_ns = self.bus.network.scheduler.clock.now_ns()

    @property
    def took_s(self) -> float:
        """Since it was asked."""
        return (self.bus.network.scheduler.clock.now_ns() - self.began_ns) / NS_PER_S

    def finish(self) -> None:
        if not self.over:
            self.over = True
            self.post(AskEnded(self.tag, self.topic, self.replies, self.failure))

    def time_out(self) -> None:
        if not self.over:
            self.failure = "timeout"
            self.finish()


@dataclass(eq=False)
class MemoryAnswerer:
    """The answers of one queryable to one query.

    index            the queryable's number in `Asking.waiting`
    arrived_ns       when the query arrives
    ended            whether `end` was called
    last_arrival_ns  when its latest answer arrives: no later answer overtakes it
    """

    asking: Asking
    queryable: Declaration
    index: int
    arrived_ns: int
    ended: bool = False
    last_arrival_ns: int = 0

    @property
    def timeout_s(self) -> float:
        return self.asking.timeout_s

    def waited_s(self) -> float:
        return (self.queryable.bus.network.scheduler.clock.now_ns() - self.arrived_ns) / NS_PER_S

    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None:
        if self.ended:
            raise RuntimeError("answered after the end")
        asking, bus = self.asking, self.queryable.bus
        named = asking.topic.one({**self.queryable.narrow, **fields})
        if bus.closed or any(chunk not in (named[name], "*") for name, chunk in asking.wanted.items()):
            return
        payload = encode(message)
        bus.sent(payload)
        key = asking.topic.below(named)
        code = code_of(bus.authenticator, asking.topic, key, payload, asking.asked)
        parsed = decode_either(payload, asking.topic.message, asking.topic.bulk)

        def arrive() -> None:
            if asking.over:
                return
            try:
                check_code(asking.bus.authenticator, code, asking.topic, key, payload, asking.asked)
            except ProtocolError:
                asking.bus.counts["payloads_dropped"] += 1
                return
            asking.bus.received(payload)
            asking.replies += 1
            asking.post(Replied(asking.tag, asking.topic, named, parsed, asking.took_s))

        self._send(payload, arrive)

    def refuse(self, reason: str) -> None:
        def arrive() -> None:
            self.asking.failure = reason

        if not self.ended:
            self._send(reason.encode(), arrive)

    def end(self) -> None:
        if self.ended:
            return
        self.ended = True

        def arrive() -> None:
            self.asking.waiting.discard(self.index)
            if not self.asking.waiting:
                self.asking.finish()

        self._send(b"", arrive)

    def _send(self, payload: bytes, arrive: Callable[[], None]) -> None:
        """What answers one query stays in order; it may be lost or repeated."""
        source, to, what = self.queryable.bus, self.asking.bus, self.asking.topic.name
        if source.closed:
            return

        def deliver() -> None:
            if to.traced(source, what, payload):
                arrive()

        now_ns = source.network.scheduler.clock.now_ns()
        for delay_ns in source.network.delays_ns(source, to, what):
            self.last_arrival_ns = max(self.last_arrival_ns, now_ns + delay_ns)
            source.network.scheduler.at(self.last_arrival_ns, deliver)
