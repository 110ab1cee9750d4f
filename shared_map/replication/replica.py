"""One process's replica of the shared map. Core: sets and digests in, changed cells and asked sets out."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared_map.replication.digest import Held, Ledger, fingerprint
from shared_map.replication.filter import Reading
from shared_map.replication.limits import Room
from shared_map.replication.mark_sets import unpacked
from shared_map.replication.marks import (
    NO_STATEMENT,
    NOTHING_SAID,
    HybridClock,
    Statements,
    changes,
    dense,
    difference,
    fault,
    first_end_ns,
    grid_cells,
    is_burial,
    mark_set,
    next_seq,
    resolve,
    sparse,
    standing,
    statements,
    supersedes,
    tile_cells,
)
from shared_map.replication.merge import Arrival, cells_of, difference_of_many, said_in
from shared_map.replication.tombstones import Graves
from swarm.clock import NS_PER_S
from swarm.errors import OutsideGridError
from swarm.grid import TILE_CELLS, GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.marks import MarkSet, MarkSets, MarksRequest
from swarm.wire.statements import FOREVER, TILE_AREA, MarkKind


class CostSink(Protocol):
    """Where the winning statements go: the cost map."""

    def apply(self, cells: NDArray[np.uint32], kinds: NDArray[np.uint8], paces: NDArray[np.float32]) -> object: ...


class Winners(Protocol):
    """Columns of winning statements: `marks.Statements` of one tile, `batch.Said` of several."""

    @property
    def kinds(self) -> NDArray[np.uint8]: ...
    @property
    def paces(self) -> NDArray[np.float32]: ...
    @property
    def stamps_ns(self) -> NDArray[np.int64]: ...


@dataclass(frozen=True, slots=True)
class PublishSet:
    """Put this set under its author's key."""

    mark_set: MarkSet


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """What a merge of many sets took in, and how many cells' winners each of them changed."""

    sets: list[MarkSet]
    changed: list[int]


class MapReplica:
    """Holds the newest set of every (tile, author) and keeps a cost map at the winning statements.

    author      name under which `write` speaks; None for those who only listen
    publish_hz  each tile's set goes out at most this often
    room        bounds of what it may hold of others
    reading     whose sets it takes in and about which tiles; everybody's and all if not given
    counts      sets_merged, sets_repeated, sets_refused, sets_without_room, sets_foreign (of a group that is not
                read), sets_elsewhere (about tiles of no interest), marks_merged (cells whose winner changed),
                marks_written
    """

    def __init__(
        self,
        grid: GridSpec,
        cost_map: CostSink | None = None,
        *,
        author: str | None = None,
        group: str = "all",
        publish_hz: float = 10.0,
        room: Room | None = None,
        reading: Reading | None = None,
    ) -> None:
        self.grid = grid
        self.author = author
        self.group = group
        names = ("merged", "repeated", "refused", "without_room", "foreign", "elsewhere")
        self.counts = dict.fromkeys([f"sets_{name}" for name in names] + ["marks_merged", "marks_written"], 0)
        self.ledger = Ledger()
        self.room = room or Room()
        self.reading = reading or Reading(grid)
        self.crowded_out: str | None = None  # the author of the set that last had no room
        self._graves = Graves()
        self._tile_count = grid.tiles
        self._ragged = bool(grid.rows % TILE_CELLS or grid.cols % TILE_CELLS)
        self._cost_map = cost_map
        self._tiles: dict[int, dict[str, MarkSet]] = {}
        self._clock = HybridClock()
        self._publish_ns = int(NS_PER_S / publish_hz)
        self._pending: dict[int, None] = {}  # own tiles with unpublished changes, in order
        self._published_ns: dict[int, int] = {}
        self._newest_ns: int | None = None
        self._now_ns = 0  # up to when statements have ended by themselves
        self._ends: list[tuple[int, int]] = []  # heap of (when, tile)

    # --- what others say ------------------------------------------------------------------------------------

    def merge(self, received: MarkSet, *, measured: bool = True) -> NDArray[np.uint32] | None:
        """Take in a set. Returns the cells whose winner changed, already applied to the cost map; None if the set
        was known, superseded or no part of this map.

        measured  counts for `take_newest_stamp_ns`; not so the sets of a late join, which are old already
        """
        held = self._tiles.get(received.tile, {}).get(received.author)
        if not self._admissible(received, held):
            return None
        if received.author == self.author:
            self._outbid(received, held)
            return None
        if is_burial(received):
            return self._bury(received, held)
        if not self.room.take(received, held):
            self._crowd_out(received)
            return None
        return self._accept(received, measured)

    def merge_many(self, received: Sequence[MarkSet], *, measured: bool = True) -> Merged:
        """As `merge` of each, in less than half the time: what is known, superseded or no part of this map is left
        out of the result."""
        merged = Merged([], [])
        for sets in self._rounds(received):
            many = len(sets) >= _WORTH_ARRAYS
            singly = [each for each in sets if not each.kinds and is_burial(each)] if many else sets
            for each in singly:
                changed = self.merge(each, measured=measured)
                if changed is not None:
                    merged.sets.append(each)
                    merged.changed.append(len(changed))
            if many:
                rest = [each for each in sets if each.kinds or not is_burial(each)] if singly else sets
                self._accept_many(rest, measured, merged)
        return merged

    def merge_bulk(self, bulk: MarkSets, *, measured: bool = True) -> Merged:
        """As `merge_many` of the sets in a message. What is said there of tiles that nobody has spoken of, most of
        a late join, overrules nothing: its columns are taken as they are, in a third of the time."""
        sets = unpacked(bulk)
        news = self._news(bulk)
        if not news.any():
            return self.merge_many(sets, measured=measured)
        rest: list[MarkSet] = []
        if not news.all():
            rest = [each for each, new in zip(sets, news, strict=True) if not new]
            sets = [each for each, new in zip(sets, news, strict=True) if new]
        self._tiles.update([(each.tile, {each.author: each}) for each in sets])
        epochs, seqs = column(bulk.epochs, "<u8")[news], column(bulk.seqs, "<u8")[news]
        self.ledger.record_rows(bulk.author, [each.tile for each in sets], epochs, seqs)
        self.counts["sets_merged"] += len(sets)
        said = said_in(bulk, news)
        self._perform(cells_of(self.grid, column(bulk.tiles, "<u4"), said.places), said, measured)
        merged = Merged(sets, np.bincount(said.places // TILE_AREA, minlength=len(news))[news].tolist())
        if rest:
            others = self.merge_many(rest, measured=measured)
            merged.sets.extend(others.sets)
            merged.changed.extend(others.changed)
        return merged

    def _news(self, bulk: MarkSets) -> NDArray[np.bool_]:
        """Which sets of a message there is room for, and say for ever what is the first about its tile."""
        tiles, counts = column(bulk.tiles, "<u4"), column(bulk.counts, "<u2")
        if len(self._graves) or bulk.author == self.author or not self.reading.hears(bulk.author, bulk.group):
            return np.zeros(len(tiles), bool)
        known, concerns = self._tiles, self.reading.concerns
        news = np.array([tile not in known and concerns(tile) for tile in tiles.tolist()], bool)
        news &= (counts > 0) & (column(bulk.ending, "<u1") == 0) & (tiles < self._tile_count)
        if self._ragged:  # statements about cells outside the grid are looked for one by one
            news &= (tiles // self.grid.tile_cols + 1 < self.grid.tile_rows) & (
                tiles % self.grid.tile_cols + 1 < self.grid.tile_cols
            )
        if news.any() and not self.room.take_new(bulk.author, int(np.count_nonzero(news)), int(counts[news].sum())):
            news[:] = False
        return news

    def _rounds(self, received: Sequence[MarkSet]) -> Sequence[Sequence[MarkSet]]:
        """The newest set of each tile and author, in groups in which no tile occurs twice."""
        if len({each.tile for each in received}) == len(received):
            return [received]
        newest: dict[tuple[int, str], MarkSet] = {}
        for each in received:
            if self._foreign(each):  # it must not stand in the way of an older one that is not
                self.counts["sets_refused"] += 1
                continue
            held = newest.setdefault((each.tile, each.author), each)
            if held is not each:
                self.counts["sets_repeated"] += 1
                if supersedes(each, held):
                    newest[each.tile, each.author] = each
        rounds: list[list[MarkSet]] = []
        times: dict[int, int] = {}
        for each in newest.values():
            nth = times.get(each.tile, 0)
            times[each.tile] = nth + 1
            if nth == len(rounds):
                rounds.append([])
            rounds[nth].append(each)
        return rounds

    def _accept_many(self, received: Sequence[MarkSet], measured: bool, merged: Merged) -> None:
        """Take in sets of different tiles."""
        arrivals: list[Arrival] = []
        for each in received:
            sets = self._tiles.get(each.tile)
            held = None if sets is None else sets.get(each.author)
            if not self._admissible(each, held):
                continue
            if each.author == self.author:
                self._outbid(each, held)
                continue
            if not self.room.take(each, held):
                self._crowd_out(each)
                continue
            if sets is None:
                arrivals.append(Arrival(each, held, ()))
                self._tiles[each.tile] = {each.author: each}
            else:
                arrivals.append(Arrival(each, held, [of for name, of in sets.items() if name != each.author]))
                sets[each.author] = each
            if each.untils_ns:
                self._note_end(each)
        if not arrivals:
            return
        sets_taken = [arrival.new for arrival in arrivals]
        self.ledger.record_many(sets_taken)
        self.counts["sets_merged"] += len(arrivals)
        changed = difference_of_many(arrivals, self._now_ns)
        tiles = np.array([each.tile for each in sets_taken], np.int64)
        self._perform(cells_of(self.grid, tiles, changed.places), changed, measured)
        merged.sets.extend(sets_taken)
        merged.changed.extend(np.bincount(changed.places // TILE_AREA, minlength=len(arrivals)).tolist())

    def _admissible(self, received: MarkSet, held: MarkSet | None) -> bool:
        """Whether a set is part of this map and news; if not, why is counted."""
        if self._foreign(received):
            self.counts["sets_refused"] += 1
            return False
        if received.author != self.author:
            if not self.reading.hears(received.author, received.group):
                self.counts["sets_foreign"] += 1
                return False
            if not self.reading.concerns(received.tile):
                self.counts["sets_elsewhere"] += 1
                return False
        known = self._graves.holds(received) if held is None else not supersedes(received, held)
        if known:
            self.counts["sets_repeated"] += 1
            return False
        return True

    def _foreign(self, received: MarkSet) -> bool:
        return received.tile >= self._tile_count or (self._ragged and fault(received, self.grid) is not None)

    def _bury(self, burial: MarkSet, held: MarkSet | None) -> NDArray[np.uint32]:
        """Nothing that an author which is gone said about a tile counts any more: forget that it said anything."""
        self._graves.dig(burial, self._now_ns)
        self.counts["sets_merged"] += 1
        if held is None:
            return _NO_CELLS
        sets = self._tiles[held.tile]
        others = [sets[name] for name in sorted(sets) if name != held.author and sets[name].kinds]
        changed = difference(held, burial, others, self._now_ns)
        del sets[held.author]
        if not sets:
            del self._tiles[held.tile]
        self.ledger.drop(held.author, held.tile)
        self.room.free(held)
        return self._apply(held.tile, changed, False)

    def limit(self, regions: frozenset[int]) -> None:
        """From now on hold what is said about these regions only, besides our own: the rest is forgotten, and its
        cells are again as the prior map and we ourselves say."""
        self.reading.limit(regions)
        for tile in [tile for tile in self._tiles if not self.reading.concerns(tile)]:
            before = resolve(self.sets(tile), self._now_ns)
            sets = self._tiles[tile]
            for each in [each for name, each in sets.items() if name != self.author]:
                del sets[each.author]
                self.ledger.drop(each.author, tile)
                self.room.free(each)
            if not sets:
                del self._tiles[tile]
            self._apply(tile, changes(before, resolve(self.sets(tile), self._now_ns)), False)

    def _crowd_out(self, received: MarkSet) -> None:
        self.counts["sets_without_room"] += 1
        self.crowded_out = received.author

    def _outbid(self, received: MarkSet, held: MarkSet | None) -> None:
        """Somebody who took us for dead wrote under our name: say what we say again, under a higher epoch."""
        assert self.author is not None
        if received.epoch + 1 >= 1 << 62:  # no honest writer counts that far, and nothing could follow it
            self.counts["sets_refused"] += 1
            return
        said = NOTHING_SAID if held is None else statements(held)
        seq = 0 if held is None else next_seq(held.seq)
        self._say(mark_set(self.author, self.group, received.tile, received.epoch + 1, seq, said))

    def _say(self, own: MarkSet) -> None:
        """Take in a set of our own, which is to go out."""
        self.room.take(own, self._tiles.get(own.tile, {}).get(own.author), own=True)
        self._accept(own, False)
        self._pending[own.tile] = None

    def _accept(self, received: MarkSet, measured: bool) -> NDArray[np.uint32]:
        tile = received.tile
        sets = self._tiles.setdefault(tile, {})
        changed = difference(
            sets.get(received.author),
            received,
            [sets[name] for name in sorted(sets) if name != received.author and sets[name].kinds],
            self._now_ns,
        )
        sets[received.author] = received
        self.ledger.record(received.author, tile, received.epoch, received.seq)
        self.counts["sets_merged"] += 1
        if received.untils_ns:
            self._note_end(received)
        return self._apply(tile, changed, measured)

    def _note_end(self, received: MarkSet) -> None:
        end_ns = first_end_ns(received, self._now_ns)
        if end_ns is not None:
            heapq.heappush(self._ends, (end_ns, received.tile))

    def _apply(self, tile: int, changed: Statements, measured: bool) -> NDArray[np.uint32]:
        if not len(changed.cells):
            return _NO_CELLS
        return self._perform(grid_cells(self.grid, tile, changed.cells), changed, measured)

    def _perform(self, cells: NDArray[np.uint32], changed: Winners, measured: bool) -> NDArray[np.uint32]:
        """Tell the cost map who wins now."""
        if not len(cells):
            return cells
        self.counts["marks_merged"] += len(cells)
        if self._cost_map is not None:
            self._cost_map.apply(cells, changed.kinds, changed.paces)
        if measured:
            newest_ns = int(changed.stamps_ns.max())
            if newest_ns != NO_STATEMENT and (self._newest_ns is None or newest_ns > self._newest_ns):
                self._newest_ns = newest_ns
        return cells

    def _end_statements(self, now_ns: int) -> None:
        """Undo what ends by itself by now. Of their own statements authors drop those from their sets."""
        ended: dict[int, None] = {}
        while self._ends and self._ends[0][0] <= now_ns:
            ended[heapq.heappop(self._ends)[1]] = None
        before_ns, self._now_ns = self._now_ns, max(now_ns, self._now_ns)
        for tile in ended:
            sets = self.sets(tile)
            self._apply(tile, changes(resolve(sets, before_ns), resolve(sets, self._now_ns)), False)
            coming = [end for each in sets if (end := first_end_ns(each, self._now_ns)) is not None]
            if coming:
                heapq.heappush(self._ends, (min(coming), tile))
            own = self._tiles.get(tile, {}).get(self.author) if self.author is not None else None
            if own is not None and own.untils_ns:
                left = standing(own, self._now_ns)
                if len(left.cells) < len(own.kinds):
                    self._put_own(tile, left)

    def take_newest_stamp_ns(self) -> int | None:
        """The newest stamp among the marks that changed the map since this was last asked; None without any."""
        newest_ns, self._newest_ns = self._newest_ns, None
        return newest_ns

    # --- what we say ----------------------------------------------------------------------------------------

    def write(
        self,
        cells: ArrayLike,
        kinds: ArrayLike,
        paces: ArrayLike,
        now_ns: int,
        *,
        lifetime_s: float | None = None,
    ) -> list[PublishSet]:
        """State something about cells, one kind and pace each; of a cell named twice the last counts. The own
        cost map knows at once; returned are the sets that may go out now, the others follow from `tick`.

        lifetime_s  the statements end by themselves so long after their stamps, by the clock of whoever reads them
        """
        flat = np.atleast_1d(np.asarray(cells, np.int64))
        if len(flat) and not (flat.min() >= 0 and flat.max() < self.grid.cells):
            raise OutsideGridError(f"a cell of {flat.min()}..{flat.max()} is not in {self.grid.cells} cells")
        new_kinds = np.broadcast_to(np.asarray(kinds, np.uint8), flat.shape)
        new_paces = np.broadcast_to(np.asarray(paces, np.float32), flat.shape)
        tiles, inner = tile_cells(self.grid, flat)
        for tile in np.unique(tiles).tolist():
            here = tiles == tile
            self._write_tile(tile, inner[here], new_kinds[here], new_paces[here], now_ns, lifetime_s)
        return self.tick(now_ns)

    def _write_tile(
        self,
        tile: int,
        cells: NDArray[np.uint16],
        kinds: NDArray[np.uint8],
        paces: NDArray[np.float32],
        now_ns: int,
        lifetime_s: float | None,
    ) -> None:
        winners = resolve(self.sets(tile), self._now_ns)
        own = self._own(tile)
        assert own.untils_ns is not None
        stamps = self._clock.stamps_ns(now_ns, winners.stamps_ns[cells])
        # What we say already, and what stands, need not be said again.
        paces = np.where(kinds == MarkKind.PACE, paces, np.float32(0))
        stands = (own.stamps_ns[cells] != NO_STATEMENT) & (own.stamps_ns[cells] == winners.stamps_ns[cells])
        said = stands & (winners.kinds[cells] == kinds) & (winners.paces[cells] == paces)
        said &= own.untils_ns[cells] == FOREVER
        if lifetime_s is None and len(np.unique(cells)) == len(cells):
            if said.all():
                return
            cells, kinds, paces, stamps = cells[~said], kinds[~said], paces[~said], stamps[~said]
        own.kinds[cells], own.paces[cells], own.stamps_ns[cells] = kinds, paces, stamps
        own.untils_ns[cells] = FOREVER if lifetime_s is None else stamps + int(lifetime_s * NS_PER_S)
        self.counts["marks_written"] += len(cells)
        self._put_own(tile, sparse(own))

    def retract(self, cells: ArrayLike, now_ns: int) -> list[PublishSet]:
        """Take back what we said about cells, as if we had never said it; what others say about them holds."""
        tiles, inner = tile_cells(self.grid, np.atleast_1d(np.asarray(cells, np.int64)))
        for tile in np.unique(tiles).tolist():
            own = self._own(tile)
            back = inner[tiles == tile]
            if (own.stamps_ns[back] != NO_STATEMENT).any():
                own.stamps_ns[back] = NO_STATEMENT
                self._put_own(tile, sparse(own))
        return self.tick(now_ns)

    def tick(self, now_ns: int) -> list[PublishSet]:
        """The own sets that are due to go out; what ends by itself by now has ended."""
        self._end_statements(now_ns)
        self._graves.forget(now_ns)
        due = [
            tile
            for tile in self._pending
            if now_ns - self._published_ns.get(tile, -self._publish_ns) >= self._publish_ns
        ]
        for tile in due:
            del self._pending[tile]
            self._published_ns[tile] = now_ns
        return [PublishSet(self._tiles[tile][self.author]) for tile in due if self.author is not None]

    def _own(self, tile: int) -> Statements:
        if self.author is None:
            raise RuntimeError("a replica without an author cannot write")
        own = self._tiles.get(tile, {}).get(self.author)
        return dense(NOTHING_SAID if own is None else statements(own))

    def _put_own(self, tile: int, own: Statements) -> None:
        assert self.author is not None
        held = self._tiles.get(tile, {}).get(self.author)
        epoch, seq = (1, 0) if held is None else (held.epoch, next_seq(held.seq))
        self._say(mark_set(self.author, self.group, tile, epoch, seq, own))

    # --- comparing ------------------------------------------------------------------------------------------

    def digest(self) -> dict[str, bytes]:
        """What we hold, of everybody."""
        return self.ledger.held()

    def own_digest(self) -> dict[str, bytes]:
        """What we have said ourselves: complete for our author."""
        return self.ledger.held([self.author] if self.author is not None else [])

    def fingerprint(self) -> str:
        return fingerprint(self.digest())

    def compare(self, theirs: Held) -> list[tuple[str, list[int]]]:
        """(author, tiles) to ask for: what they hold newer than we."""
        missing = self.reading.wanted(self.ledger.missing(theirs))
        inside = ((author, [t for t in tiles if self._wants(author, t)]) for author, tiles in missing)
        return [(author, tiles) for author, tiles in inside if tiles]

    def _wants(self, author: str, tile: int) -> bool:
        """Not what lies outside, nor what there would be no room for: it would be asked for again and again."""
        if tile >= self._tile_count:
            return False
        return not self.room.full_for(author) or author in self._tiles.get(tile, {})

    def ahead_of(self, theirs: Held, authors: list[str]) -> list[MarkSet]:
        """The sets of these authors that we hold newer than they."""
        newer = self.ledger.ahead(theirs, authors)
        return [self._tiles[tile][author] for author, tiles in newer for tile in tiles]

    def answer(self, request: MarksRequest, author: str | None = None) -> list[MarkSet]:
        """The sets asked for, in order of tile and author. `author` narrows it to one, as the asked key does."""
        wanted = set(request.authors)
        tiles: Sequence[int] = sorted(set(request.tiles)) if request.tiles else sorted(self._tiles)
        return [
            sets[name]
            for tile in tiles
            if (sets := self._tiles.get(tile)) is not None
            for name in sorted(sets)
            if (author is None or name == author) and (not wanted or name in wanted)
        ]

    # --- looking at it --------------------------------------------------------------------------------------

    def winners(self, tile: int) -> Statements:
        """The winning statements about a tile, without the cells that nobody speaks of."""
        return sparse(resolve(self.sets(tile), self._now_ns))

    @property
    def tiles(self) -> list[int]:
        """Tiles that anybody has a set for."""
        return sorted(self._tiles)

    def sets(self, tile: int) -> list[MarkSet]:
        """The sets of a tile, in order of author."""
        sets = self._tiles.get(tile, {})
        return [sets[name] for name in sorted(sets)]


_WORTH_ARRAYS = 8
"""Fewer sets are merged one by one: arrays cost more to set up than to look through."""
_NO_CELLS: NDArray[np.uint32] = np.empty(0, np.uint32)
