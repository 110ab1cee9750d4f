"""A network inside one process, on a manual clock: the same services run on it in tests and simulations.

Everything is encoded and decoded as on the wire. What a link does to a message (delay, drop, duplicate, reorder,
partition) is decided by a `LinkModel`, so that a seed replays a run exactly.
"""

from __future__ import annotations

import fnmatch
import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from swarm.bus import (
    Appeared,
    Asked,
    AskEnded,
    Disappeared,
    Event,
    Heard,
    LinkChanged,
    Post,
    Replied,
    WorkDone,
)
from swarm.clock import NS_PER_S, ManualClock
from swarm.errors import ProtocolError
from swarm.liveness import Peer
from swarm.messages import Message, decode, encode
from swarm.topics import Topic


class Scheduler:
    """What happens when, on a manual clock. Of two things due at once the one scheduled first happens first."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self._due: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._due, (max(when_ns, self.clock.now_ns()), self._count, action))

    def after(self, delay_ns: int, action: Callable[[], None]) -> None:
        self.at(self.clock.now_ns() + delay_ns, action)

    def run_until(self, end_ns: int) -> int:
        """Let everything due up to `end_ns` happen; returns how many things did."""
        happened = 0
        while self._due and self._due[0][0] <= end_ns:
            when_ns, _, action = heapq.heappop(self._due)
            self.clock.advance_to(max(when_ns, self.clock.now_ns()))
            action()
            happened += 1
        self.clock.advance_to(max(end_ns, self.clock.now_ns()))
        return happened


class LinkModel(Protocol):
    """What happens to a message between two nodes."""

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        """One delay per copy that arrives; none where it is lost."""
        ...

    def connected(self, source: str, destination: str, now_ns: int) -> bool: ...


class PerfectLinks:
    """Every message arrives once, after the same short time."""

    def __init__(self, delay_ns: int = 200_000) -> None:
        self._delays = (delay_ns,)

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        return self._delays

    def connected(self, source: str, destination: str, now_ns: int) -> bool:
        return True


@dataclass(eq=False)
class _Interest:
    bus: MemoryBus
    topic: Topic
    fields: Mapping[str, str]
    post: Post

    def matches(self, topic: Topic, fields: Mapping[str, str]) -> bool:
        return topic is self.topic and all(
            _intersect(fields.get(name, "*"), self.fields.get(name, "*")) for name in topic.fields
        )


def _intersect(a: str, b: str) -> bool:
    """Whether two chunks, either of which may hold wildcards, can name the same thing."""
    if "*" in a and "*" in b:
        return a == "*" or b == "*" or a == b
    return fnmatch.fnmatchcase(a, b) if "*" in b else fnmatch.fnmatchcase(b, a)


class MemoryNetwork:
    """What Zenoh is for real processes. `trace` is told of every delivery."""

    def __init__(
        self,
        scheduler: Scheduler,
        links: LinkModel,
        trace: Callable[[int, str, str, str, bytes], None] | None = None,
        lease_ns: int = 2 * NS_PER_S,
    ) -> None:
        self.scheduler = scheduler
        self.links = links
        self.lease_ns = lease_ns
        self._trace = trace
        self.buses: list[MemoryBus] = []

    def bus(self, node: str, namespace: str = "swarm") -> MemoryBus:
        bus = MemoryBus(self, node, namespace)
        self.buses.append(bus)
        return bus

    def carry(
        self, source: MemoryBus, to: MemoryBus, what: str, payload: bytes, arrive: Callable[[], None]
    ) -> None:
        """Schedule the arrival of each copy of a message at a node that is still open by then."""
        now_ns = self.scheduler.clock.now_ns()
        delays = (0,) if source is to else self.links.delays_ns(source.node, to.node, what, now_ns)
        for delay_ns in delays:

            def deliver() -> None:
                if not to.closed:
                    if self._trace is not None:
                        self._trace(self.scheduler.clock.now_ns(), source.node, to.node, what, payload)
                    arrive()

            self.scheduler.after(delay_ns, deliver)

    def announce(self, peer: Peer, origin: MemoryBus, up: bool) -> None:
        """Tell every watcher of a token that rose or fell, over reliable links that a partition cuts."""
        for bus in self.buses:
            if bus is not origin:
                self.tell(bus, origin, peer, up)

    def tell(self, bus: MemoryBus, origin: MemoryBus, peer: Peer, up: bool) -> None:
        if not self.links.connected(origin.node, bus.node, self.scheduler.clock.now_ns()):
            return
        for role, post in bus.watchers:
            if role in ("*", peer.role):
                event: Event = Appeared(peer) if up else Disappeared(peer)

                def deliver(post: Post = post, event: Event = event) -> None:
                    if not bus.closed:
                        post(event)

                self.scheduler.after(1_000_000, deliver)

    def link_changed(self, node: str, up: bool) -> None:
        """A node's link came up or went down: those beyond it lose or regain its tokens."""
        for bus in self.buses:
            if bus.node == node and not bus.closed:
                for post in bus.link_watchers:
                    post(LinkChanged(up))
                for other in self.buses:
                    if other is bus or other.closed:
                        continue
                    for peer in other.tokens:
                        self.force(bus, peer, up)
                    for peer in bus.tokens:
                        self.force(other, peer, up)

    @staticmethod
    def force(bus: MemoryBus, peer: Peer, up: bool) -> None:
        for role, post in bus.watchers:
            if role in ("*", peer.role):
                post(Appeared(peer) if up else Disappeared(peer))


class MemoryBus:
    """A `Bus` of one node of a `MemoryNetwork`."""

    def __init__(self, network: MemoryNetwork, node: str, namespace: str) -> None:
        self.network = network
        self.node = node
        self.namespace = namespace
        self.closed = False
        self.counts: dict[str, int] = {"messages_out": 0, "messages_in": 0, "payloads_dropped": 0}
        self.subscriptions: list[_Interest] = []
        self.queryables: list[_Interest] = []
        self.watchers: list[tuple[str, Post]] = []
        self.link_watchers: list[Post] = []
        self.tokens: list[Peer] = []

    def publish(self, topic: Topic, message: Message, **fields: str | int) -> None:
        topic.keyed(self.namespace, **fields)
        self.publish_bytes(topic, encode(message), {name: str(value) for name, value in fields.items()})

    def publish_bytes(self, topic: Topic, payload: bytes, fields: dict[str, str]) -> None:
        """Put any payload at all: tests send garbage through this."""
        self.counts["messages_out"] += 1
        for bus in self.network.buses:
            if bus.closed or bus.namespace != self.namespace:
                continue
            for interest in bus.subscriptions:
                if interest.matches(topic, fields):
                    arrive = _Arrival(bus, interest, topic, fields, payload)
                    self.network.carry(self, bus, topic.name, payload, arrive)

    def subscribe(self, topic: Topic, post: Post, **fields: str | int) -> None:
        self.subscriptions.append(_Interest(self, topic, {k: str(v) for k, v in fields.items()}, post))

    def serve(self, topic: Topic, post: Post, **fields: str | int) -> None:
        self.queryables.append(_Interest(self, topic, {k: str(v) for k, v in fields.items()}, post))

    def ask(
        self,
        topic: Topic,
        request: Message,
        post: Post,
        *,
        tag: str,
        timeout_s: float = 2.0,
        **fields: str | int,
    ) -> None:
        assert topic.request is not None
        wanted = {name: str(value) for name, value in fields.items()}
        interests = [
            interest
            for bus in self.network.buses
            if not bus.closed and bus.namespace == self.namespace
            for interest in bus.queryables
            if interest.matches(topic, wanted)
            and self.network.links.connected(self.node, bus.node, self.network.scheduler.clock.now_ns())
        ]
        asking = _Asking(self, topic, tag, post, pending=len(interests))
        if not interests:
            self.network.scheduler.after(0, asking.finish)
            return
        payload = encode(request)
        for interest in interests:
            answerer = _MemoryAnswerer(asking, interest)
            event = Asked(topic, wanted, decode(payload, topic.request), answerer)

            def arrive(interest: _Interest = interest, event: Asked = event) -> None:
                interest.post(event)

            self.network.carry(self, interest.bus, topic.name, payload, arrive)
        self.network.scheduler.after(int(timeout_s * NS_PER_S), asking.time_out)

    def declare_alive(self, peer: Peer) -> None:
        self.tokens.append(peer)
        self.network.announce(peer, self, up=True)

    def watch_alive(self, post: Post, role: str = "*") -> None:
        self.watchers.append((role, post))
        for bus in self.network.buses:
            if bus is not self and not bus.closed:
                for peer in bus.tokens:
                    if role in ("*", peer.role):
                        self.network.scheduler.after(1_000_000, lambda peer=peer: post(Appeared(peer)))  # type: ignore[misc]

    def watch_links(self, post: Post) -> None:
        self.link_watchers.append(post)

    def close(self) -> None:
        """Leave the network. Also how a crash looks to the others."""
        if self.closed:
            return
        self.closed = True
        for peer in self.tokens:
            self.network.announce(peer, self, up=False)
        self.network.buses.remove(self)


@dataclass(eq=False)
class _Arrival:
    """A sample reaching a subscription: parsed at the door, as on the real bus."""

    bus: MemoryBus
    interest: _Interest
    topic: Topic
    fields: Mapping[str, str]
    payload: bytes

    def __call__(self) -> None:
        self.bus.counts["messages_in"] += 1
        try:
            message = decode(self.payload, self.topic.message)
        except ProtocolError:
            self.bus.counts["payloads_dropped"] += 1
            return
        self.interest.post(Heard(self.topic, self.fields, message))


@dataclass(eq=False)
class _Asking:
    """One query under way."""

    bus: MemoryBus
    topic: Topic
    tag: str
    post: Post
    pending: int
    replies: int = 0
    failure: str | None = None
    over: bool = False

    def finish(self) -> None:
        if not self.over and not self.bus.closed:
            self.over = True
            self.post(AskEnded(self.tag, self.topic, self.replies, self.failure))

    def time_out(self) -> None:
        if not self.over:
            self.failure = "timeout"
            self.finish()


@dataclass(eq=False)
class _MemoryAnswerer:
    asking: _Asking
    interest: _Interest
    ended: bool = False

    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None:
        asking = self.asking
        payload = encode(message)
        named = {**self.interest.fields, **{name: str(value) for name, value in fields.items()}}

        def arrive() -> None:
            if not asking.over:
                asking.replies += 1
                reply = decode(payload, asking.topic.message)
                asking.post(Replied(asking.tag, asking.topic, named, reply))

        self._carry(payload, arrive)

    def refuse(self, reason: str) -> None:
        def arrive() -> None:
            self.asking.failure = reason

        self._carry(reason.encode(), arrive)

    def end(self) -> None:
        if self.ended:
            return
        self.ended = True

        def arrive() -> None:
            self.asking.pending -= 1
            if self.asking.pending == 0:
                self.asking.finish()

        self._carry(b"", arrive)

    def _carry(self, payload: bytes, arrive: Callable[[], None]) -> None:
        asking = self.asking
        asking.bus.network.carry(self.interest.bus, asking.bus, asking.topic.name, payload, arrive)


class InlineWorker:
    """A `Worker` whose jobs run at once and are done after the time that they are taken to cost."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._closed = False

    def submit(self, tag: str, job: Callable[[], object], post: Post, model_ns: int = 0) -> None:
        done = WorkDone(tag, job(), model_ns)
        self._scheduler.after(model_ns, lambda: None if self._closed else post(done))

    def close(self) -> None:
        self._closed = True
