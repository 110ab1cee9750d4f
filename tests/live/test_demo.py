"""The README's first command, without a screen, and what must hold of it."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from support.live_swarm import SWARM, folders_of_runs
from support.processes import eventually, in_session

from launch_scripts.report.report_and_tracks import TRACKS_FILE, read_tracks

pytestmark = [pytest.mark.network, pytest.mark.slow]


def test_a_short_demo_ends_well_and_its_report_says_so(tmp_path: Path) -> None:
    command = [*SWARM, "demo", "--port", "0", "--seconds", "10", "--runs", str(tmp_path), "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    eventually(lambda: not in_session(process.pid), 5, "the end of all")
    (run_dir,) = folders_of_runs(tmp_path)
    printed, report = json.loads(out), json.loads((run_dir / "report.json").read_text())
    assert {name: report[name] for name in printed} == printed
    assert (report["scenario"], report["vehicles"], report["targets"]) == ("demo", 100, 10)
    assert (report["processes"], report["restarts"], report["first_uses"]) == (18, 0, 0)
    assert report["seconds"] == pytest.approx(10, abs=1.5)
    assert report["vehicles_routed"] == 100
    assert (report["collisions"], report["lethal_entries"], report["lost"]) == (0, 0, 0)
    for name in ("captures", "marks", "reroute_requests", "routes_served", "startup_s"):
        assert report[name] > 0, name
    for name in ("growth_ms", "route_query_ms", "mark_to_tree_ms"):
        assert 0 < report[name]["p50"] <= report[name]["p99"], name
    assert 1.0 <= report["gap"]["mean"] <= report["gap"]["max"] < 1.5
    assert report["payloads_dropped"] == 0
    assert len(read_tracks(run_dir / TRACKS_FILE).routes) >= 100, "routes that vehicles began are kept"
    for log in ("router-0", "monitor-0", "agent-a3", "agent-a4", "planner-ghost"):
        assert (run_dir / f"{log}.log").stat().st_size > 0, log
    for name in ("run.rrd", "report.png"):
        assert (run_dir / name).stat().st_size > 0, name
