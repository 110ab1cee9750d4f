"""Target-sighted marks: set while a target is in sight; the newest wins, they end by themselves."""

import msgspec
from hypothesis import given
from hypothesis import strategies as st
from support.makers import target_pose

from launch_scripts.simulation.sample_worlds import SMALL
from launch_scripts.simulation.simulate import Simulation
from shared_map.keeper.mark_store import KeeperStore
from shared_map.replication.interest import MarkFilter
from shared_map.sightings import LONGEST_NS, Sightings, pose_of
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.peers import POSE_SILENCE_NS
from swarm.wire.messages.planning import Sighted
from swarm.wire.topics import SIGHTED
from vehicle_agent.driving.driven_vehicle import Places, Vehicle
from vehicle_agent.sensing.target_detector import SIGHTING_LASTS_NS, TargetDetector

GRID = GridSpec(40, 40, 10.0, west_m=1000.0, north_m=5000.0)


def sighted(stamp_ns, *, target="t", author="red.a0.1", seq=0, cell=7, until_ns=1000):
    group = author.partition(".")[0]
    return Sighted(
        author=author, group=group, target=target, seq=seq, stamp_ns=stamp_ns, until_ns=until_ns, cell=cell,
        x_m=0.0, y_m=0.0, uncertainty_m=5.0,
    )  # fmt: skip


some = st.builds(
    sighted,
    st.integers(0, 5),
    target=st.sampled_from(["t", "u"]),
    author=st.sampled_from(["red.a0.1", "blue.a1.1"]),
    seq=st.integers(0, 2),
    until_ns=st.integers(0, 9),
)


@given(st.lists(some, max_size=12), st.randoms(use_true_random=False))
def test_what_is_known_depends_on_neither_order_nor_repetition(told: list[Sighted], chance: object) -> None:
    # An author says one thing under one number.
    told = list({(each.target, each.author, each.stamp_ns, each.seq): each for each in told}.values())
    again = [*told, *told]
    chance.shuffle(again)  # type: ignore[attr-defined]
    one, other = Sightings(MarkFilter(GRID)), Sightings(MarkFilter(GRID))
    for each in told:
        one.receive(each, 5)
    for each in again:
        other.receive(each, 5)
    assert one.best(4) == other.best(4)
    for target, best in one.best(4).items():
        assert best.until_ns > 4
        assert best.target == target


def test_a_sighting_ends_by_itself_and_the_next_best_counts() -> None:
    seen = Sightings(MarkFilter(GRID))
    seen.receive(sighted(5, author="red.a0.1", cell=1, until_ns=10), 5)
    seen.receive(sighted(4, author="blue.a1.1", cell=2, until_ns=20), 5)
    assert seen.best(9)["t"].cell == 1
    assert seen.best(10)["t"].cell == 2
    assert seen.best(20) == {}


def test_an_author_with_a_fast_clock_outweighs_nobody_and_its_sightings_expire_all_the_same() -> None:
    seen, hour_ns = Sightings(MarkFilter(GRID)), 3600 * NS_PER_S
    assert seen.receive(sighted(hour_ns, author="red.a0.1", cell=1, until_ns=2 * hour_ns), NS_PER_S)
    assert seen.best(NS_PER_S)["t"].cell == 1
    assert seen.receive(sighted(2 * NS_PER_S, author="red.a1.1", cell=2, until_ns=hour_ns), 2 * NS_PER_S)
    assert seen.best(2 * NS_PER_S)["t"].cell == 2
    seen.expire(NS_PER_S + LONGEST_NS)
    assert seen.best(NS_PER_S + LONGEST_NS)["t"].cell == 2


def test_an_author_whose_clock_is_put_back_is_heard_again_after_the_lease() -> None:
    seen = Sightings(MarkFilter(GRID))
    seen.receive(sighted(1 << 61, cell=1, until_ns=1 << 62), 0)
    assert not seen.receive(sighted(5, seq=9, cell=2, until_ns=1 << 62), POSE_SILENCE_NS - 1)
    assert seen.receive(sighted(5, seq=9, cell=2, until_ns=1 << 62), POSE_SILENCE_NS)
    assert seen.best(POSE_SILENCE_NS)["t"].cell == 2


def test_of_a_group_that_is_not_read_nothing_is_known() -> None:
    seen = Sightings(MarkFilter(GRID, frozenset({"red"})))
    assert not seen.receive(sighted(5, author="blue.a1.1"), 5)
    assert seen.receive(sighted(4, author="red.a0.1"), 5)
    assert pose_of(seen.best(9)["t"]).seq == 4


def test_a_vehicle_tells_of_targets_in_range_and_how_sure_it_is() -> None:
    detector = TargetDetector(GRID, "red.a0.1", "red", 100.0, MarkFilter(GRID), set())
    detector.set_truth(target_pose("t", GRID.cell(10, 10), GRID), 0)
    far, near = Vehicle("u", GRID, GRID.cell(10, 30)), Vehicle("v", GRID, GRID.cell(10, 15))
    assert detector.detect(Places(GRID, [far]), 0) == []
    (told,) = detector.detect(Places(GRID, [far, near]), 0)
    assert (told.cell, told.until_ns, told.uncertainty_m) == (410, SIGHTING_LASTS_NS, 5.0 + 0.02 * 50.0)
    assert detector.detect(Places(GRID, [near]), 400_000_000) == []  # not so often
    assert len(detector.detect(Places(GRID, [near]), 500_000_000)) == 1


def test_a_planner_that_begins_anew_is_told_the_last_sighting_by_whoever_had_it_unless_it_was_a_capture() -> None:
    detector = TargetDetector(GRID, "red.a0.1", "red", 100.0, MarkFilter(GRID), set())
    near = Places(GRID, [Vehicle("v", GRID, GRID.cell(10, 15))])

    def stand(cell: int, seq: int, at_s: int, jumps: int = 0) -> None:
        detector.set_truth(target_pose("t", cell, GRID, seq=seq, jumps=jumps), at_s * NS_PER_S)

    def retold(at_s: int) -> list[Sighted]:
        detector.retell("t", at_s * NS_PER_S)
        assert detector.retold(at_s * NS_PER_S) == []
        return detector.retold((at_s + 1) * NS_PER_S)

    assert retold(0) == []
    stand(GRID.cell(10, 10), 1, 2)
    told = detector.detect(near, 2 * NS_PER_S)
    stand(0, 2, 10)
    assert retold(60) == told
    assert detector.retold(99 * NS_PER_S) == [], "once"
    detector.note_sighting(sighted(3 * NS_PER_S, author="red.a1.1"), 3 * NS_PER_S)
    assert retold(100) == [], "another knows better"
    stand(GRID.cell(10, 10), 3, 110)
    assert detector.detect(near, 110 * NS_PER_S)
    stand(0, 4, 111, jumps=1)
    assert retold(120) == [], "it was captured"


def test_the_store_keeps_where_each_target_was_seen_last() -> None:
    with KeeperStore(":memory:") as store:
        store.save_sightings([sighted(5, cell=1), sighted(5, target="u")])
        store.save_sightings([sighted(4, cell=2)])
        assert [(each.target, each.cell) for each in store.sightings()] == [("t", 1), ("u", 7)]


UNTRACKED = msgspec.structs.replace(
    SMALL,
    targets=(msgspec.structs.replace(SMALL.targets[0], name="lost", count=2, tracker="sighted"),),
    vehicles=msgspec.structs.replace(SMALL.vehicles, sense_range_m=400.0),
)


def test_a_sighting_that_ended_on_its_way_tells_nobody_anything() -> None:
    blind = msgspec.structs.replace(UNTRACKED.vehicles, sense_range_m=0.1)
    simulation = Simulation(msgspec.structs.replace(UNTRACKED, vehicles=blind))
    simulation.run_until(1)
    stranger = simulation.network.bus("stranger", authenticator=simulation.authenticator)
    late = sighted(0, target="lost0", author="all.a9.1", until_ns=1)
    stranger.publish(SIGHTED, late, target="lost0", author="all.a9.1")
    simulation.run_until(2)
    assert simulation.report(2)["payloads_dropped"] == 0
