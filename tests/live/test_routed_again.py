"""A machine of agents is cut off without a word, or dies as a whole: its vehicles are soon on their routes again.

The time to a new route, with more rounds: `PYTHONPATH=.:tests python tests/live/test_routed_again.py 5 30 120`"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.launchers import Routed
from support.live_swarm import Hands, client
from support.processes import eventually, session_of
from support.silent_link import SilentLink

from swarm.bus.endpoints import host_port, listening

pytestmark = [pytest.mark.network, pytest.mark.slow]

BASE = [option for role in ("router", "keeper", "targets", "planner") for option in ("--only", role)]


class TwoMachines:
    """A base, and a machine of agents behind a link that can be cut."""

    def __init__(self, folder: Path) -> None:
        self.hands = Hands(folder)
        self.base = self.hands.start("up", str(self.hands.path), *BASE, "--plain")
        self.link = SilentLink(host_port(self.hands.network.connect[0])[1])

    def start_agents(self) -> None:
        endpoint = f"tcp/127.0.0.1:{self.link.port}"
        arguments = ("up", str(self.hands.path), "--only", "agent", "--connect", endpoint, "--plain")
        self.agents = self.hands.start(*arguments, runs=self.hands.folder / "car-runs", own_session=True)

    def kill_agents(self) -> None:
        """The launcher and all that it started, at one instant."""
        os.killpg(self.agents.pid, signal.SIGKILL)
        self.agents.wait(20)
        eventually(lambda: not session_of(self.agents.pid), 20, "the end of the machine")


@contextmanager
def two_machines(folder: Path) -> Iterator[tuple[TwoMachines, Routed]]:
    machines = TwoMachines(folder)
    try:
        eventually(lambda: listening(machines.hands.network.connect[0]), 120, "the router")
        with client(machines.hands.network) as bus:
            routed = Routed(bus)
            machines.start_agents()
            routed.again(180)
            yield machines, routed
    finally:
        machines.link.close()
        for process in (getattr(machines, "agents", None), machines.base):
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGINT)
                try:
                    process.wait(30)
                except subprocess.TimeoutExpired:
                    process.kill()


@pytest.mark.thorough
def test_after_a_silent_cut_and_after_the_death_of_a_whole_machine_all_vehicles_are_routed_again(
    tmp_path: Path,
) -> None:
    with two_machines(tmp_path) as (machines, routed):
        machines.link.cut()
        time.sleep(5)  # longer than the lease
        assert not routed.any_since(time.monotonic() - 1)
        machines.link.heal()
        routed.again(20)
        machines.kill_agents()
        machines.start_agents()
        routed.again(180)
        assert machines.base.poll() is None, machines.hands.logs()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name, two_machines(Path(name)) as (machines, routed):
        for cut_s in map(float, sys.argv[1:]):
            machines.link.cut()
            time.sleep(cut_s)
            machines.link.heal()
            sys.stdout.write(f"cut of {cut_s:g} s: routed again {routed.again(60):.2f} s after it healed\n")
        machines.kill_agents()
        machines.start_agents()
        sys.stdout.write(f"machine killed and started again: routed again after {routed.again(180):.2f} s\n")
