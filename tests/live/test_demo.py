"""The README's first command, without a screen, and what must hold of it."""

import contextlib
import json
import re
import socket
import subprocess
from pathlib import Path

import pytest
from support.live_swarm import SMALL_WORLD, SWARM, folders_of_runs
from support.monitor_rig import taking
from support.processes import Child, eventually, in_session

from launch_scripts.observe.run_folders import registry
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


SHORT_DEMO = f"""
name = "short"
seconds = 12
{SMALL_WORLD}
[monitor]
web_port = 0
"""
"""A scenario that ends by itself later than `up` takes a viewer for one that has left."""
PAGE = r"open http://127\.0\.0\.1:(\d+)"
STAYS = "until the live view is closed"


def open_stream(port: int) -> list[socket.socket]:
    """The stream of a live view, as its page holds it; none while only the start page is there."""
    with contextlib.suppress(OSError):
        stream = socket.create_connection(("127.0.0.1", port), timeout=30)
        stream.sendall(taking())
        if b" 200 " in stream.recv(13):
            return [stream]
        stream.close()
    return []


def test_the_demo_goes_on_while_a_viewer_is_connected_and_ends_by_itself_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SWARM_STATE", str(tmp_path / "state"))
    (tmp_path / "demo").write_text(SHORT_DEMO)  # a file in the working directory precedes the built-in scenario
    command = [*SWARM, "demo", "--port", "0", "--plain"]
    with Child(tmp_path / "output.txt", *command, cwd=tmp_path, start_new_session=True) as demo:
        demo.wait_for(PAGE)
        streams: list[socket.socket] = []
        eventually(
            lambda: streams.extend(open_stream(int(re.findall(PAGE, demo.text)[-1]))) or streams, 90, "a stream"
        )
        with streams[0] as stream:
            # A line comes each 5 s: the fourth is later than the 10 s for which a page may be loaded again.
            eventually(lambda: not stream.recv(1 << 18) or demo.text.count(STAYS) >= 4, 150, STAYS)
            assert demo.process.poll() is None, demo.text
        eventually(lambda: demo.process.poll() is not None, 120, "the end of the demo without a viewer")
        assert demo.process.returncode == 0, demo.text
        eventually(lambda: not in_session(demo.process.pid), 5, "the end of all")
    (entry,) = registry().glob("*.json")
    assert json.loads(entry.read_text())["is_ending"], "`swarm ps` says so while the report is written"
