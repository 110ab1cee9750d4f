"""A network inside one process, on a manual clock: the same services run on it in tests and simulations.

Everything is encoded and decoded as on the wire, once per message; all subscribers share the frozen result. A
`LinkModel` decides what a link does to a message (delay, loss, repetition, partition), so that a seed replays a
run. Only collected samples are buffered: a handler takes no simulated time, and no reader falls behind. JSON is for
programs from outside, of which a simulation has none.
"""

from __future__ import annotations

import random
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

from swarm.bus.bus import (
    Appeared,
    Asked,
    AskEnded,
    Disappeared,
    Event,
    Heard,
    LinkChanged,
    Post,
    Replied,
    check_meant,
    check_subscription,
    counter_of,
    meant_for,
    new_counts,
    newest_of,
)
from swarm.bus.scheduler import Scheduler
from swarm.clock import NS_PER_S
from swarm.errors import ProtocolError
from swarm.peers import Peer
from swarm.wire.access import Authenticator, check_code, code_of, has_code
from swarm.wire.codec import decode, decode_either, encode
from swarm.wire.messages import Message
from swarm.wire.topics import TOPICS, Topic, check_size, proven_asker

# One query on the simulated network: which queryables have not ended yet, and how their answers travel.


@dataclass(eq=False)
class Asking:
    """One query under way.

    waiting   queryables that have not ended yet, by number; the query ends with the last
    replies   how many were posted
    failure   the last refusal, or "timeout"
    asked     the question's payload
    over      whether `AskEnded` was posted: later replies are dropped
    """

    bus: MemoryBus
    topic: Topic
    wanted: dict[str, str]
    tag: str
    post: Post
    timeout_s: float
    began_ns: int
    waiting: set[int] = field(default_factory=set)
    replies: int = 0
    failure: str | None = None
    asked: bytes = b""
    over: bool = False

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

    @property
    def size(self) -> int:
        return len(self.asking.asked)

    def waited_s(self) -> float:
        return (self.queryable.bus.network.scheduler.clock.now_ns() - self.arrived_ns) / NS_PER_S

    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None:
        if self.ended:
            raise RuntimeError("answered after the end")
        asking, bus = self.asking, self.queryable.bus
        named, key = asking.topic.value({**self.queryable.narrow, **fields})
        if bus.closed or any(chunk not in (named[name], "*") for name, chunk in asking.wanted.items()):
            return
        payload = meant_for(key, encode(message))
        bus.sent(payload)
        code = code_of(bus.authenticator, key, payload, asking.asked)
        parsed = decode_either(payload, asking.topic.message, asking.topic.bulk)

        def arrive() -> None:
            if asking.over:
                return
            try:
                check_size(len(payload), asking.topic.answer_bytes)
                check_code(asking.bus.authenticator, code, asking.topic, "answer", key, payload, asking.asked)
            except ProtocolError as error:
                asking.bus.counts[counter_of(error)] += 1
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
        """Replies to one query stay in order; each may be lost or repeated."""
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


# Subscriptions and queryables of simulated nodes, by topic and key.


@dataclass(eq=False, slots=True)
class Declaration:
    """One subscription or queryable of one bus.

    prefix    its key expression up to the first wildcard
    narrow    the fields of its key that are no wildcard
    post      a subscription without one keeps its samples until they are collected
    """

    bus: MemoryBus
    prefix: str
    narrow: dict[str, str]
    post: Post | None

    def meets(self, fields: Mapping[str, str]) -> bool:
        """Returns True if this and another key of the topic, with or without wildcards, can name the same value."""
        for name, chunk in self.narrow.items():  # noqa: SIM110 (`all` with a generator costs a simulation time)
            if fields[name] not in (chunk, "*"):
                return False
        return True


def declared(bus: MemoryBus, topic: Topic, fields: Mapping[str, str | int], post: Post | None) -> Declaration:
    """A subscription or queryable with these fields. Raises as `narrowed`."""
    prefix = topic.below(topic.every(fields)).partition("*")[0]
    return Declaration(bus, prefix, narrowed(topic, fields), post)


def narrowed(topic: Topic, fields: Mapping[str, str | int]) -> dict[str, str]:
    """The fields of a key expression that are no wildcard. Raises TypeError and ValueError as `Topic.every`."""
    return {name: chunk for name, chunk in topic.every(fields).items() if chunk != "*"}


class Subscriptions:
    """The subscriptions of one topic. Which of them a key reaches is looked up once, until one comes or goes."""

    def __init__(self) -> None:
        self._all: list[Declaration] = []
        self._found: dict[tuple[str, ...], list[Declaration]] = {}
        """Values of all fields of a key -> `find` of it."""

    def add(self, declaration: Declaration) -> None:
        self._found.clear()
        self._all.append(declaration)

    def remove(self, bus: MemoryBus, narrow: Mapping[str, str] | None = None) -> None:
        """Forgets the subscriptions of a bus: all, or those with exactly these fields."""
        self._found.clear()
        self._all = [
            each for each in self._all if each.bus is not bus or (narrow is not None and each.narrow != narrow)
        ]

    def of(self, bus: MemoryBus) -> list[Declaration]:
        """Returns the subscriptions of a bus."""
        return [each for each in self._all if each.bus is bus]

    def find(self, fields: Mapping[str, str]) -> list[Declaration]:
        """Returns the subscribers that a value with these fields reaches: those with wildcards first, then the
        others, each in order of declaration. A replayed run depends on this order. The list is cached: callers must
        not change it."""
        key = tuple(fields.values())
        found = self._found.get(key)
        if found is None:
            reached = [each for each in self._all if each.meets(fields)]
            found = self._found[key] = sorted(reached, key=lambda each: len(each.narrow) == len(fields))
        return found


def sampled(bus: MemoryBus, post: Post, every_ns: int) -> Post:
    """Posts the newest sample of each key, `every_ns` after the first that came."""
    newest: dict[str, Heard] = {}

    def flush() -> None:
        waiting = list(newest.values())
        newest.clear()
        if not bus.closed:
            for event in waiting:
                post(event)

    def arrive(event: Event) -> None:
        if isinstance(event, Heard):
            if not newest:
                bus.network.scheduler.after(every_ns, flush)
            newest[event.topic.below(event.fields)] = event

    return arrive


# Faults of messages between the nodes of a `MemoryNetwork`.


class LinkModel(Protocol):
    """Fate of a message between two nodes."""

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        """One delay per copy that arrives; none where it is lost."""
        ...

    def connected(self, source: str, destination: str, now_ns: int) -> bool:
        """Returns True if the network considers the two connected, in the direction of the message. Tokens and
        queries depend on it. It may lag behind `delays_ns`: a cut is noticed when the lease runs out."""
        ...


TOKEN_NS = 1_000_000
"""Until a token that rises or falls is noticed. Zenoh takes 3 to 8 ms to notice a killed process."""
_AT_ONCE = (0,)
"""Delays of the one copy of a message to oneself."""


Trace = Callable[[int, str, str, str, bytes], None]
"""Called at each delivery with time in ns, source node, destination node, topic and payload."""


MOST_SWAPPED = 300
"""Messages to one bus that come under a wrong key after a reconnect."""
SWAPPED_NS = NS_PER_S // 4
"""No message comes under a wrong key later than this after a reconnect."""


@dataclass(eq=False, slots=True)
class Swap:
    """A router's fault, which this network has at every reconnect: it takes the prefix of one of a bus's key
    expressions for that of another (docs/design/misrouted-keys.md).

    prefixes  each one and its substitute
    left      messages that still go astray
    """

    prefixes: Mapping[str, str]
    left: int
    until_ns: int


class MemoryNetwork:
    """Simulated counterpart of a Zenoh router: connects the buses of all nodes.

    links  may be replaced at any time; messages under way arrive as the earlier model decided

    proves_names  as in `Bus`
    """

    def __init__(self, scheduler: Scheduler, links: LinkModel, trace: Trace | None = None) -> None:
        self.scheduler = scheduler
        self.links = links
        self.proves_names = False
        self.trace = trace
        self.buses: list[MemoryBus] = []
        """Open buses in the order of their opening, which is the order of queries and tokens."""
        self.subscriptions: defaultdict[tuple[str, str], Subscriptions] = defaultdict(Subscriptions)
        """(namespace, topic) -> subscriptions of open buses."""

    def bus(self, node: str, namespace: str = "swarm", authenticator: Authenticator | None = None) -> MemoryBus:
        """Opens a bus. A node that was started again opens a new one."""
        bus = MemoryBus(self, node, namespace, authenticator)
        self.buses.append(bus)
        return bus

    def connected(self, source: MemoryBus, to: MemoryBus) -> bool:
        """Returns True if queries and tokens of `source` reach `to` now."""
        return source is to or self.links.connected(source.node, to.node, self.scheduler.clock.now_ns())

    def relink(self, nodes: Sequence[str], up: bool) -> None:
        """Makes nodes notice that their link came up or went down, and all nodes which tokens they see now."""
        for bus in list(self.buses):
            if bus.node in nodes:
                bus.swap = self._swapped(bus) if up else None
                for post in bus.link_watchers:
                    bus.later(TOKEN_NS, post, LinkChanged(up))
        self.compare_tokens()

    def _swapped(self, bus: MemoryBus) -> Swap | None:
        """Draws which two prefixes of a bus stand for each other for a while after a reconnect."""
        now_ns = self.scheduler.clock.now_ns()
        chance = random.Random(f"swap/{bus.node}/{now_ns}")
        subscribed = [each for every in list(self.subscriptions.values()) for each in every.of(bus)]
        served = [each for every in bus.queryables.values() for each in every]
        prefixes = sorted({each.prefix for each in subscribed + served})
        if len(prefixes) < 2:
            return None
        one, other = chance.sample(prefixes, 2)
        return Swap({one: other, other: one}, chance.randint(1, MOST_SWAPPED), now_ns + SWAPPED_NS)

    def compare_tokens(self) -> None:
        """Makes every watcher notice tokens that it sees since the last time, or no longer."""
        for bus in self.buses:
            for watcher in bus.watchers:
                watcher.compare()

    def delays_ns(self, source: MemoryBus, to: MemoryBus, what: str) -> Sequence[int]:
        """After how long each copy of a message sent now arrives; a node hears itself at once."""
        if source is to:
            return _AT_ONCE
        return self.links.delays_ns(source.node, to.node, what, self.scheduler.clock.now_ns())


class MemoryBus:
    """A `Bus` of one node of a `MemoryNetwork`. Every post is called by the network's scheduler."""

    def __init__(
        self, network: MemoryNetwork, node: str, namespace: str, authenticator: Authenticator | None = None
    ) -> None:
        self.network = network
        self.node = node
        self.namespace = namespace
        self.proves_names = network.proves_names
        self.authenticator = authenticator
        self.closed = False
        """Once true, nothing is sent or posted any more."""
        self.counts = new_counts()
        self.queryables: dict[str, list[Declaration]] = {}
        """Topic -> its queryables, in order; subscriptions belong to the network."""
        self.watchers: list[_Watcher] = []
        self.link_watchers: list[Post] = []
        self._kept: dict[str, deque[_Sample]] = {}
        """Topic -> samples that wait for `gather`."""
        self._gathered: dict[str, deque[_Sample]] = {}
        self.swap: Swap | None = None
        """Two prefixes of this bus that are confused at present."""
        self.tokens: list[Peer] = []
        """Raised with `declare_alive`; visible to others while the bus is open and connected."""

    def publish(self, topic: Topic, message: Message, **fields: str | int) -> None:
        if not self.closed:
            named, key = topic.value(fields)
            self.put(topic, named, key, meant_for(key, encode(message)))

    def put(self, topic: Topic, named: Mapping[str, str], key: str, payload: bytes) -> None:
        """Puts a payload, whatever it is, under a key and its fields."""
        self.sent(payload)
        code = code_of(self.authenticator, key, payload)
        sample = _Sample(topic, named, key, payload, code, checked_by=self.authenticator)
        network = self.network
        arrivals: dict[int, list[Declaration]] = {}
        for subscription in network.subscriptions[self.namespace, topic.name].find(named):
            if subscription.bus is self and not topic.echoed:
                continue
            for delay_ns in network.delays_ns(self, subscription.bus, topic.name):
                arrivals.setdefault(delay_ns, []).append(subscription)
        for delay_ns, reached in arrivals.items():
            network.scheduler.after(delay_ns, partial(self._arrive, reached, sample))

    def _arrive(self, reached: Sequence[Declaration], sample: _Sample) -> None:
        """Makes a sample arrive at subscriptions which it reaches at one time, in the order of `find`."""
        for subscription in reached:
            to = subscription.bus
            if not to.traced(self, sample.topic.name, sample.payload):
                continue
            astray = to.astray(subscription, sample.key)
            if astray is None:
                to.arrived(sample, subscription)
                continue
            for topic, fields in to.named(astray):
                wrong = replace(sample, topic=topic, fields=fields, key=astray, checked_by=None, parsed=False)
                for each in self.network.subscriptions[self.namespace, topic.name].find(fields):
                    if each.bus is to:
                        to.arrived(wrong, each)

    def astray(self, declaration: Declaration, key: str) -> str | None:
        """The wrong key under which a message to this declaration comes; None if it comes under its own."""
        swap = self.swap
        if swap is None or declaration.prefix not in swap.prefixes:
            return None
        swap.left -= 1
        if swap.left < 0 or self.network.scheduler.clock.now_ns() > swap.until_ns:
            self.swap = None
            return None
        return swap.prefixes[declaration.prefix] + key.removeprefix(declaration.prefix)

    def named(self, key: str) -> list[tuple[Topic, Mapping[str, str]]]:
        """The topics of a key below the namespace, with its fields."""
        found = ((topic, topic.parse(self.namespace, f"{self.namespace}/{key}")) for topic in TOPICS)
        return [(topic, fields) for topic, fields in found if fields is not None]

    def subscribe(self, topic: Topic, post: Post, *, every_s: float = 0.0, **fields: str | int) -> None:
        check_subscription(topic, every_s)
        if every_s:
            post = sampled(self, post, int(every_s * NS_PER_S))
        self._declare(topic, declared(self, topic, fields, post))

    def collect(self, topic: Topic, **fields: str | int) -> None:
        self._declare(topic, declared(self, topic, fields, None))

    def _declare(self, topic: Topic, subscription: Declaration) -> None:
        self.network.subscriptions[self.namespace, topic.name].add(subscription)

    def gather(self) -> None:
        for name, kept in self._kept.items():
            self._gathered.setdefault(name, deque(maxlen=kept.maxlen)).extend(kept)
        self._kept.clear()

    def collected(self, topic: Topic) -> list[Heard]:
        kept = self._gathered.pop(topic.name, ())
        return newest_of(topic, [(sample.key, sample) for sample in kept], self._event_of)

    def collected_together(self, topic: Topic) -> list[tuple[str, Message]]:
        kept = self._gathered.pop(topic.name, ())
        return [(sample.key, event.message) for sample in kept if (event := self._event_of(sample, together=True))]

    def arrived(self, sample: _Sample, subscription: Declaration) -> None:
        """Posts the event of a sample that has come, or keeps it for `collected`."""
        self.received(sample.payload)
        topic, post = sample.topic, subscription.post
        if post is None:
            self._kept.setdefault(topic.name, deque(maxlen=topic.buffer)).append(sample)
        elif (event := self._event_of(sample)) is not None:
            post(event)

    def _event_of(self, sample: _Sample, together: bool = False) -> Heard | None:
        """The event of a sample. One that is rejected is counted and dropped.

        together  the reader compares key and message
        """
        event = sample.event_for(self, together)
        if isinstance(event, ProtocolError):
            self.counts[counter_of(event)] += 1
            return None
        return event

    def unsubscribe(self, topic: Topic, **fields: str | int) -> None:
        self.network.subscriptions[self.namespace, topic.name].remove(self, narrowed(topic, fields))

    def serve(self, topic: Topic, post: Post, **fields: str | int) -> None:
        if topic.request is None:
            raise TypeError(f"topic {topic.name} is not a queryable")
        self.queryables.setdefault(topic.name, []).append(declared(self, topic, fields, post))

    def unserve(self, topic: Topic, **fields: str | int) -> None:
        narrow = narrowed(topic, fields)
        served = self.queryables.get(topic.name, [])
        self.queryables[topic.name] = [each for each in served if each.narrow != narrow]

    def ask(
        self, topic: Topic, request: Message, post: Post, *, tag: str, timeout_s: float = 2.0, **fields: str | int
    ) -> None:
        if topic.request is None:
            raise TypeError(f"topic {topic.name} is not a queryable")
        wanted = topic.every(fields)
        scheduler = self.network.scheduler
        asking = Asking(self, topic, wanted, tag, post, timeout_s, scheduler.clock.now_ns())
        if self.closed:
            scheduler.after(0, asking.finish)
            return
        payload = meant_for(topic.below(wanted), encode(request))
        self.sent(payload)
        queryables = [
            queryable
            for bus in self.network.buses
            for queryable in bus.queryables.get(topic.name, ())
            if queryable.meets(wanted) and bus.namespace == self.namespace and self.network.connected(self, bus)
        ]
        asking.waiting = set(range(len(queryables)))
        if not queryables:
            scheduler.after(0, asking.finish)
            return
        asking.asked = payload
        parsed = decode(payload, topic.request)
        code = code_of(self.authenticator, topic.below(wanted), payload)
        for index, queryable in enumerate(queryables):
            for delay_ns in self.network.delays_ns(self, queryable.bus, topic.name):
                answerer = MemoryAnswerer(asking, queryable, index, asking.began_ns + delay_ns)
                event = Asked(topic, wanted, parsed, answerer)
                scheduler.after(delay_ns, partial(self._arrive_asked, queryable, payload, code, event))
        scheduler.after(int(timeout_s * NS_PER_S), asking.time_out)

    def _arrive_asked(self, queryable: Declaration, payload: bytes, code: bytes | None, event: Asked) -> None:
        to, topic = queryable.bus, event.topic
        if not to.traced(self, topic.name, payload):
            return
        to.received(payload)
        key = topic.below(event.fields)
        astray = to.astray(queryable, key)
        if astray is None:
            to.take_asked(queryable, key, payload, code, event)
            return
        for topic, fields in to.named(astray):
            for each in to.queryables.get(topic.name, ()):
                if each.meets(fields):
                    to.take_asked(each, astray, payload, code, replace(event, topic=topic, fields=fields))
                    return
        event.end()

    def take_asked(
        self, queryable: Declaration, key: str, payload: bytes, code: bytes | None, event: Asked
    ) -> None:
        """Posts a question that has come under a key, or refuses it."""
        assert queryable.post is not None
        try:
            check_size(len(payload), event.topic.ask_bytes)
            check_meant(key, payload)
            check_code(self.authenticator, code, event.topic, "ask", key, payload)
        except ProtocolError as error:
            self.counts[counter_of(error)] += 1
            event.refuse(f"{event.topic.name}: {error}")
            event.end()
        else:
            if event.topic.costly:
                proven = has_code(self.authenticator, code, key, payload)
                event = replace(event, fields=proven_asker(event.fields, proven))
            queryable.post(event)

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
        """Leaves the network. To the others a crash looks the same."""
        if self.closed:
            return
        self.closed = True
        self.network.buses.remove(self)
        for subscriptions in self.network.subscriptions.values():
            subscriptions.remove(self)
        self.network.compare_tokens()

    def sent(self, payload: bytes) -> None:
        self.counts["messages_out"] += 1
        self.counts["bytes_out"] += len(payload)

    def received(self, payload: bytes) -> None:
        self.counts["messages_in"] += 1
        self.counts["bytes_in"] += len(payload)

    def later(self, delay_ns: int, post: Post, event: Event) -> None:
        """Posts an event after a delay, unless the bus is closed by then."""
        self.network.scheduler.after(delay_ns, lambda: None if self.closed else post(event))

    def traced(self, source: MemoryBus, what: str, payload: bytes) -> bool:
        """Trace a delivery to this bus; False if it is closed, and nothing is delivered."""
        if self.closed:
            return False
        trace = self.network.trace
        if trace is not None:
            trace(self.network.scheduler.clock.now_ns(), source.node, self.node, what, payload)
        return True


@dataclass(eq=False)
class _Watcher:
    """One call of `watch_alive`. `visible` are the tokens that were posted as up and not yet as down."""

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


_UNPARSED = ProtocolError("not parsed yet")


@dataclass(eq=False, slots=True)
class _Sample:
    """One put, parsed and checked once: when the first subscription is reached. All share the result.

    checked_by  the authenticator that made or accepted its code; None for a bus without codes
    parsed      whether it was parsed
    parses      its event, or why the payload is no message of the topic, or is meant for another key
    fits        the same, or why its fields say that it is of another sender than the key
    """

    topic: Topic
    fields: Mapping[str, str]
    key: str
    payload: bytes
    code: bytes | None
    checked_by: Authenticator | None = None
    parsed: bool = False
    parses: Heard | ProtocolError = _UNPARSED
    fits: Heard | ProtocolError = _UNPARSED

    def event_for(self, bus: MemoryBus, together: bool) -> Heard | ProtocolError:
        """The event, as a bus takes it, or why it is rejected.

        together  the reader compares the message with its key
        """
        if not self.parsed:
            self.parsed = True
            self.parse()
        if self.checked_by is not bus.authenticator and not isinstance(self.parses, ProtocolError):
            try:
                check_code(bus.authenticator, self.code, self.topic, "put", self.key, self.payload)
            except ProtocolError as error:
                return error
            self.checked_by = bus.authenticator
        return self.parses if together else self.fits

    def parse(self) -> None:
        payload, kind = self.payload, self.topic.message
        try:
            check_size(len(payload), self.topic.put_bytes)
            check_meant(self.key, payload)
            event = Heard(self.topic, self.fields, decode(payload, kind))
        except ProtocolError as error:
            self.parses = self.fits = error
            return
        self.parses = self.fits = event
        try:
            self.topic.check_key(self.fields, event.message)
        except ProtocolError as error:
            self.fits = error
