"""A recording as a file: blocks behind each other, each a compressed list of records.

    "swarm recording 3\n" {length u32, zlib([record, record, ...])} ...

Records are MessagePack, numbers little-endian; zlib has a checksum. A process that is killed leaves a file that can
be read up to its last whole block. Reading a file raises nothing but StoreError, whatever its content.

The calls into a service become records, and back: events of the bus, and the loop's counters, which the service
publishes.
"""

from __future__ import annotations

import contextlib
import logging
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, cast

import msgspec

from swarm.bus import bus
from swarm.config.input_files import FileKind, check_bytes
from swarm.config.scenario import AddedAgent
from swarm.errors import ProtocolError, StoreError
from swarm.peers import Peer
from swarm.recording.service_boundary import content_of
from swarm.runtime.stats import Counters, Histogram
from swarm.wire.codec import decode_either
from swarm.wire.topics import TOPICS

log = logging.getLogger(__name__)

MAGIC = b"swarm recording 3\n"
SUFFIX = ".inputs"
FOLDER = "inputs"
"""Folder in a run's folder: one recording per start of a process."""
MOST_BYTES = 64 << 20
"""Limit of one recording: later records are dropped, and the last record states so."""
_BLOCK_BYTES = 1 << 16
"""Size of records before compression: a block is written once it has more."""
_LONGEST_BLOCK_BYTES = 256 << 20
"""A block is taken to hold no more, whatever it says."""
_LEVEL = 1
"""Compression level, the fastest: it leaves a third to a quarter of the bytes."""
_LENGTH = struct.Struct("<I")


_Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_.-]{1,64}\Z")]
"""A role or an id: part of a file's name where a recording is copied, and shown to people."""
_Version = Annotated[str, msgspec.Meta(pattern=r"^[ -~]{0,100}\Z")]


class Record(msgspec.Struct, frozen=True, array_like=True):
    """One record. Its tag is a number, because a run has millions of them."""


class Head(Record, frozen=True, tag=0):
    """The first: which process it was, and what it was started with.

    scenario  as TOML, with every setting
    terrain   digest
    before    what its earlier generations have counted, as a payload; empty if that is not known
    versions  package -> version of what made it
    """

    role: _Name
    id: _Name
    run_id: str
    incarnation: int
    started_ns: int
    scenario: str
    terrain: str
    added: AddedAgent | None
    restarts: int
    before: bytes
    versions: dict[_Version, _Version]
    anew: bool = False


Figure = tuple[str, str | int, int | float]
"""A counter of a process's loop, not of its service: `_COUNT` and its name, `_GAUGE` and its name, or a histogram
and a bucket of it; and its value."""
_COUNT, _GAUGE = "", "~"


class Called(Record, frozen=True, tag=1):
    """A call of the service's `start`, `tick` or `stop`.

    figures  those that have changed since the last such call
    """

    now_ns: int
    method: Literal["start", "tick", "stop"]
    figures: list[Figure] = []


class Handled(Record, frozen=True, tag=2):
    """An event that the service handled (`swarm.recording.recording_file`).

    kind     the name of its class in `swarm.bus.bus`
    topic    its name; empty of an event that has none
    chunks   of the key, in the order of the topic's fields
    payload  of its message, if it has one
    rest     the other fields of the event, as `_REST` has them
    """

    now_ns: int
    kind: str
    topic: str = ""
    chunks: list[str] = []
    payload: bytes = b""
    rest: tuple[Any, ...] = ()


class Read(Record, frozen=True, tag=3):
    """A reading of an external value, inside the preceding call; before the first call while the service was
    made."""

    what: str
    value: bytes


class Output(msgspec.Struct, frozen=True, array_like=True):
    """An output of a call: its destination, its number of bytes, and their digest."""

    to: str
    length: int
    digest: bytes


class Outputs(Record, frozen=True, tag=4):
    """All outputs of the preceding call, in order. A call that lets nothing out has none."""

    outputs: list[Output]


class Cut(Record, frozen=True, tag=5):
    """The last record of a recording that does not go on to the end, though the process did."""

    why: str


class Ended(Record, frozen=True, tag=6):
    """The last record of a process that ended in order."""


Call = Called | Handled
AnyRecord = Head | Call | Read | Outputs | Cut | Ended

_encode = msgspec.msgpack.Encoder().encode
_decoder = msgspec.msgpack.Decoder(list[AnyRecord])


def packed(*records: Record | msgspec.Raw) -> bytes:
    """Records as they stand in the file: in a block of their own."""
    body = zlib.compress(_encode(records), _LEVEL)
    return _LENGTH.pack(len(body)) + body


class RecordWriter:
    """Appends records to a file of its own. A full disk, or `MOST_BYTES`, cut the recording, not the process."""

    def __init__(self, path: Path, most_bytes: int = MOST_BYTES) -> None:
        self.path = path
        self._most_bytes = most_bytes
        self._bytes = 0
        self._waiting: list[msgspec.Raw] = []
        """Records of the next block, and below their bytes."""
        self._waiting_bytes = 0
        self._file: BinaryIO | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb", buffering=0)
            self._append(MAGIC)
        except OSError as error:
            self._end(f"cannot write {path}: {error.strerror or error}")

    def write(self, record: Record) -> None:
        if self._file is None:
            return
        body = _encode(record)
        self._waiting.append(msgspec.Raw(body))
        self._waiting_bytes += len(body)
        if self._waiting_bytes >= _BLOCK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hands the waiting records over to the system."""
        if self._file is None or not self._waiting:
            return
        block = packed(*self._waiting)
        self._waiting, self._waiting_bytes = [], 0
        try:
            if self._bytes + len(block) > self._most_bytes:
                why = f"a recording takes {self._most_bytes >> 20} MiB at most"
                self._append(packed(Cut(why)))
                self._end(why)
            else:
                self._append(block)
        except OSError as error:
            self._end(f"cannot write {self.path}: {error.strerror or error}")

    def close(self) -> None:
        self.flush()
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None

    def _append(self, content: bytes) -> None:
        assert self._file is not None
        if self._file.write(content) != len(content):
            raise OSError("the disk is full")
        self._bytes += len(content)

    def _end(self, why: str) -> None:
        self._waiting = []
        self.close()
        log.warning("inputs are not recorded any more: %s", why)


class RecordReader:
    """Reads a recording from its beginning. Raises StoreError if the file cannot be opened or is not a recording.

    head     its first record
    at       how many of its bytes are read
    damaged  why it cannot be read further, in a sentence; None until that is found
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.at = 0
        self.damaged: str | None = None
        try:
            check_bytes(path, FileKind.RECORDING)
            self._file = path.open("rb")
        except OSError as error:
            raise StoreError(f"cannot read recording {path}: {error.strerror or error}") from error
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                expected = f"expected {MAGIC.decode().strip()!r} at its beginning"
                raise StoreError(
                    f"{path} is no recording of this version: {expected}; replay it with its own version"
                )
            self.at = len(MAGIC)
            self._records = self._read()
            head = next(self._records, None)
            if not isinstance(head, Head):
                why = self.damaged or "it does not say which process it is of"
                raise StoreError(f"recording {path} is damaged: {why}")
        except StoreError:
            self._file.close()
            raise
        self.head = head

    def __enter__(self) -> RecordReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[AnyRecord]:
        return self._records

    def _read(self) -> Iterator[AnyRecord]:
        try:
            while (block := self._next_block()) is not None:
                yield from _decoder.decode(block)
        except (OSError, ValueError, RecursionError, zlib.error, msgspec.MsgspecError) as error:
            self.damaged = f"damaged at byte {self.at}: {error}"

    def _next_block(self) -> bytes | None:
        """The records of the next block; None if there is no whole one, as after a kill."""
        head = self._file.read(_LENGTH.size)
        length = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
        body = self._file.read(min(length, FileKind.RECORDING.most_bytes))
        if not length or len(body) < length:
            return None
        content = zlib.decompressobj()
        block = content.decompress(body, _LONGEST_BLOCK_BYTES)
        if not content.eof or content.unused_data:
            raise ValueError(f"a block that has no end where it says, or more than {_LONGEST_BLOCK_BYTES} bytes")
        self.at += len(head) + length
        return block


@dataclass(frozen=True, slots=True, eq=False)
class JobDone(bus.WorkDone):
    """The number counts the submitted jobs from 0; `reads` is what the job read of the outside."""

    number: int
    reads: Sequence[tuple[str, bytes]]


_TOPICS = {topic.name: topic for topic in TOPICS}
_REST: dict[type, dict[str, Any]] = {
    bus.Heard: {},
    bus.Asked: {"timeout_s": float},
    bus.Replied: {"tag": str, "took_s": float},
    bus.AskEnded: {"tag": str, "replies": int, "failure": str | None},
    bus.Appeared: {"peer": Peer},
    bus.Disappeared: {"peer": Peer},
    bus.LinkChanged: {"up": bool, "beyond": bool},
    JobDone: {"tag": str, "number": int, "took_ns": int, "reads": list[tuple[str, bytes]]},
}
"""Class of an event -> what its record holds beside topic, key and message, and of which type."""
_KINDS = {kind.__name__: kind for kind in _REST}


def record_of(event: bus.Event, now_ns: int) -> Handled:
    """The record of an event that is handled now."""
    kind, topic, fields = type(event), getattr(event, "topic", None), getattr(event, "fields", None)
    if kind not in _REST:
        raise TypeError(f"an event that no boundary has passed: {event!r}")
    message = getattr(event, "request", None) or getattr(event, "message", None)
    return Handled(
        now_ns,
        kind.__name__,
        "" if topic is None else topic.name,
        [] if topic is None or fields is None else [fields[name] for name in topic.fields],
        b"" if message is None else content_of(message),
        tuple(getattr(event, name) for name in _REST[kind]),
    )


def rest_of(record: Handled) -> dict[str, Any]:
    """The content of a record beside topic, key and message, by name. Raises StoreError where it is not of its
    event."""
    try:
        rest = _REST[_KINDS[record.kind]]
        return dict(zip(rest, msgspec.convert(record.rest, tuple[tuple(rest.values())]), strict=True))  # type: ignore[misc]
    except (KeyError, msgspec.ValidationError) as error:
        raise StoreError(f"a record that is no event: {error}") from error


def event_of(record: Handled, answerer: Callable[..., Any]) -> bus.Event:
    """The event in a record, but for jobs. Raises StoreError on one that cannot have been an event.

    answerer  makes what receives the replies to a query, of its `timeout_s`
    """
    rest, kind = rest_of(record), _KINDS[record.kind]
    if kind in (bus.Appeared, bus.Disappeared, bus.LinkChanged):
        return cast(bus.Event, kind(**rest))
    topic = _TOPICS.get(record.topic)
    if topic is None:
        raise StoreError(f"this build has no topic {record.topic!r}")
    if kind is bus.AskEnded:
        return bus.AskEnded(topic=topic, **rest)
    wanted = topic.request if kind is bus.Asked else topic.message
    if wanted is None or len(record.chunks) != len(topic.fields):
        raise StoreError(f"a record of {record.kind} with {record.chunks} on topic {topic.name} that is no event")
    fields = dict(zip(topic.fields, record.chunks, strict=True))
    try:
        message = decode_either(record.payload, wanted, topic.bulk if kind is bus.Replied else None)
    except ProtocolError as error:
        raise StoreError(f"a recorded message is none to this build: {error}") from error
    if kind is bus.Asked:
        return bus.Asked(topic, fields, message, answerer(**rest))
    return cast(bus.Event, kind(topic=topic, fields=fields, message=message, **rest))


def figures_of(loop: Counters) -> dict[tuple[str, str | int], int | float]:
    """All figures of a loop, by their place."""
    found: dict[tuple[str, str | int], int | float] = {(_COUNT, name): count for name, count in loop.counts.items()}
    found.update(((_GAUGE, name), value) for name, value in loop.gauges.items())
    for name, each in loop.histograms.items():
        found.update(((name, bucket), count) for bucket, count in each.buckets.items())
    return found


def set_figures(counters: Counters, figures: Iterable[Figure]) -> None:
    """Writes figures of a loop into its service's counters."""
    for kind, name, value in figures:
        into: dict[Any, Any] = counters.counts if kind == _COUNT else counters.gauges
        if kind not in (_COUNT, _GAUGE):
            into = counters.histograms.setdefault(kind, Histogram()).buckets
        into[name] = value
