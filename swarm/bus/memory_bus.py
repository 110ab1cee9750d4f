"""A network inside one process, on a manual clock: the same services run on it in tests and simulations.

Everything is encoded and decoded as on the wire, once per message: those who hear it share the frozen result. What
a link does to a message (delay, loss, repetition, partition) is decided by a `LinkModel`, so that a seed
replays a run exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from swarm.bus.bus import Appeared, Asked, Disappeared, Event, Heard, HeardMany, LinkChanged, Post
from swarm.bus.memory_query import Asking, MemoryAnswerer
from swarm.bus.scheduler import InlineWorker as InlineWorker
from swarm.bus.scheduler import Scheduler as Scheduler
from swarm.clock import NS_PER_S
from swarm.errors import ProtocolError
from swarm.liveness import Peer
from swarm.wire.codec import decode, encode
from swarm.wire.messages.base import Message
from swarm.wire.topics import Topic

TOKEN_NS = 1_000_000
"""How long word of a token takes; zenoh needs 3 to 8 ms to notice a killed process."""


class LinkModel(Protocol):
    """What happens to a message between two nodes."""

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        """One delay per copy that arrives; none where it is lost."""
        ...

    def connected(self, source: str, destination: str, now_ns: int) -> bool:
        """Whether the network takes the two for connected: it notices a cut only after a while."""
        ...


class PerfectLinks:
    """Every message arrives once, after the same short time."""

    def __init__(self, delay_ns: int = 200_000) -> None:
        self._delays = (delay_ns,)

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        return self._delays

    def connected(self, source: str, destination: str, now_ns: int) -> bool:
        return True


Trace = Callable[[int, str, str, str, bytes], None]
"""Told of each delivery: time, source node, destination node, topic, payload."""


class MemoryNetwork:
    """What Zenoh is for real processes."""

    def __init__(self, scheduler: Scheduler, links: LinkModel, trace: Trace | None = None) -> None:
        self.scheduler = scheduler
        self.links = links
        self.buses: list[MemoryBus] = []
        self.trace = trace
        self.subscriptions: dict[tuple[str, str], _Index] = {}
        self._down: set[str] = set()

    def bus(self, node: str, namespace: str = "swarm") -> MemoryBus:
        bus = MemoryBus(self, node, namespace)
        self.buses.append(bus)
        return bus

    def subscribers(self, namespace: str, topic: str, fields: Mapping[str, str]) -> list[Interest]:
        """The subscriptions that a value with these fields reaches, in an order that depends on nothing else."""
        index = self.subscriptions.get((namespace, topic))
        return [] if index is None else index.find(fields)

    def connected(self, source: MemoryBus, to: MemoryBus) -> bool:
        if source is to:
            return True
        if source.node in self._down or to.node in self._down:
            return False
        return self.links.connected(source.node, to.node, self.scheduler.clock.now_ns())

    def link_changed(self, node: str, up: bool) -> None:
        """Cut a node off from all others, or bring it back."""
        if up:
            self._down.discard(node)
        else:
            self._down.add(node)
        self.relink([node], up)

    def relink(self, nodes: Sequence[str], up: bool) -> None:
        """Nodes notice that their link came up or went down; everybody's view of the tokens follows."""
        for bus in list(self.buses):
            if bus.node in nodes:
                for post in bus.link_watchers:
                    bus.later(TOKEN_NS, post, LinkChanged(up))
        self.compare_tokens()

    def compare_tokens(self) -> None:
        for bus in self.buses:
            for watcher in bus.watchers:
                watcher.compare()

    def arrivals_ns(self, source: MemoryBus, to: MemoryBus, what: str) -> Sequence[int]:
        """When each copy of a message sent now arrives."""
        now_ns = self.scheduler.clock.now_ns()
        if source is to:
            return (now_ns,)
        if self._down and (source.node in self._down or to.node in self._down):
            return ()
        return [now_ns + delay for delay in self.links.delays_ns(source.node, to.node, what, now_ns)]


@dataclass(eq=False, slots=True)
class Interest:
    """A subscription or a queryable. `narrow` holds the fields that are no wildcard."""

    bus: MemoryBus
    narrow: dict[str, str]
    post: Post

    def meets(self, fields: Mapping[str, str]) -> bool:
        """Whether this and another key of the topic, either with wildcards, can name the same value."""
        return not self.narrow or _meet(self.narrow, fields)


class _Index:
    """The subscriptions of one topic: a hundred vehicles each listen to a key of their own."""

    def __init__(self) -> None:
        self._wide: list[Interest] = []
        self._exact: dict[tuple[str, ...], list[Interest]] = {}

    def add(self, interest: Interest, topic: Topic) -> None:
        if len(interest.narrow) == len(topic.fields):
            self._exact.setdefault(tuple(interest.narrow.values()), []).append(interest)
        else:
            self._wide.append(interest)

    def remove(self, bus: MemoryBus, narrow: Mapping[str, str] | None = None) -> None:
        """Forget a node's subscriptions: all, or those with these fields."""

        def goes(interest: Interest) -> bool:
            return interest.bus is bus and (narrow is None or interest.narrow == narrow)

        self._wide = [interest for interest in self._wide if not goes(interest)]
        for key, interests in list(self._exact.items()):
            self._exact[key] = [interest for interest in interests if not goes(interest)]

    def find(self, fields: Mapping[str, str]) -> list[Interest]:
        found = [interest for interest in self._wide if interest.meets(fields)]
        return found + self._exact.get(tuple(fields.values()), [])


def _interest(bus: MemoryBus, topic: Topic, fields: Mapping[str, str | int], post: Post) -> Interest:
    every = topic.every(fields)
    return Interest(bus, {name: chunk for name, chunk in every.items() if chunk != "*"}, post)


def _as_many(post: Post) -> Post:
    """What arrives at one instant here arrives one by one: each sample by itself makes a `HeardMany`."""

    def together(event: Event) -> None:
        if isinstance(event, Heard):
            event = HeardMany(event.topic, [(event.topic.key.format(**event.fields), event.message)])
        post(event)

    return together


def _as_keyed(post: Post, counts: dict[str, int]) -> Post:
    """Drop what says that it is another's than its key says."""

    def alone(event: Event) -> None:
        if isinstance(event, Heard):
            try:
                event.topic.check_key(event.fields, event.message)
            except ProtocolError:
                counts["payloads_dropped"] += 1
                return
        post(event)

    return alone


def _meet(narrow: Mapping[str, str], fields: Mapping[str, str]) -> bool:
    for name, chunk in narrow.items():
        other = fields[name]
        if other not in (chunk, "*"):
            return False
    return True


class MemoryBus:
    """A `Bus` of one node of a `MemoryNetwork`."""

    def __init__(self, network: MemoryNetwork, node: str, namespace: str) -> None:
        self.network = network
        self.node = node
        self.namespace = namespace
        self.closed = False
        self.counts: dict[str, int] = {"messages_out": 0, "messages_in": 0, "payloads_dropped": 0}
        self.queryables: dict[str, list[Interest]] = {}
        self.watchers: list[_Watcher] = []
        self.link_watchers: list[Post] = []
        self.tokens: list[Peer] = []

    def publish(self, topic: Topic, message: Message, **fields: str | int) -> None:
        self.publish_bytes(topic, encode(message), fields)

    def publish_bytes(self, topic: Topic, payload: bytes, fields: Mapping[str, str | int]) -> None:
        """Put any payload at all: tests send garbage through this."""
        if self.closed:
            return
        self.counts["messages_out"] += 1
        named = topic.one(fields)
        sample = _Sample(topic, named, payload)
        network = self.network
        for interest in network.subscribers(self.namespace, topic.name, named):
            for when_ns in network.arrivals_ns(self, interest.bus, topic.name):
                network.scheduler.at(when_ns, _Arrival(self, interest, sample))

    def subscribe(self, topic: Topic, post: Post, *, together: bool = False, **fields: str | int) -> None:
        interest = _interest(self, topic, fields, _as_many(post) if together else _as_keyed(post, self.counts))
        index = self.network.subscriptions.setdefault((self.namespace, topic.name), _Index())
        index.add(interest, topic)

    def unsubscribe(self, topic: Topic, **fields: str | int) -> None:
        narrow = {name: chunk for name, chunk in topic.every(fields).items() if chunk != "*"}
        index = self.network.subscriptions.get((self.namespace, topic.name))
        if index is not None:
            index.remove(self, narrow)

    def serve(self, topic: Topic, post: Post, **fields: str | int) -> None:
        if topic.request is None:
            raise TypeError(f"topic {topic.name} is not a queryable")
        interest = _interest(self, topic, fields, post)
        self.queryables.setdefault(topic.name, []).append(interest)

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
        if topic.request is None:
            raise TypeError(f"topic {topic.name} is not a queryable")
        wanted = topic.every(fields)
        scheduler = self.network.scheduler
        asking = Asking(self, topic, wanted, tag, post)
        if self.closed:
            scheduler.after(0, asking.finish)
            return
        self.counts["messages_out"] += 1
        interests = [
            interest
            for bus in self.network.buses
            if bus.namespace == self.namespace and self.network.connected(self, bus)
            for interest in bus.queryables.get(topic.name, ())
            if interest.meets(wanted)
        ]
        asking.waiting = set(range(len(interests)))
        if not interests:
            scheduler.after(0, asking.finish)
            return
        payload = encode(request)
        parsed = decode(payload, topic.request)
        for index, interest in enumerate(interests):
            for when_ns in self.network.arrivals_ns(self, interest.bus, topic.name):
                answerer = MemoryAnswerer(asking, interest, index)
                event = Asked(topic, wanted, parsed, answerer)
                scheduler.at(when_ns, _Delivery(self, interest.bus, topic.name, payload, interest.post, event))
        scheduler.after(int(timeout_s * NS_PER_S), asking.time_out)

    def declare_alive(self, peer: Peer) -> None:
        self.tokens.append(peer)
        self.network.compare_tokens()

    def watch_alive(self, post: Post, role: str = "*") -> None:
        watcher = _Watcher(self, role, post)
        self.watchers.append(watcher)
        watcher.compare()

    def watch_links(self, post: Post) -> None:
        self.link_watchers.append(post)

    def close(self) -> None:
        """Leave the network. Also how a crash looks to the others."""
        if self.closed:
            return
        self.closed = True
        self.network.buses.remove(self)
        for index in self.network.subscriptions.values():
            index.remove(self)
        self.network.compare_tokens()

    def later(self, delay_ns: int, post: Post, event: Event) -> None:
        """Post an event unless we are closed by then."""
        self.network.scheduler.after(delay_ns, lambda: None if self.closed else post(event))

    def traced(self, source: MemoryBus, what: str, payload: bytes) -> bool:
        """Note a delivery; False if we are gone."""
        if self.closed:
            return False
        trace = self.network.trace
        if trace is not None:
            trace(self.network.scheduler.clock.now_ns(), source.node, self.node, what, payload)
        return True


@dataclass(eq=False)
class _Watcher:
    """Somebody who wants to know which tokens are up, the own process's aside."""

    bus: MemoryBus
    role: str
    post: Post
    visible: list[Peer] = field(default_factory=list)

    def compare(self) -> None:
        bus = self.bus
        now = [
            peer
            for other in bus.network.buses
            if other is not bus and other.namespace == bus.namespace
            for peer in other.tokens
            if self.role in ("*", peer.role) and bus.network.connected(other, bus)
        ]
        for peer in self.visible:
            if peer not in now:
                bus.later(TOKEN_NS, self.post, Disappeared(peer))
        for peer in now:
            if peer not in self.visible:
                bus.later(TOKEN_NS, self.post, Appeared(peer))
        self.visible = now


class _Sample:
    """One put, parsed when the first subscription is reached."""

    __slots__ = ("_heard", "_parsed", "fields", "payload", "topic")

    def __init__(self, topic: Topic, fields: dict[str, str], payload: bytes) -> None:
        self.topic = topic
        self.fields = fields
        self.payload = payload
        self._heard: Heard | None = None
        self._parsed = False

    def heard(self) -> Heard | None:
        """The event; None if the payload does not parse."""
        if not self._parsed:
            self._parsed = True
            try:
                self._heard = Heard(self.topic, self.fields, decode(self.payload, self.topic.message))
            except ProtocolError:
                self._heard = None
        return self._heard


@dataclass(eq=False, slots=True)
class _Arrival:
    """A sample reaching a subscription: parsed at the door, as on the real bus."""

    source: MemoryBus
    interest: Interest
    sample: _Sample

    def __call__(self) -> None:
        bus = self.interest.bus
        if not bus.traced(self.source, self.sample.topic.name, self.sample.payload):
            return
        bus.counts["messages_in"] += 1
        heard = self.sample.heard()
        if heard is None:
            bus.counts["payloads_dropped"] += 1
        else:
            self.interest.post(heard)


@dataclass(eq=False, slots=True)
class _Delivery:
    """A query reaching a queryable."""

    source: MemoryBus
    to: MemoryBus
    what: str
    payload: bytes
    post: Post
    event: Event

    def __call__(self) -> None:
        if self.to.traced(self.source, self.what, self.payload):
            self.to.counts["messages_in"] += 1
            self.post(self.event)
