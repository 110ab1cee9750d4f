"""Hypothesis strategies for marks, and the merge law said the slow way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st

from shared_map.replication.mark_sets import NO_STATEMENT, Statements, mark_set, sparse
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import tile_cells
from swarm.bus.bus import Bus, Event, Heard
from swarm.config.vehicle_classes import MOST_CLASSES
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import SEQ_STEP, Digest, MarkKind, MarkSet, MarksRequest
from swarm.wire.topics import DIGEST

GRID = GridSpec(40, 70, 10.0)
"""2 x 3 tiles, those at the border cut off."""
AUTHORS = ("a1.1", "a2.1", "a2.2", "b1.1")
ZONES = ("operator.z1", "operator.z2")
"""Authors of zones, whose statements win over all others."""


def set_of(
    author: str,
    tile: int,
    seq: int,
    said: dict[int, tuple[int, float, int]],
    *,
    epoch: int = 1,
    group: str = "all",
) -> MarkSet:
    """A set of marks: cell in the tile -> (kind, pace, stamp); `seq` counts the author's own sets."""
    cells = sorted(said)
    seq *= SEQ_STEP
    return mark_set(
        author,
        group,
        tile,
        epoch,
        seq,
        Statements(
            np.array(cells, np.uint16),
            np.array([said[c][0] for c in cells], np.uint8),
            np.array([said[c][1] for c in cells], np.float32),
            np.array([said[c][2] for c in cells], np.int64),
        ),
    )


def _inside(tile: int) -> list[int]:
    """A few cells of each tile of GRID, so that authors meet."""
    window = GRID.tile_window(GRID.class_of_tile(tile)[1])
    rows, cols = window.row1 - window.row0, window.col1 - window.col0
    return [r * 32 + c for r in range(0, rows, 7) for c in range(0, cols, 5)][:6]


@st.composite
def mark_sets(draw: st.DrawFn) -> MarkSet:
    """A valid set on GRID. Stamps and numbers are small, so that ties happen all the time."""
    tile = GRID.tile_for(draw(st.integers(0, GRID.tiles - 1)), draw(st.sampled_from([0, 0, 1, 3])))
    said = draw(
        st.dictionaries(
            st.sampled_from(_inside(tile)),
            st.tuples(st.sampled_from(list(MarkKind)), st.sampled_from([0.5, 1.0, 2.0]), st.integers(0, 3)),
        )
    )
    author = draw(st.sampled_from((*AUTHORS, *ZONES)))
    group = "operator" if author in ZONES else "all"
    seq, epoch = draw(st.integers(0, 3)), draw(st.integers(1, 2))
    return set_of(author, tile, seq, said, epoch=epoch, group=group)


class Composite:
    """A cost sink that remembers the last value of each cell."""

    def __init__(self, grid: GridSpec = GRID) -> None:
        self.all_kinds = np.full((MOST_CLASSES + 1, grid.cells), MarkKind.CLEAR, np.uint8)
        self.all_paces = np.zeros((MOST_CLASSES + 1, grid.cells), np.float32)
        self.kinds, self.paces = self.all_kinds[0], self.all_paces[0]
        self.changed: list[int] = []  # cells in the last `apply`

    def apply(self, cells: np.ndarray, kinds: np.ndarray, paces: np.ndarray, class_number: int = 0) -> None:
        assert len(np.unique(cells)) == len(cells)
        self.changed = sorted(cells.tolist())
        self.all_kinds[class_number, cells] = kinds
        self.all_paces[class_number, cells] = paces

    def learn(self, words: object) -> bool:
        """Learned factors concern no cell."""
        return False

    def same(self, other: Composite) -> bool:
        return bool((self.all_kinds == other.all_kinds).all() and (self.all_paces == other.all_paces).all())


def sets_asked(replica: MapReplica, request: MarksRequest, author: str | None = None) -> list[MarkSet]:
    """The sets of a replica which a request asks for."""
    return [each for each in replica.held.asked(request, author) if each is not None]


def merge_one(replica: MapReplica, each: MarkSet) -> list[int] | None:
    """The cells whose winner a set changes, of a replica with a `Composite`; None if it is not taken in."""
    sink = replica._cost_map
    assert isinstance(sink, Composite)
    sink.changed = []
    merged = replica.merge([each])
    assert merged.changed in ([], [len(sink.changed)])
    return sink.changed if merged.sets else None


def retract(replica: MapReplica, cells: Sequence[int], now_ns: int) -> list[MarkSet]:
    """Takes back what a replica's author stated about cells, as if it had never stated it."""
    tiles, inner = tile_cells(replica.grid, np.array(cells, np.int64))
    for tile in np.unique(tiles).tolist():
        own, back = replica._own(tile), inner[tiles == tile]
        if (own.stamps_ns[back] != NO_STATEMENT).any():
            own.stamps_ns[back] = NO_STATEMENT
            replica._put_own(tile, sparse(own))
    return replica.tick(now_ns)


def naive_winners(sets: Sequence[MarkSet]) -> dict[tuple[int, int], tuple[int, float]]:
    """(tile, cell) -> (kind, pace) by the two rules, one statement at a time."""
    newest: dict[tuple[int, str], MarkSet] = {}
    for each in sets:
        held = newest.get((each.tile, each.author))
        key = (each.epoch, each.seq, each.cells, each.kinds, each.paces, each.stamps_ns)
        if held is None or key > (held.epoch, held.seq, held.cells, held.kinds, held.paces, held.stamps_ns):
            newest[each.tile, each.author] = each
    best: dict[tuple[int, int], tuple[bool, int, str, int, float]] = {}
    for (tile, author), each in newest.items():
        rows = zip(
            np.frombuffer(each.cells, "<u2").tolist(),
            each.kinds,
            np.frombuffer(each.paces, "<f4").tolist(),
            np.frombuffer(each.stamps_ns, "<i8").tolist(),
            strict=True,
        )
        for cell, kind, pace, stamp_ns in rows:
            said = (author in ZONES, stamp_ns, author, kind, pace if kind == MarkKind.PACE else 0.0)
            if (tile, cell) not in best or said[:3] > best[tile, cell][:3]:
                best[tile, cell] = said
    return {at: (kind, pace) for at, (_, _, _, kind, pace) in best.items()}


def held_winners(replica: MapReplica) -> dict[tuple[int, int], tuple[int, float]]:
    """(tile, cell) -> (kind, pace) as a replica sees it."""
    return {
        (tile, cell): (kind, pace)
        for tile in replica.held.tiles
        for cell, kind, pace in zip(*(v.tolist() for v in replica.winners(tile)[:3]), strict=True)
    }


def replica_of(sets: list[MarkSet]) -> tuple[MapReplica, Composite]:
    composite = Composite()
    replica = MapReplica(GRID, composite)
    for each in sets:
        replica.merge([each])
    return replica, composite


class Acknowledged:
    """The committed sets, by the keepers' whole digests."""

    def __init__(self, bus: Bus) -> None:
        self._committed: dict[str, bytes] | None = None
        bus.subscribe(DIGEST, self._hear)

    def _hear(self, event: Event) -> None:
        if isinstance(event, Heard) and isinstance(event.message, Digest):
            digest = event.message
            if digest.role == "keeper" and digest.whole:
                self._committed = digest.held

    def not_yet(self, author: Any) -> int | None:
        """Number of an author's sets that no keeper has committed yet; None before any keeper spoke."""
        if self._committed is None or author.replica.author is None:
            return None
        return len(author.replica.held.ahead_of(self._committed, [author.replica.author]))
