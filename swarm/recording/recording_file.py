"""A recording as a file: blocks behind each other, each with its length and checksum, of compressed records.

    "swarm recording 2\n" {length u32, crc32 u32, zlib({length u32, record} {length, record} ...)} ...

Records are MessagePack, numbers little-endian. A process that is killed leaves a file that can be read up to its
last whole block. Reading a file raises nothing but StoreError, whatever its content.

The calls into a service become records, and back: events of the bus, and the loop's counters, which the service
publishes.
"""

from __future__ import annotations

import contextlib
import logging
import math
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

import msgspec

from swarm.bus import bus
from swarm.config.input_files import FileKind, check_bytes
from swarm.config.scenario import AddedAgent
from swarm.errors import ProtocolError, StoreError
from swarm.peers import Peer
from swarm.recording.service_boundary import content_of
from swarm.runtime.stats import Counters, Histogram
from swarm.wire.codec import decode, decode_either
from swarm.wire.topics import TOPICS

log = logging.getLogger(__name__)

MAGIC = b"swarm recording 2\n"
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
_HEAD = struct.Struct("<II")
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


class LoopFigures(msgspec.Struct, frozen=True, array_like=True):
    """Counters of a process's loop, not of its service, since the last call."""

    counts: dict[str, int]
    gauges: dict[str, float]
    buckets: dict[str, dict[int, int]]


class Called(Record, frozen=True, tag=1):
    """A call of the service's `start`, `tick` or `stop`."""

    now_ns: int
    method: Literal["start", "tick", "stop"]
    figures: LoopFigures | None = None


class Handled(Record, frozen=True, tag=2):
    """An event that the service handled (`swarm.recording.recording_file`).

    kind     the name of its class in `swarm.bus.bus`
    topic    its name; empty of an event that has none
    chunks   of the key, in the order of the topic's fields
    samples  ("", payload) of its message, if it has one
    rest     the other fields of the event
    """

    now_ns: int
    kind: str
    topic: str = ""
    chunks: list[str] = []
    samples: list[tuple[str, bytes]] = []
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
_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(AnyRecord)


def packed(*records: Record) -> bytes:
    """Records as they stand in the file: in a block of their own."""
    return _block(b"".join(_LENGTH.pack(len(body)) + body for body in map(_encode, records)))


def _block(content: bytes | bytearray) -> bytes:
    body = zlib.compress(content, _LEVEL)
    return _HEAD.pack(len(body), zlib.crc32(body)) + body


class RecordWriter:
    """Appends records to a file of its own. A full disk, or `MOST_BYTES`, cut the recording, not the process.

    cut  why it does not go on; None while it does
    """

    def __init__(self, path: Path, most_bytes: int = MOST_BYTES) -> None:
        self.path = path
        self.cut: str | None = None
        self._most_bytes = most_bytes
        self._bytes = 0
        self._waiting = bytearray()
        """Records of the next block."""
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
        self._waiting += _LENGTH.pack(len(body))
        self._waiting += body
        if len(self._waiting) >= _BLOCK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hands the waiting records over to the system."""
        if self._file is None or not self._waiting:
            return
        block = _block(self._waiting)
        self._waiting = bytearray()
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
        self.cut = why
        self._waiting = bytearray()
        self.close()
        log.warning("inputs are not recorded any more: %s", why)


class RecordReader:
    """Reads a recording from its beginning. Raises StoreError if the file cannot be opened or is not a recording.

    head     its first record
    at       how many of its bytes are read
    damaged  why it cannot be read further, in a sentence; None until that is found
    torn     True if the file ends within a block, as after a kill; known once all records have been read
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.at = 0
        self.damaged: str | None = None
        self.torn = False
        try:
            check_bytes(path, FileKind.RECORDING)
            self._file = path.open("rb")
        except OSError as error:
            raise StoreError(f"cannot read recording {path}: {error.strerror or error}") from error
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise StoreError(f"{path} is no recording: it does not begin with {MAGIC.decode().strip()!r}")
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
                start = 0
                while start < len(block):
                    (length,) = _LENGTH.unpack_from(block, start)
                    start += _LENGTH.size + length
                    if start > len(block):
                        raise ValueError("a record is longer than its block")
                    record: AnyRecord = _decoder.decode(block[start - length : start])
                    yield record
        except (OSError, ValueError, RecursionError, struct.error, zlib.error, msgspec.MsgspecError) as error:
            self.damaged = f"damaged at byte {self.at}: {error}"

    def _next_block(self) -> bytes | None:
        """The records of the next block; None if there is no whole one."""
        head = self._file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            self.torn = len(head) > 0
            return None
        length, checksum = _HEAD.unpack(head)
        if length > FileKind.RECORDING.most_bytes:
            raise ValueError(f"a block of {length} bytes")
        body = self._file.read(length)
        if len(body) < length:
            self.torn = True
            return None
        if zlib.crc32(body) != checksum:
            raise ValueError("a block does not match its checksum")
        content = zlib.decompressobj()
        block = content.decompress(body, _LONGEST_BLOCK_BYTES)
        if content.unconsumed_tail:
            raise ValueError(f"a block of more than {_LONGEST_BLOCK_BYTES} bytes")
        self.at += len(head) + length
        return block


_TOPICS = {topic.name: topic for topic in TOPICS}
_REST: dict[str, Any] = {
    "Heard": tuple[()],
    "Asked": tuple[float],
    "Replied": tuple[str, float],
    "AskEnded": tuple[str, int, str | None],
    "Appeared": tuple[str, str, int],
    "Disappeared": tuple[str, str, int],
    "LinkChanged": tuple[bool, bool],
    "JobDone": tuple[str, int, int, list[tuple[str, bytes]]],
}
"""Class of an event -> types of what its record holds beside topic, key and messages."""


@dataclass(frozen=True, slots=True, eq=False)
class JobDone(bus.WorkDone):
    """The number counts the submitted jobs from 0; `reads` is what the job read of the outside."""

    number: int
    reads: Sequence[tuple[str, bytes]]


def record_of(event: bus.Event, now_ns: int) -> Handled:
    """The record of an event that is handled now."""
    samples: list[tuple[str, bytes]] = []
    rest: tuple[Any, ...] = ()
    match event:
        case bus.Heard(message=message):
            samples = [("", content_of(message))]
        case bus.Asked(request=message):
            samples, rest = [("", content_of(message))], (event.timeout_s,)
        case bus.Replied(message=message):
            samples, rest = [("", content_of(message))], (event.tag, event.took_s)
        case bus.AskEnded():
            rest = (event.tag, event.replies, event.failure)
        case bus.Appeared(peer) | bus.Disappeared(peer):
            rest = (peer.role, peer.id, peer.incarnation)
        case bus.LinkChanged():
            rest = (event.up, event.beyond)
        case JobDone():
            rest = (event.tag, event.number, event.took_ns, list(event.reads))
        case _:
            raise TypeError(f"an event that no boundary has passed: {event!r}")
    topic, fields = getattr(event, "topic", None), getattr(event, "fields", None)
    chunks = [fields[name] for name in topic.fields] if topic is not None and fields is not None else []
    return Handled(now_ns, type(event).__name__, "" if topic is None else topic.name, chunks, samples, rest)


def rest_of(record: Handled) -> Any:
    """Returns the content of a record beside topic, key and messages. Raises StoreError where that is not of its
    event."""
    try:
        return msgspec.convert(record.rest, _REST[record.kind])
    except (KeyError, msgspec.ValidationError) as error:
        raise StoreError(f"a record that is no event: {error}") from error


def event_of(record: Handled, answerer: bus.Answerer) -> bus.Event:
    """The event in a record, but for jobs. Raises StoreError on one that cannot have been an event.

    answerer  receives the replies to the query
    """
    rest = rest_of(record)
    match record.kind:
        case "Appeared":
            return bus.Appeared(Peer(*rest))
        case "Disappeared":
            return bus.Disappeared(Peer(*rest))
        case "LinkChanged":
            return bus.LinkChanged(*rest)
    if record.topic not in _TOPICS:
        raise StoreError(f"this build has no topic {record.topic!r}")
    topic = _TOPICS[record.topic]
    if record.kind in ("Heard", "Asked", "Replied") and len(record.chunks) != len(topic.fields):
        raise StoreError(f"topic {topic.name} has {len(topic.fields)} fields, not {len(record.chunks)}")
    fields = dict(zip(topic.fields, record.chunks, strict=False))
    payloads = [payload for _, payload in record.samples]
    try:
        match record.kind, payloads:
            case "Heard", [payload]:
                return bus.Heard(topic, fields, decode(payload, topic.message))
            case "Asked", [payload] if topic.request is not None:
                return bus.Asked(topic, fields, decode(payload, topic.request), answerer)
            case "Replied", [payload]:
                tag, took_s = rest
                return bus.Replied(tag, topic, fields, decode_either(payload, topic.message, topic.bulk), took_s)
            case "AskEnded", _:
                tag, replies, failure = rest
                return bus.AskEnded(tag, topic, replies, failure)
    except ProtocolError as error:
        raise StoreError(f"a recorded message is none to this build: {error}") from error
    raise StoreError(f"a record of {record.kind} on topic {topic.name} that is no event")


class LoopCounters(Counters):
    """The counters of a service, for its loop: the same figures, and which of them the loop writes."""

    def __init__(self, counters: Counters) -> None:
        vars(self).update(vars(counters))  # the same, not copies
        self._recorded = LoopFigures({}, {}, {})
        """Counters of the loop as last recorded; a value that no counter has for those never written."""

    def count(self, name: str, by: int = 1) -> None:
        self._recorded.counts.setdefault(name, -1)
        super().count(name, by)

    def set_counts(self, counts: Mapping[str, int]) -> None:
        for name in counts:
            self._recorded.counts.setdefault(name, -1)
        super().set_counts(counts)

    def gauge(self, name: str, value: float) -> None:
        self._recorded.gauges.setdefault(name, math.nan)
        super().gauge(name, value)

    def observe(self, name: str, value: float) -> None:
        self._recorded.buckets.setdefault(name, {})
        super().observe(name, value)

    def changed(self) -> LoopFigures | None:
        """Returns the counters that the loop has changed since the last call; None if there are none."""
        last, gauges = self._recorded, self.gauges
        new = LoopFigures(
            {name: self.counts[name] for name, was in last.counts.items() if self.counts[name] != was},
            {name: gauges[name] for name, was in last.gauges.items() if name in gauges and gauges[name] != was},
            {},
        )
        for name, was in last.buckets.items():
            found = self.histograms[name].buckets
            if changed := {bucket: count for bucket, count in found.items() if count != was.get(bucket)}:
                new.buckets[name] = changed
                was.update(changed)
        last.counts.update(new.counts)
        last.gauges.update(new.gauges)
        return new if new.counts or new.gauges or new.buckets else None


def set_figures(counters: Counters, figures: LoopFigures | None) -> None:
    """Writes recorded figures into a service's counters."""
    if figures is None:
        return
    counters.set_counts(figures.counts)
    counters.gauges.update(figures.gauges)
    for name, buckets in figures.buckets.items():
        counters.histograms.setdefault(name, Histogram()).buckets.update(buckets)
