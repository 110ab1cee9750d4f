"""The router: a Zenoh session in router mode that passes on all messages."""

from __future__ import annotations

from collections.abc import Callable

from swarm.bus.bus import Bus, Event, Post
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.liveness import Peer
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import NO_RUN, Member
from swarm.runtime.process import Process, end_with
from swarm.runtime.role import RoleSetup
from swarm.runtime.stats import Counters
from swarm.wire.messages.processes import RunInfo


class RouterService:
    """Belongs to no run, so it may be stopped, started again and replaced while runs go on around it."""

    def __init__(self, peer: Peer, bus: Bus, post: Post) -> None:
        info = RunInfo(
            run_id=NO_RUN, role=peer.role, id=peer.id, incarnation=peer.incarnation, scenario="", terrain="",
            rows=0, cols=0, resolution_m=0.0, started_ns=peer.incarnation,
        )  # fmt: skip
        self._member = Member(info, bus, post)

    @property
    def counters(self) -> Counters:
        return self._member.counters

    def start(self, now_ns: int) -> None:
        self._member.join()

    def handle(self, event: Event, now_ns: int) -> None:
        self._member.handle(event)

    def tick(self, now_ns: int) -> None:
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._member.publish_stats(now_ns)


def run(setup: RoleSetup, stop_when: Callable[[], None] | None = None) -> None:
    clock, inbox = MonotonicClock(), Inbox()
    with open_bus(setup.scenario.network, mode="router") as bus:
        service = RouterService(Peer(setup.role, setup.id, setup.incarnation), bus, inbox.post)
        process = Process(service, inbox, clock, tick_hz=2.0)
        process.stop_on_signals()
        if stop_when is not None:
            end_with(stop_when, process.stop)
        process.run()
