"""Faulty links do what their plan says, no more and no less."""

import random

from launch_scripts.process_table import SIMULATED_ROLES, processes_of
from launch_scripts.simulation.faults import (
    OBSERVER,
    RELINK_S,
    FaultPlan,
    FaultyLinks,
    Partition,
    few_of_layer,
    random_plan,
)  # fmt: skip
from launch_scripts.simulation.sample_worlds import SMALL
from shared_map.replication.marks import MAX_AHEAD_NS
from swarm.clock import NS_PER_S
from swarm.config.scenario_files import parse_scenario

BEGAN_NS = 1_000 * NS_PER_S


def links(seed: int = 1, **plan: object) -> FaultyLinks:
    return FaultyLinks(FaultPlan(**plan), random.Random(seed), BEGAN_NS, lease_s=2.0)  # type: ignore[arg-type]


def at(seconds: float) -> int:
    return BEGAN_NS + int(seconds * NS_PER_S)


def sent(model: FaultyLinks, times: int, every_s: float = 0.001) -> list[tuple[float, ...]]:
    """Arrival times in seconds of messages sent one after the other."""
    arrivals = []
    for n in range(times):
        delays = model.delays_ns("a", "b", "pose", at(n * every_s))
        arrivals.append(tuple((at(n * every_s) - BEGAN_NS + delay) / NS_PER_S for delay in delays))
    return arrivals


def test_the_planned_share_is_lost_repeated_and_reordered():
    arrivals = sent(links(drop=0.2, duplicate=0.1), 5000)
    assert 0.17 < sum(not each for each in arrivals) / 5000 < 0.23
    assert 0.06 < sum(len(each) == 2 for each in arrivals) / 5000 < 0.1


def test_messages_keep_their_order_but_for_those_that_are_reordered():
    first = [each[0] for each in sent(links(jitter_ms=50.0), 2000)]
    assert first == sorted(first)
    assert max(each - n * 0.001 for n, each in enumerate(first)) > 0.03
    mixed = [each[0] for each in sent(links(jitter_ms=1.0, reorder=0.1), 2000)]
    assert mixed != sorted(mixed)


def test_after_the_quiet_begins_nothing_is_lost_or_repeated():
    model = links(drop=0.5, duplicate=0.5, reorder=0.5, quiet_s=10.0)
    assert all(len(model.delays_ns("a", "b", "pose", at(10 + n))) == 1 for n in range(200))


def test_a_long_partition_is_noticed_after_the_lease_and_heals_a_moment_after_it_ends():
    model = links(partitions=(Partition(5, 9, ("a", "c")),))
    assert [bool(model.delays_ns("a", "b", "x", at(t))) for t in (4.9, 5.1, 8.9, 9.1, 9 + RELINK_S)] == [
        True, False, False, False, True,
    ]  # fmt: skip
    assert [model.connected("a", "b", at(t)) for t in (5.1, 6.9, 7.1, 9.2, 9 + RELINK_S)] == [
        True, True, False, False, True,
    ]  # fmt: skip
    assert model.delays_ns("a", "c", "x", at(6))
    assert model.delays_ns("b", "d", "x", at(6))
    assert model.connected("a", "c", at(8))


def test_a_short_partition_is_only_silence():
    model = links(partitions=(Partition(5, 6, ("a",)),))
    assert not model.delays_ns("a", "b", "x", at(5.5))
    assert model.delays_ns("a", "b", "x", at(6.0))
    assert all(model.connected("a", "b", at(t / 10)) for t in range(100))


def test_the_observer_hears_everything():
    model = links(drop=1.0, partitions=(Partition(0, 100, ("a",)),))
    assert model.delays_ns("a", OBSERVER, "x", at(1)) == (1_000_000,)
    assert model.connected("a", OBSERVER, at(50))


def test_of_a_one_way_cut_one_side_hears_until_the_lease_ends_the_session():
    model = links(partitions=(Partition(5, 9, ("a",), one_way=True),))
    assert [bool(model.delays_ns("a", "b", "x", at(t))) for t in (4.9, 5.1, 8.9, 9 + RELINK_S)] == [
        True, False, False, True,
    ]  # fmt: skip
    assert [bool(model.delays_ns("b", "a", "x", at(t))) for t in (5.1, 6.9, 7.1, 9 + RELINK_S)] == [
        True, True, False, True,
    ]  # fmt: skip
    short = links(partitions=(Partition(5, 6, ("a",), one_way=True),))
    assert all(short.delays_ns("b", "a", "x", at(5 + n / 10)) for n in range(20))


def test_a_seed_makes_the_same_plan_and_ends_in_quiet():
    nodes = [spec.name for spec in processes_of(SMALL, SIMULATED_ROLES)]
    assert random_plan(SMALL, 3, 30) == random_plan(SMALL, 3, 30)
    plans = [random_plan(SMALL, seed, 30) for seed in range(200)]
    for plan in plans:
        assert plan.quiet_s == 18
        assert all(crash.at_s < 18 and crash.node in nodes for crash in plan.crashes)
        assert all(cut.until_s <= 18 and set(cut.nodes) < set(nodes) for cut in plan.partitions)
        assert all(hang.until_s <= 18 for hang in plan.hangs)
        assert all(step.at_s < 18 for step in plan.clock_steps)
        assert all(twin.at_s < 18 and twin.node.startswith("agent-") for twin in plan.twins)
        steps_s = {step.node: step.by_s for step in plan.clock_steps}
        assert len(steps_s) == len(plan.clock_steps)
        off_s = [abs(plan.skews_ms.get(node, 0.0)) / 1e3 + abs(steps_s.get(node, 0.0)) for node in nodes]
        assert 2 * max(off_s) * NS_PER_S < MAX_AHEAD_NS  # or one refuses what another says, for good
    assert len({str(plan) for plan in plans[:20]}) == 20
    kinds = [[plan.crashes, plan.partitions, plan.hangs, plan.clock_steps, plan.twins] for plan in plans]
    assert any(all(some) for some in kinds)  # everything at once
    assert any(cut.one_way for plan in plans for cut in plan.partitions)


def test_agents_that_no_one_can_tell_apart_have_no_second_generation():
    """For a drone's agent, alone in the air, and for two on the ground, no member notes which file is the first."""
    air = (
        "\n[[classes]]\nname = 'drone'\nair = { speed_m_per_s = 10 }\n[[groups]]\nname = 'drones'\nclass = 'drone'"
    )
    text = "name = 'x'\n[[groups]]\nname = 'rovers'\nvehicles = 75\n[vehicles]\nper_agent = {}"
    for per_agent, few in ((25, {"agent-a3"}), (50, {"agent-a0", "agent-a1", "agent-a2"})):
        scenario = parse_scenario(text.replace("{}", str(per_agent)) + air + "\nvehicles = 1")
        assert set(few_of_layer(scenario)) == few
        plans = [random_plan(scenario, seed, 30) for seed in range(300)]
        assert not any(twin.node in few for plan in plans for twin in plan.twins)
        assert any(plan.twins for plan in plans) is (len(few) == 1)
