"""A later start has the higher incarnation, whatever the clock says."""

import threading
from pathlib import Path

import msgspec
import pytest

from launch_scripts.launcher import run_options
from launch_scripts.launcher.run_options import next_incarnation
from swarm.clock import MonotonicClock
from swarm.errors import StoreError
from swarm.wire.fields import StampNs


def test_every_start_is_a_later_generation_though_the_clock_goes_back_forward_and_to_1970(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hour_ns, now_ns = 3600 * 10**9, 1_800_000_000 * 10**9
    found = []
    for clock_ns in (now_ns, now_ns - hour_ns, 0, now_ns + hour_ns, now_ns, 2 * now_ns, now_ns, 0, now_ns):
        monkeypatch.setattr(run_options.time, "time_ns", lambda clock_ns=clock_ns: clock_ns)
        found.append(next_incarnation(tmp_path, "agent", "a0"))
    assert found == sorted(set(found))
    assert next_incarnation(tmp_path, "agent", "a1") == now_ns, "each process has lives of its own"


@pytest.mark.parametrize("clock_ns", [-1, -(1 << 62), 1 << 62, 7_283_273_229_637_594_984, (1 << 63) - 1])
def test_a_start_with_an_impossible_clock_is_one_of_which_messages_can_speak(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock_ns: int
) -> None:
    monkeypatch.setattr(run_options.time, "time_ns", lambda: clock_ns)
    found = [next_incarnation(tmp_path, "agent", "a0") for _ in range(3)]
    assert found == sorted(set(found))
    for told_ns in (*found, MonotonicClock().now_ns()):
        msgspec.convert(told_ns, StampNs)


def test_of_many_that_start_at_once_each_gets_a_number_of_its_own(tmp_path: Path) -> None:
    found: list[int] = []
    threads = [
        threading.Thread(target=lambda: found.append(next_incarnation(tmp_path, "planner", "t0")))
        for _ in range(20)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert len(set(found)) == 20


def test_a_changed_file_is_written_again_from_the_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = 1_800_000_000 * 10**9
    monkeypatch.setattr(run_options.time, "time_ns", lambda: now_ns)
    path = tmp_path / "lives" / "agent-a0"
    path.parent.mkdir()
    path.write_text(f"{now_ns:020}")  # from before there were digests
    assert next_incarnation(tmp_path, "agent", "a0") == now_ns + 1
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert next_incarnation(tmp_path, "agent", "a0") == now_ns
        path.write_bytes(whole[:at])
        assert next_incarnation(tmp_path, "agent", "a0") == now_ns + 2 * (at in (20, 21)), "its digest alone is cut"


def test_a_folder_that_cannot_be_written_is_one_sentence() -> None:
    with pytest.raises(StoreError, match="cannot write /proc/nowhere/lives/agent-a0"):
        next_incarnation(Path("/proc/nowhere"), "agent", "a0")
