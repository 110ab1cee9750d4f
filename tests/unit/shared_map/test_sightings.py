"""Sightings of targets: the newest wins until it ends. Presence: the newest word of an author and region."""

import msgspec
from hypothesis import given
from hypothesis import strategies as st
from support.agent_world import AgentWorld, pace_of
from support.makers import fleet_of, target_pose

from launch_scripts.simulation.sample_worlds import SMALL
from launch_scripts.simulation.simulate import Simulation
from shared_map.keeper.mark_store import KeeperStore
from shared_map.replication.interest import MarkFilter
from shared_map.sightings import LONGEST_NS, Presence, Sightings, pose_of
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.peers import POSE_SILENCE_NS
from swarm.wire.messages.planning import Sighted
from swarm.wire.messages.vehicles import VehicleState
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


def test_an_author_with_a_fast_clock_outweighs_no_one_and_its_sightings_expire_all_the_same() -> None:
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


def test_a_planner_that_begins_again_is_told_the_last_sighting_by_the_one_that_had_it_unless_it_was_a_capture() -> (
    None
):
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


def test_a_sighting_that_ended_on_its_way_tells_no_one_anything() -> None:
    blind = msgspec.structs.replace(UNTRACKED.vehicles, sense_range_m=0.1)
    simulation = Simulation(msgspec.structs.replace(UNTRACKED, vehicles=blind))
    simulation.run_until(1)
    stranger = simulation.network.bus("stranger", authenticator=simulation.authenticator)
    late = sighted(0, target="lost0", author="all.a9.1", until_ns=1)
    stranger.publish(SIGHTED, late, target="lost0", author="all.a9.1")
    simulation.run_until(2)
    assert simulation.report(2)["payloads_dropped"] == 0


# --- presence -------------------------------------------------------------------------------------------------


WIDE = GridSpec(600, 600, 10.0)
LEASE_NS = 2 * NS_PER_S
Place = tuple[str, float, float]


def fleet(*vehicles, author="a0.1", seq=1, region=0, group="all", state=VehicleState.FOLLOWING, stamp_ns=5):
    cells = [int(south // 10) * WIDE.cols + int(east // 10) for _, east, south in vehicles]
    return fleet_of(
        [id for id, _, _ in vehicles], cells=cells, east_m=[east for _, east, _ in vehicles],
        south_m=[south for _, _, south in vehicles], author=author, group=group, region=region, seq=seq,
        stamp_ns=stamp_ns, state=state,
    )  # fmt: skip


def presence(**options: object) -> Presence:
    return Presence(LEASE_NS, **options)  # type: ignore[arg-type]


def test_the_newest_word_of_an_author_about_a_region_replaces_the_older() -> None:
    here = presence()
    here.receive(fleet(("u", 5, 5), ("v", 15, 5), seq=2), 0)
    here.receive(fleet(("u", 95, 5), seq=1), 0)
    assert list(here.places()) == ["u", "v"]
    here.receive(fleet(("u", 25, 5), seq=3), 0)
    assert list(here.places()) == ["u"]
    assert here.places() == {"u": (25, 5)}
    here.receive(fleet(seq=4), 0)  # it has left the region
    assert not here.places()


def test_what_is_not_said_again_ends_with_its_lease() -> None:
    here = presence()
    here.receive(fleet(("u", 5, 5)), 0)
    here.receive(fleet(("v", 5, 5), author="a1.1"), NS_PER_S)
    here.expire(LEASE_NS)
    assert len(here.places()) == 2
    here.expire(LEASE_NS + 1)
    assert list(here.places()) == ["v"]


def test_a_vehicle_between_two_regions_is_where_it_was_last_seen() -> None:
    here = presence()
    here.receive(fleet(("u", 5, 5), region=0, stamp_ns=7), 0)
    here.receive(fleet(("u", 95, 5), region=1, stamp_ns=8, seq=2), 0)
    assert list(here.places()) == ["u"]
    assert [column.tolist() for column in here.columns()] == [[95], [5]]


def test_only_the_groups_that_are_read_are_there() -> None:
    here = presence(filter=MarkFilter(WIDE, frozenset({"blue"})))
    here.receive(fleet(("u", 5, 5), group="red", author="red.a0.1"), 0)
    here.receive(fleet(("w", 5, 5), group="blue", author="red.a0.1"), 0)  # says so
    here.receive(fleet(("v", 5, 5), group="blue", author="blue.a1.1"), 0)
    assert list(here.places()) == ["v"]


# --- what vehicles make of it -------------------------------------------------------------------------------

CORRIDOR = ["." * 24] * 5
SCENARIO = """
targets = [{ name = "t", walk = "still" }, { name = "s", walk = "still" }]
groups = [
    { name = "chasers", targets = ["t"], vehicles = 1, cells = [[2, 0]] },
    { name = "parked", targets = ["s"], vehicles = 1, cells = [[2, 12]] },
]
vehicles = { per_agent = 1, sense_range_m = 30.0, capture_range_m = 10.0 }
"""


def test_a_parked_vehicle_is_driven_around_without_a_stop() -> None:
    # The other has arrived before it begins.
    world = AgentWorld(SCENARIO, pace_of(CORRIDOR)).begin(t=(2, 22), s=(2, 12))
    world.run(3.0)
    assert world.states()["a1-00"] is VehicleState.ARRIVED
    took_s = world.until(lambda: world.states()["a0-00"] is VehicleState.ARRIVED, within_s=60)
    # 21 cells of a second each, two of them diagonal, the first of which it has driven: there is no wait of five
    # seconds.
    assert took_s <= 20.5
    assert world.where()["a1-00"] == (2, 12)
    world.assert_lawful()
