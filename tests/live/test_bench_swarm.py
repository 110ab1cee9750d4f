"""`bench swarm` and `bench chaos`: swarms of real processes are measured and struck, and nothing is left behind."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import pytest
from support.benchmarks import command
from support.live_swarm import folders_of_runs, write_scenario

from launch_scripts.launcher.takeover import processes

pytestmark = [pytest.mark.network, pytest.mark.slow]
SMALL = ("swarm", "--vehicles", "20", "--targets", "2")


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary files of the bench and all that it starts."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def test_a_swarm_of_twenty_is_measured(temporary: Path) -> None:
    ended = command(*SMALL, "--seconds", 4, "--json", timeout_s=240)
    assert ended.returncode == 0, ended.stderr
    report = json.loads(ended.stdout)
    [row] = report["rows"]
    assert row["not_measured"] == []
    assert (row["vehicles"], row["targets"], row["agents"]) == (20, 2, 5)
    assert 0 < row["up_s"] < 240
    assert row["routed_s"] > 0
    assert row["routed_share"] == 1.0
    roles = {"router", "keeper", "monitor", "planner", "targets", "agent", "launcher"}
    assert roles <= row["cpu_ms_per_s"].keys()
    assert roles <= row["pss_mb"].keys()
    assert row["cpu_all_ms_per_s"] == pytest.approx(sum(row["cpu_ms_per_s"].values()))
    assert row["cpu_agents_per_vehicle_ms_per_s"] * 20 == pytest.approx(row["cpu_ms_per_s"]["agent"])
    assert row["ticks"]["agent"]["due"] >= 4 * 5 * 2  # four agents at 5 Hz, for half of the time at least
    assert 0 <= row["ticks"]["agent"]["late_share"] <= 1
    assert row["messages_in_per_s"] > row["messages_out_per_s"] > 4 * 5
    assert row["bytes_in_per_s"] > row["bytes_out_per_s"] > 1000
    route = row["route"]
    assert route["queries"] > 10
    assert route["unanswered"] == 0
    assert route["reply_bytes"] > 50
    assert route["ratio_p50_us"] == pytest.approx(route["ours_p50_us"] / route["raw_p50_us"], rel=0.01)
    assert row["collisions"] == row["lethal_entries"] == row["exit_code"] == 0
    assert list(temporary.glob("swarm-bench-*")) == []


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
    assert processes(run_dir) == {}


def test_an_unknown_blow_or_scenario_is_named(tmp_path: Path) -> None:
    for words, said in (
        (("--blow", "flood"), "--blow: no 'flood'; there are "),
        (("--spare", "monitor"), "--spare: no 'monitor'; there are router-0, "),
        (("nowhere",), "no scenario 'nowhere'"),
    ):
        ended = command("chaos", *words, "--runs", tmp_path)
        assert ended.returncode == 2
        assert said in ended.stderr
