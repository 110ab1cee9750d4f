"""The monitor as a process: a start of the swarm does not wait for what only draws it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import cast

from launch_scripts.web.live_page import LivePage, when_free
from shared_map.terrain.store import load_terrain
from swarm.bus.bus import Event, Post, WorkDone
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import Member
from swarm.runtime.process import Process, Service, end_with
from swarm.runtime.role import RoleSetup
from swarm.runtime.run_secret import authenticator_of
from swarm.runtime.stats import Counters

FRAME_HZ = 10.0
"""Frame rate for viewers."""
_TAG = "view"
_Make = Callable[[Member], Service]


def run(setup: RoleSetup, stop_when: Callable[[], None] | None) -> None:
    """Records and shows the run until SIGTERM, SIGINT or the end of the launcher."""
    terrain = load_terrain(setup)
    inbox = Inbox()
    with contextlib.ExitStack() as stack:
        view, page = setup.scenario.monitor, None
        if view.live:
            name = f"{setup.scenario.name}, run {setup.run_id}"
            told = {"life": "", "at_s": 0.0, "name": name, "state": "its processes have begun"}
            page = when_free(lambda: LivePage(view.web_port, lambda: told, terrain))
            stack.callback(page.server.close)
        network = setup.scenario.network
        bus = stack.enter_context(
            open_bus(network, patient=True, authenticator=authenticator_of(network, setup.run_id))
        )

        def load() -> _Make:
            from launch_scripts.monitor.service import load_view  # takes as long as a whole planner's start

            return load_view(setup, terrain, bus, inbox.post, stack, page)

        info = setup.info(terrain.grid, terrain.digest)
        service = LoadingMonitor(Member(info, bus, inbox.post, setup.before), inbox.post, load)
        process = Process(service, inbox, MonotonicClock(), FRAME_HZ, health=setup.health, gather=bus.gather)
        process.stop_on_signals()
        if stop_when is not None:
            end_with(stop_when, process.stop)
        process.run()


class LoadingMonitor:
    """A service that stands for another until that is loaded: rerun, the mesh and the recording take more CPU than
    the start of any other process. It is a member of its run already: it is alive, answers, and may be ended.

    member  joins when this starts, and is handed on
    load    called on a thread; returns what makes the service. Its exceptions end the process
    """

    def __init__(self, member: Member, post: Post, load: Callable[[], _Make]) -> None:
        self._member = member
        self._post = post
        self._load = load
        self._service: Service | None = None
        self._thread = threading.Thread(target=self._work, name="load-view", daemon=True)
        member.needs("its view", lambda: self._service is not None)

    @property
    def counters(self) -> Counters:
        return self._member.counters

    def lacks(self) -> list[str]:
        return self._member.lacks()

    def start(self, now_ns: int) -> None:
        self._member.join()
        self._thread.start()

    def handle(self, event: Event, now_ns: int) -> None:
        if self._service is not None:
            self._service.handle(event, now_ns)
        elif isinstance(event, WorkDone) and event.tag == _TAG:
            self._service = cast("_Make", event.result)(self._member)
            self._service.start(now_ns)
        else:
            self._member.on_member_event(event)

    def tick(self, now_ns: int) -> None:
        if self._service is not None:
            self._service.tick(now_ns)
        else:
            self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        """A run that ends before the view is loaded has none, and no recording: its end waits for neither."""
        if self._service is not None:
            self._service.stop(now_ns)
        else:
            self._member.publish_stats(now_ns)

    def _work(self) -> None:
        began_ns = time.thread_time_ns()
        self._post(WorkDone(_TAG, self._load(), time.thread_time_ns() - began_ns))
