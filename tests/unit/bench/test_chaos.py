"""The parts of `bench chaos`: faults by seed, hostile messages, recovery, and the laws of a run."""

from itertools import islice

import pytest
from chaos.fault_schedule import CALM, FAULTS, faults
from chaos.hostile import KINDS, Hostile
from chaos.results import Ended, Outcome, Recovery, Results, Sample
from support.makers import fleet_of
from support.message_fuzzer import MessageFuzzer

from swarm.grid import GridSpec
from swarm.wire.codec import encode
from swarm.wire.messages.vehicles import Fleet, VehicleState
from swarm.wire.topics import POSE

NAMES = ["agent-a0", "agent-a1", "keeper-0", "router-0"]


def fleet(places: dict[str, tuple[float, VehicleState]]) -> Fleet:
    east_m = [east for east, _ in places.values()]
    return fleet_of(list(places), east_m=east_m, states=bytes(state for _, state in places.values()))


def test_a_seed_decides_the_faults_and_their_order() -> None:
    one, same, other = (list(islice(faults(seed, NAMES, FAULTS, 5.0), 60)) for seed in (1, 1, 2))
    assert one == same != other
    assert one[0].kind == CALM
    assert {fault.kind for fault in one} == {CALM, *FAULTS}
    assert {len(fault.whom) for fault in one if fault.kind == "kill"} == {1, 2}
    assert {fault.kind for fault in islice(faults(1, NAMES, ["kill"], 5.0), 1, 20)} == {"kill"}


def hostile(seed: int = 1) -> Hostile:
    made = Hostile("swarm", MessageFuzzer(GridSpec(40, 40, 10.0), seed), seed)
    fuzzer = MessageFuzzer(GridSpec(40, 40, 10.0), 9)
    for _ in range(50):
        pose = fuzzer.message(POSE.message)
        made.heard(POSE.keyed("swarm", **fuzzer.fields(POSE, pose)), encode(pose))
    return made


def test_hostile_messages_are_of_all_kinds_and_the_same_for_the_same_seed() -> None:
    one, same, other = ([made.next() for _ in range(200)] for made in (hostile(1), hostile(1), hostile(2)))
    assert one == same != other
    assert {kind for kind, *_ in one} == set(KINDS)
    assert all(key.startswith("swarm/") for _, key, *_ in one)


def test_recovery_counts_from_when_the_fault_is_over_and_takes_the_last_vehicle() -> None:
    recovery = Recovery(["v", "w"])
    following, waiting, arrived = VehicleState.FOLLOWING, VehicleState.WAITING, VehicleState.ARRIVED
    recovery.hear(fleet({"v": (0.0, following), "w": (0.0, following)}), 1.0)
    assert recovery.reported
    recovery.over(2.0)
    assert recovery.routed_s() is None
    recovery.hear(fleet({"v": (0.0, following), "w": (0.0, waiting)}), 2.1)
    assert recovery.unrouted() == ["w"]
    assert recovery.standing() == ["v", "w"]
    recovery.hear(fleet({"v": (1.0, following), "w": (0.0, following)}), 2.5)
    assert recovery.routed_s() == 2.5
    assert recovery.moving_s() is None
    recovery.hear(fleet({"w": (0.0, arrived)}), 3.5)  # it is where it wanted to be
    assert recovery.moving_s() == 3.5


def results(seconds: float = 100.0, **fields: object) -> Results:
    return Results(scenario="x", seed=1, within_s=10.0, seconds=seconds, **fields)  # type: ignore[arg-type]


def outcome(kind: str = "kill", routed_s: float | None = 1.0, moving_s: float | None = 1.5) -> Outcome:
    return Outcome(at_s=5.0, kind=kind, whom=("agent-a0",), routed_s=routed_s, moving_s=moving_s, late=("a0-00",))


def samples(seconds: float, grows: float) -> list[Sample]:
    times = range(int(seconds))
    memory = [{"launcher": 100 * (1 + grows * t / seconds), "agent-a0": 20.0, "agent-a1": 30.0} for t in times]
    return [Sample(at_s=float(t), rss_mb=memory[t], threads=50, files=90) for t in times]


def test_a_run_in_which_all_recovers_breaks_no_law() -> None:
    assert results(outcomes=[outcome(), outcome("hang")]).broken() == []
    assert results(outcomes=[outcome(CALM, None, None)]).broken() == []  # nothing was done to it


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"outcomes": [outcome(routed_s=None)]}, "after kill of agent-a0 at 5 s not recovered: 1 vehicles"),
        ({"outcomes": [outcome(moving_s=12.0)]}, "recovered after 12.0 s"),
        ({"ended": [Ended(at_s=3.0, name="planner-t0", reason="why")]}, "planner-t0 ended by itself at 3 s: why"),
        ({"collisions": ["v and w"]}, "collision: v and w"),
        ({"lethal_entries": ["v"]}, "lethal entry: v"),
        ({"left_behind": ["agent-a0"]}, "agent-a0 was left behind"),
    ],
)
def test_each_law_of_a_run_can_break(fields: dict[str, object], says: str) -> None:
    [sentence] = results(**fields).broken()
    assert says in sentence


def test_growth_is_held_against_long_runs_only() -> None:
    grown = results(3600.0, samples=samples(3600, 0.5))
    assert [sentence.partition(" grew")[0] for sentence in grown.broken()] == ["rss_mb of launcher"]
    assert results(3600.0, samples=samples(3600, 0.02)).broken() == []
    assert results(100.0, samples=samples(100, 0.5)).broken() == []
    assert results().growth() == {"rss_mb of launcher": None, "threads": None, "files": None}
