"""Durable records: each is chained to the one before, and seals say how many there are.

A journal begins with its seal, and records follow:

    seal: magic and version, name of the journal, count before the first record, count, digest of the last, checksum
    {length u32, digest of the predecessor's digest and the body, body} ...

The seal says how many records were acknowledged. Each of them has to be there as it was written, or the file is
refused with the place of the damage. Bytes behind them are a record that a crash cut short: it was never
acknowledged. The witness is a copy of the newest seal in the file of the lock: by it an older version of the file
is noticed.

A store that is deleted or changed while its process runs is noticed at the next commit, or within a second
(`OwnFiles`). A journal is then written again from memory.

A record is on the disk before the seal counts it, and the seal is written before `sync` returns. A seal is not
synced itself: after a loss of power, the seal may count fewer records than are there, never more.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import secrets
import struct
from collections.abc import Callable, Iterable
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

from swarm.config.input_files import FileKind, read_bytes
from swarm.errors import DamagedError, StoreError, SwarmError
from swarm.files import make_folder, sync_folder, writing

log = logging.getLogger(__name__)

DIGEST_BYTES = 8
"""Bytes of a checksum: of damage one in 2^64 is missed. It is no defence against a forger."""
_HEAD = struct.Struct("<32s8sQQ8s")
_RECORD = struct.Struct("<I8s")
SEAL_BYTES = _HEAD.size + DIGEST_BYTES


def digest_of(*parts: bytes) -> bytes:
    """Returns the digest of these bytes."""
    return blake2b(b"".join(parts), digest_size=DIGEST_BYTES).digest()


class Seal(NamedTuple):
    """The acknowledged content of a store.

    kind    its format, with a version
    name    random; a store keeps it for life
    first   count of records of which the file holds only what still counts
    last    count of all records, or commits
    digest  of the last record and by its chain of all
    """

    kind: str
    name: bytes
    first: int
    last: int
    digest: bytes

    def packed(self) -> bytes:
        head = _HEAD.pack(f"swarm {self.kind}\n".encode(), self.name, self.first, self.last, self.digest)
        return head + digest_of(head)


def read_seal(data: bytes, kind: str) -> Seal | None:
    """Returns the seal at the start of these bytes; None if there is no valid one of this kind."""
    head = data[: _HEAD.size]
    if len(data) < SEAL_BYTES or data[_HEAD.size : SEAL_BYTES] != digest_of(head):
        return None
    magic, *fields = _HEAD.unpack(head)
    return Seal(kind, *fields) if magic.rstrip(b"\0") == f"swarm {kind}\n".encode() else None


class OwnFiles:
    """Files that this process alone writes, as it left them: by device, inode, size and time of change.

    what   begins a sentence about one of them
    found  what became of one since, as a sentence
    """

    def __init__(self, what: str, *paths: Path) -> None:
        self._what, self._paths, self.found = what, paths, ""
        self._left: dict[Path, _State] = {}

    def leave(self, *, new: bool = False) -> None:
        """Notes the files after a write of ours.

        new  they may be others than before
        """
        for path in self._paths:
            now = _state(path)
            if now is not None and (new or now[0] == self._left.get(path, now)[0]):
                self._left[path] = now

    def check(self) -> str:
        """The fate of a file since it was left: "", "deleted" or "changed"; its content may be the same. Raises
        DamagedError where its name belongs to another file, perhaps of a process."""
        for path, left in self._left.items():
            if (now := _state(path)) == left:
                continue
            how = "deleted" if now is None else "changed" if now[0] == left[0] else "replaced"
            self.found = f"{self._what}{path} was {how} by another program while it was in use"
            if how == "replaced":
                raise DamagedError(self.found)
            return how
        return ""


_State = tuple[tuple[int, int], tuple[int, int]]


def _state(path: Path) -> _State | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return (found.st_dev, found.st_ino), (found.st_size, found.st_mtime_ns)


class Lock:
    """The locked file beside a store, which holds its witness. It is made again if it is deleted or replaced.

    The lock ends with its process.

    waits   for the end of a process that has locked it
    in_use  why it is refused otherwise
    """

    def __init__(self, path: Path, in_use: str, *, waits: bool = False) -> None:
        self._path, self._in_use = path, in_use
        self._file = self._locked(waits=waits)

    def _locked(self, *, waits: bool) -> int:
        make_folder(self._path.parent)
        with writing(self._path):
            file = os.open(f"{self._path}.lock", os.O_CREAT | os.O_RDWR, 0o600)
        try:
            _lock(self._path, file, self._in_use, waits=waits)
        except StoreError:
            os.close(file)
            raise
        return file

    def witness(self, seal: Seal) -> None:
        if not _is_at(Path(f"{self._path}.lock"), self._file):
            with suppress(StoreError):  # another process has it, and finds the store locked or changed
                file, self._file = self._file, self._locked(waits=False)
                os.close(file)
        with writing(self._path):
            os.pwrite(self._file, seal.packed(), 0)

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def _lock(path: Path, file: int, in_use: str, *, waits: bool) -> None:
    """Locks an open file that belongs to a store."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB))
    except OSError as error:
        raise StoreError(f"{path} is in use {in_use}") from error


def _is_at(path: Path, file: int) -> bool:
    """Returns True if an open file is still the one of this name."""
    with suppress(OSError):
        return os.path.samestat(path.stat(), os.fstat(file))
    return False


def witness_of(path: Path, kind: str) -> Seal | None:
    """Returns the witness of a store; None if there is none, or one of another kind, or it is damaged itself."""
    try:
        with Path(f"{path}.lock").open("rb") as file:
            return read_seal(file.read(SEAL_BYTES), kind)
    except OSError:
        return None


def check_witness(path: Path, witness: Seal | None, found: Seal, digest_at: Callable[[int], bytes | None]) -> None:
    """Raises DamagedError if a store is older than its witness, or another one.

    found      the seal of its whole content
    digest_at  the digest of the record of a number; None if the file does not hold it
    """
    if witness is None:
        return
    if witness.name != found.name:
        why = "is another file than the one that was written last"
    elif witness.last > found.last:
        why = f"is an older version: expected {witness.last} records or commits, found {found.last}"
    elif (digest_at(witness.last) or witness.digest) != witness.digest:
        why = f"is damaged: expected record {witness.last} as it was written, found another"
    else:
        return
    raise DamagedError(f"{path} {why}; to use it nevertheless, delete {path}.lock")


class Journal:
    """Appends records to a file, and goes over to a spare one with what still counts when it is full.

    Both files have their space beforehand, so that a full disk keeps no owner from its records for long, and a life
    that begins meanwhile from none. The file is locked for as long as the process lives, and so is the one beside
    it, which may be deleted. A folder that is gone is made again for the next file.

    kind      names the format; a file of another one is refused
    live      the bodies of the records that still count
    size      bytes of each of the two files at least; they have four times that of their live records

    found     bodies of the records of the file, in order

    Raises StoreError if the file is in use or cannot be written, DamagedError if it is not as it was written.
    """

    def __init__(
        self,
        path: Path,
        kind: FileKind,
        live: Callable[[], Iterable[bytes]],
        *,
        size: int,
        in_use: str,
        waits: bool = False,
    ) -> None:
        self._path = path
        self._spare_path = path.with_name(f"{path.name}.spare")
        self._kind = kind
        self._live = live
        self._least = size
        self._file = self._spare = -1
        """Open files; -1 is none."""
        self._at = self._size = self._spare_size = 0
        """Position of the next record, and the length of the two files."""
        self._synced, self._is_broken = True, False
        self._seal = Seal(f"{kind.what} 1", secrets.token_bytes(8), 0, 0, b"")
        """The seal of all records, also of those which are not synced."""
        self.found: list[bytes] = []
        self._own = OwnFiles("", path)
        self._lock = Lock(path, in_use, waits=waits)
        try:
            if path.exists():
                self._read(in_use, waits=waits)
        except SwarmError:
            self.close()
            raise

    @property
    def ready(self) -> bool:
        """True if all that one event can bring will find space."""
        return self._spare >= 0 or (not self._is_broken and self._size - self._at >= self._size // 2)

    def begin(self) -> None:
        """Makes the file if there is none, and the spare one if it can. Empties `found`."""
        self.found = []
        if self._file < 0:
            self._switch_to_spare()
        self.reserve()

    def reserve(self) -> str | None:
        """Makes the spare file, and looks whether the file is as it was left. Returns the reason if that fails."""
        try:
            self._check_own()
            self.sync()
        except StoreError as error:
            return str(error)
        return self._reserve()

    def _check_own(self) -> None:
        if not self._is_broken and self._own.check():
            self._synced, self._is_broken = False, True
            log.warning("%s: it is written again", self._own.found)

    def _reserve(self) -> str | None:
        if self._spare >= 0:
            if _is_at(self._spare_path, self._spare):
                return None
            os.close(self._spare)  # it has been deleted, or moved away
            self._spare = -1
        size = max(self._least, 4 * (SEAL_BYTES + sum(_RECORD.size + len(body) for body in self._live())))
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            spare = os.open(self._spare_path, os.O_CREAT | os.O_RDWR, 0o600)
            try:
                if os.fstat(spare).st_size < size:
                    _write(spare, bytes(size), 0)
            except OSError:
                os.close(spare)
                with suppress(OSError):
                    self._spare_path.unlink()  # A partial file is useless. Free its space.
                raise
        except OSError as error:
            return f"cannot write {self._spare_path}: {error.strerror}"
        self._spare, self._spare_size = spare, size
        return None

    def append(self, body: bytes) -> None:
        """Writes a record that is already among what still counts. It counts after the next `sync`."""
        self._check_own()
        if self._is_broken:
            return  # `sync` writes all again
        seal, record = _chained(self._seal, [body])
        if self._at + len(record) > self._size:
            self._switch_to_spare()
            self._reserve()
            return
        with writing(self._path):
            _write(self._file, record, self._at)
            self._own.leave()
        self._seal = seal
        self._at += len(record)
        self._synced = False

    def sync(self) -> None:
        """Returns once all records are on the disk, and the seal counts them."""
        if not self._synced:
            if self._is_broken:  # the system tells only once of a write that was lost: all is written again
                self._switch_to_spare()
                return
            self._is_broken = True
            with writing(self._path):
                os.fdatasync(self._file)
                os.pwrite(self._file, self._seal.packed(), 0)
                self._own.leave()
            self._is_broken = False
            self._lock.witness(self._seal)
            self._synced = True

    def close(self) -> None:
        for file in (self._file, self._spare):
            if file >= 0:
                os.close(file)
        self._file = self._spare = -1
        self._lock.close()

    def _read(self, in_use: str, *, waits: bool) -> None:
        """Reads the records of the file, and goes on behind them."""
        with writing(self._path):
            self._file = os.open(self._path, os.O_RDWR)
        _lock(self._path, self._file, in_use, waits=waits)
        witness = witness_of(self._path, self._seal.kind)
        data = read_bytes(self._path, self._kind)
        seal = read_seal(data, self._seal.kind)
        if seal is None:
            start = repr(data[:SEAL_BYTES].rstrip(b"\0")[:40])
            raise DamagedError(
                f"{self._path} is damaged at byte 0: expected a seal of {self._seal.kind!r}, found {start}"
            )
        at, number, digest = SEAL_BYTES + DIGEST_BYTES, seal.first, data[SEAL_BYTES : SEAL_BYTES + DIGEST_BYTES]
        digests = {}
        while at + _RECORD.size <= len(data):
            length, expected = _RECORD.unpack_from(data, at)
            end = at + _RECORD.size + length
            body = data[at + _RECORD.size : end]
            if len(body) < length or digest_of(digest, body) != expected:
                break
            self.found.append(body)
            number, digest, at = number + 1, expected, end
            digests[number] = digest
        if number < seal.last or digests.get(seal.last) != seal.digest:
            raise DamagedError(
                f"{self._path} is damaged at byte {at}: expected record {number + 1} of {seal.last} as it was "
                "written, found other bytes"
            )
        found = seal._replace(last=number, digest=digest)
        check_witness(self._path, witness, found, digests.get)
        self._seal, self._at, self._size = found, at, len(data)
        self._synced = False  # a record that is whole counts from now on, and a witness may be missing
        self.sync()

    def _switch_to_spare(self) -> None:
        """Goes over to the spare file."""
        if (why := self._reserve()) is not None:
            raise StoreError(why)
        first_digest = secrets.token_bytes(DIGEST_BYTES)  # remains in the spare file do not follow from it
        seal, records = _chained(self._seal._replace(first=self._seal.last, digest=first_digest), self._live())
        content = seal.packed() + first_digest + records
        with writing(self._path):
            fcntl.flock(self._spare, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _write(self._spare, content, 0)
            os.fsync(self._spare)
            self._spare_path.replace(self._path)
            sync_folder(self._path.parent)
        self._lock.witness(seal)
        if self._file >= 0:
            os.close(self._file)
        self._seal = seal
        self._file, self._size, self._at = self._spare, max(self._spare_size, len(content)), len(content)
        self._spare, self._synced, self._is_broken = -1, True, False
        self._own.leave(new=True)


def _chained(seal: Seal, bodies: Iterable[bytes]) -> tuple[Seal, bytes]:
    """Returns the next records, and the seal that counts them."""
    records = []
    for body in bodies:
        digest = digest_of(seal.digest, body)
        seal = seal._replace(last=seal.last + 1, digest=digest)
        records.append(_RECORD.pack(len(body), digest) + body)
    return seal, b"".join(records)


def _write(file: int, content: bytes, at: int) -> None:
    if os.pwrite(file, content, at) != len(content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
