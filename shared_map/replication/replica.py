"""A process's replica of the shared map. Core: sets and digests in, changed cells and sets to publish out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared_map.pace_measurements import Measurement, columns_of
from shared_map.replication import mark_sets
from shared_map.replication.author_limits import Capacity
from shared_map.replication.digest import Held
from shared_map.replication.held_sets import HeldSets
from shared_map.replication.interest import MarkFilter
from shared_map.replication.merge import TileChange, new_winners, winners
from shared_map.replication.tiles import beyond_tile, tile_cells
from swarm.clock import NS_PER_S
from swarm.errors import OutsideGridError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import FOREVER, PACE_LEAST, PACE_MOST, MarkKind, MarkSet


class CostSink(Protocol):
    """Receiver of winning marks and of measurements: the cost map.

    class_number  whom the statements are for: 0 for all vehicles, or one of the scenario's classes from 1 on
    """

    def apply(
        self,
        cells: NDArray[np.uint32],
        kinds: NDArray[np.uint8],
        paces: NDArray[np.float32],
        class_number: int = 0,
    ) -> object: ...

    def learn(self, words: Sequence[MarkSet]) -> bool: ...


@dataclass(frozen=True, slots=True)
class Merged:
    """The sets that a merge took in, in no particular order.

    changed  how many cells each of them gave another winner. If several sets of one tile were merged together, all
             new winners of the tile, but no more than the marks in the set and the one that it replaced
    """

    sets: list[MarkSet]
    changed: list[int]


class MapReplica:
    """Holds the newest set of every (tile, author), and keeps a cost map at the winning statements.

    grid           the grid of the map
    cost_map       receives winning statements; None: only the sets are kept
    author         id under which `write` speaks; None: this replica only listens
    group          group of vehicles for which `write` speaks; replicas may read some groups only
    publish_hz     each tile's own set goes out at most this often
    capacity       bounds of what it holds of others
    filter         whose sets it takes in, and about which tiles; default: all
    held           the sets
    counts         totals since the start: sets_merged, sets_repeated, sets_refused, sets_without_room (beyond the
                   capacity), sets_foreign (of a group which is not read), sets_elsewhere (about tiles of no
                   interest), marks_merged (cells whose winner changed), marks_written
    over_capacity  author of the last set that was refused for lack of capacity; its reader sets it to None
    zones_version  grows with every change of zones
    """

    def __init__(
        self,
        grid: GridSpec,
        cost_map: CostSink | None = None,
        *,
        author: str | None = None,
        group: str = "all",
        publish_hz: float = 10.0,
        capacity: Capacity | None = None,
        filter: MarkFilter | None = None,
    ) -> None:
        self.grid = grid
        self.author = author
        self.group = group
        names = ("merged", "repeated", "refused", "without_room", "foreign", "elsewhere")
        self.counts = dict.fromkeys([f"sets_{name}" for name in names] + ["marks_merged", "marks_written"], 0)
        self.held = HeldSets(grid, capacity or Capacity())
        self.filter = filter or MarkFilter(grid)
        self.over_capacity: str | None = None
        self.zones_version = 0
        self._cost_map = cost_map
        self._learn_due_ns: int | None = (
            None  # when to look again at words that came too soon; None: there are none
        )
        self._learned_ns = -_LEARN_EVERY_NS  # when words last changed the cost map
        self._clock = mark_sets.HybridClock()
        self._publish_ns = int(NS_PER_S / publish_hz)
        self._pending: dict[int, None] = {}  # own tiles whose newest set has not been published, in order
        self._published_ns: dict[int, int] = {}  # own tile -> when its set was published last
        self._newest_ns: int | None = None  # see `take_newest_stamp_ns`
        self._now_ns = 0  # the winners in the cost map are those at this time
        self._expiry_ns: dict[int, int] = {}  # tile -> when to look for expired statements, of those with any
        self._soonest_ns = FOREVER  # the first of these times, or one before it

    # --- merging --------------------------------------------------------------------------------------------

    def merge(self, received: Sequence[MarkSet], *, measured: bool = True) -> Merged:
        """Merges sets, and reports changed winners to the cost map. Sets that are known, superseded, filtered out
        or beyond the capacity are left out of the result, and counted. Raises nothing, whatever the sets state.

        measured  counts for `take_newest_stamp_ns`; false for the sets of a late join, which are old
        """
        taken: list[MarkSet] = []
        before: dict[int, list[MarkSet]] = {}  # tile -> its sets before any of these
        statements_of: list[int] = []  # in each of these, and in the set that it replaced
        for each in received:
            tile, author = each.tile, each.author
            old = self.held.get(tile, author)
            if not self._admits(each, old):
                continue
            if author == self.author:
                self._reassert(each)
                continue
            sets = before[tile] if tile in before else self.held.of_tile(tile)
            if not each.kinds and mark_sets.is_tombstone(each):
                self.held.delete(each, self._now_ns)
            elif not self.held.put(each):
                self.counts["sets_without_room"] += 1
                self.over_capacity = author
                continue
            before[tile] = sets
            taken.append(each)
            statements_of.append(len(each.kinds) + (0 if old is None else len(old.kinds)))
            if each.untils_ns:
                self._await_expiry(tile, [each])
        if not taken:
            return Merged([], [])
        self.counts["sets_merged"] += len(taken)
        self.zones_version += any([mark_sets.is_zone(each.author) for each in taken])  # noqa: C419 - twice as fast
        counts = self._settle(before, self._now_ns, measured)
        if len(before) == len(taken):
            return Merged(taken, counts)
        in_tile = dict(zip(before, counts, strict=True))
        return Merged(taken, [min(in_tile[s.tile], most) for s, most in zip(taken, statements_of, strict=True)])

    def _admits(self, received: MarkSet, held: MarkSet | None) -> bool:
        """Returns True if a set is part of this map, wanted and new; counts the reason if not."""
        if self.held.off_grid(received) or mark_sets.is_ahead(received, self._now_ns):
            self.counts["sets_refused"] += 1
            return False
        if received.author != self.author:
            if not self.filter.accepts_author(received.author, received.group):
                self.counts["sets_foreign"] += 1
                return False
            if not self.filter.accepts_tile(received.tile):
                self.counts["sets_elsewhere"] += 1
                return False
        if not self.held.is_news(received, held):
            self.counts["sets_repeated"] += 1
            return False
        return True

    def _settle(self, before: Mapping[int, Sequence[MarkSet]], before_ns: int, measured: bool) -> list[int]:
        """Brings the cost map from the winners of these sets (by tile) at `before_ns` to those held now. Returns
        how many winners changed in each tile."""
        counts = dict.fromkeys(before, 0)
        by_class: dict[int, list[TileChange]] = {}
        for tile, sets in before.items():
            if tile == beyond_tile(self.grid):
                self._learn()  # nothing there is about a cell, so no set of it has winners
            else:
                change = TileChange(tile, sets, self.held.of_tile(tile))
                by_class.setdefault(tile // (self.grid.tiles + 1), []).append(change)
        for number, changes in sorted(by_class.items()):
            changed = self._apply(changes, number, before_ns, measured)
            counts |= zip([change.tile for change in changes], changed, strict=True)
        return list(counts.values())

    def _apply(self, changes: list[TileChange], class_number: int, before_ns: int, measured: bool) -> list[int]:
        """`_settle` of tiles which are all for the same vehicles."""
        won = new_winners(self.grid, changes, before_ns, self._now_ns)
        if len(won.cells):
            self.counts["marks_merged"] += len(won.cells)
            if self._cost_map is not None:
                self._cost_map.apply(won.cells, won.kinds, won.paces, class_number)
            if measured:
                newest_ns = int(won.stamps_ns.max())
                if newest_ns != mark_sets.NO_STATEMENT and (self._newest_ns is None or newest_ns > self._newest_ns):
                    self._newest_ns = newest_ns
        return won.counts

    def _learn(self) -> None:
        """Applies the held measurements to the cost map, at most once per `_LEARN_EVERY_NS`."""
        if self._cost_map is None:
            return
        self._learn_due_ns = self._learned_ns + _LEARN_EVERY_NS
        if self._now_ns >= self._learn_due_ns:
            self._learn_due_ns = None
            if self._cost_map.learn(self.held.of_tile(beyond_tile(self.grid))):
                self._learned_ns = self._now_ns

    @property
    def now_ns(self) -> int:
        """The time of which the cost map has the winners."""
        return self._now_ns

    def take_newest_stamp_ns(self) -> int | None:
        """The newest stamp among the marks that changed the map since the last call; None if none did."""
        newest_ns, self._newest_ns = self._newest_ns, None
        return newest_ns

    def limit_to(self, regions: frozenset[int]) -> None:
        """Holds only sets about these regions from now on, besides our own. Cells elsewhere get back what the prior
        map and we ourselves state."""
        self.filter.limit_to(regions)
        self._drop_unwanted()

    def read_groups(self, groups: frozenset[str] | None) -> None:
        """Holds only sets of these groups from now on, besides our own; of all if None. Digests then show the
        missing sets of authors that were not readable before."""
        self.filter.read_groups(groups)
        self._drop_unwanted()

    def _drop_unwanted(self) -> None:
        """Forgets the sets of others that the filter does not let in any more."""
        wanted = self.filter
        before: dict[int, list[MarkSet]] = {}
        for tile in self.held.tiles:
            near = wanted.accepts_tile(tile)
            for each in self.held.of_tile(tile):
                if each.author != self.author and not (near and wanted.accepts_author(each.author, each.group)):
                    before.setdefault(tile, self.held.of_tile(tile))
                    self.held.remove(each)
        self.zones_version += 1
        self._settle(before, self._now_ns, False)

    # --- time -----------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[MarkSet]:
        """Drops expired statements. Returns the own sets that may be published now."""
        self._expire(now_ns)
        if self._learn_due_ns is not None and self._now_ns >= self._learn_due_ns:
            self._learn()
        self.held.tombstones.expire(now_ns)
        if self.author is None:
            return []
        due = [
            tile
            for tile in self._pending
            if now_ns - self._published_ns.get(tile, -self._publish_ns) >= self._publish_ns
        ]
        for tile in due:
            del self._pending[tile]
            self._published_ns[tile] = now_ns
        return [own for tile in due if (own := self.held.get(tile, self.author)) is not None]

    def _await_expiry(self, tile: int, sets: Iterable[MarkSet]) -> None:
        """Checks a tile again when the next statement of these sets expires."""
        ends = [end_ns for each in sets if (end_ns := mark_sets.next_expiry_ns(each, self._now_ns)) is not None]
        if ends:
            self._expiry_ns[tile] = min(*ends, self._expiry_ns.get(tile, FOREVER))
            self._soonest_ns = min(self._soonest_ns, self._expiry_ns[tile])

    def _expire(self, now_ns: int) -> None:
        """Gives cells whose winning mark expired the next one. Our own marks do not expire."""
        before_ns, self._now_ns = self._now_ns, max(now_ns, self._now_ns)
        if now_ns < self._soonest_ns:
            return
        expired = {tile: self.held.of_tile(tile) for tile, at_ns in self._expiry_ns.items() if at_ns <= now_ns}
        self._expiry_ns = {tile: at_ns for tile, at_ns in self._expiry_ns.items() if tile not in expired}
        self._soonest_ns = min(self._expiry_ns.values(), default=FOREVER)
        self.zones_version += any(mark_sets.is_zone(each.author) for sets in expired.values() for each in sets)
        self._settle(expired, before_ns, False)
        for tile, sets in expired.items():
            self._await_expiry(tile, sets)

    # --- our own statements ---------------------------------------------------------------------------------

    def write(self, cells: ArrayLike, kinds: ArrayLike, paces: ArrayLike, now_ns: int) -> list[MarkSet]:
        """States something about cells; of a cell named twice the last statement counts. The own cost map changes
        at once. Returns the sets that may be published now; `tick` returns the others later.

        cells  int (cells,)      flat indices in the grid; OutsideGridError if one is not in it
        kinds  uint8 (cells,)    MarkKind, or one for all
        paces  float32 (cells,)  s/m, or one for all; read where the kind is PACE, and kept within the bounds of
               marks (`swarm.wire.messages.map_data`)

        Raises RuntimeError if the replica has no author.
        """
        flat = np.atleast_1d(np.asarray(cells, np.int64))
        if len(flat) and not (flat.min() >= 0 and flat.max() < self.grid.cells):
            raise OutsideGridError(f"a cell of {flat.min()}..{flat.max()} is not in {self.grid.cells} cells")
        new_kinds = np.broadcast_to(np.asarray(kinds, np.uint8), flat.shape)
        new_paces = np.broadcast_to(np.asarray(paces, np.float32), flat.shape)
        bounded = np.clip(new_paces, PACE_LEAST, PACE_MOST)
        new_paces = np.where(new_kinds == MarkKind.PACE, bounded, np.float32(0))
        tiles, inner = tile_cells(self.grid, flat)
        for tile in np.unique(tiles).tolist():
            here = tiles == tile
            self._write_tile(tile, inner[here], new_kinds[here], new_paces[here], now_ns)
        return self.tick(now_ns)

    def _write_tile(
        self,
        tile: int,
        cells: NDArray[np.uint16],
        kinds: NDArray[np.uint8],
        paces: NDArray[np.float32],
        now_ns: int,
    ) -> None:
        own = self._own(tile)
        won = mark_sets.dense(winners(self.held.of_tile(tile), self._now_ns))
        stamps = self._clock.stamps_ns(now_ns, won.stamps_ns[cells])
        if len(np.unique(cells)) == len(cells):
            # A mark that we have stated already, and that wins, need not be stated again.
            wins = (own.stamps_ns[cells] != mark_sets.NO_STATEMENT) & (own.stamps_ns[cells] == won.stamps_ns[cells])
            known = wins & (won.kinds[cells] == kinds) & (won.paces[cells] == paces)
            if known.all():
                return
            cells, kinds, paces, stamps = cells[~known], kinds[~known], paces[~known], stamps[~known]
        own.kinds[cells], own.paces[cells], own.stamps_ns[cells] = kinds, paces, stamps
        self.counts["marks_written"] += len(cells)
        self._put_own(tile, mark_sets.sparse(own))

    def write_learned(self, measured: Mapping[int, Measurement], now_ns: int) -> list[MarkSet]:
        """Publishes our measurements (`shared_map.learned_factors`) instead of the previous ones."""
        self._put_own(beyond_tile(self.grid), mark_sets.Statements(*columns_of(measured, now_ns)))
        return self.tick(now_ns)

    def _own(self, tile: int) -> mark_sets.Statements:
        """Our statements about a tile, spread over all of its cells."""
        if self.author is None:
            raise RuntimeError("a replica without an author cannot write")
        own = self.held.get(tile, self.author)
        return mark_sets.dense(mark_sets.NO_STATEMENTS if own is None else mark_sets.statements(own))

    def _put_own(self, tile: int, stated: mark_sets.Statements, epoch: int | None = None) -> None:
        """Replaces our set of a tile, under the next number.

        epoch  of that number; None: as before
        """
        assert self.author is not None
        held = self.held.get(tile, self.author)
        last, seq = (1, 0) if held is None else (held.epoch, mark_sets.next_seq(held.seq))
        own = mark_sets.mark_set(self.author, self.group, tile, last if epoch is None else epoch, seq, stated)
        before = {tile: self.held.of_tile(tile)}
        self.held.put(own, own=True)
        self.counts["sets_merged"] += 1
        self._settle(before, self._now_ns, False)
        self._await_expiry(tile, [own])
        self._pending[tile] = None

    def _reassert(self, received: MarkSet) -> None:
        """A keeper took us for dead, and replaced our set: states the same again under a higher epoch."""
        if received.epoch + 1 >= 1 << 62:  # no honest writer counts that far, and nothing could follow it
            self.counts["sets_refused"] += 1
            return
        held = self.held.get(received.tile, self.author)
        stated = mark_sets.NO_STATEMENTS if held is None else mark_sets.statements(held)
        self._put_own(received.tile, stated, received.epoch + 1)

    # --- comparing with others ------------------------------------------------------------------------------

    def missing(self, theirs: Held) -> list[tuple[str, list[int]]]:
        """(author, tiles) to ask for: what they hold newer than we, and we would take in."""
        return self.filter.accepted(self.held.missing(theirs))

    def lacking(self, author: str, rows: bytes) -> list[int]:
        """Tiles of interest of which we do not hold what these rows of a digest name, or what came after it."""
        wanted = self.filter.accepted([(author, self.held.lacking(author, rows))])
        return [tile for _, tiles in wanted for tile in tiles]

    def has_ended(self, author: str) -> bool:
        """Returns True if all marks of an author in some tile have expired: too early if our clock is ahead of
        its."""
        sets = (self.held.get(tile, author) for tile in self.held.tiles)
        return any(each and each.kinds and not len(mark_sets.standing(each, self._now_ns).cells) for each in sets)

    def own_digest(self) -> dict[str, bytes]:
        """Rows of all that we stated ourselves."""
        return self.held.ledger.held([] if self.author is None else [self.author])

    def winners(self, tile: int) -> mark_sets.Statements:
        """The winning statements about a tile, in order of cell; cells without any are absent."""
        return winners(self.held.of_tile(tile), self._now_ns)


_LEARN_EVERY_NS = 5 * NS_PER_S
"""New measurements change the cost map at most this often: each change is one of the whole map, and each tree is
searched again from scratch. The change depends on held sets alone, so replicas that hold the same are equal after
this time at the latest (docs/design/learning.md)."""
