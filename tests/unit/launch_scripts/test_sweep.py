"""`swarm study run` without a cluster: the meaning of a study, the work of a trial, the kept results and the
messages."""

import contextlib
import json
import random
import re
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from support.simulated import simulate
from support.small_study import STUDY, write_study

from launch_scripts.commands.simulation_commands import run as run_study
from launch_scripts.process_table import SIMULATED_ROLES, processes_of
from launch_scripts.simulation import study as statistics
from launch_scripts.simulation.faults import (
    OBSERVER,
    RELINK_S,
    FaultPlan,
    FaultyLinks,
    Partition,
    few_of_layer,
    random_plan,
)  # fmt: skip
from launch_scripts.simulation.laws import BrokenLaw
from launch_scripts.simulation.sample_worlds import SMALL
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.study import (
    Summary,
    combinations,
    load_study,
    parse_study,
    plan,
    study_names,
    study_path,
)
from launch_scripts.simulation.study_sweep import ResultStore, Sweep
from launch_scripts.simulation.trials import Result, Trial, run_trial
from shared_map.replication.mark_sets import MAX_AHEAD_NS
from swarm.clock import NS_PER_S
from swarm.config.scenario_files import load_scenario, parse_scenario
from swarm.errors import ConfigError, StoreError


def result_of(trial: Trial, broken: tuple[BrokenLaw, ...] = (), **figures: float) -> Result:
    return Result(key=trial.key, figures=figures, broken=list(broken), wall_s=2.0, cpu_s=1.0)


def finished(path: Path, out: Path, captures: dict[int, float]) -> tuple[Sweep, Summary]:
    """A sweep with results that were made up: captures of each seed, and as many more as the case's number."""
    sweep = Sweep(path, out)
    for number, each in enumerate(sweep.cases):
        for trial in each.trials:
            sweep.store.add(result_of(trial, captures=captures[trial.seed] + number, marks=5.0))
    return sweep, sweep.finish()


# --- what a study means ------------------------------------------------------------------------------------------


def test_every_scenario_is_combined_with_every_variant_and_all_parameters():
    study = parse_study("""
scenarios = ["a", "b"]
[parameters]
map.learning = [false, true]
planner.routes = ["grid", "pulled"]
[variants.one]
[variants.two]
vehicles.per_agent = 3
""")
    cases = list(combinations(study))
    assert len(cases) == 2 * 2 * 4
    assert cases[0][2] == "one, learning = false, routes = grid"
    assert cases[-1][3] == {"vehicles.per_agent": 3, "map.learning": True, "planner.routes": "pulled"}
    assert len({(scenario, label) for scenario, _, label, _ in cases}) == len(cases)


def test_a_key_of_a_result_follows_from_what_decides_it_and_from_nothing_else(tmp_path):
    def keys(text: str = STUDY) -> set[str]:
        path = write_study(tmp_path, text)
        return {trial.key for each in plan(load_study(path), tmp_path, "x") for trial in each.trials}

    first = keys()
    assert len(first) == 6
    assert keys(f'name = "other"\nabout = "?"{STUDY}'.replace("captures", "lost")) == first
    assert keys(STUDY.replace('"0:3"', '"0:5"')) > first
    assert keys(STUDY.replace("[60, 120]", "[120, 60, 90]")) > first
    assert not keys(f"seconds = 2{STUDY}") & first
    assert not keys(f"faults = true{STUDY}") & first


def first_key(path: Path) -> str:
    plan.__globals__["_file_digest"].cache_clear()
    return plan(load_study(path), path.parent, "x")[0].trials[0].key


def test_a_file_that_a_scenario_names_counts_by_what_is_in_it(tmp_path):
    path = write_study(tmp_path, STUDY + "[variants.own]\nterrain.source = 'ground.npz'")
    found = []
    for height_m in (0.0, 1.0, 0.0):
        np.savez(tmp_path / "ground.npz", elevation_m=np.full((8, 8), height_m))
        found.append(first_key(path))
    assert found[0] == found[2] != found[1]
    (tmp_path / "ground.prj").write_text("another place")
    assert first_key(path) not in found, "what lies beside it counts, too"


def test_the_modules_of_plug_ins_count_and_those_inside_of_packages(tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "__init__.py").write_text("from own.walk import Walk")
    path = write_study(tmp_path, STUDY + "[variants.own]\ntargets.0.walk = 'own:Walk'")
    found = []
    for text in ("class Walk: ...", "class Walk: speed = 2", "class Walk: ..."):
        (tmp_path / "own" / "walk.py").write_text(text)
        found.append(first_key(path))
    assert found[0] == found[2] != found[1]


@pytest.mark.parametrize("name", study_names())
def test_each_study_of_the_project_can_be_read_and_each_of_its_variants_runs(name):
    path = study_path(name)
    study = load_study(path)
    planned = {each.label: each for each in plan(study, path.parent, name)}
    assert study.outcomes
    for each in planned.values():
        briefly = msgspec.structs.replace(each.trials[0], seconds=8.0 if study.faults else 0.3)
        result = run_trial(briefly)
        assert not result.broken or study.faults  # the quiet at the end of so short a run may be too short
        told = [outcome for outcome in study.outcomes if outcome in result.figures]
        assert told == list(study.outcomes), f"{name}: the report has {sorted(result.figures)}"


# --- one trial ---------------------------------------------------------------------------------------------------


def test_a_trial_is_the_simulation_of_its_seed_and_every_number_of_its_report(tmp_path):
    [case, _] = plan(load_study(write_study(tmp_path)), tmp_path, "x")
    trial = case.trials[1]
    result = run_trial(trial)
    report = simulate(case.given, 1, 3.0)
    assert result.key == trial.key
    assert result.figures["marks"] == report["marks"]
    assert result.figures["by_group.all.distance_m"] == report["by_group"]["all"]["distance_m"]
    assert result.figures["vehicles_driven.0"] == report["vehicles_driven"][0]
    assert not any(name.startswith("by_vehicle") for name in result.figures)
    assert result.broken == []
    assert msgspec.structs.replace(run_trial(trial), wall_s=0, cpu_s=0) == msgspec.structs.replace(
        result, wall_s=0, cpu_s=0
    )


def test_a_service_that_raises_is_a_broken_law_and_other_code_is_refused(tmp_path, monkeypatch):
    [case, _] = plan(load_study(write_study(tmp_path)), tmp_path, "x")

    def fails(*_: object) -> None:
        raise RuntimeError("it fell over")

    monkeypatch.setattr(Simulation, "run_until", fails)
    [law] = run_trial(case.trials[0]).broken
    assert law.law == "a service raised"
    assert "it fell over" in law.sentence
    with pytest.raises(ConfigError, match=r"a worker has version .* of the code, expected other"):
        run_trial(msgspec.structs.replace(case.trials[0], version="other"))


def test_figures_that_must_be_zero_are_laws(tmp_path, monkeypatch):
    [case, _] = plan(load_study(write_study(tmp_path)), tmp_path, "x")

    report = {"collisions": 2, "lethal_entries": 0, "marks": None, "alarms": ["x"], "simulated": True}
    monkeypatch.setattr(Simulation, "report", lambda *_: report)
    result = run_trial(case.trials[0])
    assert result.broken == [BrokenLaw("no collision", "2 collisions")]
    assert result.figures == {"collisions": 2.0, "lethal_entries": 0.0}


# --- what is kept ------------------------------------------------------------------------------------------------


def test_results_are_read_again_as_they_were_without_half_a_line_and_of_two_with_one_key_one_is_left(tmp_path):
    first = Result(key="a", figures={"x": 1.0}, broken=[BrokenLaw("l", "s", 2.0)], wall_s=1.0, cpu_s=0.5)
    second = Result(key="b", figures={"y.z": 2.0}, broken=[BrokenLaw("l", "s")], wall_s=1.0, cpu_s=0.5)
    store = ResultStore(tmp_path)
    store.add(first)
    with store.path.open("ab") as file:
        file.write(b'{"key":"b","figures":{"x"')
    again = ResultStore(tmp_path)
    assert again.results == {"a": first}
    again.add(second)
    again.add(second)
    assert ResultStore(tmp_path).results == {"a": first, "b": second}
    whole = store.path.read_bytes()
    for at in range(whole.index(b"\n")):
        store.path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with contextlib.suppress(StoreError):
            assert ResultStore(tmp_path).results["a"] == first


@pytest.mark.parametrize(
    "line",
    [
        '{"x":' * 100_000,
        *(
            json.dumps({"key": "a", "figures": {}, "broken": [], "wall_s": 1.0, "cpu_s": 1.0, **wrong})
            for wrong in ({"key": 1}, {"broken": ["abc"]}, {"wall_s": "x"}, {"figures": {"x": "text"}})
        ),
    ],
    ids=range(5),
)
def test_a_line_of_another_program_is_no_result(tmp_path, line):
    (tmp_path / "results.jsonl").write_text(f"{line}\n", encoding="utf-8")
    with pytest.raises(StoreError, match=r"line 1 is damaged; remove it"):
        ResultStore(tmp_path)


def test_what_is_there_is_not_run_again_whatever_else_changes_in_the_study(tmp_path):
    path, out = write_study(tmp_path), tmp_path / "out"
    finished(path, out, {0: 1.0, 1: 2.0, 2: 3.0})
    assert Sweep(path, out).missing == []
    path.write_text(STUDY.replace('"0:3"', '"1:5"').replace("[60, 120]", "[120, 90]"), encoding="utf-8")
    sweep = Sweep(path, out)
    assert sweep.trials == 8
    assert sorted(trial.seed for trial in sweep.missing) == [1, 2, 3, 3, 4, 4]


# --- what is told ------------------------------------------------------------------------------------------------


def test_the_folder_of_a_study_holds_its_results_and_its_summary(tmp_path):
    out = tmp_path / "out"
    _, summary = finished(write_study(tmp_path), out, {0: 1.0, 1: 2.0, 2: 6.0})
    table = pq.read_table(out / "results.parquet").to_pylist()
    assert [(row["set.vehicles.sense_range_m"], row["seed"], row["figure.captures"]) for row in table] == [
        ("60", 0, 1.0), ("60", 1, 2.0), ("60", 2, 6.0), ("120", 0, 2.0), ("120", 1, 3.0), ("120", 2, 7.0),
    ]  # fmt: skip
    first, second = summary.cases
    assert first.label == "sense_range_m = 60"
    assert first.outcomes["captures"].mean.value == 3.0
    assert first.outcomes["captures"].difference is None
    assert second.outcomes["captures"].difference == statistics.Estimate(1.0, 1.0, 1.0)
    table = statistics.outcome_table(summary, "captures")
    assert re.search(r"\| hill.toml \| sense_range_m = 120 \| 3 +\| 4 +\|", table)
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["trials"] == 6


def test_a_trial_that_broke_a_law_is_told_with_the_command_that_runs_it_again(tmp_path):
    out = tmp_path / "out"
    path = write_study(tmp_path)
    sweep = Sweep(path, out)
    trial = sweep.cases[1].trials[2]
    sweep.store.add(result_of(trial, (BrokenLaw("no collision", "2 | collisions", 1.5),), captures=1.0))
    summary = sweep.finish()
    [failure] = summary.failing
    assert summary.missing == 5
    [_, _, scenario, *options] = failure.replay.split()
    assert options == ["--seed", "2"]
    assert load_scenario(Path(scenario)) == sweep.cases[1].given
    [row] = pq.read_table(out / "results.parquet").to_pylist()
    assert (row["law"], row["law_at_s"], row["sentence"]) == ("no collision", 1.5, "2 | collisions")


def test_the_command_prints_what_is_kept_and_says_by_its_result_whether_all_laws_held(tmp_path, capsys):
    path, out = write_study(tmp_path), tmp_path / "out"
    sweep, _ = finished(path, out, {0: 1.0, 1: 2.0, 2: 6.0})
    assert run_study(str(path), None, 1, out, as_json=True) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["cases"][0]["outcomes"]["captures"]["values"] == {"0": 1.0, "1": 2.0, "2": 6.0}
    sweep.store.add(result_of(sweep.cases[0].trials[1], (BrokenLaw("l", "it broke", 1.0),), captures=2.0))
    assert run_study(str(path), None, 1, out, as_json=False) == 1
    shown = capsys.readouterr()
    assert "6 of 6 trials are kept from before" in shown.err
    assert "sense_range_m = 120" in shown.out
    assert "failed: swarm simulate" in shown.out
    assert "1 of 6 trials broke a law" in shown.out


# --- intervals ---------------------------------------------------------------------------------------------------


def test_intervals_hold_the_truth_as_often_as_they_say():
    chance = np.random.default_rng(1)
    found = {"mean": 0, "median": 0, "share": 0}
    for _ in range(100):
        data = chance.exponential(1.0, 30)
        for name, truth, estimate in (
            ("mean", 1.0, statistics.mean(data)),
            ("median", np.log(2), statistics.median(data)),
            ("share", 0.1, statistics.share(int(chance.binomial(100, 0.1)), 100)),
        ):
            found[name] += estimate.low <= truth <= estimate.high
    # Bootstraps of 30 skewed values hold a little less than 95 %. Fixed draws: these numbers never change.
    assert min(found.values()) >= 88


def test_a_stop_that_interrupts_nothing_stops_a_sweep_after_the_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exception comes while a future is cleared away: Python reports it there, and goes on."""
    told_of: list[int] = []

    def run(sweep: Sweep, workers: int, scheduler: str | None, told: Callable[[Trial, None], None]) -> None:
        for trial in sweep.missing:
            told_of.append(trial.seed)
            if len(told_of) == 2:
                with contextlib.suppress(KeyboardInterrupt):
                    signal.raise_signal(signal.SIGTERM)
            told(trial, None)

    monkeypatch.setattr(Sweep, "run", run)
    with pytest.raises(KeyboardInterrupt):
        run_study(str(write_study(tmp_path)), None, 1, tmp_path / "out", as_json=False)
    assert len(told_of) == 2


# --- faulty links do what their plan says, no more and no less ----------------------------------------------------


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


def heard(model: FaultyLinks, by: str, times_s: Sequence[float], of: str = "a") -> str:
    """`+` for each time at which a message arrives, `-` for each at which it is lost."""
    return "".join("+" if model.delays_ns(of, by, "x", at(t)) else "-" for t in times_s)


def test_a_long_partition_is_noticed_after_the_lease_and_heals_a_moment_after_it_ends():
    model = links(partitions=(Partition(5, 9, ("a", "c")),))
    assert heard(model, "b", (4.9, 5.1, 8.9, 9.1, 9 + RELINK_S)) == "+---+"
    told = [model.connected("a", "b", at(t)) for t in (5.1, 6.9, 7.1, 9.2, 9 + RELINK_S)]
    assert told == [True, True, False, False, True]
    assert heard(model, "c", (6.0,)) == heard(model, "d", (6.0,), of="b") == "+"
    assert model.connected("a", "c", at(8))


def test_a_short_partition_is_only_silence():
    model = links(partitions=(Partition(5, 6, ("a",)),))
    assert heard(model, "b", (5.5, 6.0)) == heard(model, "a", (5.5, 6.0), of="b") == "-+"
    assert all(model.connected("a", "b", at(t / 10)) for t in range(100))


def test_the_observer_hears_everything():
    model = links(drop=1.0, partitions=(Partition(0, 100, ("a",)),))
    assert model.delays_ns("a", OBSERVER, "x", at(1)) == (1_000_000,)
    assert model.connected("a", OBSERVER, at(50))


def test_of_a_one_way_cut_one_side_hears_until_the_lease_ends_the_session():
    model = links(partitions=(Partition(5, 9, ("a",), one_way=True),))
    assert heard(model, "b", (4.9, 5.1, 8.9, 9 + RELINK_S)) == "+--+"
    assert heard(model, "a", (5.1, 6.9, 7.1, 9 + RELINK_S), of="b") == "++-+"
    short = links(partitions=(Partition(5, 6, ("a",), one_way=True),))
    assert heard(short, "a", [5 + n / 10 for n in range(20)], of="b") == "+" * 20


def test_a_seed_makes_the_same_plan_and_ends_in_quiet():
    nodes = [spec.name for spec in processes_of(SMALL, SIMULATED_ROLES)]
    assert random_plan(SMALL, 3, 30) == random_plan(SMALL, 3, 30)
    plans = [random_plan(SMALL, seed, 30) for seed in range(200)]
    for made in plans:
        assert made.quiet_s == 18
        assert all(crash.at_s < 18 and crash.node in nodes for crash in made.crashes)
        assert all(cut.until_s <= 18 and set(cut.nodes) < set(nodes) for cut in made.partitions)
        assert all(hang.until_s <= 18 for hang in made.hangs)
        assert all(step.at_s < 18 for step in made.clock_steps)
        assert all(twin.at_s < 18 and twin.node.startswith("agent-") for twin in made.twins)
        steps_s = {step.node: step.by_s for step in made.clock_steps}
        assert len(steps_s) == len(made.clock_steps)
        off_s = [abs(made.skews_ms.get(node, 0.0)) / 1e3 + abs(steps_s.get(node, 0.0)) for node in nodes]
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
