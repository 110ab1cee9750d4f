"""The launcher with idle processes: starts, restarts, ordered ends, and no process left behind."""

import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import psutil
import pytest
from support.idle_swarm import idle_swarm
from support.processes import eventually

from launch_scripts.launcher import forkserver
from launch_scripts.launcher.child_main import ExitReason
from launch_scripts.launcher.forkserver import _build
from launch_scripts.launcher.local_processes import Ending, LocalSwarm
from launch_scripts.launcher.takeover import has_ended
from launch_scripts.process_table import TABLE, ProcessSpec
from planner_service import kernel_build
from planner_service.kernel_build import name_of, needed_kernels, place_kernels
from swarm.config.scenario import Scenario

# Marked as network tests, like those: its tests wait for processes.
pytestmark = [pytest.mark.network, pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")]


@pytest.fixture
def swarms() -> Iterator[list[LocalSwarm]]:
    swarms: list[LocalSwarm] = []
    yield swarms
    for swarm in swarms:
        swarm.kill()


def swarm_of(swarms: list[LocalSwarm], folder: Path, *rows: tuple[str, str, str]) -> LocalSwarm:
    swarms.append(idle_swarm(folder, *rows))
    return swarms[-1]


def wait_for_start(folder: Path, name: str) -> None:
    path = folder / "order.txt"
    eventually(lambda: path.exists() and f"+{name}" in path.read_text().split(), 10.0, f"the start of {name}")


def started(swarms: list[LocalSwarm], folder: Path, *rows: tuple[str, str, str]) -> LocalSwarm:
    """Processes which have all begun."""
    swarm = swarm_of(swarms, folder, *rows)
    swarm.start()
    for role, id, _ in rows:
        wait_for_start(folder, f"{role}-{id}")
    return swarm


def endings_within(swarm: LocalSwarm, within_s: float = 10.0) -> list[Ending]:
    found: list[Ending] = []
    eventually(lambda: found.extend(swarm.poll()) or found, within_s, "an ending")
    return found


def test_processes_end_role_by_role_and_each_has_a_log(swarms: list[LocalSwarm], tmp_path: Path) -> None:
    rows = (("router", "0"), ("keeper", "0"), ("planner", "t0"), ("agent", "a0"))
    swarm = started(swarms, tmp_path, *((role, id, "quiet") for role, id in rows))
    order = tmp_path / "order.txt"
    ours = os.getpriority(os.PRIO_PROCESS, 0)
    for running in swarm.running:
        assert running.process.pid is not None
        niceness = min(ours + TABLE[running.spec.role].niceness, 19)
        pid = running.process.pid
        eventually(lambda pid=pid, niceness=niceness: os.getpriority(os.PRIO_PROCESS, pid) == niceness, 5)
    assert swarm.stop(lambda: time.sleep(0.02)) == []
    assert order.read_text().split()[4:] == ["-agent-a0", "-planner-t0", "-keeper-0", "-router-0"]
    assert "hello from t0" in (tmp_path / "planner-t0.log").read_text()


@pytest.mark.parametrize(
    ("row", "sentence", "again_s", "logged"),
    [
        (
            ("planner", "t0", "lose_a_thread"), "IndexError: list index out of range", 0.2,
            "thread reader ended by IndexError: list index out of range",
        ),
        (
            ("agent", "a0", "hang_in_native_code"),
            "a plug-in did not come back from native code; its log says where", 0.2, "in hang_in_native_code",
        ),
        (("planner", "t0", "leave_early"), "SystemExit: 0", 0.2, "crashed"),
        (("planner", "t0", "refuse"), "the scenario is not to my liking", None, "the scenario is not to my liking"),
    ],
)  # fmt: skip
def test_why_a_process_ended_is_said_and_only_one_that_refuses_is_not_started_again(
    row: tuple[str, str, str],
    sentence: str,
    again_s: float | None,
    logged: str,
    swarms: list[LocalSwarm],
    tmp_path: Path,
) -> None:
    swarm = swarm_of(swarms, tmp_path, row)
    swarm.start()
    (ending,) = endings_within(swarm, 20)
    assert (ending.sentence, ending.restart_in_s) == (sentence, again_s)
    assert ending.exit_code == 2 or again_s is not None
    log = (tmp_path / f"{row[0]}-{row[1]}.log").read_text()
    assert logged in log
    assert ("Traceback" in log) <= (again_s is not None)


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        ("stubborn", "keeper-0 did not end within 0.5 s and was killed"),
        ("fail_at_the_end", "keeper-0 was asked to end, but RuntimeError: could not write the last page"),
    ],
)
def test_who_does_not_end_when_asked_or_fails_then_is_named(
    function: str, sentence: str, swarms: list[LocalSwarm], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("launch_scripts.launcher.local_processes.STOP_GRACE_S", 0.5)
    swarm = started(swarms, tmp_path, ("keeper", "0", function), ("router", "0", "quiet"))
    assert sentence in swarm.stop(lambda: time.sleep(0.02))


def test_who_has_ended_as_asked_and_does_not_leave_holds_up_no_one_and_is_no_failure(
    swarms: list[LocalSwarm], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rows = [("agent", "a0", "end_and_stay"), ("keeper", "0", "end_and_stay"), ("router", "0", "quiet")]
    swarm = started(swarms, tmp_path, *rows)
    pids = [running.process.pid for running in swarm.running if running.process]

    def meanwhile() -> None:
        time.sleep(0.02)
        if (
            "-keeper-0" in (tmp_path / "order.txt").read_text()
        ):  # all but the router have ended: little time is left
            monkeypatch.setattr("launch_scripts.launcher.local_processes.STOP_GRACE_S", 1.0)

    monkeypatch.setattr("launch_scripts.launcher.local_processes.STOP_GRACE_S", 60.0)
    began_s = time.monotonic()
    assert swarm.stop(meanwhile) == []
    assert time.monotonic() - began_s < 30.0
    assert "agent-a0 has ended and does not leave: " in caplog.text
    assert "router-0 has ended" not in caplog.text
    assert not any(each.alive for each in swarm.running)
    eventually(lambda: all(pid is not None and has_ended(pid) for pid in pids), 10)


def test_when_the_end_is_asked_for_twice_all_end_at_once_and_only_who_was_killed_is_named(
    swarms: list[LocalSwarm], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("launch_scripts.launcher.local_processes.FORCED_GRACE_S", 0.5)
    rows = [("agent", "a0", "stubborn"), ("keeper", "0", "quiet"), ("router", "0", "quiet")]
    swarm = started(swarms, tmp_path, *rows)
    began_s = time.monotonic()
    failures = swarm.stop(lambda: time.sleep(0.02), force=lambda: time.monotonic() > began_s + 0.1)
    assert failures == []
    assert swarm.cut_short == ["agent-a0"]
    assert {"-keeper-0", "-router-0"} <= set((tmp_path / "order.txt").read_text().split())
    assert time.monotonic() - began_s < 2.0


def refused(swarm: LocalSwarm, ran_s: float, *, restarts: int = 1) -> float | None:
    """Ends the only process by a refusal after a run; returns the launcher's wait before the next start."""
    running = swarm.running[0]
    sentinel, other_end = socket.socketpair()
    other_end.close()  # which makes it readable, as that of a process which has ended
    ended = mock.Mock(exitcode=4, pid=1, sentinel=sentinel)
    ended.recv.return_value = ExitReason("cannot reach a router", 4, True)
    running.process = running.pipe = ended
    running.restarts, running.began_s = restarts, time.monotonic() - ran_s
    (ending,) = swarm.poll()
    return ending.restart_in_s


def test_refusals_far_apart_never_end_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [1000.0]
    monkeypatch.setattr("time.monotonic", lambda: now_s[0])
    swarm = swarm_of([], tmp_path, ("planner", "t0", "quiet"))
    for _ in range(30):
        assert refused(swarm, ran_s=80_000.0) == 0.2
        now_s[0] += 86_400
    assert refused(swarm, ran_s=80_000.0, restarts=0) == 0.2  # its first generation was a good one


@pytest.mark.parametrize(
    ("role", "first_start", "waits_s"),
    [
        ("planner", False, [0.2, 0.4, 0.8, 1.6, None]),  # five within a minute are final
        ("planner", True, [None]),
        ("monitor", False, [0.2, 0.4, 0.8, 1.6, 60.0, 60.0]),  # it ends nothing, and is tried once a minute
        ("monitor", True, [60.0]),
    ],
)
def test_refusals_at_the_first_start_or_close_together_are_final_unless_a_run_goes_on_without_the_process(
    role: str, first_start: bool, waits_s: list[float | None], tmp_path: Path
) -> None:
    swarm = swarm_of([], tmp_path, (role, "0", "quiet"))
    assert [refused(swarm, ran_s=1.0, restarts=int(not first_start)) for _ in waits_s] == waits_s


def test_processes_are_added_and_dismissed_while_the_others_run(tmp_path: Path, swarms: list[LocalSwarm]) -> None:
    swarm = swarm_of(swarms, tmp_path, ("agent", "a0", "quiet"))
    swarm.start()
    added = ProcessSpec("planner", "x", "support.dummy_roles:quiet", added=True)
    swarm.add(added)
    eventually(lambda: [each.alive for each in swarm.running] == [True, True], 10)
    swarm.dismiss(added)
    endings: list[Ending] = []
    eventually(lambda: endings.extend(swarm.poll()) or len(swarm.running) == 1, 15, "the end of the planner")
    assert endings == []
    assert [each.spec.role for each in swarm.running] == ["agent"]


def test_a_process_begins_once_what_it_waits_for_is_so_and_not_at_all_after_the_end(
    tmp_path: Path, swarms: list[LocalSwarm]
) -> None:
    rows = [("keeper", "0", "quiet"), ("agent", "a0", "quiet"), ("agent", "a1", "quiet")]
    swarm = swarm_of(swarms, tmp_path, *rows)
    _, agent, other = swarm.running
    allowed: list[str] = []
    agent.begins_when = lambda: "a0" in allowed
    other.begins_when = lambda: "a1" in allowed
    swarm.start()
    wait_for_start(tmp_path, "keeper-0")
    assert swarm.poll() == []
    assert [each.alive for each in swarm.running] == [True, False, False]
    allowed.append("a0")
    assert swarm.poll() == []
    wait_for_start(tmp_path, "agent-a0")
    assert swarm.stop() == []
    allowed.append("a1")
    assert swarm.poll() == []
    assert not other.alive


def test_what_is_started_after_the_forkserver_was_killed_leaves_signals_to_the_launcher(
    tmp_path: Path, swarms: list[LocalSwarm]
) -> None:
    swarm = started(swarms, tmp_path, ("agent", "a0", "quiet"))
    running, order = swarm.running[0], tmp_path / "order.txt"
    os.kill(psutil.Process(running.pid).ppid(), signal.SIGKILL)
    endings_within(swarm)
    eventually(lambda: swarm.poll() or order.read_text().count("+agent-a0") == 2, 10, "the second start")
    lines = Path(f"/proc/{running.pid}/status").read_text().splitlines()
    held_back = next(int(line.split()[1], 16) for line in lines if line.startswith("SigBlk"))
    assert held_back >> signal.SIGINT - 1 & 1


def test_an_added_process_that_refuses_ends_no_run(tmp_path: Path, swarms: list[LocalSwarm]) -> None:
    swarm = swarm_of(swarms, tmp_path)
    swarm.add(ProcessSpec("planner", "x", "support.dummy_roles:refuse", added=True))
    (ending,) = endings_within(swarm)
    assert "not to my liking" in ending.sentence
    assert ending.restart_in_s is not None


def test_what_loads_kernels_for_a_launcher_that_is_gone_ends_without_a_word() -> None:
    receiver, sender = multiprocessing.Pipe(duplex=False)
    receiver.close()
    _build(sender, None, is_first=True)
    with pytest.raises(OSError, match="Broken pipe"):
        sender.send(0)


def test_builders_make_what_the_places_process_starts_with_before_what_saves_time(monkeypatch) -> None:
    for name, fake in (("_end_with_launcher", lambda: None), ("os.nice", lambda _: None)):
        monkeypatch.setattr(name if "." in name else f"{forkserver.__name__}.{name}", fake)
    built: list[str] = []
    monkeypatch.setattr(kernel_build, "missing", list)
    monkeypatch.setattr(kernel_build, "build", lambda kernels, _: built.extend(map(name_of, kernels)))
    _build(multiprocessing.Pipe()[1], Scenario(), is_first=True)
    needed, places = needed_kernels(Scenario()), place_kernels(Scenario())
    soon = set(map(name_of, (*needed.first, *places.first)))
    assert sorted(built) == sorted({*map(name_of, (*needed, *places))})
    assert set(built[: len(soon)]) == soon
