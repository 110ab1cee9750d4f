"""The machine of the leading planners dies or hangs, and the standbys on another one answer."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from operator import itemgetter
from pathlib import Path

import pytest
from support.live_swarm import SWARM, LiveSwarm, client
from support.onlooker_program import Notes, look_on, steady
from support.processes import Child, eventually

from swarm.bus.zenoh_bus import ZenohBus
from swarm.endpoints import listening

pytestmark = [pytest.mark.network, pytest.mark.slow]

LONGEST_GAP_S = 3.0
SECONDS_PER_CASE = 6.0


@contextmanager
def noted(bus: ZenohBus) -> Iterator[Notes]:
    """Notes of what is said and answered meanwhile."""
    notes, over = Notes(), threading.Event()
    onlooker = threading.Thread(target=look_on, args=(bus, notes, ["t0"], lambda: not over.is_set()))
    onlooker.start()
    try:
        yield notes
    finally:
        over.set()
        onlooker.join()


def last_answer(notes: Notes) -> tuple[int, float]:
    """The life of a planner that answered last, and when that was."""
    return max(((life, last_s) for life, (_, last_s) in [*notes.answered["t0"].items()]), key=itemgetter(1))


def machine(live: LiveSwarm, folder: Path) -> Child:
    """A launcher elsewhere, with the planners that lead, in a session of its own."""
    options = ("--connect", live.endpoint, "--only", "planner", "--rank", "0", "--plain", "--runs", folder)
    return Child(folder / "output.txt", *SWARM, "up", live.path, *options, start_new_session=True)


@pytest.mark.thorough
def test_vehicles_and_clients_are_answered_again_soon_after_the_planners_machine_is_gone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = [option for role in ("router", "keeper", "targets", "planner", "agent") for option in ("--only", role)]
    also = "\n[standbys]\nplanner = 1\ntargets = 1\n"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    gaps_s: dict[str, float] = {}
    with LiveSwarm(tmp_path, *parts, "--rank", "1", also=also) as live:
        eventually(lambda: listening(live.endpoint), 60, "the router")
        with client(live.network) as bus, noted(bus) as notes, machine(live, elsewhere) as far:
            for how, number in (("hangs", signal.SIGSTOP), ("is dead", signal.SIGKILL)):
                eventually(lambda: notes.answered and steady(notes.leads, "t0"), 150, "rank 0 to lead")
                time.sleep(2.0)
                os.killpg(far.process.pid, number)
                time.sleep(0.2)  # what was answered before it ended comes
                ended, last_s = last_answer(notes)
                time.sleep(SECONDS_PER_CASE)
                other, _ = last_answer(notes)
                assert other != ended, how
                gaps_s[how] = notes.answered["t0"][other][0] - last_s
                assert gaps_s[how] < LONGEST_GAP_S, (how, gaps_s, live.text)
                if number == signal.SIGSTOP:
                    os.killpg(far.process.pid, signal.SIGCONT)
    told = ", ".join(f"{gap_s:.2f} s when the machine {how}" for how, gap_s in gaps_s.items())
    with capsys.disabled():
        sys.stdout.write(f"\nlongest time without an answer: {told}\n")
