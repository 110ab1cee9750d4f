"""The cells that a host holds by the grants of leaders, and its requests."""

import msgspec
import pytest
from support.shard_tables import GRID, MEMBERS, SHARDS, S, entries, granted_of, hear, holdings_of, table_of

from swarm.right_of_way.generations import HEARTBEAT_NS
from swarm.right_of_way.holdings import CellRequest, Holdings
from swarm.wire.messages.traffic import Left
from swarm.wire.topics import HOST_STATE


@pytest.fixture
def holdings() -> Holdings:
    return holdings_of()


def test_no_word_of_one_generation_hides_that_of_another() -> None:
    """Both are heard under one key; no other message tells that an older one has ended."""
    assert not HOST_STATE.newest


def test_a_grant_that_is_implausibly_far_ahead_is_refused_and_named(holdings: Holdings) -> None:
    far = 3 * ((1 << 40) + 1)
    for lie in (table_of(far, 1, a0=[9]), table_of(1, 1 << 40, a0=[9])):
        hear(holdings, lie, S)
        assert "implausibly far ahead" in holdings.refused.pop()
        assert holdings._views[0].heard_ns == 0
    hear(holdings, table_of(1, 1, a0=[9]), 2 * S)
    assert (list(holdings.path("a0-00")), holdings._views[0].heard_ns) == ([9], 2 * S)


def test_a_host_takes_what_follows_its_path(holdings: Holdings) -> None:
    hear(holdings, table_of(1, 1, a0=[9]))
    assert list(holdings.path("a0-00")) == [9]
    hear(holdings, table_of(1, 2, a0=[9, *entries(1, 2, 10, 20)]))
    assert list(holdings.path("a0-00")) == [9, 10]  # 20 does not follow


def test_a_host_gives_back_what_another_waits_for_far_ahead_and_says_so_at_once(holdings: Holdings) -> None:
    holdings.keeps = 2
    cells = [8, 9, 10, 11, 12, 13, 14]
    hear(holdings, table_of(1, 1, a0=cells))
    request = {"a0-00": CellRequest()}
    holdings.host_states(request, S)
    for seq, followed, left in ((2, 10, cells), (3, 13, cells[:5])):
        table = granted_of(table_of(1, seq, a0=cells))
        holdings.hear_granted(msgspec.structs.replace(table, followed={"a1": [(followed, 1, 1)]}), S)
        assert holdings.path("a0-00") == left
    assert [word.entries for word in holdings.lefts(S)] == [[(13, 1, 1)]]
    (told,) = holdings.host_states(request, S)
    assert [*told.state.vehicles[0].holds] == [(cell, 1, 1) for cell in cells[:5]]


def test_to_have_driven_on_is_no_news_until_another_waits_or_little_is_left(holdings: Holdings) -> None:
    holdings.keeps = 2
    cells, request = [8, 9, 10, 11, 12, 13, 14], {"a0-00": CellRequest()}
    hear(holdings, table_of(1, 1, a0=cells))

    def held_by_word() -> list[int]:
        return [cell for told in holdings.host_states(request, S) for cell in told.state.vehicles[0].holds.cells]

    assert held_by_word() == cells
    holdings.moved("a0-00", 10)
    assert held_by_word() == []
    table = granted_of(table_of(1, 2, a0=cells))
    holdings.hear_granted(msgspec.structs.replace(table, followed={"a1": [(8, 1, 1)]}), S)
    assert held_by_word() == cells[2:]
    holdings.moved("a0-00", 12)
    assert held_by_word() == []
    holdings.moved("a0-00", 13)
    assert held_by_word() == cells[5:]


def test_a_host_says_what_it_has_left_to_those_who_follow_until_a_table_lists_it_no_more() -> None:
    holdings = holdings_of()
    hear(holdings, table_of(1, 1, a0=[9, 10]))
    followed = msgspec.structs.replace(granted_of(table_of(1, 2, a0=[9, 10])), followed={"a3": [(9, 1, 1)]})
    holdings.hear_granted(followed, S)
    assert holdings.lefts(S) == []
    holdings.moved("a0-00", 10)
    word = Left(agent="a0", host="a3", entries=[(9, 1, 1)])
    assert [holdings.lefts(now_ns) for now_ns in (S, S + 1, S + HEARTBEAT_NS)] == [[word], [], [word]]
    hear(holdings, table_of(1, 3, a0=[10]))
    assert holdings.lefts(9 * S) == []


def test_a_host_speaks_to_the_leader_that_it_hears_and_else_to_all_members(holdings: Holdings) -> None:
    assert [told.members for told in holdings.host_states({}, S)] == [MEMBERS]
    hear(holdings, table_of(1, 1, a0=[9]), 2 * S)
    assert [told.members for told in holdings.host_states({}, 2 * S)] == [(SHARDS.leader(0, 1),)]
    hear(holdings, table_of(1, 1, a0=[9]), 3 * S)  # told again
    assert [told.members for told in holdings.host_states({}, 3 * S)] == [(SHARDS.leader(0, 1),)]
    assert [told.members for told in holdings.host_states({}, 4 * S)] == [MEMBERS]
    hear(holdings, table_of(0, 9, a0=[9]), 5 * S)  # of one that was replaced
    assert [told.members for told in holdings.host_states({}, 5 * S)] == [MEMBERS]


@pytest.mark.parametrize("lie", [[0, -8], [-8], [56, 64], [1 << 31]])
def test_cells_from_nowhere_are_not_driven_to(lie: list[int], holdings: Holdings) -> None:
    hear(holdings, table_of(1, 1, a0=lie))
    hear(holdings, table_of(1, 2, a0=[*lie, -16]))
    assert all(0 <= cell < GRID.cells for cell in holdings.path("a0-00"))
