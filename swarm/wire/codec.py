"""Messages to bytes and back, by msgspec; msgpack reads what is long, and says what is wrong with the rest.

`decode` raises nothing but ProtocolError, whatever bytes it is given, and takes a bounded amount of memory.
Decision 5 says what each of the two libraries does and what that costs.
"""

from __future__ import annotations

import contextlib
import re
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import msgpack
import msgspec

from swarm.errors import ProtocolError
from swarm.wire.fields import np, numpy_loaded
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkSet, faulty_sets
from swarm.wire.versions import STEPS, as_read, as_written, read_schemas
from swarm.wire.versions import schema_of_type as schema_of_type

MAX_PAYLOAD_BYTES = 8 << 20
"""Longer payloads are rejected unread: 1.6 times the digest of a full replica, the longest message there is."""
MAX_ITEMS = 1 << 18
"""Most items that the lists and maps of one payload may hold together. An empty map takes one byte on the wire and
64 bytes of memory, so a payload of 8 MiB could otherwise take half a gigabyte."""

M = TypeVar("M", bound=Message)
N = TypeVar("N", bound=Message)

_ENCODER = msgspec.msgpack.Encoder()
_SCHEMA = b"\xa6schema"
_BYTES = (bytes,)
"""What msgspec leaves as it is, because msgpack has a type of its own for it (JSON, its default, has not)."""
_LIMITS: dict[str, Any] = {
    "strict_map_key": False,  # histograms are maps from int
    "max_str_len": 1 << 16,
    "max_bin_len": MAX_PAYLOAD_BYTES,
    "max_ext_len": 0,
}
_STEPS = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
"""Of a path such as `held.cells[3]`: names and indices."""
_MANY_SETS = 8
"""From so many sets of marks on, checking them as arrays is faster than one by one."""
_STATEMENT_COLUMNS = ("cells", "kinds", "paces", "stamps_ns")
_DECODERS: dict[type[Message], msgspec.msgpack.Decoder[Any]] = {}
"""Of each message type that was decoded so far."""


def encode(message: Message) -> bytes:
    """A message as MessagePack: a map of its fields in their order, its `schema` first."""
    if STEPS and (older := as_written(message)) is not None:
        return _ENCODER.encode(older)
    return _ENCODER.encode(message)


def decode(payload: bytes, message_type: type[M]) -> M:
    """The message in a payload. Raises ProtocolError, and nothing else, on what is not one."""
    return _checked(_read(payload, message_type))


def decode_either(payload: bytes, usual: type[M], other: type[N] | None) -> M | N:
    """As `decode`, of a payload that is of type `other` if its schema says so, else of type `usual`."""
    if other is not None and _unpacked(payload)["schema"] in read_schemas(other):
        return decode(payload, other)
    return decode(payload, usual)


def _read(payload: bytes, message_type: type[M]) -> M:
    """The message in a payload, its types and ranges checked. Raises ProtocolError.

    What a swarm sends is short and right, and msgspec reads it at once; `MAX_ITEMS` bytes cannot hold more items
    than a payload may. A longer one goes the long way, so that its items are counted; one that msgspec refuses, so
    that the error says which field is wrong and what was found; and one that does not begin with its schema, as
    msgspec takes a tag that is missing for the right one.
    """
    if len(payload) <= MAX_ITEMS and _begins_with_schema(payload):
        decoder = _DECODERS.get(message_type) or _DECODERS.setdefault(
            message_type, msgspec.msgpack.Decoder(message_type)
        )
        try:  # `suppress` takes a fifth of the time of a short message
            message: M = decoder.decode(payload)
            return message
        except Exception:  # its own errors, those of our rules, RecursionError
            pass
    return _converted(_unpacked(payload), message_type)


def _begins_with_schema(payload: bytes) -> bool:
    """Whether it is a map whose first key is "schema", as `encode` writes it."""
    return payload.startswith(_SCHEMA, 1 if payload[:1] < b"\x90" else 3)


def decode_many(payloads: Sequence[bytes], message_type: type[M]) -> list[M | ProtocolError]:
    """As `decode` of each payload, errors in place. The statements of many mark sets are checked at once."""
    at_once = len(payloads) >= _MANY_SETS and numpy_loaded()
    found: list[M | ProtocolError] = []
    unchecked: list[tuple[int, MarkSet]] = []
    for payload in payloads:
        try:
            message = _read(payload, message_type)
            if at_once and isinstance(message, MarkSet):
                message.check_head()
                unchecked.append((len(found), message))
                found.append(message)
            else:
                found.append(_checked(message))
        except ProtocolError as error:
            found.append(error)
        except ValueError as error:
            found.append(ProtocolError(str(error)[:300]))
    if unchecked:
        counts = np.array([len(each.kinds) for _, each in unchecked], np.int64)
        columns = (b"".join([getattr(each, name) for _, each in unchecked]) for name in _STATEMENT_COLUMNS)
        for faulty in faulty_sets(counts, *columns).tolist():
            at, each = unchecked[faulty]
            try:
                each.check()  # again, alone: says which rule it breaks
            except ValueError as error:
                found[at] = ProtocolError(str(error)[:300])
    return found


def prime(message_type: type[Message]) -> None:
    """Let msgspec build its description of a type now, on one thread.

    msgspec 0.20 builds it at the first use and lets other threads see it unfinished, which crashed an agent whose
    first replies came on several threads.
    """
    with contextlib.suppress(msgspec.ValidationError):
        msgspec.convert({}, message_type)
    _DECODERS[message_type] = msgspec.msgpack.Decoder(message_type)


def _unpacked(payload: bytes) -> dict[Any, Any]:
    """The fields in a payload, with a `schema` of any value. Raises ProtocolError."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ProtocolError(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES}")
    if payload[:1] == b"{":
        raise ProtocolError("it looks like JSON, which needs Zenoh's encoding application/json")
    # msgpack allocates a list as long as it claims to be: none has more items than the payload has bytes.
    longest = min(len(payload), MAX_ITEMS)
    # A short payload cannot hold too many items, so the usual one is not slowed down by counting them.
    count = _Count().take if len(payload) > MAX_ITEMS else None
    try:
        fields = msgpack.unpackb(
            payload, max_array_len=longest, max_map_len=longest, list_hook=count, object_hook=count, **_LIMITS
        )
    except ProtocolError:
        raise
    except Exception as error:  # msgpack raises a dozen kinds; none may pass
        raise ProtocolError(f"no MessagePack: {str(error) or type(error).__name__}"[:300]) from error
    if not isinstance(fields, dict) or "schema" not in fields:
        raise ProtocolError("no map with a schema")  # msgspec would take a missing tag for the right one
    return fields


def _converted(fields: dict[Any, Any], message_type: type[M]) -> M:
    """The message of these fields, its types and ranges checked. Raises ProtocolError."""
    fields = as_read(fields, message_type)
    try:
        return msgspec.convert(fields, message_type, builtin_types=_BYTES)
    except Exception as error:
        raise ProtocolError(field_fault(error, fields)) from error


def field_fault(error: Exception, fields: Mapping[Any, Any]) -> str:
    """What msgspec finds wrong with fields, as a sentence: which it is, what was expected, what was found."""
    expected, _, place = str(error).partition(" - at `$")
    path = place.rstrip("`").lstrip(".")
    if not path:
        return (expected or type(error).__name__)[:300]
    if expected.startswith("Invalid"):  # says itself what was found
        return f"{path}: {expected}"[:300]
    found: Any = fields
    try:
        for name, index in _STEPS.findall(path):
            found = found[int(index)] if index else found[name]
    except (LookupError, TypeError):  # a place in a mapping, which msgspec writes as [...]
        return f"{path}: {expected}"[:300]
    return f"{path}: {expected}, found {reprlib.repr(found)}"[:300]


def _checked(message: M) -> M:
    try:
        message.check()
    except ValueError as error:
        raise ProtocolError(str(error)[:300]) from error
    return message


class _Count:
    """Counts lists, maps and their items while msgpack builds them, and ends it beyond MAX_ITEMS."""

    def __init__(self) -> None:
        self._items = 0

    def take(self, built: Any) -> Any:
        self._items += 1 + len(built)
        if self._items > MAX_ITEMS:
            raise ProtocolError(f"more than {MAX_ITEMS} items")
        return built
