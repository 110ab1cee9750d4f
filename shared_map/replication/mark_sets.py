"""Many sets in one message, and back: the form of replies to a late join and a resync."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from swarm.wire.fields import column, pack_column
from swarm.wire.messages.map_data import MarkSet, MarkSets

MAX_BULK_BYTES = 1 << 18
"""A message is cut off at about this size: while the reader merges one, the next is packed and sent."""
_BULK_SETS = 4096


def packed(sets: Iterable[MarkSet]) -> Iterator[MarkSets]:
    """Sets, no two of one tile and author, as few messages, each of one author and group."""
    together: dict[tuple[str, str], list[MarkSet]] = {}
    for each in sets:
        together.setdefault((each.author, each.group), []).append(each)
    for (author, group), theirs in together.items():
        for some in _cut(theirs):
            yield _message(author, group, some)


def _cut(sets: list[MarkSet]) -> Iterator[list[MarkSet]]:
    some: list[MarkSet] = []
    size = 0
    for each in sets:
        if some and (size >= MAX_BULK_BYTES or len(some) == _BULK_SETS):
            yield some
            some, size = [], 0
        some.append(each)
        size += 23 + 15 * len(each.kinds) + len(each.untils_ns)
    if some:
        yield some


def _message(author: str, group: str, sets: list[MarkSet]) -> MarkSets:
    return MarkSets(
        author=author,
        group=group,
        tiles=pack_column([each.tile for each in sets], "<u4"),
        epochs=pack_column([each.epoch for each in sets], "<u8"),
        seqs=pack_column([each.seq for each in sets], "<u8"),
        counts=pack_column([len(each.kinds) for each in sets], "<u2"),
        ending=bytes([bool(each.untils_ns) for each in sets]),
        cells=b"".join([each.cells for each in sets]),
        kinds=b"".join([each.kinds for each in sets]),
        paces=b"".join([each.paces for each in sets]),
        stamps_ns=b"".join([each.stamps_ns for each in sets]),
        untils_ns=b"".join([each.untils_ns for each in sets]),
    )


def unpacked(bulk: MarkSets) -> list[MarkSet]:
    """The sets in a message that passed its checks. Each owns its bytes, so none keeps the whole message alive."""
    counts = column(bulk.counts, "<u2").astype(np.int64)
    ends = np.cumsum(counts)
    lasting = np.cumsum(np.where(column(bulk.ending, "<u1") == 1, counts, 0))
    rows = zip(
        column(bulk.tiles, "<u4").tolist(),
        column(bulk.epochs, "<u8").tolist(),
        column(bulk.seqs, "<u8").tolist(),
        bulk.ending,
        (ends - counts).tolist(),
        ends.tolist(),
        lasting.tolist(),
        strict=True,
    )
    author, group = bulk.author, bulk.group
    cells, kinds, paces, stamps_ns, untils_ns = bulk.cells, bulk.kinds, bulk.paces, bulk.stamps_ns, bulk.untils_ns
    return [
        MarkSet(
            author=author,
            group=group,
            tile=tile,
            epoch=epoch,
            seq=seq,
            cells=cells[2 * first : 2 * end],
            kinds=kinds[first:end],
            paces=paces[4 * first : 4 * end],
            stamps_ns=stamps_ns[8 * first : 8 * end],
            untils_ns=untils_ns[8 * (until - end + first) : 8 * until] if ending else b"",
        )
        for tile, epoch, seq, ending, first, end, until in rows
    ]
