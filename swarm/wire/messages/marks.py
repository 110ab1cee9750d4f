"""Messages of the shared map: sets of marks, digests and requests."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from swarm.lazy_numpy import np, numpy_loaded
from swarm.wire.fields import Column, Id, Natural, Tile, Word, check_column, column, width_of
from swarm.wire.messages.base import Message, schema_of
from swarm.wire.statements import (
    LAST_KIND,
    PACE_LEAST,
    PACE_MOST,
    STAMP_LIMIT_NS,
    TILE_AREA,
    check_lengths,
    check_statements,
    faulty_sets,
)

SEQ_STEP = 1 << 16
"""An author's own numbers are multiples of this."""
_ROW = (("tile", "<u4"), ("epoch", "<u8"), ("seq", "<u8"))
DIGEST_ROW = list(_ROW)
"""As NumPy wants it."""
DIGEST_ROW_BYTES = width_of(_ROW)
MOST_TILES = 1 << 18
"""Named in one message: every tile of a map of 16,384 x 16,384 cells."""
DigestRows = Annotated[bytes, Meta(max_length=DIGEST_ROW_BYTES * MOST_TILES), Column(_ROW)]
_AUTHORS = Meta(max_length=1 << 16)
_Cells = Annotated[bytes, Column("<u2", per="kinds", least=0, most=TILE_AREA - 1, checked=False)]
_Kinds = Annotated[bytes, Column("<u1", least=0, most=LAST_KIND, checked=False)]
_Paces = Annotated[bytes, Column("<f4", per="kinds", least=PACE_LEAST, most=PACE_MOST, checked=False)]
_Stamps = Annotated[bytes, Column("<i8", per="kinds", least=0, most=STAMP_LIMIT_NS - 1, checked=False)]


def owner_of(author: str) -> str:
    """The process that an author is a life of. Its certificate lets it write under any number of lives, so limits
    and votes are those of processes."""
    return author.rpartition(".")[0] or author


class MarkSet(Message, frozen=True, kw_only=True, gc=False, tag=schema_of("marks")):
    """All that one author says about one tile. Replaces the author's set with a lower (epoch, seq).

    An author counts `seq` in steps of 65536. The numbers between are for keepers, which compact the sets of dead
    authors: drop from them what others overrule. Such a set without statements is a tombstone: readers forget the
    tile of that author.

    tile       of a grid of N tiles: 0 ... N - 1 for all vehicles; N tells what its author has learned; tile
               n (N + 1) + t is tile t for the n-th of the scenario's classes alone

    cells      uint16  index inside the tile, row-major over 32 x 32, strictly increasing
    kinds      uint8   MarkKind
    paces      float32 s/m for PACE, ignored otherwise
    stamps_ns  int64   hybrid logical time of each statement
    untils_ns  int64   when each statement ends by itself, FOREVER if it does not; empty if none does

    A set is checked when it is decoded (`check`), not when it is made: the statements of many sets are checked at
    once, by the rules of `swarm.wire.statements`.
    """

    author: Id
    group: Id
    tile: Tile
    epoch: Natural
    seq: Natural
    cells: _Cells
    kinds: Annotated[_Kinds, Meta(max_length=TILE_AREA)]
    paces: _Paces
    stamps_ns: _Stamps
    untils_ns: Annotated[bytes, Meta(max_length=8 * TILE_AREA), Column("<i8")] = b""

    def __post_init__(self) -> None:
        pass

    def check(self) -> None:
        self.check_head()
        if self.kinds:
            check_statements(self.cells, self.kinds, self.paces, self.stamps_ns)

    def check_head(self) -> None:
        """All but the rules of the statements themselves, which are cheaper to check of many sets at once."""
        self.check_bounds()
        check_lengths(len(self.kinds), self.cells, self.kinds, self.paces, self.stamps_ns, self.untils_ns)


class MarkSets(Message, frozen=True, kw_only=True, gc=False, tag=schema_of("mark-sets")):
    """Many sets of one author and group, as one reply carries them: columns over the sets, then the statements of
    all sets, one set after the other.

    tiles      uint32  of each set; none twice
    epochs     uint64
    seqs       uint64
    counts     uint16  statements of each set
    ending     uint8   1 where a set has `untils_ns`
    cells      uint16, kinds uint8, paces float32, stamps_ns int64: as in MarkSet
    untils_ns  int64   of the statements of the sets that have them
    """

    author: Id
    group: Id
    tiles: Annotated[bytes, Column("<u4", per="ending", least=0, most=(1 << 22) - 1)]
    epochs: Annotated[bytes, Column("<u8", per="ending", least=0, most=(1 << 62) - 1)]
    seqs: Annotated[bytes, Column("<u8", per="ending", least=0, most=(1 << 62) - 1)]
    counts: Annotated[bytes, Column("<u2", per="ending", least=0, most=TILE_AREA)]
    ending: Annotated[bytes, Meta(max_length=MOST_TILES), Column("<u1", least=0, most=1)]
    cells: _Cells
    kinds: Annotated[_Kinds, Meta(max_length=1 << 20)]
    paces: _Paces
    stamps_ns: _Stamps
    untils_ns: Annotated[bytes, Meta(max_length=8 << 20), Column("<i8")] = b""

    def __post_init__(self) -> None:
        pass

    def check(self) -> None:
        self.check_bounds()

    def relate(self) -> None:
        if not numpy_loaded():
            raise ValueError("many sets at once are read with NumPy only: ask without `bulk`")
        sets = len(self.ending)
        counts = column(self.counts, "<u2").astype(np.int64)
        ending = column(self.ending, "<u1")
        check_lengths(int(counts.sum()), self.cells, self.kinds, self.paces, self.stamps_ns)
        check_column("untils_ns", self.untils_ns, 8, int(counts[ending == 1].sum()))
        if len(np.unique(column(self.tiles, "<u4"))) < sets:
            raise ValueError("tiles names a tile twice")
        faulty = faulty_sets(counts, self.cells, self.kinds, self.paces, self.stamps_ns)
        if len(faulty):
            raise ValueError(f"set {int(faulty[0])} of {sets} breaks a rule of its statements")


class Digest(Message, frozen=True, kw_only=True, tag=schema_of("digest")):
    """Which sets a replica holds: author -> columns of tile (uint32), epoch and seq (uint64 each), interleaved as
    rows of 20 bytes. An author's own digest is complete for that author; the keeper's covers what it committed.

    whole  false: only tiles that changed lately, told between the whole digests
    seq    counts this sender's digests, so that one that comes late replaces no newer one; 0 if it does not count
    """

    author: Id
    role: Word
    held: Annotated[dict[Id, DigestRows], _AUTHORS]
    whole: bool = True
    seq: Natural = 0


class MarksRequest(Message, frozen=True, kw_only=True, tag=schema_of("marks-request")):
    """Asks authors and the keeper for sets: of these authors and tiles, or of all where a list is empty.

    bulk  answers may be MarkSets, under a key with `-` for region and tile
    """

    authors: Annotated[list[Id], _AUTHORS] = []
    tiles: Annotated[list[Tile], Meta(max_length=MOST_TILES)] = []
    bulk: bool = False
