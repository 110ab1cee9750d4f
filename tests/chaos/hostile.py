"""Hostile messages, made from recorded messages and from the table of topics. Pure."""

from __future__ import annotations

import random
from collections import deque
from typing import Any

import msgpack
from support.message_fuzzer import MessageFuzzer

from swarm.bus.bus import meant_for
from swarm.wire.codec import encode
from swarm.wire.topics import TOPICS

KINDS = ("flipped", "numbers", "replayed", "lies")
"""flipped   a few bits of a message that was said
numbers   fields of one, replaced by what no field should be
replayed  said once more, byte for byte
lies      well-formed, within all bounds, from a sender to which it does not belong"""
_BIG = (1 << 61) + 12345
_KEPT = 32
"""Payloads kept of each key: a replay may be seconds old."""
_KEYS = 5000
_PUBLISHED = tuple(topic for topic in TOPICS if topic.published)


class Hostile:
    """Makes hostile messages."""

    def __init__(self, namespace: str, fuzzer: MessageFuzzer, seed: int) -> None:
        self._namespace = namespace
        self._fuzzer = fuzzer
        self._chance = random.Random(f"hostile/{seed}")
        self._heard: dict[str, deque[tuple[bytes, bytes | None]]] = {}
        """Key -> the latest payloads under it, each with its code."""
        self._keys: list[str] = []

    def heard(self, key: str, payload: bytes, code: bytes | None = None) -> None:
        """Keeps a genuine message as material. `code` came with it, and proves who said it."""
        kept = self._heard.get(key)
        if kept is None:
            if len(self._keys) >= _KEYS:
                return
            kept = self._heard[key] = deque(maxlen=_KEPT)
            self._keys.append(key)
        kept.append((payload, code))

    def next(self) -> tuple[str, str, bytes, bytes | None]:
        """Kind, key, payload and code of one message. A thief has the codes of what he heard, and no other."""
        chance = self._chance
        kind = chance.choice(KINDS)
        if kind == "lies" or not self._keys:
            topic = chance.choice(_PUBLISHED)
            message = self._fuzzer.message(topic.message)
            key = topic.below(self._fuzzer.fields(topic, message))
            return "lies", f"{self._namespace}/{key}", meant_for(key, encode(message)), None
        key = chance.choice(self._keys)
        payload, code = chance.choice(self._heard[key])
        if kind == "flipped":
            payload = self._flipped(payload)
        elif kind == "numbers":
            payload = self._with_numbers(payload)
        return kind, key, payload, code

    def _flipped(self, payload: bytes) -> bytes:
        bits = bytearray(payload)
        for _ in range(self._chance.randint(1, 8) if bits else 0):
            bits[self._chance.randrange(len(bits))] ^= 1 << self._chance.randrange(8)
        return bytes(bits)

    def _with_numbers(self, payload: bytes) -> bytes:
        try:
            message = msgpack.unpackb(payload, strict_map_key=False)
        except ValueError:
            return payload
        if not isinstance(message, dict):
            return payload
        for field, value in message.items():
            if field != "schema" and self._chance.random() < 0.3:
                message[field] = self._instead_of(value)
        packed: bytes = msgpack.packb(message)
        return packed

    def _instead_of(self, value: Any) -> Any:
        choice = self._chance.choice
        match value:
            case bool():
                return value
            case int():
                return choice([0, -1, _BIG, 2**32 - 1, 2**63])
            case float():
                return choice([float("nan"), float("inf"), -1e308, -1.0])
            case str():
                return choice(["", "a/b", "*", "x" * 1000])
            case bytes():
                return choice([b"", b"\xff" * len(value), value[:1000] * 50])
            case list():
                return choice([[], value[:100] * 40, [_BIG] * 5])
            case _:
                return value
