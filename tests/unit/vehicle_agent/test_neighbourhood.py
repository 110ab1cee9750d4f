"""Whom an agent takes for alive, and what it follows as its vehicles drive."""

from __future__ import annotations

from swarm.config.load import parse_scenario
from swarm.grid import GridSpec
from swarm.liveness import Peer
from swarm.wire.messages.vehicles import Reservations, TerritoryRequest
from vehicle_agent.traffic.live_peers import LivePeers
from vehicle_agent.traffic.neighbourhood import Change, Neighbourhood
from vehicle_agent.traffic.right_of_way import RightOfWay
from vehicle_agent.traffic.territory import Territory

S = 1_000_000_000
GRID = GridSpec(256, 2048, 10.0)
SCENARIO = parse_scenario("[[groups]]\nvehicles = 2\n")


def test_an_agent_whose_token_fell_is_waited_for_half_a_second_more_and_no_reply_of_it_counts() -> None:
    peers = LivePeers(lease_ns=S)
    peers.appeared(Peer("agent", "b", 7))
    peers.disappeared(Peer("agent", "b", 7), 10 * S)
    assert (peers.agents_up, peers.agents) == ({}, {"b": 0})
    assert not peers.expire(10 * S + S // 2 - 1)
    assert peers.expire(10 * S + S // 2)
    assert peers.agents == {}


def test_an_agent_that_is_back_within_its_grace_period_counts_as_it_is_now() -> None:
    peers = LivePeers(lease_ns=S)
    peers.appeared(Peer("agent", "b", 7))
    peers.disappeared(Peer("agent", "b", 7), 10 * S)
    peers.appeared(Peer("agent", "b", 8))
    assert peers.agents == peers.agents_up == {"b": 8}
    assert not peers.expire(99 * S)


def test_the_earlier_token_of_an_agent_that_lives_again_may_fall_late() -> None:
    peers = LivePeers(lease_ns=S)
    peers.appeared(Peer("agent", "b", 7))
    peers.appeared(Peer("agent", "b", 8))
    peers.disappeared(Peer("agent", "b", 7), 10 * S)
    assert peers.agents == peers.agents_up == {"b": 8}


def test_a_planner_is_gone_at_once() -> None:
    peers = LivePeers(lease_ns=S)
    peers.appeared(Peer("planner", "t", 3))
    assert peers.planners == {"t": 3}
    peers.disappeared(Peer("planner", "t", 3), S)
    assert (peers.planners, peers.agents) == ({}, {})


def test_tokens_are_trusted_a_lease_after_our_own_link_is_up() -> None:
    peers = LivePeers(lease_ns=S)
    assert peers.trusted(0)
    peers.link_changed(up=False, beyond=False, now_ns=10 * S)
    assert not peers.trusted(99 * S)
    peers.link_changed(up=True, beyond=True, now_ns=20 * S)
    assert not peers.trusted(99 * S)
    peers.link_changed(up=True, beyond=False, now_ns=30 * S)
    assert not peers.trusted(31 * S - 1)
    assert peers.trusted(31 * S)


# --- what it follows ----------------------------------------------------------------------------------------


def neighbourhood(agent: str) -> Neighbourhood:
    territory = Territory(agent, 1, GRID, [])
    rights = RightOfWay(agent, 1, {"a": {"u": 0}, "b": {"v": 1}}, territory)
    found = Neighbourhood(GRID, SCENARIO, rights, territory)
    found.set_alive({"a": 1, "b": 1})
    return found


def test_each_change_of_place_says_once_what_to_begin_and_what_to_end() -> None:
    a = neighbourhood("a")
    first = a.follow([GRID.cell(10, 10)], 0)
    assert first.presence == Change([0], [])
    assert first.map_regions == {0}
    assert a.follow([GRID.cell(10, 10)], S).presence == Change([], [])
    assert a.follow([GRID.cell(10, 1500)], 2 * S).presence == Change([5], [0])


def test_a_neighbour_is_listened_to_from_the_answer_on_in_which_it_names_a_common_plot() -> None:
    a, b = neighbourhood("a"), neighbourhood("b")
    assert a.follow([GRID.cell(10, 10)], 0).reservations.begin == ["b"]  # of whom nothing is known yet
    question = b.follow([GRID.cell(10, 1500)], 0).question
    assert question is not None
    a.answer(question)
    assert a.follow([GRID.cell(10, 10)], S).reservations == Change([], ["b"])
    moved = b.follow([GRID.cell(10, 20)], 2 * S).question
    assert moved is not None
    b.answered(a.answer(moved), moved.seq)
    assert a.follow([GRID.cell(10, 10)], 3 * S).reservations == Change(["b"], [])


def test_who_asks_about_a_dead_agent_is_told_the_newest_that_was_heard_of_it() -> None:
    territory = Territory("a", 1, GRID, [])
    rights = RightOfWay("a", 1, {"a": {"u": 0}, "b": {"v": 1}}, territory)
    a = Neighbourhood(GRID, SCENARIO, rights, territory)
    last = Reservations(agent="b", incarnation=1, seq=9, clock=3, held={"v": [5]}, requested=[], seen={})
    rights.hear(last)
    assert a.answer(TerritoryRequest(agent="c", incarnation=1, seq=1, plots=[0], silent=["b"])).reservations == [
        last
    ]
    assert a.answer(TerritoryRequest(agent="c", incarnation=1, seq=2, plots=[0])).reservations == []
