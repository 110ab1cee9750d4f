"""The sets that a replica holds: the newest of every (tile, author)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from shared_map.pace_measurements import measurements_in
from shared_map.replication.author_limits import Capacity
from shared_map.replication.digest import Held, Ledger, Place, fingerprint
from shared_map.replication.mark_sets import fault, is_tombstone, is_zone, supersedes
from swarm.clock import NS_PER_S
from swarm.config.vehicle_classes import MOST_CLASSES
from swarm.grid import TILE_CELLS, GridSpec
from swarm.wire.messages.map_data import DIGEST_ROW, DIGEST_ROW_BYTES, MarkSet, MarksRequest

# Tombstones heard lately, so that an old set which arrives late is not taken for news.

REMEMBERED_NS = 600 * NS_PER_S
"""A set which arrives later than this after its tombstone is held again. No digest of a keeper names it, so it is
offered to the keepers, which remember tombstones for much longer and send this one again."""
_MAX_TOMBSTONES = 1 << 16
"""Some 23 MB. In `REMEMBERED_NS` a hundred sets a second may be deleted before any is forgotten early."""


class Tombstones:
    """(tile, author) -> the number under which the author's set was deleted, oldest first."""

    def __init__(self) -> None:
        self._deleted: dict[tuple[int, str], tuple[int, int, int]] = {}  # -> (epoch, seq, when heard)

    def covers(self, received: MarkSet) -> bool:
        """Returns True if a set was deleted already. Drops the tombstone of an author that states something
        newer."""
        tombstone = self._deleted.get((received.tile, received.author))
        if tombstone is None:
            return False
        number = (received.epoch, received.seq)
        if number < tombstone[:2] or (number == tombstone[:2] and not received.kinds):
            return True
        del self._deleted[received.tile, received.author]
        return False

    def above(self, tile: int, author: str, number: tuple[int, int]) -> bool:
        """Returns True if a tombstone of this (epoch, seq) or above is known."""
        tombstone = self._deleted.get((tile, author))
        return tombstone is not None and tombstone[:2] >= number

    def add(self, tombstone: MarkSet, now_ns: int) -> None:
        """Remembers a tombstone; beyond 65,536 the oldest is forgotten."""
        self._deleted[tombstone.tile, tombstone.author] = (tombstone.epoch, tombstone.seq, now_ns)
        if len(self._deleted) > _MAX_TOMBSTONES:
            del self._deleted[next(iter(self._deleted))]

    def expire(self, now_ns: int) -> None:
        """Forgets tombstones which are older than REMEMBERED_NS."""
        while self._deleted:
            key, (_, _, since_ns) = next(iter(self._deleted.items()))
            if now_ns - since_ns <= REMEMBERED_NS:
                return
            del self._deleted[key]

    def __len__(self) -> int:
        return len(self._deleted)


class HeldSets:
    """A table of sets, with its digest, its size and the tombstones of deleted sets.

    ledger      number of every set held; digests are made of it
    capacity    counts and bounds the held sets
    tombstones  numbers under which sets were deleted lately
    """

    def __init__(self, grid: GridSpec, capacity: Capacity) -> None:
        self.ledger = Ledger()
        self.capacity = capacity
        self.tombstones = Tombstones()
        self._grid = grid
        self._tile_count = grid.tiles
        self._ragged = bool(grid.rows % TILE_CELLS or grid.cols % TILE_CELLS)
        self._tiles: dict[int, dict[str, MarkSet]] = {}  # tile -> author -> set; no tile without sets

    def get(self, tile: int, author: str | None) -> MarkSet | None:
        """The set of an author about a tile; None if there is none, or no author."""
        sets = self._tiles.get(tile)
        return None if sets is None or author is None else sets.get(author)

    def of_tile(self, tile: int) -> list[MarkSet]:
        """The sets about a tile, in order of author."""
        sets = self._tiles.get(tile, {})
        return list(sets.values()) if len(sets) == 1 else [sets[name] for name in sorted(sets)]

    @property
    def tiles(self) -> list[int]:
        """Tiles with at least one set, in order."""
        return sorted(self._tiles)

    def off_grid(self, received: MarkSet) -> bool:
        """Returns True if a set has marks in cells which this grid does not have. Measurements are published in the
        tile beyond the last one (`learning.measurements`), never by operators."""
        if received.tile == self._tile_count:
            return is_zone(received.author) or measurements_in(received) is None
        known = received.tile < self._tile_count and not self._ragged
        return not known and fault(received, self._grid) is not None

    def is_news(self, received: MarkSet, held: MarkSet | None) -> bool:
        """Returns True if a set supersedes the held one of its tile and author, or if there is none, the deleted
        one."""
        return not self.tombstones.covers(received) if held is None else supersedes(received, held)

    def put(self, new: MarkSet, *, own: bool = False) -> bool:
        """Holds a set instead of the one which it supersedes; False if there is no capacity for it.

        own  capacity does not matter
        """
        tile, author = new.tile, new.author
        if not self.capacity.take(new, self.get(tile, author), own=own):
            return False
        self._tiles.setdefault(tile, {})[author] = new
        self.ledger.record(author, tile, new.epoch, new.seq)
        return True

    def delete(self, tombstone: MarkSet, now_ns: int) -> None:
        """Deletes what its author stated about a tile, and remembers the number."""
        assert is_tombstone(tombstone)
        self.tombstones.add(tombstone, now_ns)
        held = self.get(tombstone.tile, tombstone.author)
        if held is not None:
            self.remove(held)

    def remove(self, held: MarkSet) -> None:
        """Removes a set as if it had never been received."""
        sets = self._tiles[held.tile]
        del sets[held.author]
        if not sets:
            del self._tiles[held.tile]
        self.ledger.drop(held.author, held.tile)
        self.capacity.free(held)

    # --- comparing with others ------------------------------------------------------------------------------

    def missing(self, theirs: Held) -> list[tuple[str, list[int]]]:
        """(author, tiles) of the sets that are newer at the other replica, and that this one could hold.

        Sets for which there is no capacity are left out: they would be requested again with every digest.
        """
        newer = self.ledger.missing(theirs)
        possible = [(author, [tile for tile in tiles if self._could_hold(author, tile)]) for author, tiles in newer]
        return [(author, tiles) for author, tiles in possible if tiles]

    def lacking(self, author: str, rows: bytes) -> list[int]:
        """Tiles without the author's set at the number in these rows or above, and without a later tombstone."""
        if len(rows) % DIGEST_ROW_BYTES:
            return []
        newer = [tile for _, tiles in self.ledger.missing({author: rows}) for tile in tiles]
        if not newer or not len(self.tombstones):
            return newer
        numbers = {tile: (epoch, seq) for tile, epoch, seq in np.frombuffer(rows, DIGEST_ROW).tolist()}
        return [tile for tile in newer if not self.tombstones.above(tile, author, numbers[tile])]

    def _could_hold(self, author: str, tile: int) -> bool:
        class_number, at = self._grid.class_of_tile(tile)
        if class_number > MOST_CLASSES or (class_number and at == self._tile_count):
            return False
        return not self.capacity.full_for(author) or self.get(tile, author) is not None

    def fingerprint(self) -> str:
        """16 hex digits, equal for replicas that hold the same."""
        return fingerprint(self.ledger.held())

    def ahead_of(
        self, theirs: Held, authors: list[str], after: Place | None = None, until: Place | None = None
    ) -> list[MarkSet]:
        """The sets of these authors that we hold newer than they, in the range that `theirs` covers."""
        newer = self.ledger.ahead(theirs, authors, after, until)
        return [self._tiles[tile][author] for author, tiles in newer for tile in tiles]

    def asked(self, request: MarksRequest, author: str | None = None) -> Iterator[MarkSet | None]:
        """The sets asked for, in order of tile and author, with None after each tile.

        author  only this author's, as the key of the query says
        """
        wanted = frozenset(request.authors)
        every = self.tiles if author is None else self.ledger.tiles_of(author)
        for tile in sorted(set(request.tiles)) if request.tiles else every:
            if author is None:
                yield from (each for each in self.of_tile(tile) if not wanted or each.author in wanted)
            elif not wanted or author in wanted:
                yield self.get(tile, author)
            yield None
