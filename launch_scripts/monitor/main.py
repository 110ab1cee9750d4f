"""The monitor as a process."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from launch_scripts.monitor.loading import FRAME_HZ, LoadingMonitor
from shared_map.terrain.prepared import load_terrain
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import Member
from swarm.runtime.process import Process, Service, end_with
from swarm.runtime.role import RoleSetup


def run(setup: RoleSetup, stop_when: Callable[[], None] | None) -> None:
    """Records and shows the run until SIGTERM, SIGINT or the end of the launcher."""
    terrain = load_terrain(setup)
    inbox = Inbox()
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(open_bus(setup.scenario.network, patient=True))

        def load() -> Callable[[Member], Service]:
            from launch_scripts.monitor.view import load_view  # takes as long as a whole planner's start

            return load_view(setup, terrain, bus, inbox.post, stack)

        info = setup.info(terrain.grid, terrain.digest)
        service = LoadingMonitor(Member(info, bus, inbox.post, setup.before), inbox.post, load)
        process = Process(service, inbox, MonotonicClock(), FRAME_HZ, health=setup.health)
        process.stop_on_signals()
        if stop_when is not None:
            end_with(stop_when, process.stop)
        process.run()
