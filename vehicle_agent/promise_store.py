"""What an agent has on file for right of way: its own lives, and what it has promised and stored as a member."""

from __future__ import annotations

import fcntl
import os
import secrets
from pathlib import Path
from typing import Protocol

import msgspec

from swarm.errors import StoreError
from swarm.wire.messages.traffic import Table
from vehicle_agent.traffic.right_of_way import OwnRecord

_LARGEST_BYTES = 16 << 20


class _Record(msgspec.Struct, array_like=True):
    """One line of the file: either the agent's own record, or what it promised and stored of a plot."""

    own: OwnRecord | None = None
    promised: int = 0
    table: Table | None = None


class PromiseStore(Protocol):
    """own    of the agent itself
    saved  plot -> (promised epoch, stored table)
    """

    own: OwnRecord
    saved: dict[int, tuple[int, Table]]

    def save_own(self, own: OwnRecord) -> None: ...

    def save(self, promised: int, table: Table) -> None: ...


class MemoryPromiseStore:
    """Survives a simulated process, not this one."""

    def __init__(self, disk: int) -> None:
        self.own = OwnRecord(disk=disk)
        self.saved: dict[int, tuple[int, Table]] = {}

    def save_own(self, own: OwnRecord) -> None:
        self.own = own

    def save(self, promised: int, table: Table) -> None:
        self.saved[table.plot] = (promised, table)


class FilePromiseStore(MemoryPromiseStore):
    """Appends to a file, and writes it anew when it has grown. What was written survives a kill -9 of the process,
    not a loss of power: nothing is synced.

    The file is locked for as long as the process lives: so an earlier life that ran on it has ended.

    Raises StoreError if the file is in use, is not ours or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(secrets.randbits(60))
        self._path = path
        self._encoder = msgspec.msgpack.Encoder()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(f"{path}.lock", os.O_CREAT | os.O_RDWR, 0o600)
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StoreError(f"{path} is in use: the same agent runs here already; end it first") from error
        except OSError as error:
            raise StoreError(f"cannot open {path}: {error.strerror}") from error
        self._read()
        self._rewrite()

    def save_own(self, own: OwnRecord) -> None:
        super().save_own(own)
        self._append(_Record(own=own))

    def save(self, promised: int, table: Table) -> None:
        super().save(promised, table)
        self._append(_Record(promised=promised, table=table))

    def close(self) -> None:
        os.close(self._file)
        os.close(self._lock)

    def _read(self) -> None:
        """Take in the records of the file up to the first that was cut short by a kill."""
        data = self._path.read_bytes() if self._path.exists() else b""
        decoder = msgspec.msgpack.Decoder(_Record)
        at = 0
        while at + 4 <= len(data):
            end = at + 4 + int.from_bytes(data[at : at + 4], "little")
            if end > len(data):
                break
            try:
                record = decoder.decode(data[at + 4 : end])
            except (msgspec.MsgspecError, ValueError) as error:
                raise StoreError(f"{self._path} is damaged at byte {at}: {error}") from error
            if record.own is not None:
                self.own = record.own
            elif record.table is not None:
                self.saved[record.table.plot] = (record.promised, record.table)
            at = end

    def _rewrite(self) -> None:
        records = [_Record(own=self.own)]
        records += [_Record(promised=promised, table=table) for promised, table in self.saved.values()]
        fresh = self._path.with_suffix(".new")
        try:
            fresh.write_bytes(b"".join(map(self._packed, records)))
            fresh.replace(self._path)
            self._file = os.open(self._path, os.O_WRONLY | os.O_APPEND)
        except OSError as error:
            raise StoreError(f"cannot write {self._path}: {error.strerror}") from error

    def _packed(self, record: _Record) -> bytes:
        packed = self._encoder.encode(record)
        return len(packed).to_bytes(4, "little") + packed

    def _append(self, record: _Record) -> None:
        packed = self._packed(record)
        try:
            # A record in part would hide all that come after it; the process ends, and the next life cuts it off.
            if os.write(self._file, packed) != len(packed):
                raise StoreError(f"{self._path}: the disk is full")
            if os.fstat(self._file).st_size > _LARGEST_BYTES:
                os.close(self._file)
                self._rewrite()
        except OSError as error:
            raise StoreError(f"cannot write {self._path}: {error.strerror}") from error
