"""Messages of the shared map: sets of marks, digests and requests."""

from __future__ import annotations

import numpy as np

from swarm.wire.fields import Natural, check_column, check_id, column
from swarm.wire.messages.base import Message, schema_of
from swarm.wire.statements import check_lengths, check_statements, faulty_sets

SEQ_STEP = 1 << 16
"""An author's own numbers are multiples of this."""


class MarkSet(Message, frozen=True, kw_only=True, gc=False, tag=schema_of("marks")):
    """All that one author says about one tile. Replaces the author's set with a lower (epoch, seq).

    An author counts `seq` in steps of 65536. The numbers between are for keepers, which compact the sets of dead
    authors: drop from them what others overrule. Such a set without statements is a tombstone: readers forget the
    tile of that author.

    cells      uint16  index inside the tile, row-major over 32 x 32, strictly increasing
    kinds      uint8   MarkKind
    paces      float32 s/m for PACE, ignored otherwise
    stamps_ns  int64   hybrid logical time of each statement
    untils_ns  int64   when each statement ends by itself, FOREVER if it does not; empty if none does
    """

    author: str
    group: str
    tile: Natural
    epoch: Natural
    seq: Natural
    cells: bytes
    kinds: bytes
    paces: bytes
    stamps_ns: bytes
    untils_ns: bytes = b""

    def check(self) -> None:
        self.check_head()
        if self.kinds:
            check_statements(self.cells, self.kinds, self.paces, self.stamps_ns)

    def check_head(self) -> None:
        """All but the rules of the statements themselves, which are cheaper to check of many sets at once."""
        check_id("author", self.author)
        check_id("group", self.group)
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

    author: str
    group: str
    tiles: bytes
    epochs: bytes
    seqs: bytes
    counts: bytes
    ending: bytes
    cells: bytes
    kinds: bytes
    paces: bytes
    stamps_ns: bytes
    untils_ns: bytes = b""

    def check(self) -> None:
        check_id("author", self.author)
        check_id("group", self.group)
        sets = len(self.ending)
        for name, width in (("tiles", 4), ("epochs", 8), ("seqs", 8), ("counts", 2)):
            check_column(name, getattr(self, name), width, sets)
        counts = column(self.counts, "<u2").astype(np.int64)
        ending = column(self.ending, "<u1")
        if (ending > 1).any():
            raise ValueError(f"ending has a {int(ending.max())}, expected 0 or 1")
        check_lengths(int(counts.sum()), self.cells, self.kinds, self.paces, self.stamps_ns)
        check_column("untils_ns", self.untils_ns, 8, int(counts[ending == 1].sum()))
        for name in ("epochs", "seqs"):
            if (column(getattr(self, name), "<u8") >= 1 << 62).any():
                raise ValueError(f"{name} must be below 2**62")
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

    author: str
    role: str
    held: dict[str, bytes]
    whole: bool = True
    seq: Natural = 0

    def __post_init__(self) -> None:
        check_id("author", self.author)
        for author, rows in self.held.items():
            check_id("author", author)
            if len(rows) % DIGEST_ROW.itemsize:
                raise ValueError(f"digest of {author} has {len(rows)} bytes, not a multiple of 20")


DIGEST_ROW = np.dtype([("tile", "<u4"), ("epoch", "<u8"), ("seq", "<u8")])


class MarksRequest(Message, frozen=True, kw_only=True, tag=schema_of("marks-request")):
    """Asks authors and the keeper for sets: of these authors and tiles, or of all where a list is empty.

    bulk  answers may be MarkSets, under a key with `-` for region and tile
    """

    authors: list[str] = []
    tiles: list[Natural] = []
    bulk: bool = False
