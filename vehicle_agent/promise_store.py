"""Files of an agent for right of way: its own lives, and its promises and tables as a member."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
from pathlib import Path

import msgspec

from swarm.config.input_files import FileKind, read_bytes
from swarm.errors import StoreError
from swarm.files import writing
from swarm.recording.external_calls import ExternalCalls
from swarm.wire.messages.traffic import Table
from vehicle_agent.traffic.right_of_way_core import OwnRecord

_SIZE_BYTES = 1 << 18
"""Size of each of the two files, and at least four times that of their live records."""
_HEAD_BYTES = 4
"""The length of a record, far more than a file holds."""


class _Record(msgspec.Struct, array_like=True):
    """One line of the file: either the agent's own record, or what it promised and stored of a plot."""

    own: OwnRecord | None = None
    promised: int = 0
    table: Table | None = None


PROMISE_STORE = ExternalCalls(
    "store",
    calls={"reserve": str | None, "save_own": None, "save": None},
    facts={"own": OwnRecord, "saved": dict[int, tuple[int, Table]], "ready": bool},
)
"""Calls of its store that an agent uses."""


class PromiseStore:
    """Records of an agent, here in memory only: they survive a simulated process, not this one.

    own    of the agent itself
    saved  plot -> (promised epoch, stored table)
    """

    def __init__(self, disk: int) -> None:
        self.own = OwnRecord(disk=disk)
        self.saved: dict[int, tuple[int, Table]] = {}

    @property
    def ready(self) -> bool:
        """True if all that one event can bring will find space. While it will not, nothing may be promised."""
        return True

    def reserve(self) -> str | None:
        """Tries to get the space that is missing. Returns why it cannot."""
        return None

    def save_own(self, own: OwnRecord) -> None:
        self.own = own

    def save(self, promised: int, table: Table) -> None:
        self.saved[table.plot] = (promised, table)


class FilePromiseStore(PromiseStore):
    """Appends to a file, and goes over to a spare one with what still counts when it is full. A written record
    survives a kill -9 of the process, not a loss of power: there is no sync.

    Both files have their space beforehand, so that a disk which is full keeps no member from its promises for long,
    and a life that begins meanwhile from none. A record counts once its length stands before it, which is written
    last; behind the last record stands a length of 0.

    The file is locked for as long as the process lives: so an earlier life that ran on it has ended.

    waits  for the end of a process that has locked it

    Raises StoreError if the file is in use, is not ours or cannot be written.
    """

    def __init__(self, path: Path, *, waits: bool = False) -> None:
        super().__init__(secrets.randbits(60))
        self._path = path
        self._spare_path = path.with_name(f"{path.name}.spare")
        self._encoder = msgspec.msgpack.Encoder()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(f"{path}.lock", os.O_CREAT | os.O_RDWR, 0o600)
            fcntl.flock(self._lock, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise StoreError(f"{path} is in use: the same agent runs here already; end it first") from error
        except OSError as error:
            raise StoreError(f"cannot open {path}: {error.strerror}") from error
        self._file = self._spare = -1
        """Open files; -1 is none."""
        self._at = self._size = self._spare_size = 0
        """Position of the next record, and the length of the two files."""
        if path.exists():
            self._read()
        else:
            self._switch()
        self.reserve()

    @property
    def ready(self) -> bool:
        return self._spare >= 0 or self._size - self._at >= self._size // 2

    def reserve(self) -> str | None:
        """Makes the spare file. Returns the reason if that fails, None if there is one."""
        if self._spare >= 0:
            return None
        size = max(_SIZE_BYTES, 4 * len(self._all()))
        try:
            spare = os.open(self._spare_path, os.O_CREAT | os.O_RDWR, 0o600)
            try:
                if os.fstat(spare).st_size < size and os.pwrite(spare, bytes(size), 0) != size:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            except OSError:
                os.close(spare)
                with contextlib.suppress(OSError):
                    self._spare_path.unlink()  # A partial file is useless. Free its space.
                raise
        except OSError as error:
            return f"cannot write {self._spare_path}: {error.strerror}"
        self._spare, self._spare_size = spare, size
        return None

    def save_own(self, own: OwnRecord) -> None:
        super().save_own(own)
        self._append(_Record(own=own))

    def save(self, promised: int, table: Table) -> None:
        super().save(promised, table)
        self._append(_Record(promised=promised, table=table))

    def close(self) -> None:
        for file in (self._file, self._spare, self._lock):
            if file >= 0:
                os.close(file)

    def _read(self) -> None:
        """Reads the records of the file, and goes on behind them."""
        data = read_bytes(self._path, FileKind.PROMISES)
        decoder = msgspec.msgpack.Decoder(_Record)
        at = 0
        while length := int.from_bytes(data[at : at + _HEAD_BYTES], "little"):
            end = at + _HEAD_BYTES + length
            try:
                if end > len(data):
                    raise ValueError("it ends within a record")
                record = decoder.decode(data[at + _HEAD_BYTES : end])
            except (msgspec.MsgspecError, ValueError) as error:
                raise StoreError(f"{self._path} is damaged at byte {at}: {error}") from error
            if record.own is not None:
                self.own = record.own
            elif record.table is not None:
                self.saved[record.table.plot] = (record.promised, record.table)
            at = end
        with writing(self._path):
            self._file = os.open(self._path, os.O_RDWR)
        self._at, self._size = at, len(data)

    def _all(self) -> bytes:
        """Returns the live records, encoded as the start of a new file."""
        records = [_Record(own=self.own)]
        records += [_Record(promised=promised, table=table) for promised, table in self.saved.values()]
        packed = map(self._encoder.encode, records)
        return b"".join(len(each).to_bytes(_HEAD_BYTES, "little") + each for each in packed)

    def _switch(self) -> None:
        """Goes over to the spare file."""
        why = self.reserve()
        content = self._all()
        if why is not None:
            raise StoreError(why)
        with writing(self._path):
            os.pwrite(self._spare, content + bytes(_HEAD_BYTES), 0)
            self._spare_path.replace(self._path)
        if self._file >= 0:
            os.close(self._file)
        self._file, self._size, self._at = self._spare, max(self._spare_size, len(content)), len(content)
        self._spare = -1

    def _append(self, record: _Record) -> None:
        packed = self._encoder.encode(record)
        if self._at + len(packed) + 2 * _HEAD_BYTES > self._size:
            self._switch()  # the record is among what still counts
            self.reserve()
            return
        with writing(self._path):
            body = packed + bytes(_HEAD_BYTES)
            if os.pwrite(self._file, body, self._at + _HEAD_BYTES) != len(body):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.pwrite(self._file, len(packed).to_bytes(_HEAD_BYTES, "little"), self._at)
        self._at += _HEAD_BYTES + len(packed)
