"""A recording as a file: records behind each other, each with its length and checksum.

    "swarm recording 1\n" {length u32, crc32 u32, body} {length, crc32, body} ...

Bodies are MessagePack, little-endian heads. A process that is killed leaves a file that can be read up to its last
whole record. Records are hostile until parsed: whatever stands in a file, reading raises nothing but StoreError.
"""

from __future__ import annotations

import contextlib
import logging
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from swarm.config.agents import AddedAgent
from swarm.config.input_files import FileKind, check_bytes
from swarm.errors import StoreError

log = logging.getLogger(__name__)

MAGIC = b"swarm recording 1\n"
SUFFIX = ".inputs"
FOLDER = "inputs"
"""Of a run's folder: one recording per life of a process."""
MOST_BYTES = 128 << 20
"""Of one recording: what comes later is not recorded, and the last record says so."""
_BUFFER_BYTES = 1 << 16
_HEAD = struct.Struct("<II")


class Record(msgspec.Struct, frozen=True, array_like=True):
    """One record. Its tag is a number, because a run has millions of them."""


class Head(Record, frozen=True, tag=0):
    """The first: which process it was, and what it was started with.

    scenario  as TOML, with every setting
    terrain   digest
    before    what its earlier lives have counted, as a payload; empty if that is not known
    versions  package -> version of what made it
    """

    role: str
    id: str
    run_id: str
    incarnation: int
    started_ns: int
    scenario: str
    terrain: str
    added: AddedAgent | None
    restarts: int
    before: bytes
    versions: dict[str, str]


class LoopFigures(msgspec.Struct, frozen=True, array_like=True):
    """What the loop of a process, not its service, has counted since the last call."""

    counts: dict[str, int]
    gauges: dict[str, float]
    buckets: dict[str, dict[int, int]]


class Started(Record, frozen=True, tag=1):
    now_ns: int
    figures: LoopFigures | None = None


class Ticked(Record, frozen=True, tag=2):
    now_ns: int
    figures: LoopFigures | None = None


class Stopped(Record, frozen=True, tag=3):
    now_ns: int
    figures: LoopFigures | None = None


class HeardOne(Record, frozen=True, tag=4):
    """chunks  of the key, in the order of the topic's fields"""

    now_ns: int
    topic: str
    chunks: list[str]
    payload: bytes


class HeardSome(Record, frozen=True, tag=5):
    """samples  (key below the namespace, payload)"""

    now_ns: int
    topic: str
    samples: list[tuple[str, bytes]]


class WasAsked(Record, frozen=True, tag=6):
    now_ns: int
    topic: str
    chunks: list[str]
    payload: bytes
    timeout_s: float


class GotReply(Record, frozen=True, tag=7):
    now_ns: int
    topic: str
    chunks: list[str]
    payload: bytes
    tag: str
    took_s: float


class AskOver(Record, frozen=True, tag=8):
    now_ns: int
    topic: str
    tag: str
    replies: int
    failure: str | None


class TokenChanged(Record, frozen=True, tag=9):
    now_ns: int
    role: str
    id: str
    incarnation: int
    up: bool


class LinkSeen(Record, frozen=True, tag=10):
    now_ns: int
    up: bool
    beyond: bool


class JobEnded(Record, frozen=True, tag=11):
    """number  of the job among those that were submitted, from 0; reads  what it read of the outside"""

    now_ns: int
    tag: str
    number: int
    took_ns: int
    reads: list[tuple[str, bytes]]


class Read(Record, frozen=True, tag=12):
    """What the service read of the outside, inside the call before; before the first call while it was made."""

    what: str
    value: bytes


class Output(msgspec.Struct, frozen=True, array_like=True):
    """What a call let out: to whom, how many bytes, and their digest."""

    to: str
    length: int
    digest: bytes


class Outputs(Record, frozen=True, tag=13):
    """All that the call before let out, in order. A call that lets nothing out has none."""

    outputs: list[Output]


class Cut(Record, frozen=True, tag=14):
    """The last record of a recording that does not go on to the end, though the process did.

    whole  whether all that the last call let out is there
    """

    why: str
    whole: bool = False


class Ended(Record, frozen=True, tag=15):
    """The last record of a process that ended in order."""


Call = (
    Started
    | Ticked
    | Stopped
    | HeardOne
    | HeardSome
    | WasAsked
    | GotReply
    | AskOver
    | TokenChanged
    | LinkSeen
    | JobEnded
)
CALLS = (
    Started,
    Ticked,
    Stopped,
    HeardOne,
    HeardSome,
    WasAsked,
    GotReply,
    AskOver,
    TokenChanged,
    LinkSeen,
    JobEnded,
)
AnyRecord = Head | Call | Read | Outputs | Cut | Ended

_encode = msgspec.msgpack.Encoder().encode
_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(AnyRecord)


def packed(record: Record) -> bytes:
    """A record as it stands in the file."""
    body = _encode(record)
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
        self._buffer = bytearray(MAGIC)
        self._file: BinaryIO | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb", buffering=0)
        except OSError as error:
            self._cut(f"cannot write {path}: {error.strerror or error}")

    def write(self, record: Record) -> None:
        if self._file is None:
            return
        body = _encode(record)
        if self._bytes + len(body) > self._most_bytes:
            why = f"a recording takes {self._most_bytes >> 20} MiB at most"
            self._buffer += packed(Cut(why))
            self._cut(why)
            return
        self._bytes += _HEAD.size + len(body)
        self._buffer += _HEAD.pack(len(body), zlib.crc32(body))
        self._buffer += body
        if len(self._buffer) >= _BUFFER_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand over to the system what waits."""
        file, waiting = self._file, self._buffer
        if file is None or not waiting:
            return
        self._buffer = bytearray()
        try:
            if file.write(waiting) != len(waiting):
                raise OSError("the disk is full")
        except OSError as error:
            self._cut(f"cannot write {self.path}: {error.strerror or error}")

    def close(self) -> None:
        self.flush()
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None

    def _cut(self, why: str) -> None:
        self.cut = why
        self.close()
        log.warning("inputs are not recorded any more: %s", why)


class RecordReader:
    """Reads a recording from its beginning. Raises StoreError on a file that is none.

    head     its first record
    damaged  why it cannot be read further, in a sentence; None until that is found
    torn     whether it ends within a record, as where a process was killed; found at its end
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damaged: str | None = None
        self.torn = False
        self._at = 0
        try:
            check_bytes(path, FileKind.RECORDING)
            self._file = path.open("rb")
        except OSError as error:
            raise StoreError(f"cannot read recording {path}: {error.strerror or error}") from error
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise StoreError(f"{path} is no recording: it does not begin with {MAGIC.decode().strip()!r}")
            self._at = len(MAGIC)
            head = self._next()
            if not isinstance(head, Head):
                raise StoreError(f"{path} is damaged: {self.damaged or 'it does not say which process it is of'}")
        except StoreError:
            self._file.close()
            raise
        self.head = head

    def __enter__(self) -> RecordReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[AnyRecord]:
        while (record := self._next()) is not None:
            yield record

    @property
    def at(self) -> int:
        """How many bytes are read."""
        return self._at

    def _next(self) -> AnyRecord | None:
        if self.damaged is not None or self.torn:
            return None
        try:
            head = self._file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                self.torn = len(head) > 0
                return None
            length, checksum = _HEAD.unpack(head)
            if length > FileKind.RECORDING.most_bytes:
                raise ValueError(f"a record of {length} bytes")
            body = self._file.read(length)
            if len(body) < length:
                self.torn = True
                return None
            if zlib.crc32(body) != checksum:
                raise ValueError("a record does not match its checksum")
            record: AnyRecord = _decoder.decode(body)
        except (OSError, ValueError, RecursionError, msgspec.MsgspecError) as error:
            self.damaged = f"damaged at byte {self._at}: {error}"
            return None
        self._at += _HEAD.size + length
        return record
