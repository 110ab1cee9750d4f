"""The router: a Zenoh session in router mode, and a member of the run."""

from __future__ import annotations

import logging
from collections.abc import Callable

from shared_map.terrain.terrain import load_terrain
from swarm.bus.bus import Bus, Event, Post
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.errors import RunMismatchError
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import Member
from swarm.runtime.process import Process, end_with
from swarm.runtime.role import RoleSetup
from swarm.runtime.stats import Counters
from swarm.wire.messages.processes import RunInfo

log = logging.getLogger(__name__)


class RouterService:
    """Answers which run this is. A process of another run ends by itself; the router only reports it."""

    def __init__(self, info: RunInfo, bus: Bus, post: Post) -> None:
        self._member = Member(info, bus, post)

    @property
    def counters(self) -> Counters:
        return self._member.counters

    def start(self, now_ns: int) -> None:
        self._member.join()

    def handle(self, event: Event, now_ns: int) -> None:
        try:
            self._member.handle(event)
        except RunMismatchError as error:
            log.warning("%s", error)
            self.counters.count("strangers")
            self._member.note(now_ns, "stranger", str(error))

    def tick(self, now_ns: int) -> None:
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._member.publish_stats(now_ns)


def run(setup: RoleSetup, stop_when: Callable[[], None] | None = None) -> None:
    terrain = load_terrain(setup)
    clock, inbox = MonotonicClock(), Inbox()
    with open_bus(setup.scenario.network, mode="router") as bus:
        service = RouterService(setup.info(terrain.grid, terrain.digest), bus, inbox.post)
        process = Process(service, inbox, clock, tick_hz=2.0)
        process.stop_on_signals()
        if stop_when is not None:
            end_with(stop_when, process.stop)
        process.run()
