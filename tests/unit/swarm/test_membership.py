"""Processes of different runs or terrains refuse each other with a sentence."""

import msgspec
import pytest
from support.makers import run_info
from support.swarm_model import SwarmModel

from swarm.bus.bus import Event, LinkChanged
from swarm.errors import RunMismatchError
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.runtime.membership import NO_RUN, Member, check_belongs
from swarm.wire.topics import NOTE, RUN, STATS

INFO = run_info(
    GridSpec(4, 5, 90.0), run_id="r1", role="planner", id="t0", incarnation=7, scenario="demo", terrain="aaaa"
)


class Node:
    """A process that is nothing but a member."""

    def __init__(self, world: SwarmModel, **changes: object) -> None:
        self.world = world
        self.info = msgspec.structs.replace(INFO, **changes)
        self.bus = world.bus(self.info.id)
        self.member = Member(self.info, self.bus, self.post)
        self.rest: list[Event] = []
        self.failure: RunMismatchError | None = None

    def join(self) -> None:
        """Joins, and has all answers."""
        self.member.join()
        self.world.settle()

    def post(self, event: Event) -> None:
        try:
            if not self.member.on_member_event(event):
                self.rest.append(event)
        except RunMismatchError as error:
            self.failure = error


ROUTER = {"role": "router", "id": "0", "run_id": NO_RUN, "terrain": "", "rows": 0}


@pytest.fixture
def world() -> SwarmModel:
    return SwarmModel()


@pytest.mark.parametrize(
    "members",
    [
        [{"id": id} for id in ("t0", "t1", "t2")],
        [{"id": f"t{wire}", "wire_version": wire} for wire in (8, 9)],  # neighbouring builds
        [ROUTER, {"id": "t0"}, {"id": "t1"}],  # a router belongs to no run
        [{"id": "t0"}, {"role": "agent", "id": "a0", "incarnation": 9, "started_ns": 5}],
    ],
)
def test_members_of_one_run_get_along(members, world):
    nodes = [Node(world, **each) for each in members]
    for node in nodes:
        node.join()
    assert [node.failure for node in nodes] == [None] * len(nodes)
    assert ROUTER in members or not any(node.rest for node in nodes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"run_id": "r2", "scenario": "other"},
            "planner t1 belongs to run r2, but planner t0 in the same namespace belongs to run r1 (scenario ",
        ),
        (
            {"terrain": "bbbb", "rows": 8},
            "planner t1 has terrain bbbb (8 x 5), but planner t0 has aaaa (4 x 5): terrain files or ",
        ),
        (
            {"wire_version": 10},
            "planner t1 speaks wire version 10, but planner t0 speaks 8: only neighbouring versions share a run",
        ),
        (
            {"shard_cells": 1024},
            "planner t1 has shards of right of way of 1024 cells a side, but planner t0 has 256: map.shard",
        ),
        (
            {"traffic_parts": 3},
            "planner t1 has 3 cells of right of way across a cell of the terrain, but planner t0 has 1: map.",
        ),
        (
            {"classes": ["truck", "walker"]},
            "planner t1 has the classes of vehicles truck, walker, but planner t0 has none: marks name classes by",
        ),
    ],
)
def test_one_that_does_not_belong_ends_with_a_sentence_and_the_others_go_on(changes, words, world):
    first, stranger = Node(world), Node(world, id="t1", **changes)
    first.join()
    stranger.join()
    assert str(stranger.failure).startswith(words)
    assert stranger.failure.exit_code == 5
    assert first.failure is None


def test_a_router_that_answers_first_hides_no_other_run():
    router, foreign = (msgspec.structs.replace(INFO, **each) for each in (ROUTER, {"run_id": "r2"}))
    with pytest.raises(RunMismatchError, match="run r2"):
        check_belongs(INFO, [router, foreign])
    check_belongs(INFO, [foreign, router, INFO])


def test_of_two_that_start_at_once_at_least_one_notices(world):
    one, other = Node(world), Node(world, id="t1", run_id="r2")
    one.member.join()
    other.join()
    assert one.failure or other.failure


def test_who_meets_only_after_a_cut_heals_is_checked_then(world):
    one, other = Node(world), Node(world, id="t1", run_id="r2")
    world.cut(other.bus)
    one.member.join()
    other.join()
    assert one.failure is None
    assert other.failure is None
    world.heal(other.bus)
    world.settle()
    assert other.failure is not None
    assert LinkChanged(True) in other.rest


def test_who_sees_a_router_appear_compares_again_but_does_not_take_its_own_link_to_be_up(world):
    node = Node(world)
    node.join()
    routers, questions = world.bus("r"), []
    world.bus("counts").serve(RUN, questions.append, role="agent", id="x")
    for n in range(150):  # names cost a sender nothing
        routers.declare_alive(Peer("router", f"{n // 75}", n))
        node.member.tick(world.now_ns)
        world.run(0.2)
    assert node.rest == [LinkChanged(up=True, beyond=True)] * len(questions)
    assert 4 <= len(questions) <= 7  # in 30 s, and each of them half as often as the one before


def test_counters_are_told_once_a_second_and_at_the_end():
    world, heard = SwarmModel(), []
    node = Node(world)
    world.bus("watcher").subscribe(STATS, heard.append)
    node.member.join()
    node.member.counters.count("marks", 3)
    node.member.counters.observe("tick_ms", 2.0)
    for _ in range(25):
        node.member.tick(world.now_ns)
        world.run(0.1)
    node.member.publish_stats(world.now_ns)
    world.settle()
    assert len(heard) == 4
    last = heard[-1].message
    assert (last.role, last.id, last.incarnation) == ("planner", "t0", 7)
    assert last.counts["marks"] == 3
    assert last.counts["messages_out"] >= 3
    assert sum(last.histograms["tick_ms"].values()) == 1


def test_once_someone_has_confirmed_a_process_no_false_answer_ends_it_and_the_stranger_is_named_once():
    world, notes = SwarmModel(), []
    world.bus("watcher").subscribe(NOTE, notes.append)
    nodes = [Node(world, id=id) for id in ("t0", "t1")]
    for node in nodes:
        node.join()
    liar = Node(world, role="agent", id="zz", run_id="another", terrain="bbbb")
    liar.bus.serve(RUN, liar.post, role="agent", id="zz")
    for turn in range(3):
        world.bus("r").declare_alive(Peer("router", "0", turn + 1))  # every member asks again
        world.settle()
        for node in nodes:
            node.member.tick(world.scheduler.clock.now_ns())
    world.settle()
    assert [node.failure for node in nodes] == [None, None]
    assert [node.member.counters.counts["strangers"] for node in nodes] == [1, 1]
    assert sorted(event.message.id for event in notes) == ["t0", "t1"]
    assert "belongs to run r1, but agent zz" in notes[0].message.text


def test_a_process_that_starts_beside_a_stranger_joins_those_who_agree(world):
    first, liar = Node(world), Node(world, role="agent", id="zz", run_id="another")
    first.join()
    liar.bus.serve(RUN, liar.post, role="agent", id="zz")
    late = Node(world, id="t1")
    late.join()
    assert late.failure is None
