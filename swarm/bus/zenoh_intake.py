"""The way of a payload from Zenoh to a message: checked, decoded and counted; a rejected one is counted and logged.

Before it stands what Zenoh hands over: its threads and channels, timeouts, attachments and encodings.
"""

from __future__ import annotations

import ctypes
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import zenoh

from swarm.bus import bus
from swarm.bus.bus import SHARED, check_meant, check_named
from swarm.errors import ProtocolError
from swarm.wire import codec
from swarm.wire.access import Act, Authenticator, check_code, has_code
from swarm.wire.messages import Message
from swarm.wire.topics import Topic, check_size


def taken_from(channel: Any, most: int) -> list[Any]:
    """Returns the items that wait in a channel, up to a limit; empty if there are none.

    `try_recv` keeps the interpreter's lock, `recv` releases it: taking it back for each item costs hundreds of
    times more while another thread is busy.
    """
    items: list[Any] = []
    while len(items) < most and (item := channel.try_recv()) is not None:
        items.append(item)
    return items


_MOST_AT_ONCE = 1024
"""Most samples that a slow reader takes at once."""


def taken_after(channel: Any, closing: threading.Event, wait_s: float) -> list[Any]:
    """Waits for an item in a channel, and `wait_s` longer for others. Returns all; none if the channel closes."""
    first = channel.recv()
    return [] if closing.wait(wait_s) else [first, *taken_from(channel, _MOST_AT_ONCE)]


_own = threading.local()
"""`kept` is set where the state of a thread of Zenoh's is kept: in that state, so that it ends with it."""


def _keep_state() -> None:
    """Keeps what the interpreter knows of this thread of Zenoh's until the interpreter ends.

    Python makes a state when such a thread calls it and clears it away when the call is over, with the memory of
    its frames, which takes longer than most calls (docs/design/zenoh-topology-and-inboxes.md). A state counts who
    needs it, and this is one more. Zenoh's threads are few and live as long as the process."""
    if not hasattr(_own, "kept"):
        _own.kept = True
        ctypes.pythonapi.PyGILState_Ensure()


def guarded(callback: Callable[..., None]) -> Callable[..., None]:
    """A callback for Zenoh's own threads, which swallow an error: it ends like one of a thread of ours."""

    def guard(*arguments: Any) -> None:
        _keep_state()
        try:
            callback(*arguments)
        except Exception as error:
            what = (type(error), error, error.__traceback__, threading.current_thread())
            threading.excepthook(threading.ExceptHookArgs(what))

    return guard


def is_json(carrier: Any, payload: bytes) -> bool:
    """Returns True if the encoding of a sample or query is JSON. The lookup costs more than reading the first
    byte."""
    return codec.may_be_json(payload) and str(carrier.encoding).partition(";")[0] == codec.JSON_ENCODING


def timeout_of(stated: str) -> float:
    """The timeout that a query states, within bounds. Raises ProtocolError if it is not a positive number."""
    if not stated:
        return bus.USUAL_TIMEOUT_S
    try:
        timeout_s = float(stated)
    except ValueError:
        timeout_s = 0.0
    if not timeout_s > 0:  # neither is NaN
        raise ProtocolError(f"{bus.TIMEOUT_PARAMETER} {stated[:40]!r} is not a positive number of seconds")
    return min(timeout_s, bus.LONGEST_TIMEOUT_S)


def _code(carrier: Any) -> bytes | None:
    """The code beside a payload."""
    return None if carrier.attachment is None else carrier.attachment.to_bytes()


log = logging.getLogger(__name__)

_LOG_AGAIN_S = 60.0
"""Dropped payloads of one kind are logged again after this. A kind is a topic and a counter, never a key: a hostile
sender may use a new one each time."""


class Intake:
    """The messages of one session, of any topic below its namespace. Any thread may use it.

    authenticator  of the run; None: no code is checked
    counts         of messages and bytes both ways, and of payloads that were dropped
    """

    def __init__(self, namespace: str, authenticator: Authenticator | None) -> None:
        self._namespace, self._start = namespace, f"{namespace}/"
        self.authenticator = authenticator
        self.counts = bus.new_counts()
        self._counting = threading.Lock()
        """Held to add to `counts`."""
        self._logged_s: dict[tuple[str, str], float] = {}
        """Topic and counter -> when such a dropped payload was last logged, by the monotonic clock."""

    def _event_of(self, topic: Topic, key: str, sample: zenoh.Sample, payload: bytes) -> bus.Heard | None:
        """The event of a sample; None, counted and logged, if it is rejected."""
        try:
            named = self.fields(topic, key)
            packed = self._checked(topic, key, sample, payload)
            message = codec.decode(packed, topic.message)
            topic.check_key(named, message)
        except ProtocolError as error:
            self.drop(topic.name, key, error)
            return None
        return bus.Heard(topic, named, message)

    def together(self, topic: Topic, samples: list[zenoh.Sample]) -> list[tuple[str, Message]]:
        """Keys below the namespace and messages of samples, without those that are rejected."""
        keyed = list(self._packed(topic, samples))
        keys = [key for key, _ in keyed]
        decoded = codec.decode_many([payload for _, payload in keyed], topic.message)
        accepted: list[tuple[str, Message]] = []
        for key, message in zip(keys, decoded, strict=True):
            if isinstance(message, ProtocolError):
                self.drop(topic.name, key, message)
            else:
                accepted.append((self.below(key), message))
        return accepted

    def newest(self, topic: Topic, samples: list[zenoh.Sample]) -> list[bus.Heard]:
        """The events of the newest sample under each key, without those that are rejected."""
        keyed = ((each[0], each) for each in self._own(samples))
        return bus.newest_of(topic, keyed, lambda waited: self._event_of(topic, *waited))

    def _own(self, samples: list[zenoh.Sample]) -> list[tuple[str, zenoh.Sample, bytes]]:
        """Keys, samples and payloads of those in our namespace: `patterned` hears others, too."""
        keyed = ((str(sample.key_expr), sample) for sample in samples)
        own = [(key, sample, sample.payload.to_bytes()) for key, sample in keyed if key.startswith(self._start)]
        if own:
            self.received(*(payload for _, _, payload in own))
        return own

    def concerns(self, query: zenoh.Query) -> bool:
        """Returns True if a query asks for a key in our namespace."""
        key = str(query.key_expr)
        return key.startswith(self._start) or zenoh.KeyExpr(f"{self._start}**").intersects(query.key_expr)

    def _packed(self, topic: Topic, samples: list[zenoh.Sample]) -> Iterator[tuple[str, bytes]]:
        """Keys and payloads as MessagePack, without those that are broken JSON."""
        for key, sample, payload in self._own(samples):
            try:
                payload = self._checked(topic, key, sample, payload)
            except ProtocolError as error:
                self.drop(topic.name, key, error)
            else:
                yield key, payload

    def request(self, topic: Topic, query: zenoh.Query, asked: bytes) -> Message:
        """Decodes a query with the payload `asked`. Raises ProtocolError."""
        key, wanted = str(query.key_expr), topic.request
        assert wanted is not None
        if query.payload is None:
            parameters = dict(list(query.parameters))  # type: ignore[call-overload]
            parameters.pop(bus.TIMEOUT_PARAMETER, None)
            check_named(self.below(key), parameters.pop(codec.KEY_FIELD, self.below(key)))
            self.check(topic, "ask", key, query, asked)
            return codec.decode_parameters(parameters, wanted)
        packed = codec.packed_json(asked, wanted, None, self.below(key)) if is_json(query, asked) else asked
        check_meant(self.below(key), packed)
        self.check(topic, "ask", key, query, asked)
        return codec.decode(packed, wanted)

    def _checked(self, topic: Topic, key: str, sample: zenoh.Sample, payload: bytes) -> bytes:
        """A payload as MessagePack, which is short enough, is meant for its key and has the code that its topic
        needs. Raises ProtocolError."""
        check_size(len(payload), topic.put_bytes)
        packed, below = payload, self.below(key)
        if is_json(sample, payload):
            otherwise = "" if topic.message in SHARED else below
            packed = codec.packed_json(payload, topic.message, self.fields(topic, key), otherwise)
        check_meant(below, packed)
        self.check(topic, "put", key, sample, payload)
        return packed

    def below(self, key: str) -> str:
        """A key below the namespace."""
        return key.removeprefix(self._start)

    def check(self, topic: Topic, act: Act, key: str, carrier: Any, payload: bytes, asked: bytes = b"") -> None:
        """Raises ProtocolError where a sample, query or reply lacks the code that it needs.

        asked  the payload of the question, where this is an answer
        """
        check_code(self.authenticator, _code(carrier), topic, act, key, payload, asked)

    def proves(self, query: zenoh.Query, asked: bytes) -> bool:
        """Returns True if the asker of a query is who its key says."""
        return has_code(self.authenticator, _code(query), str(query.key_expr), asked)

    def fields(self, topic: Topic, key: str) -> dict[str, str]:
        """Parses the fields of a key. Raises ProtocolError where it is none of the topic's."""
        fields = topic.parse(self._namespace, key)
        if fields is None:
            raise ProtocolError(f"{key} is not a key of topic {topic.name} ({topic.key})")
        return fields

    # Several of zenoh's threads count: adding is not atomic.

    def sent(self, payload: bytes) -> None:
        with self._counting:
            self.counts["messages_out"] += 1
            self.counts["bytes_out"] += len(payload)

    def received(self, *payloads: bytes) -> None:
        with self._counting:
            self.counts["messages_in"] += len(payloads)
            self.counts["bytes_in"] += sum(map(len, payloads))

    def drop(self, name: str, key: str, error: ProtocolError) -> None:
        """Counts a payload which is rejected, and logs the first of its kind in a minute.

        name  of the topic, or what else it belongs to
        """
        kind, now_s = (name, bus.counter_of(error)), time.monotonic()
        with self._counting:
            self.counts[kind[1]] += 1
        if now_s - self._logged_s.get(kind, -_LOG_AGAIN_S) >= _LOG_AGAIN_S:
            self._logged_s[kind] = now_s
            log.warning("dropped a payload on %s: %s; more like it are only counted for a minute", key[:200], error)
