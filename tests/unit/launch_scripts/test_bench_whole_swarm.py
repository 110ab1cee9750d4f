"""`bench swarm` and `bench crowd`: sizes, what is read out of counters, exponents, the page."""

from __future__ import annotations

import io
import json
import math
import multiprocessing
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from bench.cli import app
from bench.whole_swarm import crowd, series
from bench.whole_swarm.figures import LIVE, SIMULATED, Figure, exponent, exponents, topic_figures
from bench.whole_swarm.page import write_sizes
from bench.whole_swarm.size import CELLS_PER_VEHICLE, scenario_of, size_of
from bench.whole_swarm.stats_window import StatsWindow, ticks
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from typer.testing import CliRunner

from launch_scripts.launcher.options import find_scenario
from launch_scripts.simulation.campaign import in_processes
from swarm.config.agents import plan_agents
from swarm.errors import ConfigError, SwarmError
from swarm.runtime.stats import Counters
from swarm.wire.fields import pack_column
from swarm.wire.messages.processes import Stats
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


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--vehicles", "0"], "--vehicles is '0', expected numbers of at least 1"),
        (["--vehicles", "10,many"], "--vehicles is '10,many'"),
        (["--vehicles", "100001"], "--vehicles is 100001, expected 1 to 100000"),
        (["--vehicles", "10", "--series"], "--series is --vehicles 100,300,1000,3000,10000: give one of the two"),
        (["--targets", "0"], "--targets is 0, expected 1 to 1000"),
        (["--agents", "3", "--per-agent", "4"], "--agents and --per-agent: give at most one"),
        (["--vehicles", "10", "--agents", "11"], "--agents is 11, expected 1 to 10"),
        (["--vehicles", "5000", "--agents", "4"], "--agents is 4, expected 5 or more"),
        (["--per-agent", "1001"], "--per-agent is 1001, expected 1 to 1000"),
        (["--size", "20"], "--size is 20, expected 32 to 16384"),
        (["--vehicles", "1000", "--size", "40"], "--size is 40, expected 64 or more for 1000 vehicles"),
        (["--tick-hz", "0"], "--tick-hz is 0, expected 0.1 to 100"),
        (["--tick-hz", "nan"], "--tick-hz is nan"),
        (["--write", "page.txt"], "--write is page.txt, expected a name that ends in .md"),
        (["--write", "no/such/folder/page.md"], "in a folder that is there"),
    ],
)
def test_an_option_of_bench_swarm_that_cannot_be_is_named(options: list[str], complaint: str) -> None:
    ran = CliRunner().invoke(app, ["swarm", *options])
    assert isinstance(ran.exception, ConfigError)
    assert complaint in str(ran.exception)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--worlds", "open,sea"], "--worlds: 'sea' is not one of open, doors, corridor, maze"),
        (["--seeds", "5"], "--seeds: '5' is not A:B"),
        (["--seeds", "5:5"], "--seeds: '5:5' is not A:B"),
        (["--vehicles", "4", "--agents", "5"], "--agents is 5, expected at most as many as --vehicles, 4"),
        (["--vehicles", "401"], "--vehicles is 401, expected at most a quarter of 40 x 40 cells"),
    ],
)
def test_an_option_of_bench_crowd_that_cannot_be_is_named(options: list[str], complaint: str) -> None:
    ran = CliRunner().invoke(app, ["crowd", *options])
    assert isinstance(ran.exception, ConfigError)
    assert complaint in str(ran.exception)


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
    [remark] = series.remarks(report)
    assert "fitted without 400 vehicles" in remark


@pytest.mark.parametrize(
    ("value", "times", "shown"),
    [(None, 1, "-"), (0, 1, "0"), (0.0, 100, "0"), (3, 1, "3"), (0.01234, 100, "1.23"), (12_345.6, 1, "12,346")],
)
def test_a_figure_is_shown_with_three_digits_and_one_that_was_not_measured_by_a_stroke(
    value: float | None, times: float, shown: str
) -> None:
    figure = Figure("a.b", "b", times=times)
    assert figure.shown({"a": {"b": value}}) == shown
    assert figure.shown({"a": {}}) == figure.shown({}) == "-"


def test_labels_and_five_sizes_fit_into_eighty_columns() -> None:
    assert max(len(figure.label) for figure in (*LIVE, *SIMULATED)) + 5 * len(" 10,000") + len(" power") <= 78


# --- counters ----------------------------------------------------------------------------------------------------


def stats(role: str, id: str, second: int, incarnation: int = 1, took_ms: list[float] | None = None, **counts: int):
    counters = Counters()
    for each in took_ms or ():
        counters.observe("tick_ms", each)
    return Stats(
        role=role,
        id=id,
        incarnation=incarnation,
        stamp_ns=second * 10**9,
        counts=counts,
        gauges={},
        histograms={name: each.buckets for name, each in counters.histograms.items()},
    )


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


# --- the page ----------------------------------------------------------------------------------------------------


def report(simulated: bool, *rows: dict[str, Any]) -> dict[str, Any]:
    machine = {"cores": 2, "machine": "a machine", "python": "3.11", "load": 0.1}
    return {
        "simulated": simulated,
        "seconds": 5.0,
        "interrupted": False,
        "exponents": {},
        "rows": [*rows],
        **machine,
    }


def test_a_run_replaces_the_section_of_its_kind_and_keeps_the_others(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    write_sizes(page, report(True, row(100, times_real_time=4.0)), "first")
    write_sizes(page, report(False, row(100, up_s=7.0), row(300, up_s=8.0)), "second")
    several = [{**row(n), "per_agent": 25} for n in (100, 200)]
    write_sizes(page, report(True, *several), "third")
    write_sizes(page, report(True, row(1000, times_real_time=0.5)), "fourth")
    text = page.read_text()
    headings = [line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")]
    assert headings == ["What the rows say", "Live processes", "Simulation", "Simulation, 25 vehicles an agent"]
    assert "`first`" not in text
    assert all(f"`{command}`" in text for command in ("second", "third", "fourth"))
    assert "| up, s | 7 | 8 |  |" in text
    assert "| times real time, by the clock | 0.500 |" in text
    again = text
    write_sizes(page, report(True, row(1000, times_real_time=0.5)), "fourth")
    assert page.read_text() == again


def test_another_page_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# Mine\n")
    (tmp_path / "page.md").write_bytes(b"\xff\xfe")
    for name, complaint in (("README.md", "which is another page"), ("page.md", "which cannot be read")):
        ran = CliRunner().invoke(app, ["swarm", "--vehicles", "5", "--write", str(tmp_path / name)])
        assert isinstance(ran.exception, ConfigError)
        assert complaint in str(ran.exception)
    assert (tmp_path / "README.md").read_text() == "# Mine\n"


def test_every_line_of_a_table_has_as_many_cells_as_its_head(tmp_path: Path) -> None:
    topics = {"fleet": {"bytes_per_s": 2000.0}, "pose": {"bytes_per_s": 9000.0}}
    rows = [
        row(100, topics=topics),
        row(300, topics={"fleet": {"bytes_per_s": 1.0}}),
        row(1000, failed="no memory"),
    ]
    assert [figure.label for figure in topic_figures(rows)] == ["pose", "fleet"]
    write_sizes(tmp_path / "page.md", report(True, *rows), "command")
    text = (tmp_path / "page.md").read_text()
    tables = [part.splitlines() for part in text.split("\n\n") if part.startswith("|")]
    assert len(tables) == 3
    assert all(len({line.count("|") for line in table}) == 1 for table in tables)
    assert "1,000 vehicles: not measured: no memory." in text


def test_what_must_not_be_is_named_and_a_series_goes_on_after_a_size_that_fails(monkeypatch) -> None:
    def measure(size: Any, *_: object) -> dict[str, Any]:
        if size.vehicles == 200:
            raise SwarmError("it did not come up")
        if size.vehicles == 400:
            raise KeyboardInterrupt
        return {"collisions": 2 if size.vehicles == 300 else 0, "lethal_entries": None}

    monkeypatch.setattr(series, "measure_live", measure)
    told: list[str] = []
    found = series.run_series([size_of(n) for n in (100, 200, 300, 400, 500)], 1.0, False, told.append)
    assert [each["vehicles"] for each in found["rows"]] == [100, 200, 300]
    assert series.broken(found) == [
        "interrupted",
        "200 vehicles: not measured: it did not come up",
        "300 vehicles: 2 collisions",
    ]
    assert "not measured: it did not come up" in told
    json.dumps(found, allow_nan=False)
    with pytest.raises(SwarmError, match="it did not come up"):
        series.run_series([size_of(200)], 1.0, False, told.append)


# --- crowds ------------------------------------------------------------------------------------------------------


def fleet(seq: int, **vehicles: tuple[int, VehicleState]) -> Fleet:
    many = len(vehicles)
    zeros = pack_column(np.zeros(many), "<f4")
    return Fleet(
        author="a0.1", group="all", region=0, seq=seq, stamp_ns=seq, ids=list(vehicles), target_ids=["t0"],
        cells=pack_column(np.array([cell for cell, _ in vehicles.values()]), "<u4"),
        east_m=zeros, south_m=zeros, heading_rad=zeros,
        states=bytes(state for _, state in vehicles.values()), targets=bytes(many),
    )  # fmt: skip


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


def test_a_small_crowd_is_driven_shown_and_written_into_the_page(tmp_path: Path) -> None:
    words = "crowd --worlds open --seeds 1:2 --vehicles 12 --agents 3 --size 16 --seconds 8 --jobs 1 --json --write"
    ran = CliRunner().invoke(app, [*words.split(), str(tmp_path / "page.md")], catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.stdout)
    [drive], [shown] = found["drives"], found["rows"]
    assert (drive["world"], drive["seed"], drive["vehicles"]) == ("open", 1, 12)
    assert drive["simulated_s"] == pytest.approx(8.0)
    assert 0.1 < shown["cells_per_step"] <= 1.5
    assert drive["longest_wait_s"] < 8.0
    assert drive["arrivals"] > 0
    assert (drive["collisions"], drive["lethal_entries"]) == (0, 0)
    text = (tmp_path / "page.md").read_text()
    assert "## Crowds\n\n`./launch_scripts/bench crowd --worlds open --seeds 1:2" in text
    assert f"| open | {shown['cells_per_step']:.2f} |" in text
    lines = Console(width=80, file=io.StringIO())
    for part in crowd.tables(found):
        lines.print(part)
    assert isinstance(lines.file, io.StringIO)
    assert "…" not in lines.file.getvalue()


def test_a_simulated_swarm_is_measured() -> None:
    options = ["--vehicles", "20", "--targets", "2", "--simulated", "--seconds", "2", "--json"]
    ran = CliRunner().invoke(app, ["swarm", *options], catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.stdout)
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
