"""Roles that do next to nothing, each in the way that a test of the launcher needs."""

import itertools
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from swarm.bus.bus import Event
from swarm.clock import MonotonicClock
from swarm.errors import ConfigError
from swarm.plugins import call_within
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.stats import Counters

Built = Callable[[], None]


def quiet(setup: RoleSetup, built: Built) -> None:
    """Runs until SIGTERM, and writes down when it began and ended."""
    ended: list[int] = []  # an Event would deadlock if the signal came in the middle of its wait
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    built()
    _write(setup, "+")
    sys.stdout.write(f"hello from {setup.id}\n")
    while not ended:
        time.sleep(0.05)
    _write(setup, "-")


def _write(setup: RoleSetup, sign: str) -> None:
    assert setup.run_dir is not None
    with (setup.run_dir / "order.txt").open("a") as order:
        order.write(f"{sign}{setup.role}-{setup.id}\n")


class Idle:
    """A service without any work, which is ready at once."""

    def __init__(self) -> None:
        self.counters = Counters()

    def lacks(self) -> list[str]:
        return []

    def start(self, now_ns: int) -> None:
        pass

    def handle(self, event: Event, now_ns: int) -> None:
        pass

    def tick(self, now_ns: int) -> None:
        pass

    def stop(self, now_ns: int) -> None:
        pass


class LosesAThread(Idle):
    """It starts a thread that dies."""

    def start(self, now_ns: int) -> None:
        threading.Thread(target=lambda: [][1], name="reader").start()


def lose_a_thread(setup: RoleSetup, built: Built) -> None:
    Process(LosesAThread(), Inbox(), MonotonicClock(), tick_hz=20.0).run()


def hang_in_native_code(setup: RoleSetup, built: Built) -> None:
    call_within(0.1, lambda: sum(itertools.repeat(0)))


def refuse(setup: RoleSetup, built: Built) -> None:
    raise ConfigError("the scenario is not to my liking")


def stubborn(setup: RoleSetup, built: Built) -> None:
    """Neither SIGTERM nor the end of the launcher moves it, from when it has written down that it began."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _write(setup, "+")
    time.sleep(1000)


def fail_at_the_end(setup: RoleSetup, built: Built) -> None:
    quiet(setup, built)
    raise RuntimeError("could not write the last page")


def end_and_stay(setup: RoleSetup, built: Built) -> None:
    """Ends as asked, and does not leave: as where a disk that stalls keeps the system from closing its files."""
    quiet(setup, built)
    os._exit = lambda code: time.sleep(1000)  # type: ignore[assignment, return-value]


def leave_early(setup: RoleSetup, built: Built) -> None:
    sys.exit(0)


def _run(setup: RoleSetup, service: Idle) -> None:
    process = Process(service, Inbox(), MonotonicClock(), tick_hz=20.0, health=setup.health)
    process.stop_on_signals()
    process.run()


class StandsStill(Idle):
    """Its third tick never ends, in the first generation of the process."""

    def __init__(self, marker: Path) -> None:
        super().__init__()
        self._marker = marker
        self._ticks = 0

    def tick(self, now_ns: int) -> None:
        self._ticks += 1
        if self._ticks == 3 and not self._marker.exists():
            self._marker.touch()
            self.stand_still()

    def stand_still(self) -> None:
        threading.Event().wait()


def stand_still(setup: RoleSetup, built: Built) -> None:
    assert setup.run_dir is not None
    _run(setup, StandsStill(setup.run_dir / "stood still"))
