"""The key for which a payload is meant, in the payload itself: a key beside it is a claim of the transport.

A router of Zenoh which stood still, or lost its links, can deliver a sample under another key and a question to
another queryable of the same session (docs/design/misrouted-keys.md). Each payload therefore ends with a field
`key`: the key below the namespace, of a question the key expression that was asked. A receiver compares it with the
key that came. Decoders of messages skip the field, as every unknown one.
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache

import msgspec

from swarm.errors import ProtocolError
from swarm.wire.codec import KEY_FIELD, MAX_PAYLOAD_BYTES
from swarm.wire.topics import TOPICS

SHARED = frozenset(
    kind for kind, uses in Counter(topic.message for topic in TOPICS if topic.published).items() if uses > 1
)
"""Messages that are put on several topics. JSON of these must name its key."""
_NAME = b"\xa3" + KEY_FIELD.encode()
_FEW_FIELDS = 16
"""A map of fewer fields has one byte as its head, else three."""


class MisroutedError(ProtocolError):
    """A payload came under a key for which it was not meant."""


class _Meant(msgspec.Struct):
    key: str | None = None


_DECODER = msgspec.msgpack.Decoder(_Meant)


@lru_cache(maxsize=1 << 14)
def _ending(key: str) -> bytes:
    """The field as the last bytes of a payload. A process puts under the same few keys again and again."""
    return _NAME + msgspec.msgpack.encode(key)


def meant_for(key: str, payload: bytes) -> bytes:
    """A payload that `encode` made, with the key for which it is meant.

    key  below the namespace
    """
    if payload[0] < 0x90:
        fields, body = (payload[0] & 0x0F) + 1, payload[1:]
    else:
        fields, body = int.from_bytes(payload[1:3], "big") + 1, payload[3:]
    head = bytes([0x80 | fields]) if fields < _FEW_FIELDS else b"\xde" + fields.to_bytes(2, "big")
    return b"".join((head, body, _ending(key)))


_MOST_KEY = 512
"""Characters of a key: those of our topics have fewer."""


def check_meant(key: str, payload: bytes, *, must: bool = False) -> None:
    """Raises MisroutedError on a payload that is meant for another key, ProtocolError on one that must name its key
    and does not. A payload that does not parse passes: the decoder says why.

    key      below the namespace
    payload  MessagePack, also of what came as JSON
    must     the key must be named: in JSON of a message in `SHARED`. Elsewhere it may be left out as long as builds
             of wire version 8, which name none, share a run
    """
    if len(key) > _MOST_KEY:
        raise ProtocolError(f"its key has {len(key)} characters, at most {_MOST_KEY}")
    if payload.endswith(_ending(key)) or len(payload) > MAX_PAYLOAD_BYTES:
        return
    try:
        named = _DECODER.decode(payload).key
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        if f"$.{KEY_FIELD}" not in str(error):
            return
        raise ProtocolError(f"{KEY_FIELD} is no text, expected {key[:200]!r}") from error
    check_named(key, named, must=must)


def check_named(key: str, named: str | None, *, must: bool = False) -> None:
    """Raises as `check_meant`, on a key that is named or not."""
    if named is None:
        if must:
            raise ProtocolError(f"no {KEY_FIELD}, expected {key[:200]!r}: other topics have this message, too")
    elif named != key:
        raise MisroutedError(f"it is meant for {named[:200]!r}")
