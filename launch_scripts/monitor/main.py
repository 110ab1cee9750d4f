"""The monitor as a process. It takes part in the run once its view is loaded: no other process waits for it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from launch_scripts.web.live_page import LivePage, when_free
from shared_map.terrain.store import load_terrain
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.run_secret import authenticator_of

FRAME_HZ = 10.0
"""Frame rate for viewers."""


def run(setup: RoleSetup, built: Callable[[], None]) -> None:
    """Records and shows the run until SIGTERM, SIGINT or the end of the launcher.

    A run that ends before the view is loaded has none, and no recording: its end waits for neither.
    """
    terrain = load_terrain(setup)
    inbox = Inbox()
    built()  # from here on others go first: the view takes more CPU than the start of any of them
    with contextlib.ExitStack() as stack:
        view, page = setup.scenario.monitor, None
        if view.live:
            name = f"{setup.scenario.name}, run {setup.run_id}"
            facts = {"life": "", "at_s": 0.0, "name": name, "state": "its processes have begun"}
            page = when_free(lambda: LivePage(view.web_port, lambda: facts, terrain))
            stack.callback(page.server.close)
        network = setup.scenario.network
        bus = stack.enter_context(
            open_bus(network, patient=True, authenticator=authenticator_of(network, setup.run_id))
        )
        from launch_scripts.monitor.service import load_view  # takes as long as a whole planner's start

        service = load_view(setup, terrain, bus, inbox.post, stack, page)
        process = Process(service, inbox, MonotonicClock(), FRAME_HZ, health=setup.health, gather=bus.gather)
        process.stop_on_signals()
        process.run()
