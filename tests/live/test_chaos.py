"""`bench chaos`: a real swarm is struck, recovers, and leaves nothing behind."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.benchmarks import command
from support.live_swarm import folders_of_runs, write_scenario

from launch_scripts.launcher.takeover import processes

pytestmark = [pytest.mark.network, pytest.mark.slow]


def running(runs: Path) -> dict[str, int]:
    """Processes of all runs in a folder."""
    return {name: pid for run_dir in folders_of_runs(runs) for name, pid in processes(run_dir).items()}


@pytest.mark.thorough
def test_a_swarm_that_is_killed_lied_to_and_stopped_recovers_and_all_is_counted(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    options = ("--seconds", 16, "--every", 4, "--within", 30, "--seed", 57, "--runs", runs, "--json")
    ended = command("chaos", write_scenario(tmp_path), *options, timeout_s=240)
    report = json.loads(ended.stdout)
    assert report["broken"] == [], ended.stderr
    assert ended.returncode == 0
    kinds = [outcome["kind"] for outcome in report["outcomes"]]
    assert kinds[:2] == ["calm", "kill"]
    assert report["outcomes"][1]["back_s"] > 0
    assert "messages" not in kinds[2:] or sum(report["messages"].values()) > 0
    [run_dir] = folders_of_runs(runs)
    whole = json.loads((run_dir / "chaos.json").read_text())
    assert whole["minutes"][0]["agent_mb"] > 20
    assert running(runs) == {}


def test_an_unknown_blow_or_scenario_is_named(tmp_path: Path) -> None:
    for words, said in (
        (("--blow", "flood"), "--blow: no 'flood'; there are "),
        (("--spare", "monitor"), "--spare: no 'monitor'; there are router-0, "),
        (("nowhere",), "no scenario 'nowhere'"),
    ):
        ended = command("chaos", *words, "--runs", tmp_path)
        assert ended.returncode == 2
        assert said in ended.stderr
