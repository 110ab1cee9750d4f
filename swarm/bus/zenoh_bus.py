"""The bus of real processes, on one Zenoh session.

Each subscription that is not collected has a thread that reads its channel; all else is posted on Zenoh's own
threads, queries undecoded (docs/design/zenoh-topology-and-inboxes.md). Three choices rest on measurements.
Subscriptions have channels that drop their oldest sample when full: with a FIFO a stalled reader holds up queries
on the same link. A thread per query for its replies is ten times slower. Queries, tokens and links are rare: a
thread that waits for them on a channel of Zenoh's wakes ten times a second for nothing."""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import chain
from typing import Any

import zenoh

from swarm.bus import zenoh_intake
from swarm.bus.bus import (
    TIMEOUT_PARAMETER,
    USUAL_TIMEOUT_S,
    Appeared,
    Asked,
    AskEnded,
    Disappeared,
    Heard,
    LinkChanged,
    Post,
    Replied,
    Undecoded,
    asker_in,
    check_meant,
    check_subscription,
    meant_for,
)
from swarm.bus.zenoh_config import patterned, session_config
from swarm.config.scenario import NetworkConfig
from swarm.endpoints import keeps_open, wait_for_router, why_not_listening, why_silent
from swarm.errors import BusError, ProtocolError
from swarm.peers import Peer
from swarm.wire.access import Authenticator, code_of
from swarm.wire.codec import decode_either, encode, encode_json
from swarm.wire.messages import Message
from swarm.wire.topics import ALIVE_KEY, Priority, Topic, check_size, peer_of, proven_asker


class ZenohAnswerer:
    """The `Answerer` of one query, which arrives when this is made. `_query` is None after the end.

    concrete  fields of the key that the queryable serves

    size   bytes of the request: its payload and its parameters, which are parsed in its turn
    fault  why the query is rejected, if it is too long, or its timeout is none
    """

    def __init__(self, bus: ZenohBus, topic: Topic, concrete: Mapping[str, str], query: zenoh.Query) -> None:
        self._bus, self._topic, self._concrete = bus, topic, concrete
        # A tool may ask with `**`, which no key template parses: all that we serve is meant.
        parsed = topic.parse(bus.namespace, str(query.key_expr))
        self.fields: Mapping[str, str] = parsed or {**dict.fromkeys(topic.fields, "*"), **concrete}
        """The fields of the key that is asked."""
        self._query: zenoh.Query | None = query
        self._arrived_s = time.monotonic()
        self._asked = b"" if query.payload is None else query.payload.to_bytes()
        parameters = query.parameters
        self.size = len(self._asked) + len(str(parameters))
        self._as_json = zenoh_intake.is_json(query, self._asked) or parameters.get("format") == "json"
        self.fault: ProtocolError | None = None
        self.timeout_s = USUAL_TIMEOUT_S
        try:
            check_size(self.size, topic.ask_bytes)
            self.timeout_s = zenoh_intake.timeout_of(parameters.get(TIMEOUT_PARAMETER) or "")
            if topic.costly:
                self.fields = proven_asker(self.fields, bus.intake.proves(query, self._asked))
        except ProtocolError as error:
            self.fault = error

    def decoded(self) -> Asked | None:
        """Returns the query, decoded; None if it is rejected, which ends the query."""
        intake, topic, query = self._bus.intake, self._topic, self._query
        assert query is not None
        key = str(query.key_expr)
        intake.received(self._asked)
        try:
            if self.fault is not None:
                raise self.fault
            request = intake.request(topic, query, self._asked)
        except ProtocolError as error:
            intake.drop(topic.name, key, error)
            self.refuse(f"{topic.name}: {error}")
            self.end()
            return None
        return Asked(topic, self.fields, request, self)

    def waited_s(self) -> float:
        return time.monotonic() - self._arrived_s

    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None:
        query, topic, bus = self._query, self._topic, self._bus
        if query is None:
            raise RuntimeError("answered after the end")
        if bus.closed:
            return
        key = topic.keyed(bus.namespace, **{**self._concrete, **fields})
        if str(query.key_expr) != key and not query.key_expr.intersects(zenoh.KeyExpr(key)):
            return
        below = bus.intake.below(key)
        payload = encode_json(message, below) if self._as_json else meant_for(below, encode(message))
        bus.intake.sent(payload)
        if self._as_json:
            query.reply(key, payload, encoding=zenoh.Encoding.APPLICATION_JSON)
        else:
            query.reply(key, payload, attachment=code_of(bus.authenticator, key, payload, self._asked))

    def refuse(self, reason: str) -> None:
        if self._query is not None and not self._bus.closed:
            self._query.reply_err(reason.encode())

    def end(self) -> None:
        # Zenoh ends a query when its last handle goes; `drop` does it now, not at the next garbage collection.
        if self._query is not None:
            self._query.drop()  # type: ignore[no-untyped-call]
            self._query = self.fault = None  # whose traceback holds what was asked, and this


log = logging.getLogger(__name__)

_PRIORITIES = {
    Priority.INTERACTIVE: zenoh.Priority.INTERACTIVE_HIGH,
    Priority.DATA: zenoh.Priority.DATA,
    Priority.BACKGROUND: zenoh.Priority.BACKGROUND,
}
_ACCEPTORS = "(acc: (worker_threads: 32))"
"""Threads of a router that take connections in, as Zenoh's variable says it. Each connection whose first message is
wrong keeps one for 45 ms, as its socket lingers: with Zenoh's single thread 100 of them delay a join by 4.6 s."""
_CLOSE_S = 3.0
"""Time for which `close` waits for an unresponsive router (s)."""


def open_bus(
    network: NetworkConfig,
    *,
    mode: str = "client",
    patient: bool = False,
    authenticator: Authenticator | None = None,
) -> ZenohBus:
    """Opens a session. Raises BusError when it cannot listen or no router answers.

    mode           "client" connects to `network.connect`; "router" listens on `network.listen` and passes
                   messages on
    patient        wait until a router listens: a process may be started before it, and a proxy be between
    authenticator  makes and checks the codes of messages
    """
    endpoints = network.listen if mode == "router" else network.connect
    if mode == "router":
        os.environ.setdefault("ZENOH_RUNTIME", _ACCEPTORS)
    warned, kept_open = False, 0
    while True:
        if patient:
            wait_for_router(endpoints)
        try:
            bus = ZenohBus(zenoh.open(session_config(network, mode)), network.namespace, authenticator)
            bus.proves_names = network.tls is not None
            return bus
        except zenoh.ZError as error:
            # A router that came up during one attempt answers the next.
            kept_open = kept_open + 1 if any(map(keeps_open, endpoints)) else 0
            if not patient or kept_open > 1:
                raise _why_not(error, network, mode) from error
            if not warned:
                log.warning("no router behind %s yet: waiting for one (Ctrl-C ends this)", ", ".join(endpoints))
            warned = True


def _why_not(error: zenoh.ZError, network: NetworkConfig, mode: str) -> BusError:
    log.info("zenoh says: %s", error)
    if mode == "router":
        return BusError(f"cannot listen on {', '.join(network.listen)}: {why_not_listening(error)}")
    reasons: dict[str, list[str]] = {}
    for endpoint in network.connect:
        reasons.setdefault(why_silent(endpoint, network.tls is not None), []).append(endpoint)
    places = "; nor at ".join(f"{', '.join(endpoints)}: {reason}" for reason, endpoints in reasons.items())
    return BusError(f"cannot reach a router at {places}")


_OPEN: dict[ZenohBus, None] = {}
"""All buses, the oldest first."""


@atexit.register
def _close_all() -> None:
    """Closes each bus at the exit of the interpreter: after what other modules registered, such as the close of a
    client, by which vehicles leave."""
    for bus in reversed([*_OPEN]):
        try:
            bus.close()
        except Exception:
            log.exception("a bus is not closed")


class ZenohBus:
    """A `Bus` on one Zenoh session, which `close` or the interpreter's exit closes.

    Its methods are called by the thread that owns the service. The threads that read channels change the counters
    and the log only; each ends when what it reads is undeclared. An unexpected error in one, or in a callback of
    Zenoh's, goes to `threading.excepthook`, by which `Process` ends.
    """

    def __init__(self, session: zenoh.Session, namespace: str, authenticator: Authenticator | None = None) -> None:
        self.session = session
        """The raw session, also for measurements beside the bus."""
        self.proves_names = False
        self.namespace = namespace
        self.intake = zenoh_intake.Intake(namespace, authenticator)
        self.counts = self.intake.counts
        self._own_peers: list[Peer] = []
        """Our tokens, of which `watch_alive` does not tell."""
        self._entities: list[Any] = []
        """Entities that are declared and not yet undeclared, in order; `close` undeclares them in reverse."""
        self._subscribers: dict[str, list[Any]] = {}
        """Key expression -> its subscribers, for `unsubscribe`."""
        self._collecting: dict[str, list[tuple[Any, deque[zenoh.Sample]]]] = {}
        """Topic -> each subscription that is collected, and what was gathered of it."""
        self._queryables: dict[str, list[Any]] = {}
        """Key expression -> its queryables, for `unserve`."""
        self._threads: list[threading.Thread] = []
        """One per channel; those that have ended are removed when the next is ended."""
        self._closing = threading.Event()
        """Set by `close`, for good: nothing is sent from then on."""
        _OPEN[self] = None

    @property
    def authenticator(self) -> Authenticator | None:
        """Makes the codes of messages, and checks them."""
        return self.intake.authenticator

    def trust(self, authenticator: Authenticator | None) -> None:
        """Signs and checks from now on: a client learns only from the swarm which run it is."""
        self.intake.authenticator = authenticator

    @property
    def closed(self) -> bool:
        return self._closing.is_set()

    def __enter__(self) -> ZenohBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, topic: Topic, message: Message, **fields: str | int) -> None:
        if self.closed:
            return
        below = topic.value(fields)[1]
        key, payload = f"{self.namespace}/{below}", meant_for(below, encode(message))
        self.intake.sent(payload)
        self.session.put(
            key,
            payload,
            attachment=code_of(self.authenticator, key, payload),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=_PRIORITIES[topic.priority],
            allowed_destination=zenoh.Locality.ANY if topic.echoed else zenoh.Locality.REMOTE,
        )

    def subscribe(self, topic: Topic, post: Post, *, every_s: float = 0.0, **fields: str | int) -> None:
        check_subscription(topic, every_s)

        def arrive(samples: list[zenoh.Sample]) -> None:
            for heard in self.intake.newest(topic, samples):
                post(heard)

        subscriber = self._subscriber(topic, fields)
        channel = subscriber.handler  # a thread that waits on the subscriber itself keeps it from being undeclared
        take = partial(zenoh_intake.taken_after, channel, self._closing, every_s)
        self._read(subscriber, arrive, f"sub-{topic.name}", take if every_s else lambda: [channel.recv()])

    def collect(self, topic: Topic, **fields: str | int) -> None:
        subscriber = self._subscriber(topic, fields)
        self._entities.append(subscriber)
        self._collecting.setdefault(topic.name, []).append((subscriber, deque(maxlen=topic.buffer)))

    def gather(self) -> None:
        for collecting in self._collecting.values():
            for subscriber, gathered in collecting:
                gathered += zenoh_intake.taken_from(subscriber.handler, gathered.maxlen or 0)

    def collected(self, topic: Topic) -> list[Heard]:
        heard: list[Heard] = []
        for samples in self._gathered(topic):
            heard += self.intake.newest(topic, samples)
        return heard

    def collected_together(self, topic: Topic) -> list[tuple[str, Message]]:
        samples = list(chain.from_iterable(self._gathered(topic)))
        return self.intake.together(topic, samples) if samples else []

    def _gathered(self, topic: Topic) -> Iterator[list[zenoh.Sample]]:
        """Takes the gathered samples of each subscription to a topic, where there are any."""
        for _, gathered in self._collecting.get(topic.name, ()):
            if gathered:
                yield list(gathered)
                gathered.clear()

    def unsubscribe(self, topic: Topic, **fields: str | int) -> None:
        subscribers = self._subscribers.pop(self._pattern(topic, fields), ())
        collecting = self._collecting.get(topic.name, ())
        self._collecting[topic.name] = [each for each in collecting if each[0] not in subscribers]
        self._undeclare_all(subscribers)

    def _pattern(self, topic: Topic, fields: Mapping[str, str | int]) -> str:
        """The key expression of a subscription or queryable."""
        return patterned(topic.expression(self.namespace, **fields))

    def _subscriber(self, topic: Topic, fields: Mapping[str, str | int]) -> Any:
        expression = self._pattern(topic, fields)
        subscriber = self.session.declare_subscriber(expression, zenoh.handlers.RingChannel(topic.buffer))
        self._subscribers.setdefault(expression, []).append(subscriber)
        return subscriber

    def serve(self, topic: Topic, post: Post, **fields: str | int) -> None:
        if topic.request is None:
            raise TypeError(f"topic {topic.name} is not a queryable")
        concrete = {name: str(value) for name, value in fields.items()}

        def enter(query: zenoh.Query) -> None:
            answerer = ZenohAnswerer(self, topic, concrete, query)
            if not self.intake.concerns(query):
                answerer.end()
            elif answerer.fault is not None:
                answerer.decoded()  # which rejects it
            else:
                post(Undecoded(topic, answerer, answerer.decoded, asker_in(answerer.fields)))

        expression = self._pattern(topic, fields)
        queryable = self.session.declare_queryable(expression, _calling(enter))
        self._queryables.setdefault(expression, []).append(queryable)
        self._entities.append(queryable)

    def unserve(self, topic: Topic, **fields: str | int) -> None:
        self._undeclare_all(self._queryables.pop(self._pattern(topic, fields), ()))

    def ask(
        self, topic: Topic, request: Message, post: Post, *, tag: str, timeout_s: float = 2.0, **fields: str | int
    ) -> None:
        replies = 0
        failure: str | None = None
        expression = topic.expression(self.namespace, **fields)
        asked = meant_for(self.intake.below(expression), encode(request))
        began_s = time.monotonic()

        def arrive(reply: zenoh.Reply) -> None:
            nonlocal replies, failure
            took_s = time.monotonic() - began_s
            if reply.ok is None:
                failure = reply.err.payload.to_bytes().decode("utf-8", "replace") if reply.err else "error"
                failure = "timeout" if failure == "Timeout" else failure
                return
            key = str(reply.ok.key_expr)
            try:
                payload = reply.ok.payload.to_bytes()
                check_size(len(payload), topic.answer_bytes)
                check_meant(self.intake.below(key), payload)
                self.intake.check(topic, "answer", key, reply.ok, payload, asked)
                message = decode_either(payload, topic.message, topic.bulk)
                named = self.intake.fields(topic, key)
            except ProtocolError as error:
                self.intake.drop(topic.name, key, error)
                return
            replies += 1
            self.intake.received(payload)
            post(Replied(tag, topic, named, message, took_s))

        def finish() -> None:
            post(AskEnded(tag, topic, replies, failure))

        if self.closed:
            finish()
            return
        self.intake.sent(asked)
        self.session.get(
            f"{expression}?{TIMEOUT_PARAMETER}={timeout_s}",
            _calling(arrive, finish),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
            payload=asked,
            attachment=code_of(self.authenticator, expression, asked),
            priority=_PRIORITIES[topic.priority],
        )

    def declare_alive(self, peer: Peer) -> None:
        self._own_peers.append(peer)
        key = ALIVE_KEY.format(role=peer.role, id=peer.id, incarnation=peer.incarnation)
        self._entities.append(self.session.liveliness().declare_token(f"{self.namespace}/{key}"))

    def watch_alive(self, post: Post, role: str = "*") -> None:
        def arrive(sample: zenoh.Sample) -> None:
            if not str(sample.key_expr).startswith(f"{self.namespace}/"):
                return
            try:
                peer = peer_of(str(sample.key_expr))
            except ProtocolError as error:
                self.intake.drop("alive", str(sample.key_expr), error)
                return
            if peer in self._own_peers:
                return  # our own token falls with the link, though we live
            post(Appeared(peer) if sample.kind == zenoh.SampleKind.PUT else Disappeared(peer))

        key = ALIVE_KEY.format(role=role, id="*", incarnation="*")
        subscriber = self.session.liveliness().declare_subscriber(
            patterned(f"{self.namespace}/{key}"), _calling(arrive), history=True
        )
        self._entities.append(subscriber)

    def watch_links(self, post: Post) -> None:
        def arrive(event: Any) -> None:
            post(LinkChanged(up=event.kind == zenoh.SampleKind.PUT))

        listener = self.session.info.declare_transport_events_listener(_calling(arrive), history=False)
        self._entities.append(listener)

    def close(self) -> None:
        """Leaves the network, within `_CLOSE_S` even if the router hangs, for which Zenoh waits ten seconds.

        The exit of the interpreter waits for the rest: a thread which returns from Zenoh after the interpreter has
        ended aborts the process.
        """
        if self.closed:
            return
        self._closing.set()
        _OPEN.pop(self, None)
        if not threading.main_thread().is_alive():  # at the exit, where no thread can be started
            self._undeclare()
            return
        closer = threading.Thread(target=self._undeclare, name="close", daemon=False)
        closer.start()
        closer.join(_CLOSE_S)
        if closer.is_alive():
            log.warning("the router does not answer: left without closing the session")

    def _undeclare_all(self, entities: Iterable[Any]) -> None:
        for entity in () if self.closed else entities:
            self._entities.remove(entity)
            entity.undeclare()  # which ends the thread that reads its channel
        self._threads = [thread for thread in self._threads if thread.is_alive()]  # those of earlier ones

    def _undeclare(self) -> None:
        for entity in reversed(self._entities):
            entity.undeclare()
        for thread in self._threads:
            thread.join(timeout=2.0)
        with contextlib.suppress(zenoh.ZError):  # the router hangs
            self.session.close()  # type: ignore[no-untyped-call]

    def _read(self, entity: Any, arrive: Callable[[Any], None], name: str, take: Callable[[], Any]) -> None:
        """Makes what `take` returns arrive, one after the other on a thread of its own, until the entity is
        undeclared: then `take` raises ZError."""
        self._entities.append(entity)

        def run() -> None:
            try:
                while True:
                    arrive(take())
            except zenoh.ZError:
                if not self.closed and entity in self._entities:
                    raise  # it has ended by itself

        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        self._threads.append(thread)


def _calling(arrive: Callable[[Any], None], finish: Callable[[], None] | None = None) -> Any:
    """Returns the handler of what arrives on Zenoh's own threads. `finish` is called once nothing more arrives."""
    ends = None if finish is None else zenoh_intake.guarded(finish)
    return zenoh.handlers.Callback(zenoh_intake.guarded(arrive), ends, indirect=False)
