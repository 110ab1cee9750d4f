"""Digests: equal holdings give equal bytes, and a difference names exactly the newer sets."""

from typing import Any
from unittest import mock

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from shared_map.replication.digest import Ledger, PendingDigests, fingerprint, parts_of
from swarm.clock import NS_PER_S
from swarm.wire.messages.map_data import DIGEST_ROW, Digest

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


tables = st.dictionaries(
    st.sampled_from(["a", "b.1", "keeper.k", "z" * 64]),
    st.sets(st.integers(0, (1 << 22) - 1), max_size=40),
    max_size=4,
)


@given(tables, tables, st.integers(100, 400))
def test_the_parts_of_a_digest_name_each_set_once_and_between_them_cover_everything(ours, theirs, most_bytes):
    """Parts show the same to be missing on their side as the whole digest does."""
    ledger, kept = Ledger(), Ledger()
    for filled, table in ((ledger, ours), (kept, theirs)):
        for author, tiles in table.items():
            for tile in tiles:
                filled.record(author, tile, 1, 7)
    held = kept.held()
    parts = list(parts_of(held, most_bytes))
    joined: dict[str, bytes] = {}
    for part, _, _ in parts:
        assert sum(80 + len(rows) for rows in part.values()) <= most_bytes
        for author, rows in part.items():
            joined[author] = joined.get(author, b"") + rows
    assert joined == held
    assert [after for _, after, _ in parts[1:]] == [until for _, _, until in parts[:-1]]
    assert parts[0][1] is None
    assert parts[-1][2] is None
    lacking = [
        (author, tile)
        for part, after, until in parts
        for author, tiles in ledger.ahead(part, ledger.authors, after, until)
        for tile in tiles
    ]
    whole = [(author, tile) for author, tiles in ledger.ahead(held, ledger.authors) for tile in tiles]
    assert sorted(lacking) == sorted(whole)
    assert len(lacking) == len(set(lacking))


def digest_of(sender: str, authors: int = 1, rows: int = 1, **fields: Any) -> Digest:
    stated = np.array([(tile, 1, 1) for tile in range(rows)], DIGEST_ROW).tobytes()
    held = {f"{sender}{n or ''}": stated for n in range(authors)}
    return Digest(author=sender, role="agent", held=held, **fields)


def compared_before(pending: PendingDigests, sender: str, now_ns: int) -> tuple[int, int]:
    """Comparisons and ticks until a sender's first digest is compared."""
    compared = 0
    for tick in range(100_000):
        for each in list(pending.due(now_ns)):
            if each.digest.author == sender:
                return compared, tick
            compared += 1
            pending.compared(each, True, now_ns)
    raise AssertionError("never")


def test_a_tick_compares_a_bounded_number_of_rows_whatever_waits() -> None:
    pending = PendingDigests()
    for n in range(300):
        pending.add(digest_of(f"keeper.q{n}.1", authors=500), 0)
        pending.add(digest_of(f"a{n}.1", rows=3000), 0)
    now_ns, ticks = NS_PER_S, 0
    while due := list(pending.due(now_ns)):
        assert sum(each.cost for each in due[:-1]) <= 1024
        ticks += 1
        for each in due:
            pending.compared(each, True, now_ns)
    assert ticks > 100
    assert pending._bytes == 0


def test_senders_that_were_made_up_later_delay_none_that_was_there_before() -> None:
    pending = PendingDigests()
    pending.add(digest_of("all.a0.1"), 0)
    [mine] = pending.due(NS_PER_S)
    pending.compared(mine, True, NS_PER_S)
    for n in range(5000):
        pending.add(digest_of(f"keeper.q{n}.1", authors=100), NS_PER_S)
    assert pending.add(digest_of("all.a0.1"), NS_PER_S)
    assert not pending.add(digest_of("all.a1.1"), NS_PER_S)
    assert compared_before(pending, "all.a0.1", 2 * NS_PER_S) == (0, 0)
    assert len(pending._senders) <= 4096
    assert pending.add(digest_of("all.a1.1"), 100 * NS_PER_S)  # the others have been silent


def test_a_sender_of_many_parts_takes_turns_with_others() -> None:
    pending = PendingDigests()
    for n in range(200):
        pending.add(digest_of("keeper.q.1", authors=400, whole=False, after=(f"q{n}", 0)), 0)
    assert len(pending._senders["keeper.q.1"].pending) == 128
    pending.add(digest_of("all.a0.1"), 0)
    assert compared_before(pending, "all.a0.1", NS_PER_S) == (1, 0)
