"""A member of a shard: what it promises and stores, and how it becomes leader."""

import msgspec
from msgspec.structs import replace
from support.shard_tables import MEMBERS, SHARDS, S, host_state, near_members, table_of

from swarm.right_of_way.generations import HEARTBEAT_NS
from swarm.right_of_way.shard_member import Member, Refused, Save
from swarm.wire.fields import MOST_IDS
from swarm.wire.messages.traffic import Granted, Held, Stand, Stored, Table


def member_of(n: int = 0, promised: int = 0) -> Member:
    return Member(SHARDS, MEMBERS[n], promised, table_of(0, 0), {}, 0, near_members())


def test_after_a_promise_nothing_older_is_stored() -> None:
    member = member_of()
    assert isinstance(member.hear_table(table_of(1, 1), 0)[0], Save)
    assert member.on_file == Stored(shard=0, agent=MEMBERS[0], epoch=1, seq=1)
    assert member.hear_claim(5, S // 10) == []  # the leader was heard just now
    assert isinstance(member.hear_claim(5, 2 * S)[0], Save)
    assert member.hear_claim(5, 9 * S) == []
    assert member.hear_table(table_of(1, 2), 2 * S) == [Stored(shard=0, agent=MEMBERS[0], epoch=5, seq=0)]
    assert member.stored.stamp == (1, 1)
    assert member.hear_table(table_of(5, 1), 2 * S)[-1] == Stored(shard=0, agent=MEMBERS[0], epoch=5, seq=1)


def test_the_second_member_says_what_the_first_has_not_said_and_something_in_each_heartbeat() -> None:
    first, second = member_of(2), member_of(0)  # of epoch 1
    said = first.hear_table(table_of(1, 1), S)
    assert [type(action) for action in said] == [Save, Stored]
    assert [type(action) for action in second.hear_table(table_of(1, 1), S)] == [Save]
    assert second.tick(S) == [second.on_file]  # it has not heard the first
    second.hear_table(table_of(1, 2), S)
    second.hear_stored(Stored(shard=0, agent=MEMBERS[2], epoch=1, seq=2), S)
    assert second.tick(S) == []
    assert second.tick(S + HEARTBEAT_NS) == [Stored(shard=0, agent=MEMBERS[0], epoch=1, seq=2)]
    assert second.tick(2 * S) == []
    second.hear_table(table_of(1, 2), 2 * S)  # the leader tells it again
    assert second.tick(2 * S) == [second.on_file]


def leader_that_told(fleets: dict[str, list[str]]) -> tuple[Member, Table]:
    """A member that has just become leader, and the table that it sent, which no member has stored yet."""
    member = Member(SHARDS, MEMBERS[0], 0, table_of(0, 0, a0=[9]), fleets, 0, near_members())
    member.hear_host_state(host_state("a0", [(9, 0, 1)], seq=1), 2 * S)
    claim = member.tick(2 * S)[0]
    member.hear_promise(MEMBERS[1], claim.promised, table_of(0, 0), 2 * S)
    member.hear_host_state(host_state("a0", [(9, 0, 1)], seq=2), 2 * S)
    (_, table) = member.tick(2 * S)
    assert isinstance(table, Table)
    return member, table


def test_members_that_answer_are_told_what_has_changed_since_the_table_that_all_of_them_have() -> None:
    member, table = leader_that_told({"a0": ["a0-00"]})
    now_ns = 2 * S
    for stored, base in (
        ((table.seq, None), table),  # the third has not said anything: it does not count
        ((table.seq, table.seq), table),
        ((table.seq, table.seq - 1), None),  # it has lost its table, or its word was late
        ((None, table.seq), table),
    ):
        now_ns += HEARTBEAT_NS
        member.hear_host_state(host_state("a0", [(9, 0, 1)], seq=now_ns), now_ns)
        for other, seq in zip(MEMBERS[1:], stored, strict=True):
            if seq is not None:
                member.hear_stored(Stored(shard=0, agent=other, epoch=table.epoch, seq=seq), now_ns)
        told = table if base is None else table.changes(base)
        assert [each for each in member.tick(now_ns) if not isinstance(each, Granted)] == [told]
    now_ns += 2 * HEARTBEAT_NS
    member.hear_host_state(host_state("a0", [(9, 0, 1)], seq=now_ns), now_ns)
    assert member.tick(now_ns) == [table]  # no member has answered


def test_changes_are_answered_as_the_table_that_they_stand_for() -> None:
    first, second = member_of(2), member_of(0)  # of epoch 1
    tables = [table_of(1, 3, a1=[2]), table_of(1, 4, a0=[1], a1=[2, 3]), table_of(1, 5, a0=[1])]
    tables[2] = replace(tables[2], hosts={**tables[1].hosts, **tables[2].hosts})
    changes = tables[1].changes(tables[0])
    lacks = [Stored(shard=0, agent=MEMBERS[2], epoch=0, seq=0)]
    assert first.hear_table(changes, S) == lacks  # it needs the whole table
    first.hear_table(tables[0], S)
    assert first.hear_table(changes, S) == [Save(1, tables[1]), first.on_file]
    assert first.hear_table(changes, S) == [first.on_file]
    assert first.hear_table(tables[2].changes(tables[0]), S) == [Save(1, tables[2]), first.on_file]  # an older base
    assert first.hear_table(changes, S) == []  # it came late
    second.hear_table(tables[1], S)
    assert second.tick(S) == [second.on_file]
    second.hear_stored(Stored(shard=0, agent=MEMBERS[2], epoch=1, seq=4), 2 * S)
    assert second.hear_table(tables[1].changes(tables[1]), 2 * S) == []
    assert second.tick(2 * S) == [second.on_file]


def test_changes_of_a_later_epoch_end_a_leader_and_those_of_an_earlier_epoch_are_told_so() -> None:
    member, table = leader_that_told({"a0": ["a0-00"]})
    later = next(
        epoch for epoch in range(table.epoch + 1, table.epoch + 3) if SHARDS.leader(0, epoch) == MEMBERS[1]
    )
    changes = table_of(later, 7).changes(table_of(later, 6))
    assert member.hear_table(changes, 2 * S) == [member.on_file]
    assert member.leader is None
    of_another_epoch = replace(changes, since=member.stored.stamp)
    assert member.hear_table(of_another_epoch, 2 * S) == [member.on_file]
    member = member_of(promised=5)
    old = table_of(1, 7).changes(table_of(1, 6))
    assert member.hear_table(old, S) == [Stored(shard=0, agent=MEMBERS[0], epoch=5, seq=0)]


def test_changes_make_no_table_that_is_larger_than_a_message_may_be() -> None:
    base = table_of(1, 3, **{f"a{n}": [n] for n in range(3)})
    more = replace(table_of(1, 4), hosts={f"h{n}": (1, 1) for n in range(MOST_IDS - 2)}, since=base.stamp)
    assert more.whole({base.stamp: base}) is None


def test_an_epoch_has_one_leader_only_though_a_promise_comes_twice() -> None:
    member = member_of()
    member.hear_host_state(host_state("a1", [(9, 0, 1)], seq=1), 2 * S)
    save = member.tick(2 * S)[0]
    member.hear_promise("a stranger", save.promised, table_of(0, 0), 2 * S)
    assert member.leader is None
    member.hear_promise(MEMBERS[1], save.promised, table_of(0, 0), 2 * S)
    first = member.leader
    assert first is not None
    member.hear_host_state(host_state("a1", [(9, 0, 1)], seq=3), 3 * S)
    member.tick(3 * S)  # no member has acknowledged anything: it resigns
    assert member.leader is None
    member.hear_promise(MEMBERS[1], save.promised, table_of(0, 0), 3 * S)
    assert member.leader is None


def test_an_epoch_that_is_implausibly_far_ahead_is_refused_and_named() -> None:
    member = member_of()
    assert isinstance(member.hear_claim(1 << 60, S)[0], Refused)
    far = next(epoch for epoch in range(1 << 60, (1 << 60) + 3) if SHARDS.leader(0, epoch) != MEMBERS[0])
    assert isinstance(member.hear_table(table_of(far, 1), S)[0], Refused)
    assert member.promised == 0


def test_what_a_table_grants_is_told_once_two_of_three_members_have_stored_it() -> None:
    fleets = {"a0": ["a0-00"], "a1": ["a1-00"]}
    member = Member(SHARDS, MEMBERS[0], 0, table_of(0, 0, a0=[9], a1=[18]), fleets, 0, near_members())
    member.hear_host_state(host_state("a0", [(9, 0, 1)], seq=1), 2 * S)
    claim = member.tick(2 * S)[0]
    member.hear_promise(MEMBERS[1], claim.promised, table_of(0, 0), 2 * S)
    wants = [Stand("a0-00", 9, 9, Held.of([(9, 0, 1)]), [], [18, 10], 2, 0)]
    member.hear_host_state(host_state("a0", [(9, 0, 1)], seq=2, vehicles=wants), 2 * S)
    (_, table) = member.tick(2 * S)
    stored = Stored(shard=0, agent=MEMBERS[1], epoch=table.epoch, seq=table.seq)
    for too_old in (msgspec.structs.replace(stored, seq=0), msgspec.structs.replace(stored, epoch=0)):
        assert member.hear_stored(too_old, 2 * S) == []
    (granted,) = member.hear_stored(stored, 2 * S)  # only a0 has spoken
    assert (granted.host, granted.stamp, granted.heard) == ("a0", table.stamp, 2)
    assert [*granted.grants["a0-00"].cells] == [9, 10]
    assert granted.occupied == [18]
    assert member.hear_stored(stored, 2 * S) == []  # told just now
    assert [type(each) for each in member.hear_stored(stored, 2 * S + HEARTBEAT_NS)] == [Granted]
