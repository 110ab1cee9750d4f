"""The keeper's store: one SQLite file (`KeeperStore`), and which sets still wait for it (`Keeper`, core)."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO
from urllib.parse import quote

import msgspec

from shared_map.keeper.compaction import united, without
from shared_map.replication.digest import Ledger
from shared_map.replication.marks import base_seq, is_tombstone
from swarm.config.input_files import FileKind, check_bytes
from swarm.errors import ProtocolError, StoreError
from swarm.grid import GridSpec
from swarm.recording.external_calls import ExternalCalls
from swarm.wire.codec import decode, encode
from swarm.wire.messages.map_data import SEQ_STEP, MarkSet
from swarm.wire.messages.orders import Order
from swarm.wire.messages.planning import Sighted

log = logging.getLogger(__name__)

STORE_VERSION = "2"
_MEMORY = ":memory:"
_LOG_BYTES = 1 << 20
"""Size of SQLite's write-ahead log beside the store, give or take one batch."""
BATCH_BYTES = 1 << 19
"""Marks of one commit, about."""
_LONGEST_VALUE_BYTES = 16 << 20
"""No message is larger, so no column of a row is."""
_SET = """
    tile INTEGER NOT NULL, author TEXT NOT NULL, grp TEXT NOT NULL, epoch INTEGER NOT NULL, seq INTEGER NOT NULL,
    cells BLOB NOT NULL, kinds BLOB NOT NULL, paces BLOB NOT NULL, stamps_ns BLOB NOT NULL, untils_ns BLOB NOT NULL
"""
_SCHEMA = f"""
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS sets ({_SET}, PRIMARY KEY (tile, author)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS folded ({_SET}, since_ns INTEGER NOT NULL, PRIMARY KEY (tile, author)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS orders (
    subject TEXT NOT NULL, name TEXT NOT NULL, stamp_ns INTEGER NOT NULL, body BLOB NOT NULL,
    PRIMARY KEY (subject, name)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS sightings (
    target TEXT PRIMARY KEY, stamp_ns INTEGER NOT NULL, sighted BLOB NOT NULL
) WITHOUT ROWID;
"""
# `folded` holds what compaction dropped; the name stays, as stores of this version have it.
_SEEN = """
INSERT INTO sightings (target, stamp_ns, sighted) VALUES (?, ?, ?)
ON CONFLICT (target) DO UPDATE SET stamp_ns = excluded.stamp_ns, sighted = excluded.sighted
WHERE excluded.stamp_ns >= sightings.stamp_ns
"""
_ORDERED = """
INSERT INTO orders (subject, name, stamp_ns, body) VALUES (?, ?, ?, ?)
ON CONFLICT (subject, name) DO UPDATE SET stamp_ns = excluded.stamp_ns, body = excluded.body
WHERE excluded.stamp_ns >= orders.stamp_ns
"""
_FIELDS = ("tile", "author", "group", "epoch", "seq", "cells", "kinds", "paces", "stamps_ns", "untils_ns")
_COLUMNS = tuple("grp" if field == "group" else field for field in _FIELDS)  # GROUP is a word of SQL
_UPSERT = f"""
INSERT INTO sets ({", ".join(_COLUMNS)}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
ON CONFLICT (tile, author) DO UPDATE SET grp = excluded.grp, epoch = excluded.epoch, seq = excluded.seq,
    cells = excluded.cells, kinds = excluded.kinds, paces = excluded.paces, stamps_ns = excluded.stamps_ns,
    untils_ns = excluded.untils_ns
WHERE (excluded.epoch, excluded.seq) >= (sets.epoch, sets.seq)
"""
_CLASSES_USED = """
SELECT DISTINCT tile / (:tiles + 1) FROM (
    SELECT tile, kinds FROM sets WHERE tile > :tiles UNION ALL SELECT tile, kinds FROM folded WHERE tile > :tiles
) WHERE length(kinds) > 0
"""
"""Numbers of classes for which alone something is marked, or was until compaction set it aside."""
_DELETE = "DELETE FROM sets WHERE tile = ? AND author = ? AND (epoch, seq) <= (?, ?)"
_OUTDATE = "DELETE FROM folded WHERE tile = ? AND author = ? AND (epoch, seq) < (?, ?)"
"""Marks dropped from a set count only until their author publishes a newer set."""
_DROP = f"REPLACE INTO folded ({', '.join(_COLUMNS)}, since_ns) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"


class KeeperStore:
    """Every set in one SQLite file, or in memory under the name ":memory:". One writing process at a time.

    A commit is on the disk when it returns (WAL with synchronous=FULL): it survives kill -9 of this process at any
    instant, and a power cut if the disk flushes as requested. All methods raise StoreError where the file is
    damaged or cannot be written.

    rebuild    move a damaged file aside, and begin an empty one, which the swarm fills
    read_only  look at a store, even while a keeper writes it
    """

    def __init__(self, path: Path | str, *, rebuild: bool = False, read_only: bool = False) -> None:
        self.path = Path(path)
        self._lock: IO[bytes] | None = None
        in_memory = str(path) == _MEMORY
        if not in_memory and self.path.is_file():
            check_bytes(self.path, FileKind.STORE)
        if read_only:
            self._db = _open_to_read(self.path)
            return
        if not in_memory:
            self._lock = _lock(self.path)
        try:
            self._db = _open(str(path))
        except StoreError:
            if in_memory or not rebuild:
                self._unlock()
                raise
            log.warning("moved the damaged store to %s", _move_aside(self.path))
            self._db = _open(str(path))

    def bind(self, terrain: str, grid: GridSpec, classes: Sequence[str] | None = ()) -> None:
        """Tie the store to this terrain, and to these classes. Raises StoreError if it holds the marks of another
        terrain, or marks for one class alone by whose number another is meant.

        classes  those of the scenario beside "ground", in the order of their numbers; None: not known
        """
        bound = self.terrain
        if bound is None:
            with self._writing():
                self._db.execute("INSERT INTO meta VALUES ('terrain', ?)", (terrain,))
                self._db.execute("INSERT INTO meta VALUES ('grid', ?)", (json.dumps(asdict(grid)),))
        elif bound != terrain:
            raise StoreError(
                f"the store {self.path} holds marks on terrain {bound}, but this run has terrain {terrain}: "
                "give another --store, or the terrain and cost rules that it was made with"
            )
        if classes is not None and self.classes != (order := self._class_order(list(classes), grid)):
            with self._writing():
                self._db.execute("REPLACE INTO meta VALUES ('classes', ?)", (json.dumps(order),))

    def _class_order(self, given: list[str], grid: GridSpec) -> list[str]:
        """The classes in the order of their numbers, once a run with these has the store: those of the run, then
        what only the store knows. Raises StoreError if a mark for one class alone would become one for another, or
        for none though the class exists. A store which is older than its marks may lack some of their classes."""
        stored = self.classes
        with self._reading():
            used = sorted(row[0] for row in self._db.execute(_CLASSES_USED, {"tiles": grid.tiles}))
        for number in (each for each in used if each <= len(stored)):
            name = stored[number - 1]
            is_gone = number > len(given) and name not in given
            if not is_gone and given[number - 1 : number] != [name]:
                raise StoreError(
                    f"the store {self.path} holds marks for {name} alone, which is class {number} there, but this "
                    f"run has the classes {', '.join(given) or 'none'}: list it in [[classes]] at its old place, "
                    "or give another --store"
                )
        return [*given, *stored[len(given) :]]

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Commits all or nothing. A StoreError leaves the store usable."""
        try:
            with self._db:
                yield
        except sqlite3.ProgrammingError:
            raise  # a bug of ours, and no disk will get better
        except sqlite3.Error as error:
            raise StoreError(f"cannot write the store {self.path}: {error}") from error

    @contextmanager
    def _reading(self, what: str = "") -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, ValueError, TypeError, msgspec.MsgspecError, ProtocolError) as error:
            raise StoreError(_damaged(self.path, f"{what}{error}")) from error

    @property
    def classes(self) -> list[str]:
        """Returns the classes of vehicles beside "ground", in the order of the numbers by which marks name them;
        none in a store without that table."""
        text = self._meta("classes")
        with self._reading("classes: "):
            return [] if text is None else msgspec.json.decode(text, type=list[str])

    @property
    def terrain(self) -> str | None:
        """Digest of the terrain that the store belongs to; None before the first `bind`."""
        return self._meta("terrain")

    @property
    def grid(self) -> GridSpec | None:
        """The grid of that terrain."""
        text = self._meta("grid")
        with self._reading("grid: "):
            return None if text is None else GridSpec(**json.loads(text))

    def _meta(self, key: str) -> str | None:
        with self._reading():
            row = self._db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return None if row is None else str(row[0])

    def load(self) -> Iterator[MarkSet]:
        """Every set in the store. Raises StoreError at a row which is no valid set."""
        return self._sets("FROM sets")

    def set_aside(self, tile: int) -> dict[str, MarkSet]:
        """Returns author -> marks dropped from its set of this tile, under the number of its last compacted set."""
        return {each.author: each for each in self._sets("FROM folded WHERE tile = ?", tile)}

    def tiles_set_aside(self) -> list[int]:
        """Tiles of which compaction dropped something, in order."""
        with self._reading():
            return [row[0] for row in self._db.execute("SELECT DISTINCT tile FROM folded ORDER BY tile")]

    def _sets(self, where: str, *values: object) -> Iterator[MarkSet]:
        with self._reading():
            for row in self._db.execute(f"SELECT {', '.join(_COLUMNS)} {where}", values):
                mark_set = MarkSet(**dict(zip(_FIELDS, row, strict=True)))
                mark_set.check()
                yield mark_set

    def _set_at(self, table: str, tile: int, author: str) -> MarkSet | None:
        found = list(self._sets(f"FROM {table} WHERE tile = ? AND author = ?", tile, author))
        return found[0] if found else None

    def save(self, sets: Iterable[MarkSet], now_ns: int = 0) -> None:
        """Commit all or none. Marks which a compacted set lacks of the set that it replaces are archived. A
        StoreError leaves the store usable."""
        given = list(sets)
        own = [each for each in given if each.seq % SEQ_STEP == 0]
        with self._writing():
            self._db.executemany(_UPSERT, [_row(each) for each in own])
            self._db.executemany(_OUTDATE, [(each.tile, each.author, each.epoch, each.seq) for each in own])
            for each in given:
                if each.seq % SEQ_STEP:
                    self._save_compacted(each, now_ns)

    def _save_compacted(self, compacted: MarkSet, now_ns: int) -> None:
        at = (compacted.tile, compacted.author)
        stored = self._set_at("sets", *at)
        if stored is not None and (stored.epoch, stored.seq) > (compacted.epoch, compacted.seq):
            return
        base = (compacted.epoch, base_seq(compacted.seq))
        before = [
            each
            for each in (stored, self._set_at("folded", *at))
            if each is not None and (each.epoch, base_seq(each.seq)) == base
        ]
        if before:
            self._db.execute(_DROP, (*_row(without(united(*before), compacted)), now_ns))
        elif is_tombstone(compacted):
            self._db.execute(_DROP, (*_row(compacted), now_ns))
        if is_tombstone(compacted):
            self._db.execute(_DELETE, (*at, compacted.epoch, compacted.seq))
        else:
            self._db.execute(_UPSERT, _row(compacted))

    def save_sightings(self, seen: Iterable[Sighted]) -> None:
        """Keeps where each target was seen last."""
        with self._writing():
            self._db.executemany(_SEEN, [(each.target, each.stamp_ns, encode(each)) for each in seen])

    def sightings(self) -> list[Sighted]:
        """The last sighting of each target, in order of target; none in a store without a table of them."""
        with self._reading(), suppress(sqlite3.OperationalError):
            rows = self._db.execute("SELECT sighted FROM sightings ORDER BY target").fetchall()
            return [decode(row[0], Sighted) for row in rows]
        return []

    def save_orders(self, orders: Iterable[Order]) -> None:
        """Commits the newest orders."""
        rows = [(each.subject, each.name, each.stamp_ns, msgspec.json.encode(each)) for each in orders]
        if rows:
            with self._writing():
                self._db.executemany(_ORDERED, rows)

    def orders(self) -> list[Order]:
        """The newest order about each subject."""
        with self._reading("orders: "):
            rows = self._db.execute("SELECT body FROM orders ORDER BY subject, name").fetchall()
            return [msgspec.json.decode(row[0], type=Order) for row in rows]

    def close(self) -> None:
        """Releases the file, and its lock."""
        self._db.close()
        self._unlock()

    def __enter__(self) -> KeeperStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def _bytes_of(of: MarkSet) -> int:
    return 200 + sum(len(column) for column in (of.cells, of.kinds, of.paces, of.stamps_ns, of.untils_ns))


def _row(of: MarkSet) -> tuple[object, ...]:
    return tuple(getattr(of, field) for field in _FIELDS)


def _open(path: str) -> sqlite3.Connection:
    try:
        db = sqlite3.connect(path, check_same_thread=False, timeout=2.0)
    except sqlite3.Error as error:
        raise StoreError(f"cannot open the store {path}: {error}") from error
    try:
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        # Committed pages are checkpointed as soon as the log has this number of them, and the log file is truncated
        # then: otherwise the log fills a small disk permanently.
        db.execute(f"PRAGMA wal_autocheckpoint = {_LOG_BYTES // 4096}")
        db.execute(f"PRAGMA journal_size_limit = {_LOG_BYTES}")
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_VALUE_BYTES)
        found = [row[0] for row in db.execute("PRAGMA quick_check(1)")]
        if found != ["ok"]:
            raise StoreError(_damaged(path, found[0] if found else "no answer from quick_check"))
        with db:
            db.executescript(_SCHEMA)
            db.execute("INSERT OR IGNORE INTO meta VALUES ('version', ?)", (STORE_VERSION,))
        version = db.execute("SELECT value FROM meta WHERE key = 'version'").fetchone()[0]
        if version != STORE_VERSION:
            raise StoreError(f"the store {path} has version {version}, this program reads {STORE_VERSION}")
    except sqlite3.DatabaseError as error:
        db.close()
        if isinstance(error, sqlite3.OperationalError):
            raise StoreError(f"cannot open the store {path}: {error}") from error
        raise StoreError(_damaged(path, str(error))) from error
    except StoreError:
        db.close()
        raise
    return db


def _open_to_read(path: Path) -> sqlite3.Connection:
    if not path.is_file():
        raise StoreError(f"there is no store {path}: no such file; a run leaves one as runs/RUN/map.sqlite")
    try:
        db = sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True, timeout=2.0)
        db.execute("SELECT count(*) FROM meta").fetchone()
    except sqlite3.Error as error:
        why = "it is not a keeper's store" if "not a database" in str(error) else str(error)
        raise StoreError(f"cannot read the store {path}: {why}") from error
    return db


def _damaged(path: Path | str, reason: str) -> str:
    return (
        f"the store {path} is damaged ({reason}): move it away, or start the keeper with --rebuild to fill a new "
        "one from the swarm"
    )


def _lock(path: Path) -> IO[bytes]:
    """Refuses a second writer on the same file. The lock ends with its process."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = open(f"{path}.lock", "wb")  # noqa: SIM115 - held until close
    except OSError as error:
        raise StoreError(f"cannot open the store {path}: {error.strerror or error}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.close()
        raise StoreError(f"the store {path} is in use by another keeper") from error
    return lock


def _move_aside(path: Path) -> Path:
    number = 1
    while (aside := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    os.replace(path, aside)
    for tail in ("-wal", "-shm"):
        Path(f"{path}{tail}").unlink(missing_ok=True)
    return aside


KEEPER_STORE = ExternalCalls(
    "store",
    calls={
        "bind": None,
        "load": list[MarkSet],
        "set_aside": dict[str, MarkSet],
        "tiles_set_aside": list[int],
        "save": None,
        "save_sightings": None,
        "save_orders": None,
        "orders": list[Order],
    },
    facts={"path": Path},
)
"""Calls of its store that a keeper uses."""


class Keeper:
    """Sets that wait for the disk, and sets that are on it.

    committed  the sets on the disk: the keeper's digest names these only, and so acknowledges them
    """

    def __init__(self) -> None:
        self.committed = Ledger()
        self._waiting: dict[tuple[int, str], MarkSet] = {}  # (tile, author) -> newest set not on the disk

    def restored(self, mark_set: MarkSet) -> None:
        """A set was read from the store."""
        self.committed.record(mark_set.author, mark_set.tile, mark_set.epoch, mark_set.seq)

    def accept(self, mark_set: MarkSet) -> None:
        """The replica took in a set: it replaces an older one of its tile and author which still waits."""
        self._waiting[mark_set.tile, mark_set.author] = mark_set

    @property
    def waiting(self) -> int:
        """Number of sets that wait to be saved."""
        return len(self._waiting)

    def batches(self) -> Iterator[list[MarkSet]]:
        """The sets to save, as many at a time as one commit should hold."""
        batch: list[MarkSet] = []
        held = 0
        for each in list(self._waiting.values()):
            batch.append(each)
            held += _bytes_of(each)
            if held >= BATCH_BYTES:
                yield batch
                batch, held = [], 0
        if batch:
            yield batch

    def saved(self, sets: Iterable[MarkSet]) -> None:
        """Accepts that these sets are on the disk, or that their tombstones deleted older ones."""
        for each in sets:
            if is_tombstone(each):
                self.committed.drop(each.author, each.tile)
            else:
                self.committed.record(each.author, each.tile, each.epoch, each.seq)
            if self._waiting.get((each.tile, each.author)) is each:
                del self._waiting[each.tile, each.author]
