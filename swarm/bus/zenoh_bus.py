"""The bus of real processes, on one Zenoh session.

Each subscription and queryable has a thread that reads what comes in, but for a queryable whose questions an inbox
decodes: those are posted on Zenoh's own thread (decision 99). Three other choices rest on measurements:
subscriptions have channels that drop their oldest sample when full, because with a FIFO a stalled reader holds up
queries on the same link; replies are posted on Zenoh's own thread, because a thread per query is ten times slower;
questions, tokens and links come seldom and have no channel of Zenoh's, because a thread that waits on one wakes
ten times a second for nothing (`Arrivals`).
"""

from __future__ import annotations

import errno
import logging
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import zenoh

from swarm.bus.bus import (
    TIMEOUT_PARAMETER,
    USUAL_TIMEOUT_S,
    Appeared,
    Asked,
    AskEnded,
    Disappeared,
    Heard,
    HeardMany,
    LinkChanged,
    Post,
    Replied,
    Undecoded,
    check_subscription,
)
from swarm.bus.endpoints import host_port, listening, wait_for_router
from swarm.bus.zenoh_config import session_config
from swarm.bus.zenoh_intake import (
    Arrivals,
    Intake,
    guarded,
    says_json,
    taken_after,
    taken_from,
    timeout_of,
    waiting_in,
)
from swarm.config.scenario import NetworkConfig
from swarm.errors import BusError, ProtocolError
from swarm.liveness import Peer
from swarm.wire.access import Authenticator, code_of
from swarm.wire.codec import decode_either, encode, encode_json
from swarm.wire.messages import Message
from swarm.wire.topics import ALIVE_KEY, Priority, Topic, peer_of

# The answers to one query on Zenoh.


class Reply(Protocol):
    """Sends one answer to a query whose payload was `asked`, or as a text why there is none."""

    def __call__(
        self, query: zenoh.Query, asked: bytes, message: Message | str, fields: Mapping[str, str | int]
    ) -> None: ...


class ZenohAnswerer:
    """The `Answerer` of one query, which arrives when this is made. `_query` is None after the end.

    asked  its payload
    """

    def __init__(self, query: zenoh.Query, asked: bytes, reply: Reply) -> None:
        self._query: zenoh.Query | None = query
        self._reply = reply
        self.asked = asked
        self._arrived_s = time.monotonic()
        self.timeout_s = USUAL_TIMEOUT_S

    def waited_s(self) -> float:
        return time.monotonic() - self._arrived_s

    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None:
        if self._query is None:
            raise RuntimeError("answered after the end")
        self._reply(self._query, self.asked, message, fields)

    def refuse(self, reason: str) -> None:
        if self._query is not None:
            self._reply(self._query, self.asked, reason, {})

    def end(self) -> None:
        # Zenoh ends a query when its last handle goes; `drop` does it now, not at the next garbage collection.
        if self._query is not None:
            self._query.drop()  # type: ignore[no-untyped-call]
            self._query = None


# Why a session could not be opened, in our words. The library names its own source files instead.

_OS_ERROR = re.compile(r"\(os error (\d+)\)")
_KNOCK_S = 1.0
_HINTS = {
    errno.EADDRINUSE: "is the port taken?",
    errno.EADDRNOTAVAIL: "is it an address of this machine?",
    errno.EACCES: "ports below 1024 are for administrators",
}


def why_unreachable(endpoints: Sequence[str], *, encrypted: bool) -> str:
    """Why no router is reached at any of these endpoints: what its port does when somebody knocks."""
    reasons = dict.fromkeys(_why_silent(endpoint, encrypted) for endpoint in endpoints)
    return "; ".join(reasons)


def why_not_listening(error: Exception) -> str:
    """Why nobody can listen, from what the library says."""
    found = _OS_ERROR.search(str(error))
    if found is None:
        return "the network library refuses; its own words are in the log (is the port taken?)"
    number = int(found[1])
    hint = _HINTS.get(number)
    return os.strerror(number) + (f" ({hint})" if hint else "")


def _why_silent(endpoint: str, encrypted: bool) -> str:
    try:
        host, port = host_port(endpoint)
        socket.create_connection((host, port), timeout=_KNOCK_S).close()
    except socket.gaierror:
        return f"the name {host} is unknown here"
    except TimeoutError:
        return f"no answer within {_KNOCK_S:g} s (is a firewall between?)"
    except ConnectionRefusedError:
        return "nobody listens there (is `swarm router` running there?)"
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    if encrypted:
        return (
            "somebody listens there, and refuses us or is no router "
            "(is `swarm router` running there, with certificates of the same authority?)"
        )
    return "somebody listens there, and does not answer as a router (is `swarm router` running there?)"


log = logging.getLogger(__name__)

_PRIORITIES = {
    Priority.INTERACTIVE: zenoh.Priority.INTERACTIVE_HIGH,
    Priority.DATA: zenoh.Priority.DATA,
    Priority.BACKGROUND: zenoh.Priority.BACKGROUND,
}
_QUERY_BUFFER = 4096
"""Queries that wait to be read, per queryable. One that comes then ends without an answer."""
_TOKEN_BUFFER = 65_536
"""Changes of tokens, or of links, that wait to be read: more than processes can start in a second."""
_CLOSE_S = 3.0
"""How long `close` waits for a router that does not answer."""


def open_bus(
    network: NetworkConfig,
    *,
    mode: str = "client",
    patient: bool = False,
    authenticator: Authenticator | None = None,
) -> ZenohBus:
    """Open a session. Raises BusError when it cannot listen or no router answers.

    mode           "client" connects to `network.connect`; "router" listens on `network.listen` and passes
                   messages on
    patient        wait for as long as nobody listens there: a process may be started before its router
    authenticator  for who speaks on trusted topics
    """
    endpoints = network.listen if mode == "router" else network.connect
    if patient:
        wait_for_router(endpoints)
    try:
        return ZenohBus(zenoh.open(session_config(network, mode)), network.namespace, authenticator)
    except zenoh.ZError as error:
        if patient and not any(map(listening, endpoints)):
            return open_bus(network, patient=True, authenticator=authenticator)
        log.info("zenoh says: %s", error)
        if mode == "router":
            what, reason = "listen on", why_not_listening(error)
        else:
            what, reason = "reach a router at", why_unreachable(endpoints, encrypted=network.tls is not None)
        raise BusError(f"cannot {what} {', '.join(endpoints)}: {reason}") from error


class ZenohBus:
    """A `Bus` on one Zenoh session. Always `close` it: an open session can hang the interpreter's exit.

    Its methods are called by the thread that owns the service. The threads that read channels change the counters
    and the log only; each ends when what it reads is undeclared. An unexpected error in one, or in a callback of
    Zenoh's, goes to `threading.excepthook`, by which `Process` ends.
    """

    def __init__(self, session: zenoh.Session, namespace: str, authenticator: Authenticator | None = None) -> None:
        self._session = session
        self._namespace = namespace
        self._authenticator = authenticator
        self._intake = Intake(namespace, authenticator)
        self._own_peers: list[Peer] = []
        """Our tokens, of which `watch_alive` does not tell."""
        self._entities: list[Any] = []
        """All that was declared and not yet undeclared, in order; `close` undeclares it backwards."""
        self._subscribers: dict[str, list[Any]] = {}
        """Key expression -> its subscribers, for `unsubscribe`."""
        self._collecting: dict[str, list[Any]] = {}
        """Topic -> its subscribers that nobody reads before `collected`."""
        self._queryables: dict[str, list[Any]] = {}
        """Key expression -> its queryables, for `unserve`."""
        self._threads: list[threading.Thread] = []
        """One per channel; those that have ended are removed when the next is ended."""
        self._closing = threading.Event()
        """Set by `close`, for good: nothing is sent from then on."""

    @property
    def namespace(self) -> str:
        return self._namespace

    @property
    def counts(self) -> Mapping[str, int]:
        return self._intake.counts

    @property
    def _closed(self) -> bool:
        return self._closing.is_set()

    @property
    def session(self) -> zenoh.Session:
        """The raw session, for measurements beside it."""
        return self._session

    def __enter__(self) -> ZenohBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, topic: Topic, message: Message, **fields: str | int) -> None:
        if self._closed:
            return
        key, payload = topic.keyed(self._namespace, **fields), encode(message)
        self._intake.sent(payload)
        self._session.put(
            key,
            payload,
            attachment=code_of(self._authenticator, topic, key, payload),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=_PRIORITIES[topic.priority],
            allowed_destination=zenoh.Locality.ANY if topic.echoed else zenoh.Locality.REMOTE,
        )

    def subscribe(
        self, topic: Topic, post: Post, *, together: bool = False, every_s: float = 0.0, **fields: str | int
    ) -> None:
        check_subscription(topic, together, every_s)

        def arrive(sample: zenoh.Sample) -> None:
            heard = self._intake.arrived(topic, sample)
            if heard is not None:
                post(heard)

        def arrive_together(samples: list[zenoh.Sample]) -> None:
            heard = self._intake.together(topic, samples)
            if heard:
                post(HeardMany(topic, heard))

        def arrive_sampled(samples: list[zenoh.Sample]) -> None:
            for heard in self._intake.newest(topic, samples):
                post(heard)

        subscriber = self._subscriber(topic, fields)
        channel = subscriber.handler  # a thread that waits on the subscriber itself keeps it from being undeclared
        name = f"sub-{topic.name}"
        if together:
            self._read(subscriber, arrive_together, name, partial(waiting_in, channel))
        elif every_s:
            self._read(subscriber, arrive_sampled, name, partial(taken_after, channel, self._closing, every_s))
        else:
            self._read(subscriber, arrive, name, channel.recv)

    def collect(self, topic: Topic, **fields: str | int) -> None:
        subscriber = self._subscriber(topic, fields)
        self._entities.append(subscriber)
        self._collecting.setdefault(topic.name, []).append(subscriber)

    def collected(self, topic: Topic) -> list[Heard]:
        heard: list[Heard] = []
        for subscriber in self._collecting.get(topic.name, ()):
            heard += self._intake.newest(topic, taken_from(subscriber.handler, topic.buffer))
        return heard

    def collected_together(self, topic: Topic) -> list[tuple[str, Message]]:
        samples: list[zenoh.Sample] = []
        for subscriber in self._collecting.get(topic.name, ()):
            samples += taken_from(subscriber.handler, topic.buffer)
        return self._intake.together(topic, samples) if samples else []

    def unsubscribe(self, topic: Topic, **fields: str | int) -> None:
        subscribers = self._subscribers.pop(topic.expression(self._namespace, **fields), ())
        collecting = self._collecting.get(topic.name, ())
        self._collecting[topic.name] = [each for each in collecting if each not in subscribers]
        self._undeclare_all(subscribers)

    def _reply(
        self,
        topic: Topic,
        concrete: Mapping[str, str],
        as_json: bool,
        query: zenoh.Query,
        asked: bytes,
        message: Message | str,
        fields: Mapping[str, str | int],
    ) -> None:
        """Send one answer to a query, or as a text why there is none."""
        if self._closed:
            return
        if isinstance(message, str):
            query.reply_err(message.encode())
            return
        key = topic.keyed(self._namespace, **{**concrete, **fields})
        if str(query.key_expr) != key and not query.key_expr.intersects(zenoh.KeyExpr(key)):
            return
        payload = encode_json(message) if as_json else encode(message)
        self._intake.sent(payload)
        if as_json:
            query.reply(key, payload, encoding=zenoh.Encoding.APPLICATION_JSON)
        else:
            query.reply(key, payload, attachment=code_of(self._authenticator, topic, key, payload, asked))

    def _subscriber(self, topic: Topic, fields: Mapping[str, str | int]) -> Any:
        expression = topic.expression(self._namespace, **fields)
        subscriber = self._session.declare_subscriber(expression, zenoh.handlers.RingChannel(topic.buffer))
        self._subscribers.setdefault(expression, []).append(subscriber)
        return subscriber

    def serve(self, topic: Topic, post: Post, *, undecoded: bool = False, **fields: str | int) -> None:
        request_type = topic.request
        if request_type is None:
            raise TypeError(f"topic {topic.name} is not a queryable")
        concrete = {name: str(value) for name, value in fields.items()}

        def decoded(
            query: zenoh.Query, answerer: ZenohAnswerer, parameters: dict[str, str], fault: ProtocolError | None
        ) -> Asked | None:
            key = str(query.key_expr)
            self._intake.received(answerer.asked)
            try:
                if fault is not None:
                    raise fault
                self._intake.check(topic, key, query, answerer.asked)
                request = self._intake.request(request_type, query, answerer.asked, parameters)
            except ProtocolError as error:
                self._intake.drop(key, error)
                answerer.refuse(f"{topic.name}: {error}")
                answerer.end()
                return None
            # A tool may ask with `**`, which no key template parses: all that we serve is meant.
            asked = topic.parse(self._namespace, key) or dict.fromkeys(topic.fields, "*") | concrete
            return Asked(topic, asked, request, answerer)

        def undecoded_of(query: zenoh.Query) -> Undecoded:
            parameters = dict(list(query.parameters))  # type: ignore[call-overload]
            payload = b"" if query.payload is None else query.payload.to_bytes()
            as_json = says_json(query, payload) or parameters.get("format") == "json"
            answerer = ZenohAnswerer(query, payload, partial(self._reply, topic, concrete, as_json))
            fault = None
            try:
                answerer.timeout_s = timeout_of(parameters.pop(TIMEOUT_PARAMETER, ""))
            except ProtocolError as error:
                fault = error
            return Undecoded(topic, answerer, partial(decoded, query, answerer, parameters, fault))

        def arrive(query: zenoh.Query) -> None:
            asked = undecoded_of(query).decoded()
            if asked is not None:
                post(asked)

        def leave(query: zenoh.Query) -> None:
            post(undecoded_of(query))

        expression = topic.expression(self._namespace, **fields)
        arrivals = Arrivals(_QUERY_BUFFER)
        into = zenoh.handlers.Callback(guarded(leave), indirect=False) if undecoded else _into(arrivals)
        queryable = self._session.declare_queryable(expression, into)
        self._queryables.setdefault(expression, []).append(queryable)
        if undecoded:
            self._entities.append(queryable)
        else:
            self._read(queryable, arrive, f"serve-{topic.name}", arrivals.take)

    def unserve(self, topic: Topic, **fields: str | int) -> None:
        self._undeclare_all(self._queryables.pop(topic.expression(self._namespace, **fields), ()))

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
        replies = 0
        failure: str | None = None
        expression, asked = topic.expression(self._namespace, **fields), encode(request)
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
                self._intake.check(topic, key, reply.ok, payload, asked)
                message = decode_either(payload, topic.message, topic.bulk)
                named = self._intake.fields(topic, key)
            except ProtocolError as error:
                self._intake.drop(key, error)
                return
            replies += 1
            self._intake.received(payload)
            post(Replied(tag, topic, named, message, took_s))

        def finish() -> None:
            post(AskEnded(tag, topic, replies, failure))

        if self._closed:
            finish()
            return
        self._intake.sent(asked)
        self._session.get(
            f"{expression}?{TIMEOUT_PARAMETER}={timeout_s}",
            zenoh.handlers.Callback(guarded(arrive), guarded(finish), indirect=False),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
            payload=asked,
            attachment=code_of(self._authenticator, topic, expression, asked),
            priority=_PRIORITIES[topic.priority],
        )

    def declare_alive(self, peer: Peer) -> None:
        self._own_peers.append(peer)
        key = ALIVE_KEY.format(role=peer.role, id=peer.id, incarnation=peer.incarnation)
        self._entities.append(self._session.liveliness().declare_token(f"{self._namespace}/{key}"))

    def watch_alive(self, post: Post, role: str = "*") -> None:
        def arrive(sample: zenoh.Sample) -> None:
            try:
                peer = peer_of(str(sample.key_expr))
            except ProtocolError as error:
                self._intake.drop(str(sample.key_expr), error)
                return
            if peer in self._own_peers:
                return  # our own token falls with the link, though we live
            post(Appeared(peer) if sample.kind == zenoh.SampleKind.PUT else Disappeared(peer))

        key = ALIVE_KEY.format(role=role, id="*", incarnation="*")
        arrivals = Arrivals(_TOKEN_BUFFER)
        subscriber = self._session.liveliness().declare_subscriber(
            f"{self._namespace}/{key}", _into(arrivals), history=True
        )
        self._read(subscriber, arrive, "alive", arrivals.take)

    def watch_links(self, post: Post) -> None:
        def arrive(event: Any) -> None:
            post(LinkChanged(up=event.kind == zenoh.SampleKind.PUT))

        arrivals = Arrivals(_TOKEN_BUFFER)
        listener = self._session.info.declare_transport_events_listener(_into(arrivals), history=False)
        self._read(listener, arrive, "links", arrivals.take)

    def close(self) -> None:
        """Leave the network, within `_CLOSE_S` even if the router hangs, for which Zenoh would wait ten seconds."""
        if self._closed:
            return
        self._closing.set()
        closer = threading.Thread(target=self._undeclare, name="close", daemon=True)
        closer.start()
        closer.join(_CLOSE_S)
        if closer.is_alive():
            log.warning("the router does not answer: left without closing the session")

    def _undeclare_all(self, entities: Iterable[Any]) -> None:
        for entity in entities:
            self._entities.remove(entity)
            entity.undeclare()  # which ends the thread that reads its channel
        self._threads = [thread for thread in self._threads if thread.is_alive()]  # those of earlier ones

    def _undeclare(self) -> None:
        for entity in reversed(self._entities):
            entity.undeclare()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self._session.close()  # type: ignore[no-untyped-call]

    def _read(self, entity: Any, arrive: Callable[[Any], None], name: str, take: Callable[[], Any]) -> None:
        """Let what `take` returns arrive, one after the other on a thread of its own, until the entity is
        undeclared: then `take` returns None or raises ZError."""
        self._entities.append(entity)

        def run() -> None:
            try:
                for item in iter(take, None):
                    arrive(item)
                raise BusError(f"{name} hears nothing more")
            except (BusError, zenoh.ZError):
                if not self._closed and entity in self._entities:
                    raise  # it has ended by itself

        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        self._threads.append(thread)


def _into(arrivals: Arrivals) -> Any:
    """What an entity is declared with to leave what comes in there."""
    return zenoh.handlers.Callback(arrivals.put, arrivals.end, indirect=False)
