"""Marks of one author as mark sets: published, served and digested. Pure; needs no NumPy.

A process of the swarm keeps a whole replica (`shared_map`); this keeps only what its own author says.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import NamedTuple

from swarm.grid import TILE_CELLS, GridSpec
from swarm.wire.messages.map_data import FOREVER, SEQ_STEP, Digest, MarkKind, MarkSet, MarksRequest


class _Statement(NamedTuple):
    kind: MarkKind
    pace_s_per_m: float
    stamp_ns: int
    until_ns: int


class OwnMarks:
    """The mark sets of one author, which belongs to one group."""

    def __init__(self, author: str, group: str, grid: GridSpec) -> None:
        self.author = author
        self._group = group
        self._grid = grid
        self._tiles: dict[int, dict[int, _Statement]] = {}
        """Tile -> cell in it -> its last mark."""
        self._sets: dict[int, MarkSet] = {}
        """Tile -> its newest set."""
        self._stamp_ns = 0
        """Timestamp of the newest mark: no later mark is older, even if the clock is set back."""
        self._digests = 0

    @property
    def any(self) -> bool:
        """True if there are any marks."""
        return bool(self._sets)

    def state(
        self,
        cells: Iterable[int],
        kind: MarkKind,
        pace_s_per_m: float,
        now_ns: int,
        until_ns: int = FOREVER,
        class_number: int = 0,
    ) -> list[MarkSet]:
        """State the same of all these cells of the grid. Returns the sets to put.

        class_number  for whom: 0 is all vehicles, a class of the scenario counts from 1 on
        """
        self._stamp_ns = max(self._stamp_ns + 1, now_ns)
        statement = _Statement(kind, pace_s_per_m, self._stamp_ns, until_ns)
        changed: dict[int, None] = {}
        for cell in cells:
            row, col = self._grid.row_col(cell)
            tile = self._grid.tile_for(self._grid.tile_of(cell), class_number)
            changed[tile] = None
            self._tiles.setdefault(tile, {})[row % TILE_CELLS * TILE_CELLS + col % TILE_CELLS] = statement
        return [self._set(tile, now_ns) for tile in changed]

    def heard(self, other: MarkSet, now_ns: int) -> list[MarkSet]:
        """A set under our name. If a keeper took us for dead and shortened ours, the set to put in its place."""
        mine = self._sets.get(other.tile)
        if mine is None or (other.epoch, other.seq) <= (mine.epoch, mine.seq) or other.epoch + 1 >= 1 << 62:
            return []
        return [self._set(other.tile, now_ns, epoch=other.epoch + 1)]

    def answer(self, request: MarksRequest) -> list[MarkSet]:
        """Returns the requested mark sets."""
        if request.authors and self.author not in request.authors:
            return []
        return [each for tile, each in self._sets.items() if not request.tiles or tile in request.tiles]

    def digest(self) -> Digest:
        """Digest of the sets, by which others find those that they lack."""
        self._digests += 1
        rows = b"".join(
            struct.pack("<IQQ", tile, each.epoch, each.seq) for tile, each in sorted(self._sets.items())
        )
        return Digest(author=self.author, role="rover", held={self.author: rows}, seq=self._digests)

    def region_of(self, of: MarkSet) -> int:
        return self._grid.region_of_tile(self._grid.class_of_tile(of.tile)[1])

    def _set(self, tile: int, now_ns: int, epoch: int | None = None) -> MarkSet:
        stated = self._tiles[tile]
        for cell in [cell for cell, each in stated.items() if each.until_ns <= now_ns]:
            del stated[cell]
        before = self._sets.get(tile)
        rows = sorted(stated.items())
        many = len(rows)
        ends = any(each.until_ns != FOREVER for each in stated.values())
        made = self._sets[tile] = MarkSet(
            author=self.author,
            group=self._group,
            tile=tile,
            epoch=epoch if epoch is not None else 1 if before is None else before.epoch,
            seq=0 if before is None else before.seq + SEQ_STEP,
            cells=struct.pack(f"<{many}H", *(cell for cell, _ in rows)),
            kinds=bytes(each.kind for _, each in rows),
            paces=struct.pack(f"<{many}f", *(each.pace_s_per_m for _, each in rows)),
            stamps_ns=struct.pack(f"<{many}q", *(each.stamp_ns for _, each in rows)),
            untils_ns=struct.pack(f"<{many}q", *(each.until_ns for _, each in rows)) if ends else b"",
        )
        made.check()
        return made
