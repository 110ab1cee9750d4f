"""`bench chaos`: a real swarm is struck, recovers, and leaves nothing behind, also where chaos itself is ended."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from support.benchmarks import begin, command
from support.live_swarm import folders_of_runs, write_scenario
from support.processes import eventually

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
    assert whole["samples"][0]["rss_mb"] > 100
    assert running(runs) == {}


@pytest.mark.parametrize("number", [pytest.param(signal.SIGTERM, marks=pytest.mark.thorough), signal.SIGKILL])
def test_chaos_that_ends_takes_its_swarm_with_it(tmp_path: Path, number: signal.Signals) -> None:
    runs = tmp_path / "runs"
    with (tmp_path / "said").open("w") as said:
        chaos = begin("chaos", write_scenario(tmp_path), "--seconds", 200, "--runs", runs, said=said)
    try:
        eventually(lambda: runs.exists() and len(running(runs)) >= 6, 90, "the start of the swarm")
        chaos.send_signal(number)
        assert chaos.wait(90) != 0
        eventually(lambda: running(runs) == {}, 60, "the end of all processes")
    finally:
        chaos.kill()


def test_an_unknown_blow_or_scenario_is_named(tmp_path: Path) -> None:
    for words, said in (
        (("--blow", "flood"), "--blow: no 'flood'; there are "),
        (("nowhere",), "no scenario 'nowhere'"),
    ):
        ended = command("chaos", *words, "--runs", tmp_path)
        assert ended.returncode == 2
        assert said in ended.stderr
