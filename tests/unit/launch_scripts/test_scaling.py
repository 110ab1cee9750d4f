"""`bench scaling` and `swarm deploy size`: counts, quantities, fits, what several machines need, the page."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from bench.cli import app as bench
from bench.scaling import page, rows
from bench.scaling.blocks import NAMES, Block, blocks
from bench.scaling.check import compare, model_of, summary, usable
from bench.scaling.cost_model import fit, relative_error
from bench.scaling.design import KINDS, Run, runs
from bench.scaling.model import Model, Row
from bench.scaling.needs import Machine, crossings_of, fewest_machines, needs, too_much
from bench.scaling.quantities import _asks_per_s, quantities_of
from bench.scaling.rows import measure_missing, read_rows
from bench.scaling.terms import SENT, TERMS, WORK
from bench.scaling.traffic import MACHINES, Traffic, run
from bench.whole_swarm.size import Size, size_of
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from launch_scripts.commands.deploy import app as deploy
from swarm.errors import ConfigError, SwarmError
from swarm.grid import REGION_CELLS

PAGE = Path(__file__).parents[3] / "docs" / "scaling.md"


@pytest.fixture(scope="module")
def measured() -> list[Row]:
    found, _ = usable(read_rows())
    return found


@pytest.fixture(scope="module")
def model(measured: list[Row]) -> Model:
    return model_of(measured)


# --- counts ------------------------------------------------------------------------------------------------------

NODES = [*(f"agent-a{n}" for n in range(8)), *(f"planner-t{n}" for n in range(5)), "keeper-0", "targets-0", "-"]


def machine_of(node: str, machines: int) -> int:
    """The slow twin: blocks of equal size, all else on the first."""
    role, _, id = node.partition("-")
    count = {"agent": 8, "planner": 5}.get(role)
    if count is None:
        return 0
    return next(
        m
        for m in range(machines)
        if int(id[1:]) in range(-(-m * count // machines), -(-(m + 1) * count // machines))
    )


@given(
    st.lists(
        st.tuples(
            st.sampled_from(NODES),
            st.sets(st.sampled_from(NODES)),
            st.sampled_from(["marks", "pose"]),
            st.binary(min_size=2, max_size=9),
        ),
        max_size=30,
    )
)
def test_each_put_crosses_once_to_each_other_machine_that_takes_it(
    puts: list[tuple[str, set[str], str, bytes]],
) -> None:
    traffic = Traffic(agents=8, targets=5)
    crossed: dict[int, Counter[str]] = {machines: Counter() for machines in MACHINES}
    for source, takers, topic, content in puts:
        payload = bytes(bytearray(content))  # an object of its own, as each message is encoded anew
        for taker in sorted(takers):
            traffic.delivered(0, source, taker, topic, payload)
        for machines in MACHINES:
            there = {machine_of(taker, machines) for taker in takers} - {machine_of(source, machines)}
            crossed[machines][topic] += len(there) * len(payload)
    traffic.close()
    for machines in MACHINES:
        assert +traffic.crossing_bytes[machines] == +crossed[machines]
    assert sum(traffic.puts.values()) == sum(1 for _, takers, _, _ in puts if takers)
    assert sum(traffic.flows.values()) == sum(len(takers) for _, takers, _, _ in puts)


def test_the_end_of_a_query_is_no_message() -> None:
    traffic = Traffic(agents=1, targets=1)
    traffic.delivered(0, "planner-t0", "agent-a0", "cost", b"")
    assert not traffic.flows


def test_a_simulated_swarm_sends_what_the_table_says_to_whom_it_says() -> None:
    """Who adds a topic, or another hearer of one, has to change the table."""
    counted = run(size_of(24, 3, per_agent=6), 1.5, 2.0, 60.0)
    assert counted["complete"]
    table = {(sent.topic, sent.source): sent.to for sent in SENT}
    seldom = {"note", "known", "run", "obeyed", "leave"}
    """As people ask, and at starts."""
    for flow in counted["flows"]:
        key = flow["topic"], flow["source"]
        if flow["topic"] in seldom or (flow["topic"] == "stats" and flow["source"] in ("keeper", "targets")):
            continue
        if flow["topic"] == "marks" and flow["source"] in ("keeper", "planner"):
            continue  # what a newcomer is told
        assert key in table, key
        assert flow["to"] in table[key], flow
    puts = {(each["topic"], each["source"]): each["messages_per_s"] for each in counted["puts"]}
    for sent in SENT:
        if sent.topic in (
            "fleet",
            "standing",
            "granted",
            "table",
            "stored",
            "digest",
            "pose",
            "status",
            "stats",
            "orders",
            "cost",
        ):
            assert puts.get((sent.topic, sent.source), 0) > 0, sent.topic


# --- quantities --------------------------------------------------------------------------------------------------

sizes = st.builds(
    lambda vehicles, targets, per_agent: size_of(vehicles, targets, per_agent=min(per_agent, vehicles)),
    st.integers(10, 5000),
    st.integers(1, 300),
    st.integers(20, 1000),
)


@settings(max_examples=30)
@given(sizes)
def test_agents_share_regions_and_hear_marks_within_bounds(size: Size) -> None:
    q = quantities_of(size)
    regions = math.ceil(size.side / REGION_CELLS) ** 2
    assert q.plots == (min(q.plots, regions, 8 * size.agents) if size.agents >= 3 else 0)
    assert q.shared_plots == q.shared if q.plots == regions else q.agents <= q.shared_plots <= q.shared
    assert q.agents <= q.shared <= min(q.agents * regions, 9 * q.vehicles)
    assert 0 < q.near <= 1
    assert 1 <= q.hearers <= q.agents
    assert 0 < q.chases <= min(size.agents * size.targets, size.vehicles) + 1e-9


def test_on_one_region_every_agent_hears_every_mark() -> None:
    q = quantities_of(size_of(100, 10, per_agent=10, side=200))
    assert (q.plots, q.shared, q.hearers) == (1, 10, 10)


def test_few_agents_on_a_large_map_have_few_plots() -> None:
    q = quantities_of(size_of(1000, 10, agents=5, side=4096))
    assert q.plots == 36  # and not 256
    assert q.shared_plots < q.shared / 3


@pytest.mark.parametrize(
    ("captures_per_s", "targets"), [(0.01, 1), (0.2, 4), (1.0, 20), (1.0, 100), (5.0, 100), (50.0, 1000)]
)
def test_the_rate_of_asks_is_the_mean_of_a_drawn_history(captures_per_s: float, targets: int) -> None:
    rng = np.random.default_rng(3)
    captures = np.cumsum(rng.exponential(1 / captures_per_s, max(200, int(10_000 * captures_per_s))))
    asks, now = 0, 0.0
    while now < captures[-1] - 10:
        following = captures[np.searchsorted(captures, now, side="right")]
        now = min(now + 5.0, max(following + 0.5, now + targets / 50))
        asks += 1
    assert _asks_per_s(captures_per_s, targets) == pytest.approx(asks / now, rel=0.05)


def test_without_captures_agents_ask_every_five_seconds() -> None:
    assert _asks_per_s(0.0, 10) == pytest.approx(0.2)
    assert _asks_per_s(1e-9, 10) == pytest.approx(0.2)


# --- fits --------------------------------------------------------------------------------------------------------


@given(
    st.lists(st.floats(0.01, 100), min_size=3, max_size=3),
    st.lists(st.tuples(*[st.floats(0.1, 1000)] * 3), min_size=6, max_size=12, unique=True),
)
def test_coefficients_that_are_known_are_found_again(
    known: list[float], quantities: list[tuple[float, float, float]]
) -> None:
    matrix = np.array(quantities)
    weighted = matrix / (matrix @ known)[:, np.newaxis]
    assume(np.linalg.cond(weighted / np.abs(weighted).max(axis=0)) < 1e4)
    values = [dict(zip("abc", row, strict=True)) for row in quantities]
    measured = [sum(k * value for k, value in zip(known, row, strict=True)) for row in quantities]
    found = fit(("a", "b", "c"), values, measured)
    assert list(found.coefficients.values()) == pytest.approx(known, rel=1e-4)


@given(
    st.lists(
        st.tuples(st.floats(0.1, 1e3), st.floats(0.1, 1e3), st.just(0.0) | st.floats(1e-3, 1e6)),
        min_size=1,
        max_size=12,
    )
)
def test_no_coefficient_is_negative_whatever_was_measured(measured: list[tuple[float, float, float]]) -> None:
    found = fit(("a", "b"), [{"a": a, "b": b} for a, b, _ in measured], [value for _, _, value in measured])
    assert min(found.coefficients.values()) >= 0


def test_an_error_is_relative_to_what_was_measured() -> None:
    assert relative_error(120, 100) == pytest.approx(0.2)
    assert relative_error(80, 100) == pytest.approx(0.2)
    assert (relative_error(0, 0), relative_error(1, 0)) == (0, 1)


# --- the measured model ------------------------------------------------------------------------------------------


def test_every_term_of_the_table_is_one_that_there_is() -> None:
    for sent in SENT:
        assert set(sent.messages) | set(sent.bytes) <= TERMS.keys()
    for work in WORK:
        assert set(work.cpu) | set(work.memory) <= TERMS.keys() | {"messages", "bytes", "map bytes", "costs bytes"}


def test_messages_and_bytes_of_simulations_that_no_fit_saw_are_foretold(measured: list[Row]) -> None:
    errors = summary([each for each in compare(measured) if "live" not in each.run])
    assert errors["messages"] < 0.2
    assert errors["bytes"] < 0.2


@settings(max_examples=25, deadline=None)
@given(size=sizes, machines=st.sampled_from([1, 2, 7, 30]))
def test_what_a_swarm_needs_is_finite_positive_and_nothing_crosses_on_one_machine(
    model: Model, size: Size, machines: int
) -> None:
    found = needs(model, size, machines)
    assert all(math.isfinite(each) and each >= 0 for each in found.cpu_cores.values())
    assert 0 < found.memory_gb <= found.first_memory_gb < 1e6
    assert found.first_cores >= found.machine_cores > 0
    if machines == 1:
        assert found.crossings_per_s == found.link_mbit_per_s == found.link_out_mbit_per_s == 0
    else:
        assert 0 < found.link_out_mbit_per_s <= found.link_mbit_per_s * (1 + 1e-9)
    q = quantities_of(size, machines=machines)
    flows = model.flows(q)
    for (_, messages, _), sent in zip(crossings_of(flows, q, machines), SENT, strict=True):
        [puts] = {flow.puts for flow in flows if flow.sent is sent}
        copies = sum(flow.messages for flow in flows if flow.sent is sent)
        assert messages <= min(puts * (machines - 1), copies) * (1 + 1e-9) + 1e-9


@settings(max_examples=15, deadline=None)
@given(vehicles=st.integers(100, 5000), targets=st.integers(1, 50), times=st.floats(1, 3))
def test_a_larger_swarm_never_needs_fewer_machines_nor_better_ones_more(
    model: Model, vehicles: int, targets: int, times: float
) -> None:
    small, large = (size_of(n, targets, per_agent=100) for n in (vehicles, int(vehicles * times)))
    weak, strong = Machine(8, 32, 1000), Machine(16, 64, 10_000)
    assert fewest_machines(model, small, strong).machines <= fewest_machines(model, small, weak).machines
    few, many = fewest_machines(model, small, weak), fewest_machines(model, large, weak)
    assert not [each for each in too_much(few, weak) if not each.startswith("one ")]
    assert few.machines <= many.machines + 1  # a map of more plots may lie better over agents


# --- rows --------------------------------------------------------------------------------------------------------


def test_each_measurement_has_a_name_of_its_own_and_some_of_each_kind_only_check() -> None:
    keys = [run.key for run in runs()]
    assert len(keys) == len(set(keys))
    for kind in KINDS:
        assert {run.use for run in runs() if run.kind == kind} == {"fit", "check"}


def test_what_is_measured_is_kept_and_an_interrupted_measurement_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def measure(run: Run, _: Any) -> dict[str, Any]:
        asked.append(run.key)
        if len(asked) == 3:
            raise SwarmError("the machine is full")
        return {"complete": True}

    monkeypatch.setattr(rows, "measure", measure)
    some = runs()[:5]
    said = measure_missing(some, tmp_path / "new", 60.0, lambda _: None)
    assert said == [f"{some[2].key}: the machine is full"]
    assert [row.run for row in read_rows(tmp_path / "new")] == [some[0], some[1], some[3], some[4]]
    assert measure_missing(some, tmp_path / "new", 60.0, lambda _: None) == []
    assert asked == [run.key for run in (*some, some[2])]
    assert len(read_rows(tmp_path / "new")) == 5
    [late] = measure_missing(runs()[5:6], tmp_path / "new", -1.0, lambda _: None)
    assert "the same command goes on" in late


def test_a_line_that_is_no_measurement_is_named(tmp_path: Path) -> None:
    (tmp_path / "live.jsonl").write_text('{"run": 3}\n')
    with pytest.raises(ConfigError, match=r"live\.jsonl, line 1: .*expected a measurement"):
        read_rows(tmp_path)


def test_runs_that_fell_behind_are_not_used_and_named(measured: list[Row]) -> None:
    live = next(row for row in measured if row.run.kind == "live")
    late = msgspec.structs.replace(live, figures={**live.figures, "ticks": {"agent": {"late_share": 0.5}}})
    simulated = next(row for row in measured if row.run.kind == "simulated")
    cut = msgspec.structs.replace(simulated, figures={**simulated.figures, "complete": False})
    kept, said = usable([live, late, simulated, cut])
    assert kept == [live, simulated]
    assert [each.partition(": ")[2][:13] for each in said] == ["50 % of agent", "the simulatio"]


# --- commands and page -------------------------------------------------------------------------------------------


def test_the_page_holds_what_the_rows_say(measured: list[Row], model: Model) -> None:
    text = PAGE.read_text(encoding="utf-8")
    found = blocks(model, compare(measured), measured)
    assert [block.name for block in found] == list(NAMES)
    assert page.with_blocks(text, found) == text, (
        "run ./launch_scripts/bench scaling --kinds none --write docs/scaling.md"
    )


def test_tables_are_replaced_between_their_marks_only(tmp_path: Path) -> None:
    block = Block("check", "T", ("a", "b"), [["x", "1"], ["  y", "2"]], ["So."])
    text = "before\n<!-- table check -->\nold\n<!-- end of table check -->\nafter\n"
    found = page.with_blocks(text, [block])
    assert found.startswith("before\n") and found.endswith("\nafter\n") and "old" not in found  # noqa: PT018
    assert "| &nbsp;&nbsp;y | 2 |" in found
    assert page.with_blocks(found, [block]) == found
    other = tmp_path / "other.md"
    other.write_text("nothing")
    with pytest.raises(ConfigError, match="lacks a place for a table"):
        page.check(other, NAMES)


def test_the_model_is_shown_and_drawn_without_measuring(tmp_path: Path) -> None:
    picture = tmp_path / "scaling.png"
    ran = CliRunner().invoke(bench, ["scaling", "--kinds", "none", "--json", "--picture", str(picture)])
    assert ran.exit_code == 0, ran.output
    report = json.loads(ran.stdout)
    assert report["cpu_ms_per_s"].keys() == {work.role for work in WORK}
    assert {each["held_out"] for each in report["errors"]} == {True, False}
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("command", "options", "complaint"),
    [
        (bench, ["scaling", "--kinds", "lived"], "--kinds: 'lived' is not one of simulated, live"),
        (bench, ["scaling", "--kinds", "none", "--rows", __file__], "expected a folder"),
        (bench, ["scaling", "--kinds", "none", "--write", "no/page.md"], "no/page.md, which cannot be read"),
        (bench, ["scaling", "--kinds", "none", "--rows", "/nowhere"], "has no measurements of simulations"),
        (deploy, ["size", "--vehicles", "0"], "--vehicles is 0, expected 1 to 100000"),
        (deploy, ["size", "--map", "0"], "--map is 0, expected 4000 to 268435456 cells for 1000 vehicles"),
        (deploy, ["size", "--vehicles", "100", "--map", "100"], "--map is 100, expected 1024 to"),
        (deploy, ["size", "--vehicles", "100", "--map", "300000000"], "--map is 300000000, expected 1024 to"),
        (deploy, ["size", "--memory", "inf"], "--memory is inf, expected a number"),
        (deploy, ["size", "--link", "inf"], "--link is inf, expected a number"),
        (deploy, ["size", "--tick-hz", "inf"], "--tick-hz is inf, expected 0.1 to 100"),
    ],
)
def test_an_option_that_cannot_be_is_named(command: Any, options: list[str], complaint: str) -> None:
    ran = CliRunner().invoke(command, options)
    assert isinstance(ran.exception, ConfigError), ran.output
    assert complaint in str(ran.exception)


def test_a_small_swarm_fits_one_machine_and_a_full_process_is_named() -> None:
    ran = CliRunner().invoke(deploy, ["size", "--vehicles", "100", "--targets", "4", "--json"])
    assert ran.exit_code == 0, ran.output
    report = json.loads(ran.stdout)
    assert (report["machines"], report["full"], report["extrapolated"]) == (1, [], False)
    ran = CliRunner().invoke(
        deploy, ["size", "--vehicles", "20000", "--targets", "100", "--cores", "64", "--memory", "512"]
    )
    assert ran.exit_code == 1
    assert "process takes" in ran.stdout
    assert "Extrapolated" in ran.stdout
