"""The keeper's store: one SQLite file (`KeeperStore`), and which sets still wait for it (`Keeper`, core)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import msgspec

from shared_map.keeper.compaction import united, without
from shared_map.keeper.sealed_database import META, SealedDatabase, Table
from shared_map.replication.digest import Ledger
from shared_map.replication.mark_sets import base_seq, is_tombstone
from swarm.errors import StoreError
from swarm.grid import GridSpec
from swarm.recording.service_boundary import ExternalCalls
from swarm.wire.codec import decode, encode
from swarm.wire.messages.map_data import SEQ_STEP, MarkSet
from swarm.wire.messages.orders import Order, VehicleGoals
from swarm.wire.messages.planning import Sighted

_Kept = TypeVar("_Kept", Order, VehicleGoals)
BATCH_BYTES = 1 << 19
"""Marks of one commit, about."""
_FIELDS = ("tile", "author", "group", "epoch", "seq", "cells", "kinds", "paces", "stamps_ns", "untils_ns")
_SET = {
    "tile": "INTEGER", "author": "TEXT", "grp": "TEXT", "epoch": "INTEGER", "seq": "INTEGER",
    "cells": "BLOB", "kinds": "BLOB", "paces": "BLOB", "stamps_ns": "BLOB", "untils_ns": "BLOB",
}  # fmt: skip
# `grp`, as GROUP is a word of SQL
_SETS = Table("sets", _SET, 2)
_FOLDED = Table("folded", {**_SET, "since_ns": "INTEGER"}, 2)
"""Marks dropped by compaction; the name stays, as older stores have it."""
_ORDERS = Table("orders", {"subject": "TEXT", "name": "TEXT", "stamp_ns": "INTEGER", "body": "BLOB"}, 2)
_SIGHTINGS = Table("sightings", {"target": "TEXT", "stamp_ns": "INTEGER", "sighted": "BLOB"}, 1)
_GOALS = "goals."
"""In `meta`, before the vehicle."""
_NUMBER = ("epoch", "seq")
_CLASSES_USED = """
SELECT DISTINCT tile / (:tiles + 1) FROM (
    SELECT tile, kinds FROM sets WHERE tile > :tiles UNION ALL SELECT tile, kinds FROM folded WHERE tile > :tiles
) WHERE length(kinds) > 0
"""
"""Numbers of classes for which alone something is marked, or was until compaction set it aside."""
_DELETE = "DELETE FROM sets WHERE tile = ? AND author = ? AND (epoch, seq) <= (?, ?)"
_OUTDATE = "DELETE FROM folded WHERE tile = ? AND author = ? AND (epoch, seq) < (?, ?)"
"""Marks dropped from a set count only until their author publishes a newer set."""


class KeeperStore(SealedDatabase):
    """Every set, order and sighting in one file (`SealedDatabase`)."""

    def __init__(self, path: Path | str, *, rebuild: bool = False, read_only: bool = False) -> None:
        super().__init__(path, (_SETS, _FOLDED, _ORDERS, _SIGHTINGS), rebuild=rebuild, read_only=read_only)

    def bind(self, terrain: str, grid: GridSpec, classes: Sequence[str] = ()) -> None:
        """Ties the store to this terrain, and to these classes. Raises StoreError if it holds the marks of another
        terrain, or marks for one class alone by whose number another is meant.

        classes  those of the scenario beside "ground", in the order of their numbers
        """
        bound = self.terrain
        if bound is None:
            with self._writing():
                self._put(META, ("terrain", terrain))
                self._put(META, ("grid", json.dumps(asdict(grid))))
        elif bound != terrain:
            raise StoreError(
                f"the store {self.path} holds marks on terrain {bound}, but this run has terrain {terrain}: "
                "give another --store, or the terrain and cost rules that it was made with"
            )
        if self.classes != (order := self._class_order(list(classes), grid)):
            with self._writing():
                self._put(META, ("classes", json.dumps(order)))

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
        row = next(self._rows(META, "WHERE key = ?", key), None)
        return None if row is None else str(row[1])

    def load(self) -> Iterator[MarkSet]:
        """Every set in the store. Raises StoreError at a row which is no valid set."""
        return self._sets(_SETS)

    def set_aside(self, tile: int) -> dict[str, MarkSet]:
        """Returns author -> marks dropped from its set of this tile, under the number of its last compacted set."""
        return {each.author: each for each in self._sets(_FOLDED, "WHERE tile = ?", tile)}

    def tiles_set_aside(self) -> list[int]:
        """Tiles with marks that compaction dropped, in ascending order."""
        with self._reading():
            return [row[0] for row in self._db.execute("SELECT DISTINCT tile FROM folded ORDER BY tile")]

    def _sets(self, table: Table, where: str = "", *values: object) -> Iterator[MarkSet]:
        with self._reading():
            for row in self._rows(table, where, *values):
                mark_set = MarkSet(**dict(zip(_FIELDS, row, strict=False)))
                mark_set.check()
                yield mark_set

    def _set_at(self, table: Table, tile: int, author: str) -> MarkSet | None:
        return next(self._sets(table, "WHERE tile = ? AND author = ?", tile, author), None)

    def save(self, sets: Iterable[MarkSet], now_ns: int = 0) -> None:
        """Commits all or none. Marks which a compacted set lacks of the set that it replaces are archived. A
        StoreError leaves the store usable."""
        given = list(sets)
        own = [each for each in given if each.seq % SEQ_STEP == 0]
        with self._writing():
            self._put(_SETS, *map(_row, own), newer=_NUMBER)
            self._db.executemany(_OUTDATE, [(each.tile, each.author, each.epoch, each.seq) for each in own])
            for each in given:
                if each.seq % SEQ_STEP:
                    self._save_compacted(each, now_ns)

    def _save_compacted(self, compacted: MarkSet, now_ns: int) -> None:
        at = (compacted.tile, compacted.author)
        stored = self._set_at(_SETS, *at)
        if stored is not None and (stored.epoch, stored.seq) > (compacted.epoch, compacted.seq):
            return
        base = (compacted.epoch, base_seq(compacted.seq))
        before = [
            each
            for each in (stored, self._set_at(_FOLDED, *at))
            if each is not None and (each.epoch, base_seq(each.seq)) == base
        ]
        if before:
            whole = before[0] if len(before) == 1 else united(*before)
            self._put(_FOLDED, (*_row(without(whole, compacted)), now_ns))
        elif is_tombstone(compacted):
            self._put(_FOLDED, (*_row(compacted), now_ns))
        if is_tombstone(compacted):
            self._db.execute(_DELETE, (*at, compacted.epoch, compacted.seq))
        else:
            self._put(_SETS, _row(compacted), newer=_NUMBER)

    def save_sightings(self, seen: Iterable[Sighted]) -> None:
        """Commits the last sighting of each target."""
        rows = [(each.target, each.stamp_ns, encode(each)) for each in seen]
        self._commit(_SIGHTINGS, rows, ("stamp_ns",))

    def sightings(self) -> list[Sighted]:
        """The last sighting of each target, in order of target."""
        with self._reading():
            return [decode(sighted, Sighted) for *_, sighted in self._rows(_SIGHTINGS, "ORDER BY target")]

    def save_orders(self, orders: Iterable[Order]) -> None:
        """Commits the newest orders."""
        rows = [(each.subject, each.name, each.stamp_ns, msgspec.json.encode(each)) for each in orders]
        self._commit(_ORDERS, rows, ("stamp_ns",))

    def orders(self) -> list[Order]:
        """The newest order about each subject."""
        return self._read_json("orders: ", Order, _ORDERS, "ORDER BY subject, name")

    def save_goals(self, goals: Iterable[VehicleGoals]) -> None:
        """Commits the newest goals of vehicles. They are rows of `meta`, as older builds know no other table."""
        self._commit(META, [(f"{_GOALS}{each.name}", msgspec.json.encode(each).decode()) for each in goals])

    def goals(self) -> list[VehicleGoals]:
        """The newest goals of each vehicle."""
        return self._read_json("goals: ", VehicleGoals, META, "WHERE key GLOB ? ORDER BY key", f"{_GOALS}*")

    def _commit(self, table: Table, rows: Sequence[Sequence[object]], newer: Sequence[str] = ()) -> None:
        if rows:
            with self._writing():
                self._put(table, *rows, newer=newer)

    def _read_json(self, what: str, kind: type[_Kept], table: Table, where: str, *values: object) -> list[_Kept]:
        """The last column of rows of a table."""
        with self._reading(what):
            return [msgspec.json.decode(row[-1], type=kind) for row in self._rows(table, where, *values)]

    def __enter__(self) -> KeeperStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _row(of: MarkSet) -> tuple[object, ...]:
    return tuple(getattr(of, field) for field in _FIELDS)


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
        "save_goals": None,
        "goals": list[VehicleGoals],
        "check": None,
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
        """Notes a set that was read from the store."""
        self.committed.record(mark_set.author, mark_set.tile, mark_set.epoch, mark_set.seq)

    def accept(self, mark_set: MarkSet) -> None:
        """Queues a set that the replica has merged, instead of an older one of its tile and author."""
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
            held += 200 + sum(map(len, (each.cells, each.kinds, each.paces, each.stamps_ns, each.untils_ns)))
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
