"""The processes that `./launch_scripts/test` starts end with it, however it is stopped."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from support import contained
from support.processes import eventually

STARTS = """
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
print(child.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_what_a_stopped_command_leaves_in_another_session_is_ended(number: signal.Signals) -> None:
    command = [sys.executable, str(Path(contained.__file__)), sys.executable, "-c", STARTS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        orphan = int(process.stdout.readline())
        process.send_signal(number)
        assert process.wait(30) != 0
    eventually(lambda: not psutil.pid_exists(orphan), 5, "the end of the orphan")


def test_the_exit_code_is_that_of_the_command() -> None:
    assert contained_code("raise SystemExit(5)") == 5
    assert contained_code("") == 0


def contained_code(program: str) -> int:
    command = [sys.executable, str(Path(contained.__file__)), sys.executable, "-c", program]
    return subprocess.run(command, timeout=30, check=False).returncode
