"""A monitor takes part in its run while it loads what it shows."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
from support.monitor_rig import little_scenario, little_terrain
from support.swarm_model import SwarmModel

from launch_scripts.monitor.main import LoadingMonitor
from swarm.bus.bus import Event, Post, Replied, WorkDone
from swarm.clock import MonotonicClock
from swarm.errors import BusError
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import Member
from swarm.runtime.process import Process
from swarm.runtime.stats import Counters
from swarm.wire.messages import Nothing
from swarm.wire.topics import RUN


class View:
    """Stands for the service that draws; records its calls."""

    def __init__(self, member: Member) -> None:
        self.member = member
        self.counters: Counters = member.counters
        self.calls: list[str] = []

    def lacks(self) -> list[str]:
        return []

    def start(self, now_ns: int) -> None:
        self.calls.append("start")

    def handle(self, event: Event, now_ns: int) -> None:
        self.calls.append("handle")
        self.member.on_member_event(event)

    def tick(self, now_ns: int) -> None:
        self.calls.append("tick")

    def stop(self, now_ns: int) -> None:
        self.calls.append("stop")


class World(SwarmModel):
    """A monitor that loads until `go`, and a tool beside it."""

    def __init__(self) -> None:
        super().__init__(terrain=little_terrain(), scenario=little_scenario())
        self.go, self.loaded = threading.Event(), threading.Event()
        self.views: list[View] = []
        self.tool = self.bus("tool")
        self.service: LoadingMonitor = self.start("monitor", self._make)

    def _make(self, bus: object, post: Post) -> LoadingMonitor:
        def tell(event: Event) -> None:
            post(event)
            if isinstance(event, WorkDone):
                self.loaded.set()

        info = self.setup("monitor", "0").info(self.terrain.grid, self.terrain.digest)
        return LoadingMonitor(Member(info, bus, post), tell, self._load)  # type: ignore[arg-type]

    def _load(self) -> Callable[[Member], View]:
        assert self.go.wait(20)

        def make(member: Member) -> View:
            self.views.append(View(member))
            return self.views[-1]

        return make

    def load(self) -> None:
        self.go.set()
        assert self.loaded.wait(20)
        self.settle()

    def answers(self) -> int:
        """Number of members of a run that answer a tool."""
        heard: list[Event] = []
        self.tool.ask(RUN, Nothing(), heard.append, tag="run")
        self.run(0.5)
        return sum(isinstance(event, Replied) for event in heard)


def test_while_it_loads_it_is_alive_answers_and_says_what_it_lacks() -> None:
    world = World()
    alive: list[Event] = []
    world.tool.watch_alive(alive.append)
    world.run(1.0)
    assert len(alive) == 1
    assert world.answers() == 1
    assert "its view" in world.service.lacks()
    assert not world.views
    world.load()
    assert "its view" not in world.service.lacks()
    world.go.set()


def test_what_is_loaded_takes_its_place_once_and_joins_no_second_time() -> None:
    world = World()
    world.run(0.3)
    world.load()
    (view,) = world.views
    assert view.calls[0] == "start"
    assert world.answers() == 1
    world.run(0.5)
    assert {"handle", "tick"} <= set(view.calls)
    assert view.counters is world.service.counters
    world.service.stop(world.now_ns)
    assert view.calls[-1] == "stop"


def test_it_ends_while_it_loads_and_nobody_waits_for_what_it_would_have_shown() -> None:
    world = World()
    world.run(0.3)
    world.service.stop(world.now_ns)
    assert not world.views
    world.go.set()


def test_what_loading_raises_ends_the_process_with_it() -> None:
    def load() -> Callable[[Member], View]:
        raise BusError("cannot show the live view on port 1")

    world = SwarmModel(terrain=little_terrain(), scenario=little_scenario())
    inbox = Inbox()
    info = world.setup("monitor", "0").info(world.terrain.grid, world.terrain.digest)
    service = LoadingMonitor(Member(info, world.bus("monitor"), inbox.post), inbox.post, load)
    with pytest.raises(BusError, match="port 1"):
        Process(service, inbox, MonotonicClock(), 20.0).run()
