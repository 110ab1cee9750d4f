"""The results of a run: its folder, its numbers, which add up, and its picture."""

import csv
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from support import fake_run
from support.command import Swarm

from launch_scripts.launcher.run_options import SCENARIOS, find_scenario
from launch_scripts.observe.latest_messages import VehicleColumns
from launch_scripts.observe.recorder import Driven, Recorder
from launch_scripts.observe.run_folders import begin_run, ended, find_run, point_last, read_report
from launch_scripts.observe.run_state import verdict
from launch_scripts.report import plots_and_figures as plots
from launch_scripts.report import run_page_and_map as picture
from launch_scripts.report.compare import LeftRun, circumstances_that_differ, figures, settings_that_differ
from launch_scripts.report.report_and_tracks import TABLES, make_report, read_tracks, write_report
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import load_scenario, parse_scenario, scenario_text
from swarm.errors import ConfigError, StoreError
from swarm.files import write_file
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import VehicleState

ASKED_FOR = [
    "scenario", "seed", "seconds", "vehicles", "targets", "processes", "restarts", "captures", "stranded", "lost",
    "reroute_requests", "marks", "routes_served", "collisions", "lethal_entries", "startup_s", "gap", "growth_ms",
    "route_query_ms", "mark_to_tree_ms",
]  # fmt: skip


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Recorder]:
    """The folder of a run of two groups after hidden targets, over hidden ground, and what recorded it."""
    folder = tmp_path_factory.mktemp("run")
    scenario = parse_scenario(
        'name = "little"\nseed = 3\nseconds = 12.0\ntime_scale = 10\n'
        '[[targets]]\nname = "t"\ncount = 2\ntracker = "sighted"\n'
        '[[groups]]\nname = "north"\nvehicles = 6\n[[groups]]\nname = "south"\nvehicles = 4\n'
        "[vehicles]\nper_agent = 3\n"
    )
    begin_run(folder, scenario, "r1")
    terrain = terrain_of_pace(np.full((24, 32), 0.1, np.float32), 25.0)
    truth = np.array(terrain.pace_s_per_m)
    truth[10:13, 5:20], truth[2:6, 22:28] = np.inf, 0.3
    recorder = fake_run.played(terrain, truth, scenario)
    report = make_report(recorder, terrain, run_id="r1", startup_s=1.5)
    write_report(folder, report, recorder, terrain, truth=truth)
    return folder, recorder


def test_the_report_has_every_number_that_was_asked_for(left: tuple[Path, Recorder]) -> None:
    folder, _ = left
    report = json.loads((folder / "report.json").read_text())
    assert report["ground_shows"] == ["hidden"]
    assert [name for name in ASKED_FOR if report.get(name) is None] == []
    assert (report["startup_s"], report["restarts"]) == (1.5, 0)
    assert report["marks"] == report["marked_cells"] > 0
    assert report["vehicles_routed"] == 10
    outcome = r"10 of 10 vehicles routed, (no|\d+) captures?, no collisions\. All went well\."
    assert re.fullmatch(outcome, report["verdict"])
    worse = {**report, "collisions": 1, "lost": 2}
    assert verdict(worse, ["agent-a0 did not end"]).endswith(
        "1 collision. Not all went well: agent-a0 did not end; collisions 1; 2 of 10 vehicles lost at the end."
    )
    slow = {**worse, "ticks": 1000, "ticks_late": 201}
    assert ". Not all went well: overloaded machine, 20% of ticks were late; collisions 1" in verdict(slow)
    assert "overloaded" not in verdict({**slow, "ticks_late": 200})
    assert set(report["gap"]) == {"mean", "p95", "max"}
    assert set(report["growth_ms"]) == {"p50", "p99"}
    assert len(report["series"]["t_s"]) == len(report["series"]["captures"]) >= 10
    image = imread(folder / "report.png")
    assert image.shape[:2] == (round(picture.HEIGHT_IN * picture.DPI), round(picture.WIDTH_IN * picture.DPI))
    assert image[..., :3].std() > 0.1
    assert sorted(path.name for path in folder.iterdir()) == [
        "ground.npz", "ground.webp", "groups.csv", "report.html", "report.json", "report.png", "run.json",
        "scenario.toml", "targets.csv", "tracks.npz", "vehicles.csv",
    ]  # fmt: skip


def test_names_of_targets_at_the_upper_border_or_beside_each_other_do_not_overlap_also_without_marks(
    left: tuple[Path, Recorder],
) -> None:
    tracks = read_tracks(left[0] / "tracks.npz")
    ends = [[9.0, -1.0], [90.0, -300.0], [95.0, -300.0], [500.0, -300.0]]
    targets = [
        dataclasses.replace(tracks.vehicles[0], id=f"t{n}", xy_m=np.array([end])) for n, end in enumerate(ends)
    ]
    no_marks = tracks.marks._make(column[:0] for column in tracks.marks)
    axes = Figure().add_subplot()
    picture.draw_map(axes, dataclasses.replace(tracks, targets=targets, marks=no_marks), {})
    assert [each.get_va() for each in axes.texts[:4]] == ["top", "bottom", "top", "bottom"]


def test_the_legend_of_the_map_names_targets_which_no_tracker_published(left: tuple[Path, Recorder]) -> None:
    tracks = read_tracks(left[0] / "tracks.npz")
    report = json.loads((left[0] / "report.json").read_text())
    drawn = {track.id for track in tracks.targets}
    assert drawn < set(report["by_target"]) == {"t0", "t1"}
    axes = Figure().add_subplot()
    picture.draw_map(axes, tracks, report)
    hidden = ", ".join(sorted(set(report["by_target"]) - drawn))
    assert picture.untracked(tracks, report) == f" (not drawn, no tracker: {hidden})"
    assert ("target" in " ".join(axes.get_legend_handles_labels()[1])) == bool(drawn)


def test_a_run_of_which_nothing_was_heard_still_leaves_a_report(tmp_path: Path) -> None:
    terrain = terrain_of_pace(np.ones((1, 1), np.float32))
    recorder = Recorder(fake_run.little_scenario(), GridSpec(1, 1, 10.0))
    report = make_report(recorder, terrain)
    write_report(tmp_path, report, recorder, terrain)
    assert report["captures"] is None
    assert (tmp_path / "report.png").stat().st_size > 10_000
    # It may be stopped before a vehicle has reported its place.
    series = {"t_s": [0.5], **{state.name.lower(): [0] for state in VehicleState}}
    assert not plots.PLOTS[0].draw(Figure().add_subplot(), plots.PLOTS[0], {"series": series})


def test_a_folder_that_cannot_be_written_is_one_clear_sentence(tmp_path: Path) -> None:
    terrain = terrain_of_pace(np.ones((4, 4), np.float32))
    recorder = Recorder(fake_run.little_scenario(), terrain.grid)
    report = make_report(recorder, terrain)
    with pytest.raises(StoreError, match=r"cannot write .*nowhere/report\.json: No such file"):
        write_report(tmp_path / "nowhere", report, recorder, terrain)
    for path in (Path("/dev/full"), Path("/sys/notes")):  # ENOSPC, EACCES
        with pytest.raises(StoreError, match=rf"cannot write {path}: (No space|Permission)"):
            write_file(path, b"1")


# --- the folder of a run ------------------------------------------------------------------------------------------

F, W = VehicleState.FOLLOWING, VehicleState.WAITING


ODD = Path(__file__).with_name("odd_scenario.toml")


@pytest.mark.parametrize("name", [*sorted(path.stem for path in SCENARIOS.glob("*.toml")), "odd", "presets"])
def test_a_scenario_that_was_written_is_read_as_the_same_from_any_folder(name: str, tmp_path: Path) -> None:
    if name == "odd":
        scenario = parse_scenario(ODD.read_text(encoding="utf-8"), base=tmp_path / "elsewhere")
    elif name == "presets":
        scenario = parse_scenario('[cost]\npreset = "hiker"\nslope_rule = "linear"', base=tmp_path)
    else:
        scenario = find_scenario(name)
    written = tmp_path / "run" / "scenario.toml"
    written.parent.mkdir()
    written.write_text(scenario_text(scenario, tmp_path))
    assert load_scenario(written) == scenario
    assert scenario_text(load_scenario(written), Path("/nowhere")) == scenario_text(scenario, tmp_path)


def test_every_setting_that_has_a_value_is_written(tmp_path: Path) -> None:
    written = scenario_text(Scenario(), tmp_path)

    def keys(struct: msgspec.Struct) -> set[str]:
        values = {each.encode_name: getattr(struct, each.name) for each in msgspec.structs.fields(struct)}
        inner = [value for value in values.values() if isinstance(value, msgspec.Struct)]
        inner += [each for value in values.values() if isinstance(value, tuple) for each in value]
        own = {key for key, value in values.items() if value is not None}
        return own.union(*(keys(each) for each in inner if isinstance(each, msgspec.Struct)))

    assert [key for key in sorted(keys(Scenario())) if key not in written] == []


def test_a_relative_path_of_a_scenario_leads_to_the_same_file_when_written(tmp_path: Path) -> None:
    scenario = parse_scenario('[terrain]\nsource = "dem.tif"')
    folder = tmp_path / "runs" / "r1"
    folder.mkdir(parents=True)
    begin_run(folder, scenario, "r1")
    assert load_scenario(folder / "scenario.toml").terrain.source == str(Path.cwd() / "dem.tif")
    facts = json.loads((folder / "run.json").read_text())
    assert facts["versions"]["numpy"] == np.__version__
    assert (facts["run_id"], facts["seed"]) == ("r1", 1)
    with pytest.raises(ConfigError, match="has not ended yet"):
        read_report(folder)
    begin_run(folder, scenario, "r1", recorded=False)
    with pytest.raises(ConfigError, match="the launcher of another machine records the run"):
        read_report(folder)


# --- which run was last -------------------------------------------------------------------------------------------


def test_last_is_the_run_that_began_last(tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        assert point_last(tmp_path / name) is None
        assert (tmp_path / "LAST").resolve() == tmp_path / name
        assert find_run("LAST", tmp_path).resolve() == tmp_path / name
    assert sorted(path.name for path in tmp_path.iterdir()) == ["LAST", "first", "second"]


def test_where_last_cannot_be_a_link_that_is_said(tmp_path: Path) -> None:
    (tmp_path / "LAST").mkdir()
    (tmp_path / "r").mkdir()
    assert str(point_last(tmp_path / "r")).endswith("LAST cannot be made a link to this run: Is a directory")


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999", "9" * 400])
def test_a_number_that_no_report_has_is_damage(number: str, tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text(f'{{"seconds": {number}}}')
    with pytest.raises(StoreError, match=r"report\.json is damaged"):
        read_report(tmp_path)


@pytest.mark.parametrize("facts", ["5", "[1]", "[" * 100_000, "no JSON"])
def test_a_damaged_file_of_a_run_does_not_keep_it_from_its_report(facts: str, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(facts)
    assert ended(tmp_path) == {}


# --- results ------------------------------------------------------------------------------------------------------


def test_results_per_target_group_and_vehicle_add_up_to_those_of_the_run(left: tuple[Path, Recorder]) -> None:
    folder, recorder = left
    report = json.loads((folder / "report.json").read_text())
    proven = recorder.observed.histogram("followed_gap_excess").count
    assert 0 < report["captures"] <= len(recorder.captures) <= report["captures"] + 1  # counted once a second
    assert proven > 0
    for section in TABLES:
        rows = report[section].values()
        assert sum(row["captures"] for row in rows) == report["captures"], section
        assert sum(row["routes_begun"] for row in rows) == proven, section
        gaps = [row["certified_gap"]["max"] for row in rows if row["routes_begun"]]
        assert max(gaps) == report["certified_gap"]["max"]
    for name, group in report["by_group"].items():
        own = [row for row in report["by_vehicle"].values() if row["group"] == name]
        assert group["vehicles"] == len(own)
        assert group["distance_m"] == pytest.approx(sum(row["distance_m"] for row in own), rel=1e-4)
    assert {name: group["vehicles"] for name, group in report["by_group"].items()} == {"north": 6, "south": 4}
    assert report["made"]["began"] <= report["made"]["ended"]
    summary = recorder.summary(recorder.observed.last_ns or 0)
    caught = {id: row["captures"] for id, row in report["by_target"].items()}
    assert {line.id: line.captures for line in summary.targets} == caught
    assert summary.certified_gap["mean"] == pytest.approx(report["certified_gap"]["mean"], rel=1e-5)


def test_the_tables_are_those_of_the_report(left: tuple[Path, Recorder]) -> None:
    report = read_report(left[0])
    for section, (file, what) in TABLES.items():
        rows = list(csv.DictReader((left[0] / file).read_text().splitlines()))
        assert [row[what] for row in rows] == list(report[section])
        for row in rows:
            told = report[section][row[what]]
            assert int(row["captures"]) == told["captures"]
            gap = told["certified_gap"]
            assert row["certified_gap_p95"] == ("" if told["routes_begun"] == 0 else str(gap["p95"]))


def columns(ids: list[str], places: list[float], states: list[VehicleState]) -> VehicleColumns:
    east_m = np.array(places, np.float32)
    return VehicleColumns(ids, east_m, 0 * east_m, np.array(states, np.uint8), np.full(len(ids), -1), [])


def test_distance_and_waiting_are_those_of_each_vehicle_also_of_one_that_comes_later_or_leaves() -> None:
    driven = Driven()
    samples = [
        (["b"], [0.0], [W]),
        (["a", "b"], [7.0, 0.0], [F, W]),
        (["a", "b"], [7.0, 3.0], [F, F]),
        (["a"], [17.0], [F]),
        (["a", "b"], [17.0, 5.0], [W, F]),
    ]
    for second, (ids, places, states) in enumerate(samples):
        driven.add(2 * second * NS_PER_S, columns(ids, places, states), lambda: {"a": "g"})
    told = dict(zip(driven.ids, driven.totals.T.tolist(), strict=True))
    assert told == {"a": [10.0, 2.0, 2.0], "b": [5.0, 2.0, 0.0]}
    assert driven.groups == {"a": "g", "b": ""}


# --- the differences between runs ---------------------------------------------------------------------------------


GAP = {"mean": 1.05, "p95": 1.16, "max": 8.1, "unproven": 3}


def left_run(name: str, settings: dict[str, Any] | None, **report: Any) -> LeftRun:
    return LeftRun(name, report, settings)


def test_only_keys_that_differ_are_named_and_ports_are_not() -> None:
    first = {"seed": 1, "targets": [{"name": "t", "count": 2}], "network": {"listen": ["tcp/127.0.0.1:1"]}}
    second = {
        "seed": 1,
        "targets": [{"name": "t", "count": 3}, {"name": "u"}],
        "cost": {"zones": [], "preset": "hiker"},
    }
    assert settings_that_differ([left_run("a", first), left_run("b", second), left_run("old", None)]) == [
        ("targets[0].count", [2, 3, None]),
        ("targets[1].name", [None, "u", None]),
        ("cost.zones", [None, [], None]),
        ("cost.preset", [None, "hiker", None]),
    ]
    assert settings_that_differ([left_run("a", first), left_run("b", first)]) == []


def test_figures_stand_beside_each_other_also_of_a_run_that_has_fewer() -> None:
    groups = {"g": {"distance_m": 5.0}, "h": {"distance_m": 2.5}}
    new = left_run("a", {}, captures=4, certified_gap=GAP, by_group=groups, by_target={"t": {"captures": 4}})
    rows = dict(figures([new, left_run("b", {}, captures=2, certified_gap=None, by_group=[1])]))
    assert rows["captures"] == [4, 2]
    assert rows["certified gap, p95"] == [1.16, None]
    assert rows["driven by all, m"] == [7.5, None]
    assert rows["captures of t"] == [4, None]
    assert "messages/s" not in rows


def test_what_makes_figures_incomparable_is_named() -> None:
    made = [{"versions": {"numpy": version}, "began": version, "machine": {"cores": 2}} for version in ("1", "2")]
    live = left_run("a", {}, made=made[0], terrain={"digest": "ab"})
    simulated = left_run("b", {}, made=made[1], terrain={"digest": "cd"}, simulated=True)
    assert circumstances_that_differ([live, simulated]) == [
        ("versions.numpy", ["1", "2"]), ("terrain", ["ab", "cd"]), ("simulated", [False, True])
    ]  # fmt: skip
    assert circumstances_that_differ([live, live]) == []


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for name, seed in (("r1", 1), ("r2", 2)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "scenario.toml").write_text(scenario_text(parse_scenario(f"seed = {seed}"), tmp_path))
        (folder / "report.json").write_text(json.dumps({"captures": seed, "certified_gap": GAP}))
    return tmp_path


def test_the_command_shows_settings_and_figures(runs: Path, swarm: Swarm) -> None:
    code, out, _ = swarm("runs compare r1 --runs", runs, runs / "r2")
    assert code == 0
    told = [line.replace("│", "").split() for line in out.splitlines()]
    assert ["seed", "1", "2"] in told
    assert ["certified", "gap,", "mean", "5.00%", "5.00%"] in told
    assert ["captures", "1", "2"] in told
    (runs / "r2" / "report.json").write_text('{"seed": "\\u001b[31m"}')
    assert "\x1b" not in swarm("runs compare r1 r2 --runs", runs)[1]
    found = json.loads(swarm("runs compare r1 r1 --json --runs", runs)[1])
    assert (found["scenario"], found["figures"]["certified gap, mean"]) == ({}, [1.05, 1.05])


@pytest.mark.parametrize(
    ("file", "content", "sentence"),
    [
        ("report.json", b"[1]", "found no object, expected the figures of a run"),
        ("report.json", b"\xff\xfe", r"report\.json"),
        ("report.json", b"[" * 100_000, r"report\.json is damaged"),
        ("scenario.toml", b"seed = ", r"scenario\.toml"),
    ],
)
def test_damaged_files_are_one_sentence(runs: Path, swarm: Swarm, file: str, content: bytes, sentence: str) -> None:
    (runs / "r2" / file).write_bytes(content)
    code, _, told = swarm("runs compare r1 r2 --runs", runs)
    assert (code > 0, told.count("\n")) == (True, 1)
    assert re.search(sentence, told), told
