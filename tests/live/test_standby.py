"""The machine of the leading planners dies or hangs, and the standbys on another one answer."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.live_swarm import SWARM, LiveSwarm, client, swarm
from support.processes import eventually, session_of

from swarm.bus.bus import Replied
from swarm.bus.zenoh_bus import ZenohBus
from swarm.runtime.inbox import Inbox
from swarm.wire.messages.planning import RouteReply, RouteRequest
from swarm.wire.routes import RouteStatus
from swarm.wire.topics import ROUTE

pytestmark = [pytest.mark.network, pytest.mark.slow]

ASK_S = 0.05
LONGEST_GAP_S = 3.0
SECONDS_PER_CASE = 12.0


class Asker:
    """A client that asks for a route every 50 ms, and notes when an answer came and from whom."""

    def __init__(self, bus: ZenohBus, target: str) -> None:
        self.bus = bus
        self.target = target
        self.inbox = Inbox()
        self.answers: list[tuple[float, int]] = []

    def ask_for(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        due_s = time.monotonic()
        while (now_s := time.monotonic()) < until_s:
            if now_s >= due_s:
                due_s += ASK_S
                request = RouteRequest(row=8, col=8)
                self.bus.ask(ROUTE, request, self.inbox.post, tag="asker", timeout_s=1.0, target=self.target)
            event = self.inbox.take(max(due_s - time.monotonic(), 0.0))
            reply = event.message if isinstance(event, Replied) else None
            if isinstance(reply, RouteReply) and reply.routes[0].status is not RouteStatus.NO_TARGET:
                self.answers.append((time.monotonic(), reply.incarnation))

    def longest_gap_s(self) -> float:
        return max(late - early for (early, _), (late, _) in itertools.pairwise(self.answers))


def leading(endpoint: str) -> dict[str, bool | None]:
    told = swarm("status", "--connect", endpoint, "--json")
    if told.returncode != 0:
        return {}
    return {f"{each['role']}-{each['id']}": each["leads"] for each in json.loads(told.stdout)["processes"]}


@contextlib.contextmanager
def machine(live: LiveSwarm, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A launcher elsewhere, with the planners that lead, in a session of its own."""
    options = ["--connect", live.endpoint, "--only", "planner", "--rank", "0", "--plain", "--runs", str(folder)]
    with (folder / "output.txt").open("w") as output:
        launcher = subprocess.Popen(
            [*SWARM, "up", str(live.path), *options], stdout=output, stderr=output, start_new_session=True
        )
    try:
        yield launcher
    finally:
        if session_of(launcher.pid):
            os.killpg(launcher.pid, signal.SIGKILL)
        launcher.wait(10)


def test_vehicles_and_clients_are_answered_again_soon_after_the_planners_machine_is_gone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    live = LiveSwarm(tmp_path, "--rank", "1", "--no-live", also="\n[standbys]\nplanner = 1\ntargets = 1\n")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    gaps_s: dict[str, float] = {}
    try:
        eventually(
            lambda: leading(live.endpoint).get("planner-t0.r1"), 120, "the standby to lead while it is alone"
        )
        with machine(live, elsewhere) as launcher, client(live.network) as bus:
            eventually(lambda: leading(live.endpoint).get("planner-t0"), 120, "the planner of rank 0 to lead")
            assert leading(live.endpoint)["planner-t0.r1"] is False
            for how, number in (("hangs", signal.SIGSTOP), ("is dead", signal.SIGKILL)):
                asker = Asker(bus, "t0")
                asker.ask_for(3.0)
                before = {life for _, life in asker.answers}
                os.killpg(launcher.pid, number)
                asker.ask_for(SECONDS_PER_CASE)
                gaps_s[how] = asker.longest_gap_s()
                assert asker.answers[-1][1] not in before, how
                assert gaps_s[how] < LONGEST_GAP_S, (how, live.output.read_text())
                if number == signal.SIGSTOP:
                    os.killpg(launcher.pid, signal.SIGCONT)
                    eventually(lambda: leading(live.endpoint).get("planner-t0"), 60, "rank 0 to lead again")
        status = json.loads(swarm("status", "--connect", live.endpoint, "--json").stdout)
        assert sum(process["gauges"]["lost"] for process in status["processes"] if process["role"] == "agent") == 0
    finally:
        live.end()
        live.kill()
        told = ", ".join(f"{gap_s:.2f} s when the machine {how}" for how, gap_s in gaps_s.items())
        with capsys.disabled():
            sys.stdout.write(f"\nlongest time without an answer: {told}\n")
