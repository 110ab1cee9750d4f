"""`bench swarm` and `bench crowd`: sizes, figures from counters, tables."""

import math

import msgspec
import pytest
from bench.whole_swarm import crowd
from bench.whole_swarm.ideal_crowd import drive_ideal
from bench.whole_swarm.size import CELLS_PER_VEHICLE, scenario_of, size_of
from bench.whole_swarm.stats_window import StatsWindow, ticks
from hypothesis import given
from hypothesis import strategies as st
from support import makers
from support.benchmarks import bench
from support.makers import fleet_of

from launch_scripts.launcher.run_options import find_scenario
from launch_scripts.simulation.sample_worlds import CROWDS
from launch_scripts.simulation.sample_worlds import crowd as crowded
from swarm.config.scenario import plan_agents
from swarm.runtime.stats import Counters
from swarm.wire.messages.vehicles import Fleet, VehicleState

# --- sizes -------------------------------------------------------------------------------------------------------


def test_a_thousand_vehicles_are_the_built_in_scenario() -> None:
    built_in = find_scenario("thousand")
    made = scenario_of(size_of(1000))
    assert made == msgspec.structs.replace(built_in, name="scale", plugin_folder=made.plugin_folder)


@given(st.integers(1, 100_000), st.integers(1, 1000))
def test_every_size_has_a_valid_scenario_with_its_vehicles_agents_and_density(vehicles: int, targets: int) -> None:
    size = size_of(vehicles, targets)
    scenario = scenario_of(size)
    assert scenario.vehicle_count == vehicles
    assert len(scenario.target_ids) == targets
    assert len(plan_agents(scenario)) == size.agents
    assert 1 <= size.agents <= max(40, vehicles // 1000 + 1)
    assert scenario.terrain.rows == scenario.terrain.cols == size.side
    if vehicles >= 10:
        assert size.side**2 / vehicles == pytest.approx(CELLS_PER_VEHICLE, rel=0.05)


# --- counters ----------------------------------------------------------------------------------------------------


def stats(role: str, id: str, second: int, incarnation: int = 1, took_ms: list[float] | None = None, **counts: int):
    counters = Counters()
    for each in took_ms or ():
        counters.observe("tick_ms", each)
    stamp_ns = second * 10**9
    return makers.stats(role, id, counters, incarnation=incarnation, stamp_ns=stamp_ns, counts=counts)


def test_a_window_counts_what_came_between_its_ends_in_any_order() -> None:
    window = StatsWindow()
    window.hear(stats("agent", "a0", 10, bytes_in=1000, ticks_late=5, ticks_dropped=5, took_ms=[90.0] * 40))
    window.hear(stats("agent", "a0", 9, bytes_in=1))  # late: an older one changes nothing
    window.begin()
    took = [90.0] * 40 + [7.0] * 9
    window.hear(stats("agent", "a0", 14, bytes_in=5000, ticks_late=8, ticks_dropped=6, took_ms=took))
    window.hear(stats("agent", "a0", 12, bytes_in=2000))
    window.hear(stats("agent", "a1", 14, bytes_in=7))  # began later
    [span] = window.spans
    assert span.per_s("bytes_in") == 1000
    found = ticks(window.spans)
    assert found["due"] == 10  # nine were taken, one was dropped
    assert found["late_share"] == found["worst_late_share"] == pytest.approx(0.3)
    assert found["dropped_share"] == pytest.approx(0.1)
    assert found["p99_ms"] == pytest.approx(7.0, rel=0.03)
    assert window.silent([("agent", "a0"), ("agent", "a1"), ("keeper", "0")]) == ["agent a1", "keeper 0"]


# --- crowds ------------------------------------------------------------------------------------------------------


def fleet(seq: int, **vehicles: tuple[int, VehicleState]) -> Fleet:
    cells = [cell for cell, _ in vehicles.values()]
    states = bytes(state for _, state in vehicles.values())
    return fleet_of(list(vehicles), cells=cells, target="t0", seq=seq, stamp_ns=seq, states=states)


def test_waits_speed_and_arrivals_are_counted_from_what_agents_publish() -> None:
    drives = crowd.Drives(cols=10)
    follows, arrived = VehicleState.FOLLOWING, VehicleState.ARRIVED
    drives.hear(fleet(0, straight=(0, follows), waits=(50, follows), there=(90, arrived)))
    for n in range(1, 8):
        drives.hear(fleet(n, straight=(11 * n, follows), waits=(50, follows), there=(90, arrived)))
    drives.hear(fleet(8, straight=(77, arrived), waits=(51, follows), there=(90, arrived)))
    drives.hear(fleet(9, straight=(77, arrived), waits=(51, follows), there=(90, follows)))
    assert drives.longest_wait == {"straight": 0, "waits": 7, "there": 1}
    assert drives.arrivals == 1
    assert drives.ticks_out_of_reach == 8 + 10 + 1
    assert drives.driven_cells == pytest.approx(7 * math.sqrt(2) + 1)
    assert drives.longest_confined["waits"] == 9
    assert drives.longest_confined["straight"] == 2  # three cells away from a place it is out of its box


@pytest.mark.parametrize("kind", CROWDS)
def test_an_ideal_crowd_drives_most_of_the_time_and_more_than_one_that_may_not_follow(kind: str) -> None:
    _, terrain = crowded(kind, 3, 100, 25, 30)
    flows = [drive_ideal(terrain.pace_s_per_m, 100, 3, 60, follow)["cells_per_step"] for follow in (True, False)]
    assert 1.0 >= flows[0] > 1.2 * flows[1] > 0.0


def test_a_small_crowd_is_driven() -> None:
    small = ["--seeds", "1:2", "--vehicles", "12", "--agents", "3", "--size", "16"]
    found = bench("crowd", "--worlds", "open", *small, "--seconds", "8", "--jobs", "1")
    [drive], [shown] = found["drives"], found["rows"]
    assert (drive["world"], drive["seed"], drive["vehicles"]) == ("open", 1, 12)
    assert drive["simulated_s"] == pytest.approx(8.0)
    assert 0.1 < shown["cells_per_step"] <= 1.5
    assert drive["longest_wait_s"] < 8.0
    assert drive["arrivals"] > 0
    assert shown["deliveries_per_cell"] > 1
    assert 0 < shown["cpu_ms_per_cell"] < 1000 * drive["wall_s"] / drive["driven_cells"] * 1.1
    assert (drive["collisions"], drive["lethal_entries"]) == (0, 0)


def test_a_simulated_swarm_is_measured() -> None:
    found = bench("swarm", "--vehicles", "20", "--targets", "2", "--simulated", "--seconds", "2")
    assert found["mode"] == "simulation"
    [figures] = found["rows"]
    assert figures["simulated_s"] == pytest.approx(2.0)
    assert figures["cpu_all_per_vehicle_ms_per_s"] * 20 == pytest.approx(figures["cpu_all_ms_per_s"])
    topics = figures["topics"]
    assert topics["fleet"]["deliveries_per_s"] >= 2 * 5  # four agents, one listener, and some are still starting
    assert sum(each["bytes_per_s"] for each in topics.values()) == pytest.approx(figures["bytes_in_per_s"])
    assert figures["collisions"] == figures["lethal_entries"] == 0
    assert figures["not_measured"] == []
