"""Digests: equal holdings give equal bytes, and a difference names exactly the newer sets."""

from __future__ import annotations

from unittest import mock

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from shared_map.replication.digest import Ledger, fingerprint
from swarm.wire.messages.map_data import DIGEST_ROW

rows = st.dictionaries(
    st.tuples(st.sampled_from("abc"), st.integers(0, 6)), st.tuples(st.integers(1, 3), st.integers(0, 3))
)
Rows = dict[tuple[str, int], tuple[int, int]]


def ledger_of(held: Rows, order: list[tuple[str, int]] | None = None) -> Ledger:
    ledger = Ledger()
    for author, tile in order or list(held):
        ledger.record(author, tile, *held[author, tile])
    return ledger


@given(rows, st.randoms(use_true_random=False))
def test_equal_holdings_give_equal_bytes_whatever_the_order(held: Rows, random: object) -> None:
    shuffled = list(held)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    a, b = ledger_of(held).held(), ledger_of(held, shuffled or None).held()
    assert a == b
    assert fingerprint(a) == fingerprint(b)


@settings(deadline=None)
@given(rows, rows)
def test_missing_and_ahead_name_exactly_what_is_newer(ours: Rows, theirs: Rows) -> None:
    ledger = ledger_of(ours)
    held = ledger_of(theirs).held()
    newer = {at for at in theirs if at not in ours or theirs[at] > ours[at]}
    for few in (64, 0, 64):  # as tuples of records, as arrays, as tuples of rows
        with mock.patch("shared_map.replication.digest._FEW", few):
            assert {(author, tile) for author, tiles in ledger.missing(held) for tile in tiles} == newer
    ahead = {(author, tile) for author, tiles in ledger.ahead(held, ["a", "b", "c"]) for tile in tiles}
    assert ahead == {at for at in ours if at not in theirs or ours[at] > theirs[at]}


def test_a_garbled_digest_with_rows_out_of_order_and_twice_is_only_read() -> None:
    ledger = ledger_of({("a", 1): (1, 5), ("a", 2): (1, 5)})
    garbled = np.array([(2, 1, 9), (1, 1, 4), (2, 1, 3), (7, 0, 0)], DIGEST_ROW).tobytes()
    assert ledger.missing({"a": garbled}) == [("a", [2, 7])]
    assert ledger.ahead({"a": garbled}, ["a"]) == [("a", [1])]


def test_a_row_recorded_again_replaces_the_older_one() -> None:
    ledger = ledger_of({("a", n): (1, 0) for n in (9, 3, 5)})
    ledger.record("a", 3, 1, 7)
    rows = np.frombuffer(ledger.held()["a"], DIGEST_ROW)
    assert rows.tolist() == [(3, 1, 7), (5, 1, 0), (9, 1, 0)]
    for tile in (9, 3, 5):
        ledger.drop("a", tile)
    assert ledger.held() == {}
