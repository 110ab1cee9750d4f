"""What the operating system tells about processes, against what Python knows of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from launch_scripts.launcher.run_processes import cpu_s, has_ended, in_session, machine_cpu_s, pss_bytes, usage

pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self/smaps_rollup"), reason="there is no /proc")


def test_cpu_and_memory_are_those_of_the_process() -> None:
    me, machine_before_s, before_s = os.getpid(), machine_cpu_s(), cpu_s(os.getpid())
    assert machine_before_s is not None
    assert before_s == pytest.approx(time.process_time(), abs=0.1)
    until_s = time.process_time() + 0.3
    while time.process_time() < until_s:
        pass
    used_s = (cpu_s(me) or 0.0) - before_s
    assert used_s == pytest.approx(0.3, abs=0.1)
    assert (machine_cpu_s() or 0.0) - machine_before_s >= used_s - 0.1
    memory, now = pss_bytes(me), usage(me)
    assert memory is not None
    assert now is not None
    assert 1e6 < memory <= now.rss_bytes * 1.1


def test_a_session_is_its_living_processes_and_of_one_that_has_ended_nothing_is_told() -> None:
    sleeper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
    try:
        assert in_session(sleeper.pid) == [sleeper.pid]
        assert os.getpid() in in_session(os.getsid(0))
    finally:
        sleeper.kill()
        while not has_ended(sleeper.pid):
            time.sleep(0.01)
    assert in_session(sleeper.pid) == []  # dead, though not yet reaped
    sleeper.wait(10)
    assert cpu_s(sleeper.pid) is pss_bytes(sleeper.pid) is usage(sleeper.pid) is None
