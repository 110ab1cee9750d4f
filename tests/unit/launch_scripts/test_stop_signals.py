"""Signals that ask a launcher or a command to end, and output whose reader has gone."""

import os
import pty
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from support import contained
from support.processes import eventually

from launch_scripts.commands import run_commands
from launch_scripts.observe.run_folders import KnownRun
from launch_scripts.stop_requests import StopAsked, stop_requests

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    before = [signal.getsignal(number) for number in NUMBERS]
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests themselves may run under nohup
    yield
    for number, handler in zip(NUMBERS, before, strict=True):
        signal.signal(number, handler)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    now_s = [100.0]
    monkeypatch.setattr("launch_scripts.stop_requests.time.monotonic", lambda: now_s[0])
    return lambda seconds: now_s.__setitem__(0, now_s[0] + seconds)


def test_a_signal_leaves_what_takes_long_before_there_is_a_process() -> None:
    asked = StopAsked()
    threading.Timer(0.1, os.kill, [os.getpid(), signal.SIGTERM]).start()
    began_s = time.monotonic()
    assert asked.interruptible(lambda: time.sleep(20.0)) is None
    assert time.monotonic() - began_s < 5.0
    assert asked.interruptible(lambda: "work") is None, "asked before"
    assert (bool(asked), asked.force(), asked.exit_code) == (True, False, 143)


def test_the_second_ctrl_c_forces_but_not_an_echo_of_the_first(clock: Callable[[float], None]) -> None:
    asked = StopAsked()
    signal.raise_signal(signal.SIGINT)
    clock(0.1)
    signal.raise_signal(signal.SIGINT)  # as a wrapper sends on what the whole group has got
    assert not asked.force()
    clock(1.0)
    signal.raise_signal(signal.SIGINT)
    assert asked.force()
    assert asked.exit_code == 130


def test_a_closed_terminal_ends_in_order_however_often_it_says_so(clock: Callable[[float], None]) -> None:
    asked = StopAsked()
    for _ in range(3):
        signal.raise_signal(signal.SIGHUP)
        clock(1.0)
    assert asked
    assert not asked.force()
    assert asked.interruptible(lambda: "report", anew=True) == "report"


def test_nohup_stays_in_force() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    asked = StopAsked()
    signal.raise_signal(signal.SIGHUP)
    assert not asked


def test_the_report_is_written_after_two_signals_and_left_by_one_more(clock: Callable[[float], None]) -> None:
    asked = StopAsked()

    def work() -> str:
        signal.raise_signal(signal.SIGINT)
        clock(1.0)
        return "report"

    assert asked.interruptible(work, anew=True) == "report", "the first asks for the end only"
    assert asked.interruptible(work, anew=True) is None
    assert asked.interruptible(lambda: "report", anew=True) == "report"


_TALKER = """
import logging, sys, time
from pathlib import Path
from launch_scripts.stop_requests import StopAsked
from launch_scripts.launcher.console import Terminal

asked, terminal, out = StopAsked(), Terminal(False, sys.argv[2] == "plain"), Path(sys.argv[1])
with terminal.busy("driving"):
    until_s = time.monotonic() + 1.3
    while time.monotonic() < until_s and not asked:
        terminal.say("a line")
        time.sleep(0.02)
print("on standard output", flush=True)
print("on standard error", file=sys.stderr, flush=True)
terminal.say("writing")
out.write_text(f"report {asked.number}")
sys.exit(7)
"""


def talker(report: Path, how: str, **streams: int) -> subprocess.Popen[bytes]:
    folder = str(Path(__file__).parents[3])
    environment = {**os.environ, "PYTHONPATH": folder, "TERM": "xterm-256color"}
    command = [sys.executable, "-c", _TALKER, str(report), how]
    return subprocess.Popen(command, env=environment, start_new_session=True, **streams)  # type: ignore[call-overload,no-any-return]


def test_a_broken_pipe_silences_the_output_and_ends_nothing(tmp_path: Path) -> None:
    with talker(tmp_path / "report", "plain", stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        assert process.stdout.readline() == b"a line\n"
        process.stdout.close()  # as `head -1`
        assert process.wait(20) == 7
    assert (tmp_path / "report").read_text() == "report None"


def test_a_terminal_that_is_closed_loses_no_report(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    with talker(tmp_path / "report", "table", stdin=theirs, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        assert b"a line" in os.read(ours, 100)
        os.close(ours)  # writing gives EIO from now on
        process.send_signal(signal.SIGHUP)  # by the shell, and by the kernel
        process.send_signal(signal.SIGHUP)
        assert process.wait(20) == 7
    assert (tmp_path / "report").read_text() == "report 1"


# --- a command that runs until it is asked to end does so, even where the exception is lost -----------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_request_is_known_though_a_library_swallows_the_exception(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_requests() as stopping:
        assert not stopping()
        with suppress(BaseException):
            signal.raise_signal(number)
        assert stopping()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(number) is before


def test_followed_logs_end_though_a_library_swallows_the_exception(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    active = KnownRun(tmp_path, (1,), 0, False)

    def swallows(folder: Path) -> KnownRun:
        with suppress(BaseException):
            signal.raise_signal(signal.SIGTERM)
        return active

    monkeypatch.setattr(run_commands, "_chosen", lambda run: [active])
    monkeypatch.setattr(run_commands, "_run_in", swallows)
    run_commands.logs(follow=True)


# --- processes that ./launch_scripts/test starts end with it ----------------------------------------------------

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
        orphan = int(process.stdout.readline())
        process.send_signal(number)
        assert process.wait(30) != 0
    eventually(lambda: not psutil.pid_exists(orphan), 5, "the end of the orphan")


@pytest.mark.parametrize("code", [0, 5])
def test_the_exit_code_is_that_of_the_command(code: int) -> None:
    command = [sys.executable, str(Path(contained.__file__)), sys.executable, "-c", f"raise SystemExit({code})"]
    assert subprocess.run(command, timeout=30, check=False).returncode == code
