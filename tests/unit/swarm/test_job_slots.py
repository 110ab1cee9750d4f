"""Long jobs of one machine in turn."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from swarm.runtime.process import LONG_NS, JobSlots

HOLDER = """
import sys, time
from pathlib import Path
from swarm.runtime.process import JobSlots
with JobSlots(Path(sys.argv[1]), most=1).one():
    print("mine", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("most", [1, 2, 3])
def test_no_more_have_a_turn_at_once_than_may_and_everybody_has_one(tmp_path: Path, most: int) -> None:
    turns, lock = JobSlots(tmp_path, most), threading.Lock()
    at_once, highest, done = 0, 0, 0

    def work() -> None:
        nonlocal at_once, highest, done
        with turns.one():
            with lock:
                at_once += 1
                highest = max(highest, at_once)
            time.sleep(0.03)
            with lock:
                at_once -= 1
                done += 1

    threads = [threading.Thread(target=work) for _ in range(6)]
    for each in threads:
        each.start()
    for each in threads:
        each.join(10)
    assert done == 6
    assert 1 <= highest <= most


def test_the_turn_of_a_process_that_is_killed_ends(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"mine\n"
        began_s = time.monotonic()
        threading.Timer(0.2, os.kill, (holder.pid, signal.SIGKILL)).start()
        with JobSlots(tmp_path, most=1, longest_s=30).one():
            assert 0.1 < time.monotonic() - began_s < 20


def test_no_one_waits_for_ever_for_one_that_is_stopped_and_short_jobs_not_at_all(tmp_path: Path) -> None:
    entered = []
    with JobSlots(tmp_path, most=1).one():
        with JobSlots(tmp_path, most=1, longest_s=0.1).one():
            entered.append("after a while")
        with JobSlots(tmp_path, most=1, longest_s=3600).one(LONG_NS - 1):
            entered.append("at once")
    assert entered == ["after a while", "at once"]


def test_a_folder_that_cannot_be_written_keeps_no_one_from_work(tmp_path: Path) -> None:
    file = tmp_path / "no-folder"
    file.touch()
    with JobSlots(file).one(), JobSlots(None).one():
        pass
