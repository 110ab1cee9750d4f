"""The machine of the leading planners dies or hangs, and the standbys on another one answer."""

import itertools
import os
import signal
import sys
import time
from pathlib import Path

import pytest
from support.live_swarm import SWARM, LiveSwarm, client
from support.processes import Child, eventually

from swarm.bus.bus import Event, Heard, Replied
from swarm.bus.zenoh_bus import ZenohBus
from swarm.endpoints import listening
from swarm.runtime.inbox import Inbox
from swarm.wire.messages.planning import RouteReply, RouteRequest
from swarm.wire.messages.processes import Heartbeat, Stats
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import LEAD, ROUTE, STATS

pytestmark = [pytest.mark.network, pytest.mark.slow]

ASK_S = 0.05
LONGEST_GAP_S = 3.0
SECONDS_PER_CASE = 6.0


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


class Leaders:
    """The current leaders, by the claims of each process."""

    def __init__(self, bus: ZenohBus) -> None:
        self.told: dict[str, bool] = {}
        self.lost = 0.0
        bus.subscribe(LEAD, self._take)
        bus.subscribe(STATS, self._take, role="agent")

    def _take(self, event: Event) -> None:
        match event:
            case Heard(message=Heartbeat() as heartbeat):
                self.told[heartbeat.id] = heartbeat.leads
            case Heard(message=Stats() as stats):
                self.lost = stats.gauges.get("lost", 0.0)

    def are(self, **told: bool) -> bool:
        """True if the planner of t0 and its standby lead: `first`, `second`."""
        return {"first": self.told.get("t0"), "second": self.told.get("t0.r1")} == told


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
        with client(live.network) as bus, machine(live, elsewhere) as far:
            launcher, leaders = far.process, Leaders(bus)
            eventually(lambda: leaders.are(first=True, second=False), 150, "the planner of rank 0 to lead")
            for how, number in (("hangs", signal.SIGSTOP), ("is dead", signal.SIGKILL)):
                asker = Asker(bus, "t0")
                asker.ask_for(2.0)
                before = {generation for _, generation in asker.answers}
                os.killpg(launcher.pid, number)
                asker.ask_for(SECONDS_PER_CASE)
                gaps_s[how] = asker.longest_gap_s()
                assert asker.answers[-1][1] not in before, how
                assert gaps_s[how] < LONGEST_GAP_S, (how, gaps_s, live.text)
                if number == signal.SIGSTOP:
                    os.killpg(launcher.pid, signal.SIGCONT)
                    eventually(lambda: leaders.are(first=True, second=False), 60, "rank 0 to lead again")
            assert leaders.lost == 0
    told = ", ".join(f"{gap_s:.2f} s when the machine {how}" for how, gap_s in gaps_s.items())
    with capsys.disabled():
        sys.stdout.write(f"\nlongest time without an answer: {told}\n")
