"""`bench swarm`: a small swarm of real processes is measured, and nothing is left however the bench ends."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import pytest
from support.benchmarks import command

pytestmark = pytest.mark.network
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
