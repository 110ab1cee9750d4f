"""A full disk stops only the parts that need it, and these report it.

/dev/full, which takes no byte, and a limit of the size of files stand for it.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from launch_scripts.observe.run_folder import DiskWatch

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")


def test_a_simulation_whose_trace_finds_no_space_prints_its_figures_and_says_so(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "import sys; from launch_scripts.cli import main; sys.exit(main())"]
    command += ["simulate", "jacksboro", "--seconds", "1", "--trace", "/dev/full", "--runs", str(tmp_path)]
    told = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert told.returncode == 6, told.stderr
    assert "0 of 100 vehicles routed, no capture, no collision. Not all went well" in told.stdout
    assert "times real time" in told.stdout
    assert told.stderr.splitlines()[-1] == "swarm: the event log /dev/full has no end: No space left on device"
    assert "Traceback" not in told.stderr


def test_a_folder_that_takes_no_data_is_named_once_a_minute_and_when_it_does_again(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    watch = DiskWatch(folder)
    said = {now_s: watch.check_room(float(now_s)) for now_s in range(100)}
    sentence = f"cannot write {folder}: No such file or directory; all goes on but logs and recording"
    assert {now_s: each for now_s, each in said.items() if each} == {0: sentence, 60: sentence}
    folder.mkdir()
    later = [watch.check_room(float(now_s)) for now_s in range(100, 200)]
    assert [each for each in later if each] == [f"{folder} can be written again"]
    assert list(folder.iterdir()) == []
