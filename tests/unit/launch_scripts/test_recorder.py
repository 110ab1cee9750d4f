"""The recorder's figures for the messages that it heard."""

import pickle
import random
import re
import tracemalloc

import msgspec
import numpy as np
import pytest
from support import makers
from support.makers import fleet_of, planner_status, target_pose
from support.map_strategies import set_of

from launch_scripts.launcher.console import plain_line
from launch_scripts.observe import run_state as facts
from launch_scripts.observe.alarms import Alarm as SeenAlarm
from launch_scripts.observe.latest_messages import LatestState, plan_of
from launch_scripts.observe.recorder import BegunRoute, Recorder, Sampling, Thinned
from launch_scripts.observe.summed_counts import CertifiedGap
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, StandbyConfig
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.runtime.stats import CAPTURES_OF, GAPS_TO, Counters
from swarm.wire.codec import decode, encode
from swarm.wire.fields import ZERO_BUCKET
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.orders import GoalState, GoalStates
from swarm.wire.messages.planning import PlannerStatus, TargetPose
from swarm.wire.messages.processes import Alarm, Heartbeat, Note, Stats
from swarm.wire.messages.vehicles import Fleet, Followed, Obstacle, VehicleState

GRID = GridSpec(64, 96, 10.0, west_m=1000.0, north_m=5000.0)


def scenario() -> Scenario:
    return parse_scenario(
        'name = "test"\nseed = 7\n[[targets]]\nname = "t"\ncount = 2\n'
        "[[groups]]\nvehicles = 4\n[vehicles]\nper_agent = 2\n"
    )


@pytest.fixture
def recorder() -> Recorder:
    return Recorder(scenario(), GRID)


def hear(recorder: Recorder, *messages: Message, at_s: float = 0.0) -> None:
    for message in messages:
        recorder.on_message(message, int(at_s * NS_PER_S))


def stats(
    role: str,
    id: str,
    incarnation: int = 1,
    at_s: float = 0.0,
    counts: dict[str, int] | None = None,
    gauges: dict[str, float] | None = None,
    **histograms: list[float],
) -> Stats:
    counters = Counters()
    for name, values in histograms.items():
        for value in values:
            counters.observe(name, value)
    stamp_ns = int(at_s * NS_PER_S)
    told = {"incarnation": incarnation, "stamp_ns": stamp_ns, "counts": counts or {}, "gauges": gauges or {}}
    return makers.stats(role, id, counters, **told)


def fleet(
    author: str,
    places: dict[str, tuple[float, float]],
    at_s: float = 0.0,
    region: int = 0,
    state: VehicleState = VehicleState.FOLLOWING,
    target: str | None = "t0",
) -> Fleet:
    return fleet_of(
        list(places), author=author, region=region, state=state, target=target, seq=int(at_s * 10),
        stamp_ns=int(at_s * NS_PER_S), east_m=[east for east, _ in places.values()],
        south_m=[south for _, south in places.values()],
    )  # fmt: skip


def pose(target: str, east_m: float, south_m: float, seq: int, captures: int = 0) -> TargetPose:
    x_m, y_m = GRID.west_m + east_m, GRID.north_m - south_m
    return target_pose(target, seq=seq, stamp_ns=seq, x_m=x_m, y_m=y_m, captures=captures, jumps=captures)


def test_vehicles_which_stop_reporting_as_a_run_ends_are_not_counted_as_waiting(recorder: Recorder) -> None:
    for tick in range(42):
        hear(recorder, fleet("a0.7", {"a0-00": (tick, 0.0), "a0-01": (5.0, 0.0)}, tick / 5), at_s=tick / 5)
    hear(recorder, pose("t0", 1.0, 1.0, 1), at_s=9.1)
    recorder.finish(int(9.2 * NS_PER_S))
    assert recorder.series()["standing_at_once"][1:] == pytest.approx([1.0] * 10)


def status(target: str, gap_max: float | None, following: int = 1) -> PlannerStatus:
    gaps = dict.fromkeys(("gap_mean", "gap_p95", "gap_max"), gap_max)
    return planner_status(target, stamp_ns=0, following=following, **gaps)


def test_an_external_vehicle_is_named_until_its_lease_ends_and_the_report_names_it_for_good(
    recorder: Recorder,
) -> None:
    hear(recorder, Obstacle(id="rover", incarnation=1, seq=1, x_m=0.0, y_m=0.0, radius_m=1.0, lease_s=2.0))
    assert [recorder.summary(int(at_s * NS_PER_S)).external for at_s in (1.9, 2.1)] == [("rover",), ()]
    recorder.finish(9 * NS_PER_S)
    assert (recorder.report()["external"], recorder.report()["external_seen"]) == ((), ["rover"])


def test_what_no_one_told_of_is_null_and_not_zero(recorder: Recorder) -> None:
    report = recorder.report()
    for name in ("seconds", "captures", "collisions", "lethal_entries", "stranded", "lost", "marks", "startup_s"):
        assert report[name] is None, name
    assert report["gap"] == {"mean": None, "p95": None, "max": None}
    assert report["growth_ms"] == {"p50": None, "p99": None}
    assert report["vehicles"] == 4
    assert report["targets"] == 2


def test_counts_are_summed_over_processes_and_incarnations_but_gauges_over_the_newest(recorder: Recorder) -> None:
    hear(
        recorder,
        stats("agent", "a0", 1, 1.0, {"marks": 5}, {"restarts": 0.0}),
        stats("agent", "a0", 1, 2.0, {"marks": 7}, {"restarts": 0.0}),
        stats("agent", "a0", 2, 3.0, {"marks": 1}, {"restarts": 1.0}),
        stats("agent", "a1", 1, 3.0, {"marks": 10}, {"restarts": 2.0}),
    )
    report = recorder.report()
    assert report["marks"] == 7 + 1 + 10
    assert report["restarts"] == 3


def test_a_generation_that_carries_on_what_earlier_ones_counted_is_not_added_to_them(recorder: Recorder) -> None:
    """A recorder of all incarnations has the same sums as a recorder of the last only."""
    first = stats("agent", "a0", 1, 2.0, {"marks": 7})
    second = msgspec.structs.replace(stats("agent", "a0", 2, 4.0, {"marks": 9}), since=1)
    other = stats("agent", "a0", 5, 6.0, {"marks": 100})
    late = Recorder(scenario(), GRID)
    hear(recorder, first, second)
    hear(late, second)
    assert recorder.report()["marks"] == late.report()["marks"] == 9
    hear(recorder, other)  # one that was started by hand knows of no other generation
    assert recorder.report()["marks"] == 109


def test_an_hour_of_kills_leaves_as_much_in_memory_as_minutes_of_them_and_no_count_is_lost() -> None:
    """The size of all that a view keeps of a run whose agent is killed every second, in whatever order it hears."""
    latest = LatestState(plan_of(scenario(), 0), GRID)

    def live(from_s: int, until_s: int) -> int:
        generations = [
            msgspec.structs.replace(stats("agent", "a0", 2 + n, n, {"marks": n}, x=[n + 1.0]), since=2)
            for n in range(from_s, until_s)
        ]
        for n, generation in zip(range(from_s, until_s), generations, strict=True):
            late = random.Random(n).choice(generations[: n - from_s + 1])
            author, gone = f"a0.{n:x}", set_of(f"a0.{n - 1:x}", 1, 1, {})
            marks = [set_of(author, 1, 1, {3: (MarkKind.LETHAL, 0.0, n)})]
            marks.append(msgspec.structs.replace(gone, seq=gone.seq + 1))  # a keeper has compacted it
            marks.append(set_of(gone.author, 1, 1, {3: (MarkKind.LETHAL, 0.0, n - 1)}))  # and it comes late
            for message in (generation, late, fleet(author, {"a0-00": (n, 1.0)}, n, region=n % 2), *marks):
                latest.on_message(message, n * NS_PER_S)
            assert latest.vehicles().east_m.tolist() == [n]
            latest.started(Peer("agent", "a0", n))
            latest.alive(Peer("agent", "a0", n), True, n * NS_PER_S)
            latest.alive(Peer("agent", "a0", n - 1), False, n * NS_PER_S)
        assert latest.total("marks") == until_s - 1
        kept = {name: each for name, each in vars(latest).items() if name != "book"}
        return len(pickle.dumps(kept))

    minutes = live(1, 660)  # deleted sets are remembered for 600 s
    assert live(660, 3600) < 1.1 * minutes


def test_made_up_names_take_a_bounded_memory_and_known_ones_are_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("launch_scripts.observe.latest_messages._MOST_NAMES", 10)
    monkeypatch.setattr("launch_scripts.observe.summed_counts._MOST_GENERATIONS", 10)
    latest = LatestState(plan_of(scenario(), 0), GRID)

    def hear_of(name: str, at_s: int) -> None:
        goal = GoalState(name=f"{name}-00", stamp_ns=1, done=0, state="underway")
        for message in (
            stats("agent", name, at_s=at_s), status(name, 1.0), pose(name, 1.0, 1.0, at_s + 1),
            fleet(f"{name}.1", {f"{name}-00": (1.0, 1.0)}, at_s), set_of(f"{name}.1", 0, at_s + 1, {}),
            Heartbeat(role="planner", id=name, incarnation=1, ready=True, leads=True, seq=1),
            GoalStates(agent=name, stamp_ns=1, states=[goal]),
        ):  # fmt: skip
            latest.on_message(message, at_s * NS_PER_S)
        latest.alive(Peer("agent", name, 1), True, at_s * NS_PER_S)

    for n in range(40):
        hear_of(f"x{n}", 0)
    hear_of("x3", 7)
    kept = vars(latest)
    sizes = {name: len(each) for name, each in kept.items() if isinstance(each, dict)}
    assert max(sizes.values()) == 10, sizes
    assert latest.newest_stats("agent", "x3") is not None
    assert latest.poses["x3"].seq == 8


def test_tokens_of_strangers_that_have_fallen_take_no_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("launch_scripts.observe.latest_messages._MOST_NAMES", 10)
    latest = LatestState(plan_of(scenario(), 0), GRID)
    strangers = [Peer("agent", f"x{n}", 1) for n in range(10)]
    for up in (True, False):
        for peer in strangers:
            latest.alive(peer, up, 0)
    latest.alive(Peer("planner", "t7", 1), True, 0)
    assert latest.up() == [("planner", "t7")]


def test_gaps_are_those_of_planners_and_certified_ones_those_of_routes_that_vehicles_begin(
    recorder: Recorder,
) -> None:
    hear(recorder, stats("planner", "t0", gap_excess=[0.0, 0.0, 0.0, 0.04]), status("t0", 1.2), status("t0", 1.05))
    gap = recorder.report()["gap"]
    assert gap["mean"] == pytest.approx(1.01, abs=0.001)
    assert gap["p95"] == pytest.approx(1.04, abs=0.002)
    assert gap["max"] == 1.2, "the largest that any of them told"
    hear(recorder, stats("agent", "a0", counts={"followed_unproven": 1}, followed_gap_excess=[0.0]))
    hear(recorder, stats("agent", "a1", followed_gap_excess=[0.25]))
    certified = recorder.report()["certified_gap"]
    assert certified["mean"] == pytest.approx(1.125, abs=0.005)
    assert certified["max"] == pytest.approx(1.25, abs=0.005)
    assert certified["unproven"] == 1


def test_a_vehicle_that_has_followed_a_route_counts_as_routed_for_good(recorder: Recorder) -> None:
    hear(recorder, fleet("a0.1", {"a0-00": (1.0, 1.0), "a0-01": (2.0, 2.0)}, state=VehicleState.WAITING), at_s=0.0)
    assert recorder.report()["vehicles_routed"] == 0
    hear(recorder, fleet("a0.1", {"a0-00": (1.0, 1.0)}, 1.0), at_s=1.0)
    hear(recorder, fleet("a0.1", {"a0-00": (1.0, 1.0)}, 2.0, state=VehicleState.STRANDED), at_s=2.0)
    assert recorder.report()["vehicles_routed"] == 1


def test_a_vehicle_that_crosses_into_another_region_is_counted_once_where_it_is_now(recorder: Recorder) -> None:
    hear(
        recorder,
        fleet("a0.1", {"a0-00": (10.0, 10.0), "a0-01": (20.0, 20.0)}, 1.0, region=0),
        fleet("a0.1", {"a0-01": (30.0, 20.0)}, 2.0, region=1, state=VehicleState.ARRIVED),
    )
    vehicles = recorder.observed.vehicles()
    assert vehicles.ids == ["a0-00", "a0-01"]
    assert vehicles.east_m.tolist() == [10.0, 30.0]
    assert vehicles.chasing("t0").tolist() == [0, 1]
    assert vehicles.chasing("t1").tolist() == []
    summary = recorder.summary(2 * NS_PER_S)
    assert summary.states == {
        "idle": 0, "waiting": 0, "following": 1, "arrived": 1, "stranded": 0, "lost": 0,
            "outdated": 0, "searching": 0,
    }  # fmt: skip


def capture(target: str, cell: int) -> Note:
    return Note(role="targets", id="d0", stamp_ns=1, kind="capture", text="a captured it", cell=cell, target=target)


def test_a_capture_is_placed_where_the_target_was_though_no_one_tracks_it(recorder: Recorder) -> None:
    hear(recorder, pose("t0", 100.0, 200.0, 1), at_s=1.0)
    hear(recorder, capture("t1", 3 * GRID.cols + 5), capture("t1", GRID.cells), at_s=3.0)
    (placed,) = recorder.captures
    metres = GRID.resolution_m
    assert (placed.time_s, placed.target, placed.east_m, placed.south_m) == (2.0, "t1", 5.5 * metres, 3.5 * metres)


def test_a_jump_begins_a_new_piece_of_a_targets_track(recorder: Recorder) -> None:
    for n in range(4):
        hear(recorder, pose("t0", 100.0 + n, 200.0, n, captures=int(n >= 2)), at_s=float(n))
    places = [(*each.keys, *each.places_m.tolist()) for each in recorder.target_tracks.kept]
    assert places == [(("t0", int(n >= 2)), [100.0 + n, 200.0]) for n in range(4)]


def test_of_two_marks_on_a_cell_the_newer_counts_and_a_cleared_one_is_gone(recorder: Recorder) -> None:
    hear(
        recorder,
        set_of("a0.1", 0, 1, {33: (MarkKind.LETHAL, 0.0, 10), 40: (MarkKind.LETHAL, 0.0, 10)}),
        set_of("a1.1", 0, 1, {33: (MarkKind.PACE, 0.5, 20), 40: (MarkKind.CLEAR, 0.0, 20)}),
    )
    marked = recorder.observed.marked()
    assert marked.cells.tolist() == [1 * GRID.cols + 1]
    assert marked.kinds.tolist() == [MarkKind.PACE]
    assert marked.paces.tolist() == [0.5]
    assert recorder.report()["marked_cells"] == 1


def test_a_line_says_which_standby_leads_and_whether_any_planner_is_there() -> None:
    standing_by = msgspec.structs.replace(scenario(), standbys=StandbyConfig(planner=1))
    recorder = Recorder(standing_by, GRID)
    assert "planner t0.r1" in recorder.observed.missing()

    def titles() -> list[str]:
        return [line.title for line in recorder.summary(0).targets]

    def heartbeat(id: str, leads: bool, seq: int = 1) -> Heartbeat:
        return Heartbeat(role="planner", id=id, incarnation=1, ready=True, leads=leads, seq=seq)

    assert titles() == ["t0 (planner down)", "t1 (planner down)"]
    begun = Recorder(standing_by, GRID, 1)
    assert begun.summary(29 * NS_PER_S).targets[0].title == "t0 (planner starting)"
    assert begun.summary(31 * NS_PER_S).targets[0].title == "t0 (planner down)"
    for id in ("t0", "t0.r1", "t1"):
        recorder.alive(Peer("planner", id, 1), True, 0)
    hear(recorder, heartbeat("t0", True), heartbeat("t0.r1", False), heartbeat("t1", True))
    assert titles() == ["t0", "t1"]
    recorder.alive(Peer("planner", "t0", 1), False, 0)
    hear(recorder, heartbeat("t0.r1", True, 2), heartbeat("t0", True))
    assert titles() == ["t0 (standby 1)", "t1"]
    hear(recorder, heartbeat("t0.r1", False, 3), heartbeat("t0", True, 2))
    assert titles() == ["t0", "t1"]


def test_the_live_table_has_a_line_per_target(recorder: Recorder) -> None:
    recorder.alive(Peer("planner", "t0", 1), True, 0)
    recorder.alive(Peer("agent", "a0", 1), True, 0)
    hear(
        recorder,
        pose("t0", 100.0, 100.0, 1),
        fleet("a0.1", {"a0-00": (130.0, 140.0), "a0-01": (500.0, 100.0)}),
        status("t0", 1.02),
        stats("planner", "t0", counts={"growths": 3, "window_growths": 2}),
        msgspec.structs.replace(stats("agent", "a0"), histograms_by={GAPS_TO: {"t0": {ZERO_BUCKET: 3}}}),
        msgspec.structs.replace(stats("targets", "d0"), counts_by={CAPTURES_OF: {"t1": 2}}),
    )
    first, second = recorder.summary(0).targets
    assert (first.id, first.planner_up, first.following, first.nearest_m) == ("t0", True, 2, 50.0)
    assert (first.growths, first.growth_ms, first.gap) == (5, 1.5, CertifiedGap(1.0, 1.0, 1.0, 3))
    assert (second.id, second.planner_up, second.following, second.nearest_m) == ("t1", False, 0, None)
    assert (first.captures, second.captures) == (0, 2)


def test_a_target_with_a_lost_tracker_says_so_in_table_line_and_report_until_it_is_back(
    recorder: Recorder,
) -> None:
    recorder.alive(Peer("planner", "t0", 1), True, 0)
    recorder.alive(Peer("planner", "t1", 1), True, 0)
    hear(recorder, pose("t0", 100.0, 100.0, 1), at_s=1.0)
    hear(recorder, pose("t1", 100.0, 100.0, 1), at_s=9.0)
    first, second = recorder.summary(10 * NS_PER_S).targets
    assert (first.title, first.lost, first.pose_age_s) == ("t0 (lost for 9 s)", True, 9.0)
    assert (second.title, second.lost, second.pose_age_s) == ("t1", False, 1.0)
    lost = "target lost: no tracker publishes t0; routes lead to its last place, row 0, col 0, for 10 s"
    assert lost in plain_line(recorder.summary(10 * NS_PER_S), "small")
    assert recorder.report()["tracking"]["lost_at_end"] == ["t0"]
    hear(recorder, status("t0", 1.0), at_s=60.0)  # the last words of a run that takes long to end
    assert recorder.report()["tracking"]["lost_at_end"] == ["t0"]
    assert [alarm["about"] for alarm in recorder.report()["alarms"] if alarm["kind"] == "target-lost"] == ["t0"]
    hear(recorder, fleet("a0.1", {"a0-00": (1.0, 1.0)}), at_s=60.0)
    assert recorder.report()["tracking"]["lost_at_end"] == ["t0", "t1"]
    hear(recorder, pose("t0", 100.0, 100.0, 2), pose("t1", 100.0, 100.0, 2), at_s=61.0)
    assert [line.lost for line in recorder.summary(61 * NS_PER_S).targets] == [False, False]
    assert recorder.report()["tracking"]["lost_at_end"] == []


def test_of_a_target_that_only_vehicles_see_its_planner_tells_whether_it_is_lost(recorder: Recorder) -> None:
    lost = msgspec.structs.replace(status("t0", 1.0), tracker_lost=True, pose_age_s=31.0)
    hear(recorder, lost)
    line = recorder.summary(0).targets[0]
    assert (line.lost, line.pose_age_s) == (True, 31.0)


def test_the_run_is_ready_when_all_processes_are_alive_and_a_vehicle_has_a_route(recorder: Recorder) -> None:
    for n, (role, id) in enumerate(recorder.observed.plan.crew):
        assert recorder.ready_ns is None
        recorder.alive(Peer(role, id, 1), True, n)
    assert recorder.observed.missing() == []
    hear(recorder, fleet("a0.1", {"a0-00": (1.0, 1.0)}, 1.0), at_s=1.0)
    assert recorder.ready_ns == NS_PER_S
    recorder.alive(Peer("planner", "t1", 1), False, 100)
    assert recorder.observed.missing() == ["planner t1"]
    assert recorder.ready_ns == NS_PER_S


def test_messages_per_second_are_what_the_processes_that_live_say(recorder: Recorder) -> None:
    recorder.alive(Peer("agent", "a0", 1), True, 0)
    recorder.alive(Peer("agent", "a1", 1), True, 0)
    for second in range(4):
        told = [stats("agent", id, 1, second, gauges={"messages_per_s": 25.0}) for id in ("a0", "a1")]
        hear(recorder, *told, at_s=float(second))
    assert recorder.summary(3 * NS_PER_S).messages_now_per_s == 50.0
    assert recorder.report()["messages_per_s"] == pytest.approx(50.0, rel=0.2)
    recorder.alive(Peer("agent", "a1", 1), False, 3 * NS_PER_S)
    assert recorder.summary(3 * NS_PER_S).messages_now_per_s == 25.0


def test_tracks_forget_every_second_sampling_instead_of_growing() -> None:
    samplings = Thinned[Sampling](100, lambda sampling: len(sampling.keys))
    for now_ns in range(1000):
        samplings.add(Sampling(now_ns, (("a", 0), ("b", 0)), np.full((2, 2), now_ns, np.float32)))
    times_ns = [each.time_ns for each in samplings.kept]
    assert 25 <= len(times_ns) <= 51
    assert all((each.places_m == each.time_ns).all() for each in samplings.kept)
    assert (times_ns[0], times_ns[-1] > 900) == (0, True)
    assert len({*np.diff(times_ns).tolist()}) == 1  # evenly spread


def test_a_run_of_a_day_takes_no_more_memory_than_one_of_an_hour(monkeypatch: pytest.MonkeyPatch) -> None:
    """The size of a recorder by its own lists: captures, samples and places are all bounded."""
    monkeypatch.setattr("launch_scripts.observe.recorder._CAPTURES_KEPT", 128)
    monkeypatch.setattr("launch_scripts.observe.recorder._MOST_SAMPLES", 128)
    monkeypatch.setattr("launch_scripts.observe.recorder._MOST_PLACES", 5_000)
    recorder = Recorder(scenario(), GRID)

    def record(from_s: int, until_s: int) -> int:
        for at_s in range(from_s, until_s, 2):
            places = {f"a0-{n:02d}": (float(at_s % 900), 5.0) for n in range(4)}
            hear(recorder, fleet("a0.1", places, at_s), pose("t0", 1.0, 2.0, at_s), capture("t0", 7), at_s=at_s)
        kept = [recorder.samples, recorder.vehicle_tracks, recorder.target_tracks]
        return len(pickle.dumps([recorder.captures, *(each.kept for each in kept)]))

    hour = record(0, 400)
    day = record(400, 1600)
    assert day < 1.5 * hour
    assert len(recorder.captures) == recorder.captures.maxlen


def test_routes_and_tracks_take_no_more_memory_than_is_counted_for_them(recorder: Recorder) -> None:
    route = Followed(vehicle="a0-0", target="t", start=0, directions=b"", cost_s=1.0, lower_bound_s=1.0)
    sent = [encode(msgspec.structs.replace(route, start=n, directions=bytes(n))) for n in range(90)]
    keys = tuple((f"t{n}", 0) for n in range(4))
    began = 10**18
    tracemalloc.start()
    for at_ns, payload in enumerate(sent * 9, began):
        recorder.routes.add(BegunRoute(at_ns, decode(payload, Followed)))
    routes_took, _ = tracemalloc.get_traced_memory()
    for at_ns in range(began, began + 5000):
        recorder.target_tracks.add(Sampling(at_ns, keys, np.zeros((4, 2), np.float32)))
    took, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert routes_took < 1.2 * recorder.routes._total
    assert took - routes_took < 1.2 * 8 * recorder.target_tracks._total  # a place is two floats of 4 bytes


def told(kind: str, about: str, since_s: float, over_s: float | None = None) -> Alarm:
    over_ns = None if over_s is None else int(over_s * NS_PER_S)
    return Alarm(
        kind=kind, about=about, text=f"{about} it is", since_ns=int(since_s * NS_PER_S), over_ns=over_ns, cell=97
    )


def test_alarms_say_where_and_since_when_the_serious_first_and_many_of_a_kind_in_one_line() -> None:
    recorder = Recorder(scenario(), GRID, 0)
    at_s = 60.0
    hear(recorder, fleet("a0.1", {"a0-00": (1.0, 1.0)}, at_s), at_s=at_s)
    for role, id in recorder.observed.plan.crew:
        recorder.alive(Peer(role, id, 1), True, int(at_s * NS_PER_S))
        late = [told("behind", f"{role}-{id}", 12.0)]
        hits = [told("collision", "a0-00 a0-01", 31.0, 31.0), told("x", "y", 3.0)] if role == "targets" else []
        hear(recorder, msgspec.structs.replace(stats(role, id, at_s=at_s), alarms=[*late, *hits]), at_s=at_s)
    state = recorder.summary(int(at_s * NS_PER_S))
    assert facts.alarm_lines(state, 9) == [
        "x: y it is, row 1, col 1, for 57 s",
        "behind: 6 times, agent-a0, agent-a1, keeper-0 and 3 more, the longest for 48 s (overloaded machine)",
    ]
    assert re.search(r"^collision: .*, row 1, col 1, at \d\d:\d\d:31$", facts.alarm_lines(state, 9, over=True)[2])
    recorder.alive(Peer("planner", "t1", 1), False, int(at_s * NS_PER_S))
    gone = recorder.summary(int((at_s + 1) * NS_PER_S))
    assert facts.alarm_lines(gone, 9)[0] == "down: planner-t1 is gone, for 1 s"
    silent = recorder.summary(int((at_s + 5) * NS_PER_S))
    assert {alarm.about for alarm in silent.alarms if alarm.kind == "silent"} == {
        f"{role}-{id}" for role, id in recorder.observed.plan.crew if id != "t1"
    }
    for later_s in (at_s + 15, at_s + 16):
        for role, id in recorder.observed.plan.crew:
            hear(recorder, stats(role, id, at_s=later_s - 10 * (id == "a0")), at_s=later_s)
    told_at_end = facts.for_report(recorder.summary(int(later_s * NS_PER_S)))["alarms"]
    assert {alarm["text"] for alarm in told_at_end if alarm["kind"] == "silent"} == {
        f"{role}-{id} was silent" for role, id in recorder.observed.plan.crew if id != "a0"
    }
    assert "keeper-0 was silent for 15 s" in facts.verdict({"vehicles": 0, "alarms": told_at_end})
    ended = stats("planner", "t1", at_s=later_s, gauges={"ended": 1.0})
    hear(recorder, ended, at_s=later_s + 1)
    assert not [alarm for alarm in recorder.summary(int((later_s + 1) * NS_PER_S)).alarms if alarm.kind == "down"]


def test_many_alarms_of_one_process_share_a_line_among_those_of_their_kind() -> None:
    def behind(about: str, since_s: float, over_s: float) -> SeenAlarm:
        return SeenAlarm("behind", about, f"{about} skips", since_s, over_s)

    of_keeper = [behind("keeper-0", 10.0 * n, 10.0 * n + 1 + n % 3) for n in range(5)]
    others = [behind("agent-a0", 3.0, 5.0), behind("planner-t0", 3.0, 4.0)]
    [(line, parts)] = facts.grouped([*of_keeper, *others])
    names = "keeper-0, agent-a0, planner-t0"
    assert line == f"behind: 7 times, {names}, the longest at 20 s of the run, for 3 s (overloaded machine)"
    assert parts == [
        "behind: 5 times, keeper-0, the longest at 20 s of the run, for 3 s",
        "behind: agent-a0 skips, at 3 s of the run, for 2 s",
        "behind: planner-t0 skips, at 3 s of the run, for 1 s",
    ]
    assert facts.grouped(others) == [(line, []) for line in parts[1:]], "few are said one by one"
