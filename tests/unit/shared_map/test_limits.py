"""Quotas: an author that exceeds its budget waits, loses nothing and delays no other author."""

import numpy as np
import pytest
from support.map_strategies import set_of
from support.swarm_model import SwarmModel, hold_the_same

from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import _NAME_AT_MOST, THROTTLED
from shared_map.replication.author_limits import _MAX_WAITING, _TURNS, Capacity, Quota
from shared_map.replication.replica_sync import MapSync
from swarm.clock import NS_PER_S
from swarm.config.scenario import MapConfig, Scenario
from swarm.wire.messages.map_data import MarkKind, MarkSet
from swarm.wire.topics import NOTE

_EMPTY = {name: getattr(set_of("a", 0, 1, {}), name) for name in MarkSet.__struct_fields__}


def test_an_author_that_overdraws_its_budget_waits_until_it_has_filled_up_and_others_do_not() -> None:
    quota = Quota(author_marks_per_s=10)
    loud, calm = set_of("loud", 0, 1, {}), set_of("calm", 0, 1, {})
    assert quota.admits(loud, 0)
    quota.charge("loud", 150, 0)  # of ten seconds' worth: 50 too many
    assert not quota.admits(loud, NS_PER_S)
    assert quota.admits(calm, NS_PER_S)
    assert quota.throttled == ["loud"]
    assert next(quota.due(5 * NS_PER_S), None) is None
    assert next(quota.due(6 * NS_PER_S)) == loud
    assert next(quota.due(6 * NS_PER_S), None) is None
    assert quota.throttled == []


def test_sets_that_change_nothing_use_up_the_budget_as_sets_of_one_mark_do() -> None:
    quota = Quota(author_marks_per_s=10)
    for _ in range(99):
        quota.charge("loud", 0, 0)
    assert quota.admits(set_of("loud", 0, 1, {}), 0)
    quota.charge("loud", 0, 0)
    assert not quota.admits(set_of("loud", 0, 1, {}), 0)


def test_a_larger_set_in_place_of_an_old_one_is_refused_beyond_the_bounds_and_a_smaller_one_never() -> None:
    one, two, more = (set_of("a", 0, 1, dict.fromkeys(range(n), (0, 1.0, 1))) for n in (1, 2, 3))
    capacity = Capacity(max_marks=8)  # two for one process
    assert capacity.take(one, None)
    assert not capacity.take(more, one)
    assert (capacity.sets, capacity.marks) == (1, 1)
    assert capacity.take(two, one)
    assert not capacity.take(more, two)
    assert capacity.take(more, two, own=True)
    assert capacity.take(two, more)
    assert (capacity.sets, capacity.marks) == (1, 2)


def test_of_a_waiting_tile_only_the_newest_set_is_kept() -> None:
    quota = Quota(author_marks_per_s=1)
    quota.charge("loud", 100, 0)
    for seq in (3, 9, 5):
        assert not quota.admits(set_of("loud", 0, seq, {}), 0)
    assert list(quota.due(1000 * NS_PER_S)) == [set_of("loud", 0, 9, {})]


def test_budgets_that_are_full_again_are_forgotten() -> None:
    quota = Quota(author_marks_per_s=1)
    quota.charge("a", 1, 0)
    quota.forget(59 * NS_PER_S)
    assert list(quota._owners) == ["a"], "it may have been counted just now"
    quota.forget(100 * NS_PER_S)
    assert quota._owners == {}


def test_a_process_gains_nothing_by_writing_under_many_generations() -> None:
    quota = Quota(author_marks_per_s=10, total_marks_per_s=100)
    for generation in range(4):
        assert quota.admits(set_of(f"all.a0.{generation}", 0, 1, {}), 0)
        quota.charge(f"all.a0.{generation}", 30, 0)
    assert not quota.admits(set_of("all.a0.9", 0, 1, {}), 0)
    assert not quota.admits(set_of("all.a0.8", 0, 1, {}), 0)
    assert quota.throttled == ["all.a0"]
    assert quota.admits(set_of("all.a1.9", 0, 1, {}), 0)
    assert list(quota.due(100 * NS_PER_S)) == [set_of("all.a0.9", 0, 1, {}), set_of("all.a0.8", 0, 1, {})]
    capacity = Capacity(max_sets=8, max_marks=100)
    taken = [capacity.take(set_of(f"all.a0.{generation}", generation, 1, {}), None) for generation in range(8)]
    assert taken == [True, True] + 6 * [False]
    assert capacity.full_for("all.a0.99")
    assert capacity.take(set_of("all.a1.1", 0, 1, {}), None)
    for generation in range(2):
        capacity.free(set_of(f"all.a0.{generation}", generation, 1, {}))
    assert capacity.take(set_of("all.a0.9", 0, 1, {}), None)


@pytest.mark.parametrize("owners", [1, 9])
def test_what_waits_is_bounded_for_one_process_and_for_all(owners: int) -> None:
    quota = Quota(author_marks_per_s=1)
    for owner in range(owners):
        quota.charge(f"all.a{owner}.1", 100, 0)
    at_most = _MAX_WAITING // 4 if owners == 1 else _MAX_WAITING
    for tile in range(_MAX_WAITING // 4 + 10):
        for owner in range(owners):
            assert not quota.admits(MarkSet(**_EMPTY | {"author": f"all.a{owner}.1", "tile": tile}), 0)
    waited = 0
    while more := sum(1 for _ in quota.due(10_000 * NS_PER_S)):
        waited += more
    assert waited == at_most
    assert quota.throttled == []


def test_of_all_together_only_who_exceeds_its_share_waits() -> None:
    quota = Quota(author_marks_per_s=1000, total_marks_per_s=100)
    for name in ("loud", "calm"):
        assert quota.admits(set_of(name, 0, 1, {}), 0)
    quota.charge("calm", 10, 0)
    quota.charge("loud", 3000, 0)  # all are allowed 1,000 in ten seconds
    for second in range(2, 40):
        now_ns = second * NS_PER_S
        assert not quota.admits(set_of("loud", 0, second, {}), now_ns), second
        assert quota.admits(set_of("calm", 0, second, {}), now_ns), second
        quota.charge("calm", 40, now_ns)
        assert quota.throttled == ["loud"]


def test_what_others_leave_of_the_total_may_be_used() -> None:
    quota = Quota(author_marks_per_s=1000, total_marks_per_s=100)
    for second in range(100):
        now_ns = second * NS_PER_S
        for name, marks in (("busy", 90), ("calm", 1)):
            assert quota.admits(set_of(name, 0, second, {}), now_ns), (name, second)
            quota.charge(name, marks, now_ns)


def test_two_that_wait_take_turns() -> None:
    quota = Quota(author_marks_per_s=10)
    for name in ("a", "b"):
        quota.charge(name, 101, 0)
        for tile in range(3):
            quota.admits(set_of(name, tile, 1, {}), 0)
    assert [each.author for each in quota.due(100 * NS_PER_S)] == ["a", "b"] * 3


def test_many_invented_names_that_wait_are_looked_at_over_several_ticks_and_a_true_one_has_its_turn() -> None:
    quota = Quota(author_marks_per_s=20_000)
    for n in range(5000):
        quota.charge(f"all.a{n}.1", 200_001, 0)
    quota.charge("all.x.1", 10**9, 0)  # with all names that are new from now on
    for name in (*(f"x{n}" for n in range(12_000)), "a0"):
        assert not quota.admits(set_of(f"all.{name}.1", 0, 1, {}), 0)
    assert [len(list(quota.due(NS_PER_S))) for _ in range(95)] == [0] * (12_000 // _TURNS) + [1, 0]


def test_authors_that_are_gone_are_compared_with_digests_of_keepers_by_turns_over_several_ticks() -> None:
    swarm = SwarmModel()
    sync = swarm.listener("p").sync
    sync.replica.merge([set_of(f"all.q{n}.1", n % 4, 1, {1: (1, 0.0, 1)}) for n in range(2500)])
    swarm.run(20)
    sync._offers_left, compared = 256, []
    for most in (1024, 1024, 452, 1024):
        compared.append(sync._next_silent(swarm.now_ns))
        assert len(compared[-1]) == most
        swarm.run(0.1)
    assert [name for each in compared[:3] for name in each] == [f"all.q{n}.1" for n in range(2500)]


def test_few_authors_are_named_whichever_names_come_later(monkeypatch: pytest.MonkeyPatch) -> None:
    keeper = SwarmModel().keeper("keeper", KeeperStore(":memory:"))
    for n in reversed(range(50)):
        monkeypatch.setattr(MapSync, "throttled", [f"a{each:02}" for each in range(n, 50)])
        keeper._name_throttled(NS_PER_S)
        assert len(keeper._named) == min(50 - n, _NAME_AT_MOST)


def test_a_loud_author_is_named_and_late_but_loses_nothing_and_holds_no_one_up() -> None:
    swarm = SwarmModel(scenario=Scenario(map=MapConfig(author_marks_per_s=20)))
    keeper = swarm.keeper("keeper", KeeperStore(":memory:"))
    keeper._sync._quota = Quota(20)
    notes: list[str] = []
    swarm.network.bus("ear").subscribe(NOTE, lambda event: notes.append(event.message.text))
    loud, calm, listener = swarm.writer("loud.1"), swarm.writer("calm.1"), swarm.listener("p")
    swarm.run(1)
    cells = np.arange(40 * 70)
    for kind in (MarkKind.LETHAL, MarkKind.CLEAR):
        loud.sync.publish(loud.replica.write(cells, kind, 0.0, swarm.now_ns))
        swarm.run(0.2)
    calm.sync.publish(calm.replica.write([5], MarkKind.LETHAL, 0.0, swarm.now_ns))
    swarm.run(1)
    assert listener.sync.throttled == ["loud"]
    assert "calm.1" in listener.replica.held.ledger.held()
    assert keeper.counters.gauges[THROTTLED + "loud"] == 1
    assert notes == ["author loud exceeds its quota; its marks are delayed"]
    assert [(each.kind, each.about, each.over_ns) for each in keeper._member.alarms.current()] == [
        ("quota", "loud", None)
    ]
    swarm.run(400)
    assert listener.sync.throttled == []
    assert [each.over_ns is None for each in keeper._member.alarms.current()] == [False]
    assert THROTTLED + "loud" not in keeper.counters.gauges
    assert hold_the_same([listener, loud, keeper])
