"""What comes out of Zenoh becomes messages: checked, decoded, counted; what is rejected is counted and logged."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from typing import Any

import zenoh

from swarm.bus.bus import Heard, new_counts, newest_of
from swarm.bus.zenoh_threads import attached, says_json
from swarm.errors import ProtocolError
from swarm.wire.access import Authenticator, check_code
from swarm.wire.codec import decode, decode_many, decode_parameters, packed_json
from swarm.wire.messages import Message
from swarm.wire.topics import Topic

log = logging.getLogger(__name__)

_LOG_AGAIN_S = 60.0
"""A key whose payloads are dropped is logged again after this."""
_LOGGED_KEYS = 10_000
"""Most keys whose last log is remembered: a hostile sender may use a new one each time."""


class Intake:
    """The messages of one session, of any topic below its namespace. Any thread may use it.

    counts  of messages and bytes both ways, and of payloads that were dropped
    """

    def __init__(self, namespace: str, authenticator: Authenticator | None) -> None:
        self._namespace = namespace
        self._authenticator = authenticator
        self.counts = new_counts()
        self._counting = threading.Lock()
        """Held to add to `counts`."""
        self._logged_s: dict[str, float] = {}
        """Key -> when a dropped payload on it was last logged, by the monotonic clock."""

    def arrived(self, topic: Topic, sample: zenoh.Sample) -> Heard | None:
        """The event of a sample that has just come; None if it is rejected."""
        payload = sample.payload.to_bytes()
        self.received(payload)
        return self._heard(topic, sample, payload)

    def _heard(self, topic: Topic, sample: zenoh.Sample, payload: bytes) -> Heard | None:
        """The event of a sample; None, counted and logged, if it is rejected."""
        key = str(sample.key_expr)
        try:
            named = self.fields(topic, key)
            self.check(topic, key, sample, payload)
            if says_json(sample, payload):
                payload = packed_json(payload, topic.message, named)
            message = decode(payload, topic.message)
            topic.check_key(named, message)
        except ProtocolError as error:
            self.drop(key, error)
            return None
        return Heard(topic, named, message)

    def together(self, topic: Topic, samples: list[zenoh.Sample]) -> list[tuple[str, Message]]:
        """Keys below the namespace and messages of samples, without those that are rejected."""
        keyed = list(self._packed(topic, samples))
        keys = [key for key, _ in keyed]
        decoded = decode_many([payload for _, payload in keyed], topic.message)
        heard: list[tuple[str, Message]] = []
        for key, message in zip(keys, decoded, strict=True):
            if isinstance(message, ProtocolError):
                self.drop(key, message)
            else:
                heard.append((key[len(self._namespace) + 1 :], message))
        return heard

    def newest(self, topic: Topic, samples: list[zenoh.Sample]) -> list[Heard]:
        """The events of the newest sample under each key, without those that are rejected."""
        payloads = [sample.payload.to_bytes() for sample in samples]
        if samples:
            self.received(*payloads)
        keyed = ((str(each[0].key_expr), each) for each in zip(samples, payloads, strict=True))
        return newest_of(topic, keyed, lambda waited: self._heard(topic, *waited))

    def _packed(self, topic: Topic, samples: list[zenoh.Sample]) -> Iterator[tuple[str, bytes]]:
        """Keys and payloads as MessagePack, without those that are broken JSON."""
        payloads = [sample.payload.to_bytes() for sample in samples]
        self.received(*payloads)
        for sample, payload in zip(samples, payloads, strict=True):
            key = str(sample.key_expr)
            try:
                if says_json(sample, payload):
                    payload = packed_json(payload, topic.message, self.fields(topic, key))
            except ProtocolError as error:
                self.drop(key, error)
            else:
                yield key, payload

    def request(
        self, wanted: type[Message], query: zenoh.Query, asked: bytes, parameters: dict[str, str]
    ) -> Message:
        """What a query asks, whose payload is `asked`. Raises ProtocolError."""
        if query.payload is None:
            return decode_parameters(parameters, wanted)
        return decode(packed_json(asked, wanted) if says_json(query, asked) else asked, wanted)

    def check(self, topic: Topic, key: str, carrier: Any, payload: bytes, asked: bytes = b"") -> None:
        """Raises ProtocolError where a trusted topic's sample, query or reply has no right code."""
        if topic.trusted:
            check_code(self._authenticator, attached(carrier), topic, key, payload, asked)

    def fields(self, topic: Topic, key: str) -> dict[str, str]:
        """What a key names. Raises ProtocolError where it is none of the topic's."""
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

    def drop(self, key: str, error: ProtocolError) -> None:
        with self._counting:
            self.counts["payloads_dropped"] += 1
        now_s = time.monotonic()
        if now_s - self._logged_s.get(key, -_LOG_AGAIN_S) >= _LOG_AGAIN_S:
            if len(self._logged_s) > _LOGGED_KEYS:
                self._logged_s.clear()
            self._logged_s[key] = now_s
            log.warning("dropped a payload on %s: %s", key[:200], error)
