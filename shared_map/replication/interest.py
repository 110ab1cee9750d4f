"""Filters of what a replica takes in of others: marks by author (the policy of groups) and by tile (its interest),
and the digests which can concern what it holds (`DigestInterest`). Pure: time is an argument.

An author's id begins with its group (`blue.a3.17f2`), and the keys of all that it writes end with this id. Access
control can therefore enforce the policy; and sets which would be refused are not requested: a digest names their
authors.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.replication.tiles import beyond_tile, of_all_classes, region_tiles
from swarm.config.scenario import Scenario, readable_groups
from swarm.config.setting_types import RESERVED_GROUP
from swarm.grid import REGION_CELLS, GridSpec


def readable_for_target(
    scenario: Scenario, target: str, chased_by: Callable[[str], Collection[str]] | None = None
) -> frozenset[str] | None:
    """The groups whose marks the planner of a target takes in: all that any group reads which chases the target.
    None if that is all groups.

    The least informed of these groups therefore gets routes as good as the best informed one, but not the marks
    behind them. Groups which must not learn even that much have to chase targets of their own.

    chased_by  the targets of a group, where operators may have ordered others than the scenario says
    """
    groups: set[str] = set()
    for group in scenario.groups:
        targets = group.targets if chased_by is None else chased_by(group.name)
        if target in targets or (chased_by is None and not targets):
            readable = readable_groups(scenario, group.name)
            if readable is None:
                return None
            groups |= readable
    return frozenset(groups)


class MarkFilter:
    """Filter of sets by author and by tile. Either limit may be absent. Zones of operators concern
    every group.

    groups   only sets of these groups are accepted; both the author's id and the set's `group` must match. None:
             all groups
    regions  about which regions; None: all
    """

    def __init__(self, grid: GridSpec, groups: frozenset[str] | None = None) -> None:
        self.regions: frozenset[int] | None = None
        self._grid = grid
        self._tiles: frozenset[int] | None = None  # those of `regions`
        self.read_groups(groups)

    def read_groups(self, groups: frozenset[str] | None) -> None:
        """From now on accept the sets of these groups only; of all if None."""
        self.groups = None if groups is None else groups | {RESERVED_GROUP}
        self._prefixes = None if self.groups is None else tuple(f"{group}." for group in sorted(self.groups))

    def limit_to(self, regions: frozenset[int]) -> None:
        """From now on accept only sets about these regions."""
        self.regions = regions
        tiles = [tile for region in regions for tile in region_tiles(self._grid, region)]
        self._tiles = frozenset([beyond_tile(self._grid), *of_all_classes(self._grid, tiles)])

    def accepts_author(self, author: str, group: str) -> bool:
        """Returns True if the policy of groups lets us read this author, which claims this group."""
        return self.groups is None or (group in self.groups and author.startswith(f"{group}."))

    def accepts_tile(self, tile: int) -> bool:
        """Returns True if a tile is in the regions of interest, or beyond the map: measurements concern all."""
        return self._tiles is None or tile in self._tiles

    def accepted(self, sets: Sequence[tuple[str, list[int]]]) -> list[tuple[str, list[int]]]:
        """Returns those of (author, tiles) which would be accepted."""
        of_authors = sets
        if self._prefixes is not None:
            of_authors = [(author, tiles) for author, tiles in sets if author.startswith(self._prefixes)]
        inside = ((author, [tile for tile in tiles if self.accepts_tile(tile)]) for author, tiles in of_authors)
        return [(author, tiles) for author, tiles in inside if tiles]


# --- interest -----------------------------------------------------------------------------------------------


class Interest:
    """The regions within `enter_cells` of any cell, and those of the last update that are within twice that.

    The hysteresis keeps a vehicle at a border from subscribing again with every crossing. Squares are numbered
    row by row, as regions are.

    squares  the result of the last `update`
    """

    def __init__(self, grid: GridSpec, enter_cells: int) -> None:
        self._grid = grid
        self._across = -(-grid.cols // REGION_CELLS)
        self._enter = enter_cells
        self.squares: frozenset[int] = frozenset()

    def update(self, cells: Iterable[int]) -> frozenset[int]:
        """The squares of interest around these cells (flat indices in the grid)."""
        rows, cols = np.divmod(np.fromiter(cells, np.int64), self._grid.cols)
        near = self._within(rows, cols, self._enter)
        if not self.squares <= near:
            near |= self.squares & self._within(rows, cols, 2 * self._enter)
        self.squares = frozenset(near)
        return self.squares

    def _within(self, rows: NDArray[np.int64], cols: NDArray[np.int64], reach: int) -> set[int]:
        """The squares that are at most `reach` cells away from any of these cells, by row or column."""
        grid, side = self._grid, REGION_CELLS
        north = np.maximum(rows - reach, 0) // side
        south = np.minimum(rows + reach, grid.rows - 1) // side
        west = np.maximum(cols - reach, 0) // side
        east = np.minimum(cols + reach, grid.cols - 1) // side
        blocks = set(zip(north.tolist(), south.tolist(), west.tolist(), east.tolist(), strict=True))
        return {
            row * self._across + col
            for top, bottom, left, right in blocks
            for row in range(top, bottom + 1)
            for col in range(left, right + 1)
        }


_KEEPER_FOR = 3
_NAMED_FOR = 30
_ALL_EVERY = 90
_ALL_FOR = 5
"""In periods of whole digests: how long a keeper or author counts as near after it spoke; how often and how long
everybody is listened to. The last is longer than an author is silent before it counts as gone."""
_MOST_NAMES = 1024
"""Keepers and authors that are remembered, of each: a swarm has some hundred; names cost a sender nothing."""


class DigestInterest:
    """Decides whose digests a replica that holds a part of the map listens to.

    A digest concerns replicas that hold tiles of which its author has put sets lately. Which those are is not known
    beforehand. A replica listens to

    - keepers, whose digests name all sets;
    - authors of which sets about its own regions came in the last `_NAMED_FOR` periods;
    - everybody, while no keeper is heard, after a link came back, and now and then.

    A set that was lost is found by the next digest of its author if the author is known, else by that of the
    keeper. If the keeper has ended, is full or is cut off from the author, that is found when the replica next
    subscribes to all digests.

    name       of the listener: those with different names do not all listen to everybody at the same time
    period_ns  of whole digests
    near       only a part of the map is held; else everybody is listened to
    """

    def __init__(self, name: str, period_ns: int, *, near: bool = True) -> None:
        self._near = near
        self._period_ns = period_ns
        self._phase_ns = _ALL_EVERY * period_ns * zlib.crc32(name.encode()) >> 32
        self._keepers: dict[str, int] = {}  # keeper -> until when it counts as heard
        self._authors: dict[str, int] = {}  # author -> until when it counts as near
        self._all_until_ns = 0  # listen to everybody until then, at least
        self._all_digests_due_ns = 0  # and again from then on
        self._all_since_ns: int | None = None  # when that began; None: only those of `_named` are listened to
        self._named: dict[str, int] = {}  # sender -> since when it has been listened to, of those by name

    def start(self, now_ns: int) -> None:
        """Everybody is listened to from now on, until a keeper is heard."""
        self._all_since_ns = now_ns
        self._all_until_ns = now_ns + _ALL_FOR * self._period_ns
        self._all_digests_due_ns = self._all_until_ns + self._phase_ns

    def listen_to_all(self, now_ns: int) -> None:
        """Subscribes to all digests after a link came back: missed sets may belong to any author."""
        self._all_until_ns = now_ns + _ALL_FOR * self._period_ns

    def keeper_spoke(self, keeper: str, now_ns: int) -> None:
        """Notes that a keeper has published all its sets."""
        _note(self._keepers, keeper, now_ns + _KEEPER_FOR * self._period_ns)

    def author_is_near(self, author: str, now_ns: int) -> None:
        """An author put a set about tiles that are held here."""
        _note(self._authors, author, now_ns + _NAMED_FOR * self._period_ns)

    def update(self, now_ns: int) -> frozenset[str] | None:
        """Returns the senders of digests to subscribe to from now on; None for all."""
        self._keepers = {keeper: until for keeper, until in self._keepers.items() if now_ns <= until}
        self._authors = {author: until for author, until in self._authors.items() if now_ns <= until}
        if now_ns >= self._all_digests_due_ns:
            self._all_digests_due_ns = now_ns + _ALL_EVERY * self._period_ns
            self.listen_to_all(now_ns)
        if not self._near or not self._keepers or now_ns < self._all_until_ns:
            if self._all_since_ns is None:
                self._all_since_ns = now_ns
            return None
        since_ns = now_ns if self._all_since_ns is None else self._all_since_ns
        self._named = {each: min(self._named.get(each, now_ns), since_ns) for each in self._keepers | self._authors}
        self._all_since_ns = None
        return frozenset(self._named)

    def since_ns(self, author: str) -> int | None:
        """Since when an author's digests have been listened to; None if they are not."""
        found = [each for each in (self._all_since_ns, self._named.get(author)) if each is not None]
        return min(found, default=None)


def _note(known: dict[str, int], name: str, until_ns: int) -> None:
    if name in known or len(known) < _MOST_NAMES:
        known[name] = until_ns
