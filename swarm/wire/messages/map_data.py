"""The shared map on the wire: statements about cells with the rules of their columns, sets and digests of them, and
the terrain from a keeper."""

from __future__ import annotations

import enum
import struct
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

from swarm.grid import TILE_CELLS, GridSpec
from swarm.wire import fields
from swarm.wire.messages import Message, schema_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

TILE_AREA = TILE_CELLS * TILE_CELLS

STAMP_LIMIT_NS = 1 << 62
"""Marks stamped from here on (year 2116) are rejected by all processes, so that there is always a newer stamp."""

PACE_LEAST: float = struct.unpack("<f", struct.pack("<f", 1 / 340))[0]
"""s/m; anything faster than sound is no vehicle. Float32, as marks are."""
PACE_MOST = 100.0
"""s/m, a cell of 10 m in 17 minutes: slower ground is better marked as lethal. Both bound what one wrong mark can
do to lower bounds and to the number of buckets of every planner."""

FOREVER = (1 << 63) - 1
"""`until_ns` of a mark that does not expire."""


class MarkKind(enum.IntEnum):
    """Meaning of a mark for its cell."""

    PACE = 0
    """It can be driven at this pace, in s/m."""
    LETHAL = 1
    """It must not be entered."""
    CLEAR = 2
    """It is as the prior map has it: undoes older marks."""


LAST_KIND = int(max(MarkKind))
_FEW = 100
"""Up to this many statements, which most sets have, lists are checked several times faster than arrays."""


def check_lengths(
    count: int, cells: bytes, kinds: bytes, paces: bytes, stamps_ns: bytes, untils_ns: bytes = b""
) -> None:
    """Raises ValueError unless these are columns of `count` statements; `untils_ns` may be empty."""
    fields.check_column("cells", cells, 2, count)
    fields.check_column("kinds", kinds, 1, count)
    fields.check_column("paces", paces, 4, count)
    fields.check_column("stamps_ns", stamps_ns, 8, count)
    if untils_ns:
        fields.check_column("untils_ns", untils_ns, 8, count)


def check_statements(cells: bytes, kinds: bytes, paces: bytes, stamps_ns: bytes) -> None:
    """Raises ValueError with the rule that the columns of one set break. It has one or more statements."""
    if max(kinds) > LAST_KIND:
        raise ValueError(f"kind {max(kinds)} is not in 0..{LAST_KIND}")
    if len(kinds) > _FEW and fields.numpy_loaded():
        counts = fields.np.array([len(kinds)], fields.np.int64)
        if not faulty_sets(counts, cells, kinds, paces, stamps_ns).size:
            return
    listed = memoryview(cells).cast("H").tolist()
    if sorted(set(listed)) != listed or listed[-1] >= TILE_AREA:
        raise ValueError(f"cells must increase strictly below {TILE_AREA}")
    driven = zip(memoryview(paces).cast("f").tolist(), kinds, strict=True)
    if not all(kind != MarkKind.PACE or PACE_LEAST <= pace <= PACE_MOST for pace, kind in driven):
        raise ValueError(f"the pace of a PACE mark must be in {PACE_LEAST:.4g} ... {PACE_MOST:g} s/m")
    stamps = memoryview(stamps_ns).cast("q").tolist()
    if min(stamps) < 0 or max(stamps) >= STAMP_LIMIT_NS:
        raise ValueError("stamps_ns must not be negative, and below 2**62")


def faulty_sets(
    counts: NDArray[fields.np.int64], cells: bytes, kinds: bytes, paces: bytes, stamps_ns: bytes
) -> NDArray[fields.np.int64]:
    """Numbers of the sets that break a rule of `check_statements`, in order.

    counts  int64 (sets,)  statements of each set; the columns hold those of all sets, one set after the other
    """
    cell, kind = fields.column(cells, "<u2"), fields.column(kinds, "<u1")
    pace, stamp_ns = fields.column(paces, "<f4"), fields.column(stamps_ns, "<i8")
    wrong = (cell >= TILE_AREA) | (kind > LAST_KIND) | (stamp_ns < 0) | (stamp_ns >= STAMP_LIMIT_NS)
    wrong |= (kind == MarkKind.PACE) & ~((pace >= PACE_LEAST) & (pace <= PACE_MOST))
    fallen = fields.np.zeros(len(cell), bool)
    fallen[1:] = cell[1:] <= cell[:-1]
    starts = fields.np.cumsum(counts) - counts
    fallen[starts[counts > 0]] = False
    wrong |= fallen
    if not wrong.any():
        return fields.np.empty(0, fields.np.int64)
    return fields.np.unique(fields.np.repeat(fields.np.arange(len(counts)), counts)[wrong])


SEQ_STEP = 1 << 16
"""An author's own numbers are multiples of this."""
_ROW = (("tile", "<u4"), ("epoch", "<u8"), ("seq", "<u8"))
DIGEST_ROW = list(_ROW)
"""Row type, as NumPy wants it."""
DIGEST_ROW_BYTES = fields.width_of(_ROW)
MOST_TILES = 1 << 18
"""Named in one message: every tile of a map of 16,384 x 16,384 cells."""
DigestRows = Annotated[bytes, Meta(max_length=DIGEST_ROW_BYTES * MOST_TILES), fields.Column(_ROW)]
_AUTHORS = Meta(max_length=1 << 16)
_Cells = Annotated[bytes, fields.Column("<u2", per="kinds", least=0, most=TILE_AREA - 1, checked=False)]
_Kinds = Annotated[bytes, fields.Column("<u1", least=0, most=LAST_KIND, checked=False)]
_Paces = Annotated[bytes, fields.Column("<f4", per="kinds", least=PACE_LEAST, most=PACE_MOST, checked=False)]
_Stamps = Annotated[bytes, fields.Column("<i8", per="kinds", least=0, most=STAMP_LIMIT_NS - 1, checked=False)]


def owner_of(author: str) -> str:
    """The process that an author is a generation of. Its certificate lets it write under any number of generations,
    so limits and votes are those of processes."""
    return author.rpartition(".")[0] or author


class MarkSet(Message, frozen=True, kw_only=True, gc=False, tag=schema_of("marks")):
    """All marks of one author in one tile. Replaces the author's set with a lower (epoch, seq).

    An author counts `seq` in steps of 65536. The numbers between are for keepers, which drop superseded marks of
    dead authors. Such a set without marks is a tombstone: readers drop the author's marks in that tile.

    tile       in a grid of N tiles, 0 to N - 1 are tiles for all vehicles. N holds the author's learned factors.
               n (N + 1) + t is tile t for vehicle class n only
    epoch      1; the next whenever a keeper took the living author for dead
    cells      indices inside the tile, row-major over 32 x 32, strictly increasing
    kinds      MarkKind
    paces      s/m for PACE, ignored otherwise
    stamps_ns  when each mark was made, by the author's clock, but later than the mark which it replaces
    untils_ns  end of each mark, or FOREVER (2^63 - 1); empty if none ends
    """

    author: fields.Id
    group: fields.Id
    tile: fields.Tile
    epoch: fields.Natural
    seq: fields.Natural
    cells: _Cells
    kinds: Annotated[_Kinds, Meta(max_length=TILE_AREA)]
    paces: _Paces
    stamps_ns: _Stamps
    untils_ns: Annotated[bytes, Meta(max_length=8 * TILE_AREA), fields.Column("<i8")] = b""

    # A set is checked when it is decoded (`check`), not when it is made: those of many sets at once.
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
    """Many sets of one author and group: columns over the sets, then the statements of all sets, one set after the
    other.

    tiles      of each set; none twice
    counts     statements of each set
    ending     1 where a set has `untils_ns`
    untils_ns  of the statements of these sets
    """

    author: fields.Id
    group: fields.Id
    tiles: Annotated[bytes, fields.Column("<u4", per="ending", least=0, most=(1 << 22) - 1)]
    epochs: Annotated[bytes, fields.Column("<u8", per="ending", least=0, most=(1 << 62) - 1)]
    seqs: Annotated[bytes, fields.Column("<u8", per="ending", least=0, most=(1 << 62) - 1)]
    counts: Annotated[bytes, fields.Column("<u2", per="ending", least=0, most=TILE_AREA)]
    ending: Annotated[bytes, Meta(max_length=MOST_TILES), fields.Column("<u1", least=0, most=1)]
    cells: _Cells
    kinds: Annotated[_Kinds, Meta(max_length=1 << 20)]
    paces: _Paces
    stamps_ns: _Stamps
    untils_ns: Annotated[bytes, Meta(max_length=8 << 20), fields.Column("<i8")] = b""

    def __post_init__(self) -> None:
        pass

    def check(self) -> None:
        self.check_bounds()

    def relate(self) -> None:
        if not fields.numpy_loaded():
            raise ValueError("many sets at once are read with NumPy only: ask without `bulk`")
        sets = len(self.ending)
        counts = fields.column(self.counts, "<u2").astype(fields.np.int64)
        ending = fields.column(self.ending, "<u1")
        check_lengths(int(counts.sum()), self.cells, self.kinds, self.paces, self.stamps_ns)
        fields.check_column("untils_ns", self.untils_ns, 8, int(counts[ending == 1].sum()))
        if len(fields.np.unique(fields.column(self.tiles, "<u4"))) < sets:
            raise ValueError("tiles names a tile twice")
        faulty = faulty_sets(counts, self.cells, self.kinds, self.paces, self.stamps_ns)
        if len(faulty):
            raise ValueError(f"set {int(faulty[0])} of {sets} breaks a rule of its statements")


MOST_DIGEST_BYTES = 1 << 16
"""Bound of one digest, so that it is compared within a tick. It names 3,000 sets, more than most agents ever leave.
A replica that holds more publishes parts (`Digest.after`)."""
KEEPERS = "keeper"
"""The authors under which keepers publish digests begin with this and a dot, and no group is called so: an author's
role is what its name says, as access is granted by name."""
_Place = tuple[fields.Id, fields.Tile]


class Digest(Message, frozen=True, kw_only=True, tag=schema_of("digest")):
    """Sets that a replica holds. An author's own digest is complete for that author; the keeper's covers what it
    committed. Only a keeper (by `author`) names sets of others.

    role   not used
    held   author -> its sets
    whole  false: only tiles that changed lately, or a part of a whole digest
    seq    number of the digest, so that a late one replaces no newer one; 0: not numbered
    after  of a part: author and tile after which it begins; None: with the first
    until  of a part: author and tile with which it ends; None: with the last
    """

    author: fields.Id
    role: fields.Word
    held: Annotated[dict[fields.Id, DigestRows], _AUTHORS]
    whole: bool = True
    seq: fields.Natural = 0
    after: _Place | None = None
    until: _Place | None = None

    @property
    def complete(self) -> bool:
        """True if all sets of its range are named."""
        return self.whole or self.after is not None or self.until is not None


def is_keeper(author: str) -> bool:
    """Returns True if a sender of digests is a keeper."""
    return author.startswith(f"{KEEPERS}.")


MOST_TILES_ASKED = 4096
"""Tiles in one query: those of 64 regions. A process that needs more queries again."""


class MarksRequest(Message, frozen=True, kw_only=True, tag=schema_of("marks-request")):
    """Asks authors and the keeper for sets: of these authors and tiles, or of all where a list is empty.

    bulk  replies may be MarkSets, under a key with `-` for region and tile
    """

    authors: Annotated[list[fields.Id], _AUTHORS] = []
    tiles: Annotated[list[fields.Tile], Meta(max_length=MOST_TILES)] = []
    bulk: bool = False


BASE_DIGEST_BYTES = 8
"""Bytes of the digest of one region of a layer."""
MOST_REGIONS = 1 << 16
"""Number of regions of the largest grid."""
_DIGESTS = Meta(max_length=BASE_DIGEST_BYTES * MOST_REGIONS)
_LAYERS = Meta(max_length=100)


class BaseMap(Message, frozen=True, kw_only=True, tag=schema_of("base-map")):
    """A keeper's copy of the terrain, for machines without its files.

    digests  layer -> 8 bytes per region, in order: BLAKE2b of its bytes
    notes    origin of the terrain, in sentences
    """

    keeper: fields.Id
    terrain: fields.Word
    rows: fields.GridSide
    cols: fields.GridSide
    resolution_m: fields.Resolution
    west_m: fields.Metres
    north_m: fields.Metres
    crs: fields.LongText
    digests: Annotated[dict[fields.Word, Annotated[bytes, _DIGESTS]], _LAYERS]
    notes: Annotated[list[fields.LongText], Meta(max_length=1000)] = []

    def relate(self) -> None:
        regions = self.grid.regions
        for layer, digests in self.digests.items():
            fields.check_column(f"digests of {layer[:40]}", digests, BASE_DIGEST_BYTES, regions)

    @property
    def grid(self) -> GridSpec:
        return GridSpec(self.rows, self.cols, self.resolution_m, self.west_m, self.north_m, self.crs)


class BaseMapRequest(Message, frozen=True, kw_only=True, tag=schema_of("base-map-request")):
    """Asks a keeper for these layers of these regions."""

    layers: Annotated[list[fields.Word], _LAYERS] = []
    regions: Annotated[list[fields.Region], Meta(max_length=MOST_REGIONS)] = []


class BaseMapTile(Message, frozen=True, kw_only=True, tag=schema_of("base-map-tile")):
    """One layer of one region. `data` is zlib of the lowest byte of every value, row by row, then of the next
    bytes."""

    layer: fields.Word
    region: fields.Region
    data: Annotated[bytes, Meta(max_length=4 << 20)]
