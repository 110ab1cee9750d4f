"""An SQLite file of rows with digests, and a seal which counts commits and sums the digests of all rows.

SQLite notices some damage to its pages and none to what lies in them, and drops commits of a damaged log silently.
The digest shows that a row is as it was written, the sum that none is missing, and the witness beside the file
(`swarm.journal`) that no commit is.
"""

from __future__ import annotations

import logging
import os
import secrets
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import msgspec

from swarm.config.input_files import FileKind, check_bytes
from swarm.errors import DamagedError, ProtocolError, StoreError, SwarmError
from swarm.files import make_folder, sync_folder, writing
from swarm.journal import DIGEST_BYTES, Lock, OwnFiles, Seal, check_witness, digest_of, read_seal, witness_of

log = logging.getLogger(__name__)

STORE_VERSION = "3"
_SEAL = "seal"
"""Key of the seal among `meta`, which the sum leaves out."""
_KIND = f"marks {STORE_VERSION}"
_MEMORY = ":memory:"
_LOG_BYTES = 1 << 20
"""Size of SQLite's write-ahead log beside the store, give or take one batch."""
_LONGEST_VALUE_BYTES = 16 << 20
"""No message is larger, so no column of a row is."""


class Table(NamedTuple):
    """A table of rows with digests.

    columns  name -> its type in SQL; the digest is beside them
    key      the number of columns, from the first, that are the key
    """

    name: str
    columns: dict[str, str]
    key: int

    @property
    def schema(self) -> str:
        columns = ", ".join(f"{name} {kind} NOT NULL" for name, kind in self.columns.items())
        key = ", ".join([*self.columns][: self.key])
        digest = "digest BLOB NOT NULL DEFAULT x''"
        return f"CREATE TABLE IF NOT EXISTS {self.name} ({columns}, {digest}, PRIMARY KEY ({key})) WITHOUT ROWID"

    def digest(self, row: Sequence[object]) -> bytes:
        """The digest of a row."""
        return digest_of(self.name.encode(), msgspec.msgpack.encode(row))

    def put(self, newer: Sequence[str] = ()) -> str:
        """Returns the statement which writes a row and its digest, for values of `sealed`.

        newer  columns by which a row that is not older replaces the one of its key; if empty, any does
        """
        columns = [*self.columns, "digest"]
        marks, key = ", ".join("?" * len(columns)), ", ".join(columns[: self.key])
        changes = ", ".join(f"{name} = excluded.{name}" for name in columns[self.key :])
        after, before = (", ".join(f"{where}.{name}" for name in newer) for where in ("excluded", self.name))
        condition = f"WHERE ({after}) >= ({before})" if newer else ""
        insert = f"INSERT INTO {self.name} ({', '.join(columns)}) VALUES ({marks})"
        return f"{insert} ON CONFLICT ({key}) DO UPDATE SET {changes} {condition}"

    def sealed(self, row: Sequence[object]) -> tuple[object, ...]:
        return (*row, self.digest(row))

    def triggers(self) -> Iterator[str]:
        """The statements by which no other changes a row without the sum."""
        for event, row, digests in (
            ("INSERT", "new", "x'', new.digest"),
            ("UPDATE", "new", "old.digest, new.digest"),
            ("DELETE", "old", "old.digest, x''"),
        ):
            when = f"WHEN {row}.key <> '{_SEAL}'" if self is META else ""
            yield (
                f"CREATE TEMP TRIGGER {self.name}_{event} AFTER {event} ON main.{self.name} {when} "
                f"BEGIN SELECT moved({digests}); END"
            )


META = Table("meta", {"key": "TEXT", "value": "TEXT"}, 1)
"""Its key is the first column."""


class SealedDatabase:
    """The file, or memory under the name ":memory:". One writing process at a time.

    A commit is on the disk when it returns (WAL with synchronous=FULL): it survives kill -9 of this process at any
    instant, and a power cut if the disk flushes as requested. All methods raise DamagedError where the file is not
    as it was written, which is looked for at the start, at each row that is read and at each commit (`check`), and
    StoreError if it cannot be written.

    tables     those of the file beside `meta`
    rebuild    move a damaged file aside, and begin an empty one
    read_only  look at a file, even while another process writes it
    """

    def __init__(
        self, path: Path | str, tables: Sequence[Table], *, rebuild: bool = False, read_only: bool = False
    ) -> None:
        self.path = Path(path)
        self._tables = (META, *tables)
        self._in_memory = str(path) == _MEMORY
        self._read_only = read_only
        self._sum = 0
        """The sum of the digests of all rows, within an open transaction too."""
        self._seal = Seal(_KIND, secrets.token_bytes(8), 0, 0, bytes(DIGEST_BYTES))
        self._own = OwnFiles("the store ", self.path, Path(f"{path}-wal"))
        self._lock: Lock | None = None
        if not self._in_memory and self.path.is_file():
            check_bytes(self.path, FileKind.STORE)
        if not self._in_memory and not read_only:
            self._lock = Lock(self.path, "by another keeper")
        try:
            self._db = self._opened()
        except SwarmError:
            if self._in_memory or read_only or not rebuild:
                self._unlock()
                raise
            log.warning("moved the damaged store to %s", _move_aside(self.path))
            self._db = self._opened()

    def close(self) -> None:
        """Releases the file, and its lock."""
        self._db.close()
        self._unlock()

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Commits all or nothing. A StoreError leaves the store usable."""
        self.check()
        before, seal = self._sum, self._seal
        try:
            with self._db:
                if self._lock is not None and seal.last:
                    self._check_own()
                yield
                if self._sum != before:
                    digest = self._sum.to_bytes(DIGEST_BYTES, "little")
                    seal = seal._replace(last=seal.last + 1, digest=digest)
                    self._put(META, (_SEAL, seal.packed().hex()))
            before = self._sum
        except sqlite3.ProgrammingError:
            raise  # a bug of ours, and no disk will get better
        except sqlite3.Error as error:
            raise StoreError(f"cannot write the store {self.path}: {error}") from error
        finally:
            self._sum = before
            self._own.leave()
        self._seal = seal
        if self._lock is not None:
            self._lock.witness(seal)

    def check(self) -> None:
        """Looks whether the file is as it was left. SQLite holds a deleted one open: a copy gets its name."""
        how = "" if self._lock is None else self._own.check()
        if not how:
            return
        if how == "changed":  # a restart reads it whole
            raise DamagedError(self._own.found)
        try:
            with self._new_file() as part, closing(sqlite3.connect(part)) as copy:
                self._db.backup(copy)
        except sqlite3.Error as error:
            raise StoreError(f"cannot write the store {self.path}: {error}") from error
        with closing(self._db):
            self._db = self._opened()
        log.warning("%s: it is written again", self._own.found)

    @contextmanager
    def _new_file(self) -> Iterator[Path]:
        """Yields the path of a file which becomes the store: it is whole, or not there."""
        part = Path(f"{self.path}.part")
        make_folder(part.parent)
        with writing(self.path):
            part.unlink(missing_ok=True)
            yield part
            # A log beside it is of a store that was moved away; SQLite would replay it.
            for tail in ("-wal", "-shm"):
                Path(f"{self.path}{tail}").unlink(missing_ok=True)
            part.replace(self.path)
            sync_folder(self.path.parent)

    def _check_own(self) -> None:
        """Begins a transaction. Raises DamagedError if another process has written the file, which only a deleted
        lock lets it: its rows are not in our sum."""
        self._db.execute("BEGIN IMMEDIATE")
        row = self._db.execute("SELECT value FROM meta WHERE key = ?", (_SEAL,)).fetchone()
        if row is None or row[0] != self._seal.packed().hex():
            raise DamagedError(
                f"the store {self.path} was written by another keeper; was {self.path}.lock deleted?"
            )

    @contextmanager
    def _reading(self, what: str = "") -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, ValueError, TypeError, msgspec.MsgspecError, ProtocolError) as error:
            raise DamagedError(_damaged(self.path, f"{what}{error}")) from error

    def _rows(self, table: Table, where: str = "", *values: object) -> Iterator[list[Any]]:
        """Rows of a table. Raises DamagedError at one that is not as it was written."""
        with self._reading():
            for *row, digest in self._db.execute(
                f"SELECT {', '.join(table.columns)}, digest FROM {table.name} {where}", values
            ):
                if digest != table.digest(row):
                    key = ", ".join(map(repr, row[: table.key]))
                    raise ValueError(
                        f"row {key} of table {table.name}: expected one with digest {digest.hex()}, found another"
                    )
                yield row

    def _put(self, table: Table, *rows: Sequence[object], newer: Sequence[str] = ()) -> None:
        """Writes rows with their digests, in the open transaction (`Table.put`)."""
        self._db.executemany(table.put(newer), map(table.sealed, rows))

    def _moved(self, before: bytes, after: bytes) -> None:
        """A row with one digest has become one with another; a missing row's is empty."""
        change = int.from_bytes(after, "little") - int.from_bytes(before, "little")
        self._sum = (self._sum + change) % (1 << 8 * DIGEST_BYTES)

    # --- opening --------------------------------------------------------------------------------------------

    def _opened(self) -> sqlite3.Connection:
        if self._in_memory:
            return self._begun(_connect(_MEMORY))
        if not self._read_only and not self.path.exists():
            with self._new_file() as part:
                self._begun(_connect(part)).close()
        witness = witness_of(self.path, _KIND)
        db = _connect(self.path, read_only=self._read_only)
        try:
            return self._checked(db, witness)
        except (sqlite3.DatabaseError, ValueError) as error:  # a ValueError where its message is not UTF-8
            db.close()
            if self._read_only:
                why = "it is not a keeper's store" if "not a database" in str(error) else str(error)
                raise StoreError(f"cannot read the store {self.path}: {why}") from error
            raise _refused(self.path, error) from error
        except SwarmError:
            db.close()
            raise

    def _begun(self, db: sqlite3.Connection) -> sqlite3.Connection:
        """Makes the tables."""
        self._db = db
        self._sum = 0
        with self._writing():
            db.execute("BEGIN IMMEDIATE")
            for table in self._tables:
                db.execute(table.schema)
            self._watch(db)
            self._put(META, ("version", STORE_VERSION))
        return db

    def _watch(self, db: sqlite3.Connection) -> None:
        db.execute("PRAGMA recursive_triggers = ON")  # otherwise REPLACE deletes without one
        db.create_function("moved", 2, self._moved)
        for table in self._tables:
            for trigger in table.triggers():
                db.execute(trigger)

    def _checked(self, db: sqlite3.Connection, witness: Seal | None) -> sqlite3.Connection:
        """Raises DamagedError if a row is not as it was written, or one is missing or too many."""
        [(found,)] = db.execute("PRAGMA integrity_check(1)")
        if found != "ok":
            raise DamagedError(_damaged(self.path, found))
        self._db = db
        db.execute("BEGIN")  # one state of a file which another process may write
        try:
            self._sum = 0
            meta = {}
            for table in self._tables:
                for row in self._rows(table):
                    if table is META:
                        meta[row[0]] = row[1]
                    if table is not META or row[0] != _SEAL:
                        self._moved(b"", table.digest(row))
        finally:
            db.rollback()
        if (version := meta.get("version")) != STORE_VERSION:
            raise StoreError(f"the store {self.path} has version {version}, this program reads {STORE_VERSION}")
        with self._reading("seal: "):
            seal = read_seal(bytes.fromhex(meta.get(_SEAL, "")), _KIND)
        if seal is None or seal.digest != self._sum.to_bytes(DIGEST_BYTES, "little"):
            raise DamagedError(_damaged(self.path, "expected the rows of its seal, found more or fewer"))
        check_witness(self.path, witness, seal, lambda number: seal.digest if number == seal.last else None)
        self._seal = seal
        if self._lock is not None:
            self._watch(db)
            self._lock.witness(seal)  # there may be none
            self._own.leave(new=True)
        return db


def _connect(path: Path | str, *, read_only: bool = False) -> sqlite3.Connection:
    if read_only and not Path(path).is_file():
        raise StoreError(f"there is no store {path}: no such file; a run leaves one as runs/RUN/map.sqlite")
    name = f"file:{quote(str(path))}?mode=ro" if read_only else path
    try:
        db = sqlite3.connect(name, check_same_thread=False, timeout=2.0, uri=read_only)
    except sqlite3.Error as error:
        raise StoreError(f"cannot open the store {path}: {error}") from error
    if read_only:
        return db
    try:
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        # Committed pages are checkpointed as soon as the log has this number of them, and the log file is truncated
        # then: otherwise the log fills a small disk permanently.
        db.execute(f"PRAGMA wal_autocheckpoint = {_LOG_BYTES // 4096}")
        db.execute(f"PRAGMA journal_size_limit = {_LOG_BYTES}")
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_VALUE_BYTES)
    except (sqlite3.DatabaseError, ValueError) as error:  # a ValueError where its message is not UTF-8
        db.close()
        raise _refused(path, error) from error
    return db


def _refused(path: Path | str, error: Exception) -> SwarmError:
    if isinstance(error, sqlite3.OperationalError):
        return StoreError(f"cannot open the store {path}: {error}")
    return DamagedError(_damaged(path, str(error)))


def _damaged(path: Path | str, reason: str) -> str:
    return (
        f"the store {path} is damaged ({reason}): move it away, or start the keeper with --rebuild to fill a new "
        "one from the swarm"
    )


def _move_aside(path: Path) -> Path:
    number = 1
    while (aside := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    with writing(path):
        os.replace(path, aside)
        for tail in ("-wal", "-shm"):
            if (beside := Path(f"{path}{tail}")).exists():
                beside.replace(f"{aside}{tail}")
    return aside
