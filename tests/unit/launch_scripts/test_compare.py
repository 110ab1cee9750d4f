"""The differences between runs."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from support.command import Swarm

from launch_scripts.report.compare import LeftRun, circumstances_that_differ, figures, settings_that_differ
from swarm.config.scenario_files import parse_scenario, scenario_text

GAP = {"mean": 1.05, "p95": 1.16, "max": 8.1, "unproven": 3}


def left(name: str, settings: dict[str, Any] | None, **report: Any) -> LeftRun:
    return LeftRun(name, report, settings)


def test_only_keys_that_differ_are_named_and_ports_are_not() -> None:
    first = {"seed": 1, "targets": [{"name": "t", "count": 2}], "network": {"listen": ["tcp/127.0.0.1:1"]}}
    second = {
        "seed": 1,
        "targets": [{"name": "t", "count": 3}, {"name": "u"}],
        "cost": {"zones": [], "preset": "hiker"},
    }
    assert settings_that_differ([left("a", first), left("b", second), left("old", None)]) == [
        ("targets[0].count", [2, 3, None]),
        ("targets[1].name", [None, "u", None]),
        ("cost.zones", [None, [], None]),
        ("cost.preset", [None, "hiker", None]),
    ]
    assert settings_that_differ([left("a", first), left("b", first)]) == []


def test_figures_stand_beside_each_other_also_of_a_run_that_has_fewer() -> None:
    groups = {"g": {"distance_m": 5.0}, "h": {"distance_m": 2.5}}
    new = left("a", {}, captures=4, certified_gap=GAP, by_group=groups, by_target={"t": {"captures": 4}})
    rows = dict(figures([new, left("b", {}, captures=2, certified_gap=None, by_group=[1])]))
    assert rows["captures"] == [4, 2]
    assert rows["certified gap, p95"] == [1.16, None]
    assert rows["driven by all, m"] == [7.5, None]
    assert rows["captures of t"] == [4, None]
    assert "messages/s" not in rows


def test_what_makes_figures_incomparable_is_named() -> None:
    made = [{"versions": {"numpy": version}, "began": version, "machine": {"cores": 2}} for version in ("1", "2")]
    live = left("a", {}, made=made[0], terrain={"digest": "ab"})
    simulated = left("b", {}, made=made[1], terrain={"digest": "cd"}, simulated=True)
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
