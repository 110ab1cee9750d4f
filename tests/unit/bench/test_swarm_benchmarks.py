"""`bench swarm` and `bench crowd`: sizes, what is read out of counters, exponents, what is shown."""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from typing import Any

import msgspec
import pytest
from bench.whole_swarm import crowd, sizes
from bench.whole_swarm.size import CELLS_PER_VEHICLE, scenario_of, size_of
from bench.whole_swarm.sizes import Figure, exponent, exponents, topic_figures
from bench.whole_swarm.stats_window import StatsWindow, ticks
from hypothesis import given
from hypothesis import strategies as st
from support import makers
from support.benchmarks import bench
from support.makers import fleet_of

from launch_scripts.launcher.options import find_scenario
from launch_scripts.simulation.many_seeds import in_processes
from swarm.config.agents import plan_agents
from swarm.errors import SwarmError
from swarm.runtime.stats import Counters
from swarm.wire.messages.vehicles import Fleet, VehicleState

# --- sizes -------------------------------------------------------------------------------------------------------


def test_a_thousand_vehicles_are_the_built_in_scenario() -> None:
    built_in = find_scenario("thousand")
    made = scenario_of(size_of(1000))
    assert made == msgspec.structs.replace(built_in, name="scale", plugin_folder=made.plugin_folder)


@given(
    st.integers(1, 100_000),
    st.integers(1, 1000),
    st.floats(0.1, 100),
    st.integers(0, 2**53),
)
def test_every_size_has_a_valid_scenario_with_its_vehicles_agents_and_density(
    vehicles: int, targets: int, tick_hz: float, seed: int
) -> None:
    size = size_of(vehicles, targets, tick_hz=tick_hz, seed=seed)
    scenario = scenario_of(size)
    assert scenario.vehicle_count == vehicles
    assert len(scenario.target_ids) == targets
    assert len(plan_agents(scenario)) == size.agents
    assert 1 <= size.agents <= max(40, vehicles // 1000 + 1)
    assert scenario.terrain.rows == scenario.terrain.cols == size.side
    if vehicles >= 10:
        assert size.side**2 / vehicles == pytest.approx(CELLS_PER_VEHICLE, rel=0.05)


@pytest.mark.parametrize(
    ("vehicles", "agents"), [(2, 2), (20, 5), (1000, 5), (3000, 6), (10_000, 20), (30_000, 40)]
)
def test_there_is_an_agent_for_each_five_hundred_vehicles_but_five_at_least_and_forty_at_most(
    vehicles: int, agents: int
) -> None:
    assert size_of(vehicles).agents == agents


def test_agents_or_vehicles_of_an_agent_may_be_given() -> None:
    assert [size_of(n, per_agent=25).agents for n in (100, 1000)] == [4, 40]
    assert size_of(1000, agents=40).per_agent == 25


# --- exponents ---------------------------------------------------------------------------------------------------


@given(
    st.floats(0.01, 1e6), st.floats(-3, 3), st.lists(st.integers(1, 10_000), min_size=2, max_size=6, unique=True)
)
def test_the_exponent_of_a_power_is_found(factor: float, power: float, xs: list[int]) -> None:
    assert exponent(xs, [factor * x**power for x in xs]) == pytest.approx(power, abs=1e-6)


@pytest.mark.parametrize(
    ("xs", "ys"),
    [([], []), ([100], [3.0]), ([100, 100], [3.0, 4.0]), ([100, 300], [3.0, None]), ([1, 2], [0.0, 5.0])],
)
def test_there_is_no_exponent_without_two_values(xs: list[int], ys: list[float | None]) -> None:
    assert exponent(xs, ys) is None


def test_what_was_not_measured_is_left_out_of_an_exponent() -> None:
    assert exponent([100, 200, 400, 800], [1.0, None, 4.0, math.inf]) == pytest.approx(1.0)


def row(vehicles: int, late_share: float | None = 0.0, **figures: Any) -> dict[str, Any]:
    size = msgspec.structs.asdict(size_of(vehicles))
    return {**size, "ticks": {"agent": {"late_share": late_share}}, "not_measured": [], **figures}


def test_a_run_that_is_late_is_left_out_of_exponents_and_named() -> None:
    rows = [row(100, cpu_all_ms_per_s=100), row(200, cpu_all_ms_per_s=200), row(400, 0.8, cpu_all_ms_per_s=210)]
    figure = Figure("cpu_all_ms_per_s", "CPU", fitted=True)
    assert exponents([figure], rows)["cpu_all_ms_per_s"] == pytest.approx(1.0)
    report = {"simulated": False, "rows": rows, "interrupted": False, "exponents": {}}
    [remark] = sizes.remarks(report)
    assert "fitted without 400 vehicles" in remark


def test_a_figure_is_found_by_its_path_and_shown_in_its_unit() -> None:
    one = Figure("a.b", "b", times=100)
    assert one.shown({"a": {"b": 0.01234}}) == "1.23"
    assert one.shown({"a": {"b": None}}) == one.shown({"a": {}}) == one.shown({}) == "-"


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


def test_a_process_that_was_started_again_is_not_mixed_with_its_earlier_life() -> None:
    window = StatsWindow()
    window.hear(stats("planner", "t0", 10, messages_in=900))
    window.begin()
    window.hear(stats("planner", "t0", 11, messages_in=1000))
    window.hear(stats("planner", "t0", 20, incarnation=2, messages_in=3))
    assert [span.count("messages_in") for span in window.spans] == [100]


def test_of_nobody_no_share_is_told() -> None:
    found = ticks([])
    assert found["due"] == 0
    assert found["late_share"] is found["worst_late_share"] is found["p50_ms"] is None


# --- several sizes ----------------------------------------------------------------------------------------------


def test_topics_are_the_largest_first_and_a_size_that_failed_has_strokes() -> None:
    topics = {"fleet": {"bytes_per_s": 2000.0}, "pose": {"bytes_per_s": 9000.0}}
    rows = [
        row(100, topics=topics),
        row(300, topics={"fleet": {"bytes_per_s": 1.0}}),
        row(1000, failed="no memory"),
    ]
    figures = topic_figures(rows)
    assert [figure.label for figure in figures] == ["pose", "fleet"]
    report = {"rows": rows, "exponents": {figures[1].key: -1.5}, "interrupted": False}
    assert sizes.lines_of(report, figures) == [
        {"vehicles": "pose", "100": "9", "300": "-", "1,000": "-", "power": ""},
        {"vehicles": "fleet", "100": "2", "300": "0.001", "1,000": "-", "power": "-1.50"},
    ]
    assert "1,000 vehicles: not measured: no memory." in sizes.remarks(report)


def test_what_must_not_be_is_named_and_a_series_goes_on_after_a_size_that_fails(monkeypatch) -> None:
    def measure(size: Any, *_: object) -> dict[str, Any]:
        if size.vehicles == 200:
            raise SwarmError("it did not come up")
        if size.vehicles == 400:
            raise KeyboardInterrupt
        return {"collisions": 2 if size.vehicles == 300 else 0, "lethal_entries": None}

    monkeypatch.setattr(sizes, "measure_live", measure)
    found = sizes.run_sizes([size_of(n) for n in (100, 200, 300, 400, 500)], 1.0, False)
    assert [each["vehicles"] for each in found["rows"]] == [100, 200, 300]
    assert found["heading"] == "Live processes"
    assert found["broken"] == [
        "interrupted",
        "200 vehicles: not measured: it did not come up",
        "300 vehicles: 2 collisions",
    ]
    json.dumps(found, allow_nan=False)
    with pytest.raises(SwarmError, match="it did not come up"):
        sizes.run_sizes([size_of(200)], 1.0, False)


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


def test_the_worst_wait_of_several_drives_counts_and_shares_are_of_all_vehicles() -> None:
    one = {
        "world": "doors", "seed": 1, "vehicles": 100, "simulated_s": 10.0, "cut_short": False,
        "cells_per_step": 0.5,
        "longest_wait_s": 3.0, "waited_long": 0, "confined_long": 1, "arrivals": 50, "collisions": 0,
        "lethal_entries": 0,
    }  # fmt: skip
    other = {**one, "seed": 2, "cells_per_step": 0.3, "longest_wait_s": 12.0, "waited_long": 3, "collisions": None}
    found = crowd.row_of("doors", [one, other])
    assert found["longest_wait_s"] == 12.0
    assert found["longest_wait_seed"] == "doors 2"
    assert found["waited_long_share"] == pytest.approx(0.015)
    assert found["cells_per_step"] == pytest.approx(0.4)
    assert found["arrivals_per_vehicle_and_100_s"] == pytest.approx(5.0)
    assert found["collisions"] == 0


def test_a_small_crowd_is_driven() -> None:
    small = ["--seeds", "1:2", "--vehicles", "12", "--agents", "3", "--size", "16"]
    found = bench("crowd", "--worlds", "open", *small, "--seconds", "8", "--jobs", "1")
    [drive], [shown] = found["drives"], found["rows"]
    assert (drive["world"], drive["seed"], drive["vehicles"]) == ("open", 1, 12)
    assert drive["simulated_s"] == pytest.approx(8.0)
    assert 0.1 < shown["cells_per_step"] <= 1.5
    assert drive["longest_wait_s"] < 8.0
    assert drive["arrivals"] > 0
    assert (drive["collisions"], drive["lethal_entries"]) == (0, 0)


def test_a_simulated_swarm_is_measured() -> None:
    found = bench("swarm", "--vehicles", "20", "--targets", "2", "--simulated", "--seconds", "2")
    assert found["heading"] == "Simulation"
    [figures] = found["rows"]
    assert figures["simulated_s"] == pytest.approx(2.0)
    assert figures["cpu_all_per_vehicle_ms_per_s"] * 20 == pytest.approx(figures["cpu_all_ms_per_s"])
    topics = figures["topics"]
    assert topics["fleet"]["deliveries_per_s"] >= 2 * 5  # four agents, one listener, and some are still starting
    assert sum(each["bytes_per_s"] for each in topics.values()) == pytest.approx(figures["bytes_in_per_s"])
    assert figures["collisions"] == figures["lethal_entries"] == 0
    assert figures["not_measured"] == []


# --- many processes ----------------------------------------------------------------------------------------------


def nap(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def test_work_in_processes_ends_with_those_who_stop_to_read() -> None:
    results = in_processes(nap, [0.01, 60.0, 60.0, 60.0], 2)
    assert next(results) == 0.01
    running = multiprocessing.active_children()
    assert running
    results.close()  # type: ignore[attr-defined]
    until_s = time.monotonic() + 10
    while any(child.is_alive() for child in running) and time.monotonic() < until_s:
        time.sleep(0.05)
    assert not any(child.is_alive() for child in running)
