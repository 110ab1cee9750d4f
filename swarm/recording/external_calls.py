"""Encoding of external values that a service reads: the type of each call's result, by name."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from swarm.errors import StoreError

_MOST_BYTES = 1 << 30
"""Limit for one value, unpacked."""


@dataclass(frozen=True)
class ExternalCalls:
    """Calls of an external object, such as a store, that a service may use.

    name   of it, in the recording
    calls  method -> type of what it returns; its arguments are outputs of the service
    facts  attribute -> its type
    fixed  attributes that follow from scenario and terrain: nothing is recorded of them
    """

    name: str
    calls: Mapping[str, Any] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    fixed: tuple[str, ...] = ()


def _plain(value: object) -> object:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.tobytes())
    if isinstance(value, Iterable):
        return list(value)
    raise NotImplementedError(f"a value of type {type(value).__name__} crosses the boundary of a service")


def _made(kind: type, value: object) -> object:
    if kind is Path:
        return Path(msgspec.convert(value, str))
    if kind is np.ndarray:
        dtype, content = msgspec.convert(value, tuple[str, bytes])
        try:
            return np.frombuffer(content, np.dtype(dtype)).copy()
        except TypeError as error:
            raise ValueError(str(error)) from error
    raise NotImplementedError(f"no value of type {kind.__name__} was recorded")


_encoder = msgspec.msgpack.Encoder(enc_hook=_plain)


def content_of(value: object) -> bytes:
    """A value as bytes: MessagePack, as the codec writes messages."""
    return _encoder.encode(value)


def pack(value: object) -> bytes:
    """A value that is read, as it is recorded."""
    return zlib.compress(content_of(value), 1) if isinstance(value, np.ndarray) else content_of(value)


def unpack(content: bytes, kind: Any) -> Any:
    """Raises StoreError if it is not a value of this type."""
    try:
        if kind in (np.ndarray, np.ndarray | None) and content[:1] == b"x":
            content = zlib.decompressobj().decompress(content, _MOST_BYTES)
        return msgspec.msgpack.decode(content, type=kind, dec_hook=_made)
    except (msgspec.MsgspecError, ValueError, TypeError, zlib.error) as error:
        raise StoreError(f"a recorded value is damaged: {error}") from error
