"""A whole swarm whose files cannot grow: it goes on, names the missing space, and prints its figures."""

from __future__ import annotations

import resource
import subprocess
from pathlib import Path

import pytest
from support.live_swarm import SWARM, folders_of_runs, write_scenario

pytestmark = [pytest.mark.network, pytest.mark.slow]

LONGEST = 300_000
"""Bytes of a file: the terrain's are shorter, the recording and the report's picture are not."""


@pytest.mark.thorough
def test_where_nothing_more_can_be_written_the_swarm_goes_on_and_says_so(tmp_path: Path) -> None:
    def limit() -> None:
        _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (LONGEST, hard))

    command = [*SWARM, "up", str(write_scenario(tmp_path)), "--runs", str(tmp_path / "runs")]
    told = subprocess.run(
        [*command, "--plain", "--seconds", "10"],
        capture_output=True, text=True, timeout=150, check=False, preexec_fn=limit,
    )  # fmt: skip
    (run_dir,) = folders_of_runs(tmp_path / "runs")
    assert told.returncode == 6, told.stdout + told.stderr
    assert told.stderr == ""
    assert "processes 6 of 6, restarts 0" in told.stdout
    recording = run_dir / "run.rrd"
    assert f"monitor-0: the recording {recording} has ended: File too large" in told.stdout
    lines = [" ".join(line.split()) for line in told.stdout.splitlines()]
    assert "vehicles that had a route 12" in lines
    assert not [line for line in lines if line.startswith("restarts ")]
    assert lines[-1] == f"cannot write {run_dir / 'report.png'}: File too large"
