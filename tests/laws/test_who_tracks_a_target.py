"""The owner of a target: the law of `runtime.tracker_ownership`, attacked with loss, delay, order and clocks."""

import random
from dataclasses import dataclass, field
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.makers import target_pose

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.runtime.tracker_ownership import LONGEST_AGE_NS, MOST_GENERATIONS, SAME_NS, Tracking, Trackings, Verdict
from swarm.wire.messages.planning import CELL_OF_PLACE, TargetPose

GRID = GridSpec(25, 40, 10.0)
HOUR_NS = 3600 * NS_PER_S
START_NS = 1_800_000_000 * NS_PER_S
"""True time begins at a date, as every clock shows one."""


@dataclass(eq=False)
class Tracker:
    """A tracker outside: its clock is wrong by `offset_ns`, and it tells every `period_ns`."""

    name: str | None
    began_ns: int
    offset_ns: int = 0
    period_ns: int = NS_PER_S // 2
    lease_s: float = 2.0
    seq: int = field(default=0, init=False)

    def pose(self, now_ns: int, cell: int = 5, target: str = "t", **said: Any) -> TargetPose:
        self.seq += 1
        told = {
            "tracker": self.name, "incarnation": self.began_ns + self.offset_ns, "seq": self.seq,
            "stamp_ns": now_ns + self.offset_ns, "lease_s": self.lease_s,
        }  # fmt: skip
        return target_pose(target, cell, **(told | said))


def owner_of(tracking: Tracking, now_ns: int) -> tuple[str | None, int] | None:
    owner = tracking._owner(now_ns)
    return None if owner is None else (owner.name, owner.incarnation)


offsets = st.one_of(st.sampled_from([0, HOUR_NS, -HOUR_NS]), st.integers(-HOUR_NS, HOUR_NS))


@settings(deadline=None, max_examples=few(150))
@given(st.data())
def test_receivers_agree_on_the_oldest_tracker_that_lives_whatever_each_has_heard_before(
    data: st.DataObject,
) -> None:
    """Messages are lost, late, repeated and out of order, each receiver's in its own way; then, for longer than any
    lease, each receives at least one pose of every tracker that lives."""
    chance = data.draw(st.randoms(use_true_random=False))
    names = data.draw(st.lists(st.sampled_from(["a", "b", "c", None]), min_size=1, max_size=5))
    # Ages differ by more than receivers can mistake; two generations of one name begin at different times.
    ages_s = data.draw(st.lists(st.integers(1, 400), min_size=len(names), max_size=len(names), unique=True))
    trackers = [
        Tracker(
            name,
            START_NS - 2 * age_s * NS_PER_S,
            data.draw(offsets),
            chance.choice([NS_PER_S // 10, NS_PER_S // 2]),
            chance.choice([1.0, 2.0, 5.0]),
        )
        for name, age_s in zip(names, ages_s, strict=True)
    ]
    receivers = [(Tracking(GRID), data.draw(offsets)) for _ in range(3)]
    ends_ns = {id(each): chance.choice([12, 3]) * NS_PER_S for each in trackers}
    arrivals: list[tuple[int, int, TargetPose]] = []
    for each in trackers:
        first_ns = chance.randrange(NS_PER_S)
        for at_ns in range(first_ns, ends_ns[id(each)], each.period_ns):
            pose = each.pose(START_NS + at_ns)
            for receiver in range(len(receivers)):
                if at_ns < 5 * NS_PER_S:
                    for _ in range(chance.choice([0, 0, 1, 1, 1, 2])):
                        arrivals.append((at_ns + chance.randrange(2 * NS_PER_S), receiver, pose))
                else:
                    arrivals.append((at_ns + chance.randrange(NS_PER_S // 20), receiver, pose))
    for at_ns, receiver, pose in sorted(arrivals, key=lambda each: each[:2]):
        tracking, offset_ns = receivers[receiver]
        tracking.judge(pose, START_NS + at_ns + offset_ns)
    end_ns = START_NS + 12 * NS_PER_S
    owners = {owner_of(tracking, end_ns + offset_ns) for tracking, offset_ns in receivers}
    alive = [each for each in trackers if ends_ns[id(each)] == 12 * NS_PER_S]
    assert len(owners) == 1, owners
    assert owners == {_expected(alive)}


def _expected(alive: list[Tracker]) -> tuple[str | None, int] | None:
    """By the rule itself, in true time."""
    speakers: list[Tracker] = []
    for each in alive:
        same = [other for other in alive if other.name is not None and other.name == each.name]
        if not same or max(same, key=lambda one: one.began_ns + one.offset_ns) is each:
            speakers.append(each)
    if not speakers:
        return None
    oldest = min(speakers, key=lambda each: each.began_ns)
    return oldest.name, oldest.began_ns + oldest.offset_ns


@given(offsets, offsets, offsets, st.sampled_from(["a", "z", None]))
def test_a_second_tracker_steals_no_target_while_the_first_lives_whatever_the_clocks_say(
    first_ns: int, second_ns: int, receiver_ns: int, name: str | None
) -> None:
    first = Tracker("m", START_NS, first_ns)
    second = Tracker(name, START_NS + 2 * NS_PER_S, second_ns)
    tracking = Tracking(GRID)
    for at_ns in range(0, 20 * NS_PER_S, NS_PER_S // 2):
        now_ns = START_NS + at_ns
        assert tracking.judge(first.pose(now_ns), now_ns + receiver_ns) is Verdict.COUNTS
        if now_ns >= second.began_ns:
            refused = second.pose(now_ns + 1, cell=7)
            assert tracking.judge(refused, now_ns + 1 + receiver_ns) is Verdict.REFUSED
        assert tracking.pose.cell == 5
    # The first dies: its lease ends, and the second counts from its next pose on.
    last_ns = START_NS + 20 * NS_PER_S - NS_PER_S // 2
    assert tracking.judge(second.pose(last_ns + 1), last_ns + NS_PER_S + receiver_ns) is Verdict.REFUSED
    assert tracking.judge(second.pose(last_ns + 2), last_ns + 2 * NS_PER_S + receiver_ns) is Verdict.COUNTS


@given(st.sampled_from([0.0, 1e-9, 0.5, 2.0, 60.0]))
def test_a_target_is_lost_when_the_lease_has_passed_since_the_last_arrival_and_not_before(lease_s: float) -> None:
    tracking, tracker = Tracking(GRID), Tracker("a", START_NS, lease_s=lease_s)
    assert not tracking.lost(START_NS)
    tracking.judge(tracker.pose(START_NS), START_NS)
    end_ns = START_NS + int(lease_s * NS_PER_S)
    assert not tracking.lost(end_ns - 1)
    assert tracking.lost(end_ns)
    assert tracking.age_ns(end_ns) == end_ns - START_NS
    assert tracking.pose is not None, "where it was last is kept"


def test_a_lease_of_zero_hands_the_target_over_and_what_comes_late_does_not_take_it_back() -> None:
    first, second, tracking = Tracker("a", START_NS), Tracker("b", START_NS + NS_PER_S), Tracking(GRID)
    now_ns = START_NS + 2 * NS_PER_S
    late = first.pose(now_ns)
    tracking.judge(first.pose(now_ns), now_ns)
    assert tracking.judge(second.pose(now_ns), now_ns) is Verdict.REFUSED
    first.lease_s = 0.0
    assert tracking.judge(first.pose(now_ns), now_ns) is Verdict.COUNTS
    assert tracking.judge(second.pose(now_ns), now_ns) is Verdict.COUNTS
    assert tracking.judge(late, now_ns + 1) is Verdict.LATE
    assert tracking.judge(second.pose(now_ns), now_ns + 2) is Verdict.COUNTS


def test_of_two_trackers_with_one_name_the_later_counts_until_it_is_silent() -> None:
    tracking, first, second = Tracking(GRID), Tracker("a", START_NS), Tracker("a", START_NS + NS_PER_S)
    for at_ns in range(2 * NS_PER_S, 4 * NS_PER_S, NS_PER_S // 4):
        assert tracking.judge(second.pose(START_NS + at_ns), START_NS + at_ns) is Verdict.COUNTS
        assert tracking.judge(first.pose(START_NS + at_ns), START_NS + at_ns) is Verdict.REFUSED
    assert tracking.judge(first.pose(START_NS), START_NS + 6 * NS_PER_S) is Verdict.COUNTS


def test_trackers_that_began_together_are_ordered_by_name_for_all_receivers() -> None:
    a, b, none = Tracker("a", START_NS + SAME_NS // 2), Tracker("b", START_NS), Tracker(None, START_NS)
    now_ns = START_NS + NS_PER_S
    for order in ((a, b, none), (none, b, a), (b, none, a)):
        tracking = Tracking(GRID)
        for each in order:
            tracking.judge(each.pose(now_ns), now_ns)
        assert owner_of(tracking, now_ns) == ("a", a.began_ns)


@pytest.mark.parametrize("incarnation", [0, 1, START_NS + HOUR_NS, (1 << 62) - 1])
def test_an_incarnation_that_is_no_time_gives_no_seniority(incarnation: int) -> None:
    tracker, tracking = Tracker("z", START_NS), Tracking(GRID)
    now_ns = START_NS + NS_PER_S
    tracking.judge(tracker.pose(now_ns), now_ns)
    odd = Tracker("a", 0).pose(now_ns, incarnation=incarnation)
    assert odd.stamp_ns - incarnation not in range(LONGEST_AGE_NS)
    assert tracking.judge(odd, now_ns) is Verdict.REFUSED
    # Alone it is heard all the same.
    assert Tracking(GRID).judge(odd, now_ns) is Verdict.COUNTS


@given(st.lists(st.tuples(st.integers(0, (1 << 62) - 1), st.integers(0, (1 << 62) - 1)), max_size=60))
def test_whatever_is_made_up_a_tracker_that_goes_on_is_heard_after_the_longest_lease_of_a_lie(
    lies: list[tuple[int, int]],
) -> None:
    tracking, tracker = Tracking(GRID), Tracker("a", START_NS)
    for incarnation, seq in lies:
        name = None if seq % 2 else "a"
        tracking.judge(tracker.pose(START_NS, tracker=name, incarnation=incarnation, seq=seq), START_NS)
    heard = [
        tracking.judge(tracker.pose(START_NS + at), START_NS + at) for at in range(0, 4 * NS_PER_S, NS_PER_S // 4)
    ]
    assert heard[-1] is Verdict.COUNTS
    assert len(tracking._generations) <= MOST_GENERATIONS


def test_a_flood_of_young_trackers_does_not_push_out_the_owner() -> None:
    tracking, owner = Tracking(GRID), Tracker("z", START_NS)
    now_ns = START_NS + 10 * NS_PER_S
    tracking.judge(owner.pose(now_ns), now_ns)
    for n in range(100):
        young = Tracker(None, START_NS + 2 * NS_PER_S + n)
        assert tracking.judge(young.pose(now_ns), now_ns) is Verdict.REFUSED
        assert tracking.judge(owner.pose(now_ns), now_ns) is Verdict.COUNTS
    assert len(tracking._generations) == MOST_GENERATIONS


@pytest.mark.parametrize("cell", [-2, GRID.cells, (1 << 32) - 1])
def test_a_pose_off_the_map_neither_counts_nor_keeps_its_tracker_alive(cell: int) -> None:
    trackings, tracker = Trackings(GRID), Tracker("a", START_NS)
    assert trackings.counted(tracker.pose(START_NS, cell), START_NS) is None
    assert trackings.of("t") is None
    trackings.counted(tracker.pose(START_NS), START_NS)
    now_ns = START_NS + 2 * NS_PER_S
    assert trackings.counted(tracker.pose(now_ns, cell), now_ns) is None
    assert trackings.lost(now_ns) == {"t"}


def test_made_up_targets_keep_out_no_other_once_their_leases_end() -> None:
    trackings, tracker = Trackings(GRID), Tracker("a", START_NS)
    assert trackings.counted(tracker.pose(START_NS, lease_s=60.0), START_NS) is not None
    for n in range(5000):
        trackings.counted(tracker.pose(START_NS, target=f"q{n}", lease_s=30.0), START_NS)
    pose = tracker.pose(START_NS, target="new")
    assert trackings.counted(pose, START_NS) is None
    later_ns = START_NS + 31 * NS_PER_S
    assert any(trackings.counted(pose, later_ns) is not None for _ in range(3))
    assert len(trackings.poses()) <= 4096
    assert {"t", "new"} <= trackings.poses().keys()


def test_replaying_everything_that_was_heard_changes_nothing() -> None:
    chance, tracking = random.Random(3), Tracking(GRID)
    trackers = [Tracker("a", START_NS), Tracker("b", START_NS + 5 * NS_PER_S)]
    told = [each.pose(START_NS + at_ns) for at_ns in range(0, NS_PER_S, NS_PER_S // 10) for each in trackers]
    for pose in told:
        tracking.judge(pose, START_NS)
    before = tracking.pose
    chance.shuffle(told)
    assert {tracking.judge(pose, START_NS + 1) for pose in told} == {Verdict.LATE}
    assert tracking.pose is before


def test_a_pose_that_comes_late_does_not_make_its_tracker_younger() -> None:
    first, second, tracking = Tracker("z", START_NS), Tracker("a", START_NS + 2 * NS_PER_S), Tracking(GRID)
    for at_ns in range(3 * NS_PER_S, 9 * NS_PER_S, NS_PER_S // 2):
        late_ns = 0 if at_ns == 3 * NS_PER_S else 7 * NS_PER_S // 5
        arrives_ns = START_NS + at_ns + late_ns
        assert tracking.judge(first.pose(START_NS + at_ns), arrives_ns) is Verdict.COUNTS
        assert tracking.judge(second.pose(arrives_ns), arrives_ns) is Verdict.REFUSED


@given(st.floats(-50, 450), st.floats(-300, 50))
def test_a_pose_without_a_cell_is_in_the_cell_of_its_place_or_outside(x_m: float, y_m: float) -> None:
    trackings, tracker = Trackings(GRID), Tracker("a", START_NS)
    pose = tracker.pose(START_NS, CELL_OF_PLACE, x_m=x_m, y_m=y_m)
    counts = trackings.counted(pose, START_NS)
    if counts is None:
        assert not (0 <= x_m < 400 and -250 < y_m <= 0)
        return
    middle_x_m, middle_y_m = GRID.centre_m(counts.cell)
    assert max(abs(x_m - middle_x_m), abs(y_m - middle_y_m)) <= 5.0
    assert counts == msgspec.structs.replace(pose, cell=counts.cell)
