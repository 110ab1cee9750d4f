"""`bench swarm`: a small swarm of real processes is measured, and nothing is left however the bench ends."""

from __future__ import annotations

import json
import os
import signal
import tempfile
from pathlib import Path

import pytest
from support.benchmarks import begin, command
from support.process_usage import cpu_s, in_session
from support.processes import eventually
from support.up_process import UpProcess

from launch_scripts.launcher.takeover import processes
from swarm.errors import SwarmError

pytestmark = pytest.mark.network

SIGNALS = [
    pytest.param(signal.SIGINT, marks=pytest.mark.thorough),
    pytest.param(signal.SIGTERM, marks=pytest.mark.thorough),
    signal.SIGKILL,
]
SMALL = ("swarm", "--vehicles", "20", "--targets", "2")


def running(folder: Path) -> dict[str, int]:
    """Processes of the runs whose temporary folders are in one folder."""
    return {name: pid for run in folder.resolve().glob("swarm-bench-*/run") for name, pid in processes(run).items()}


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary files of the bench and all that it starts."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def test_a_swarm_of_twenty_is_measured_and_written_into_the_page(temporary: Path) -> None:
    page = temporary / "page.md"
    ended = command(*SMALL, "--seconds", 4, "--json", "--write", page, timeout_s=240)
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
    assert "## Live processes" in page.read_text()
    assert list(temporary.glob("swarm-bench-*")) == []


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_a_bench_that_is_ended_takes_its_swarm_with_it(temporary: Path, number: signal.Signals) -> None:
    with (temporary / "said").open("w") as said:
        bench = begin(*SMALL, "--seconds", 300, said=said)
    try:
        eventually(lambda: len(running(temporary)) >= 10, 120, "the start of the swarm")
        launcher = os.getsid(next(iter(running(temporary).values())))
        assert launcher != os.getsid(bench.pid)
        bench.send_signal(number)
        assert bench.wait(90) != 0
        eventually(lambda: in_session(launcher) == [], 60, "the end of all processes")
        assert running(temporary) == {}
        if number != signal.SIGKILL:
            assert list(temporary.glob("swarm-bench-*")) == []
            assert "interrupted" in (temporary / "said").read_text()
            assert "Traceback" not in (temporary / "said").read_text()
    finally:
        bench.kill()
        for pid in running(temporary).values():
            os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize(
    ("words", "processes"),
    [("crowd --seeds 0:50", 2), ("swarm --vehicles 100 --simulated --seconds 600", 1)],
    ids=["crowds", "simulated"],
)
def test_a_simulated_bench_that_is_ended_takes_its_processes_with_it(
    tmp_path: Path, number: signal.Signals, words: str, processes: int
) -> None:
    with (tmp_path / "said").open("w") as said:
        bench = begin(*words.split(), said=said, start_new_session=True)

    def at_work() -> int:
        """Processes which have imported everything."""
        return sum((cpu_s(pid) or 0.0) > 2.0 for pid in in_session(bench.pid) if pid != bench.pid)

    try:
        eventually(lambda: at_work() >= processes, 200, "its processes")
        if number == signal.SIGINT:
            os.killpg(bench.pid, number)  # as a terminal sends it: to everybody
        else:
            bench.send_signal(number)
        assert bench.wait(30) != 0
        eventually(lambda: in_session(bench.pid) == [], 30, "the end of all processes")
        assert "Traceback" not in (tmp_path / "said").read_text()
    finally:
        for pid in in_session(bench.pid):
            os.kill(pid, signal.SIGKILL)
        bench.wait(10)


def test_a_launcher_that_refuses_is_quoted_with_its_exit_code(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    launcher = UpProcess("nowhere", run_dir, 5.0)
    launcher.process.wait(60)
    with pytest.raises(SwarmError, match=r"the launcher ended with code 2: no scenario 'nowhere'") as raised:
        launcher.check()
    assert raised.value.exit_code == 2
    assert launcher.report() is None
    assert launcher.end() == []
