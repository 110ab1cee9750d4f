"""No service raises on a message that `decode` accepts, in any state; after the lies each does its work again."""

from __future__ import annotations

import random

import numpy as np
import pytest
import rerun as rr
from support.liar import Liar, asked, published
from support.swarm_model import SwarmModel

from launch_scripts.chaos.lies import ROLES
from launch_scripts.launcher.router import RouterService
from launch_scripts.monitor.service import MonitorService
from launch_scripts.world.service import TargetsService
from planner_service.service import PlannerService
from shared_map.keeper.service import KeeperService
from shared_map.keeper.store import KeeperStore
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import Event, Replied
from swarm.bus.scheduler import InlineWorker
from swarm.config.load import parse_scenario
from swarm.liveness import Peer
from swarm.wire.authentication import Authenticator
from swarm.wire.fields import unbounded
from swarm.wire.messages.base import Message
from swarm.wire.messages.orders import GiveOrder, Orders, ZoneOrder, Zones
from swarm.wire.messages.planning import RouteReply, RouteRequest
from swarm.wire.routes import RouteStatus
from swarm.wire.statements import MarkKind
from swarm.wire.topics import GIVE_ORDER, ROUTE, RUN, ZONES
from vehicle_agent.promise_store import MemoryPromiseStore
from vehicle_agent.service import AgentService

SCENARIO = parse_scenario("""
name = "lied-to"
time_scale = 10
[[targets]]
count = 2
speed_m_per_s = 2
[[groups]]
vehicles = 4
[vehicles]
per_agent = 2
sense_range_m = 60
capture_range_m = 20
[standbys]
planner = 1
targets = 1
[monitor]
live = false
""")
PACE = np.ones((40, 72), np.float32) / 5
PACE[10:30, 30] = np.inf
STATES = ("fresh", "running", "cut", "without target", "restarted")


class Lied(SwarmModel):
    """One process of every role, two agents, and a liar."""

    def __init__(self, state: str, seed: int) -> None:
        super().__init__(terrain=terrain_of_pace(PACE, 10.0), scenario=SCENARIO)
        self.authenticator = Authenticator(b"the liar has no secret", "run")
        self.chance = random.Random(seed)
        self.state = state
        self.ear = self.bus("ear")
        self.heard: list[RouteReply] = []
        self.stores: list[KeeperStore] = []
        self.promises = {id: MemoryPromiseStore(n) for n, id in enumerate(("a0", "a1"), 1)}
        self.liar = Liar(self.bus("liar"), self.terrain.grid.cells, seed)
        for role in ROLES:
            for id in ("a0", "a1") if role == "agent" else ("t0",) if role == "planner" else ("0",):
                if not (role == "targets" and state == "without target"):
                    self.begin(role, id, 1)
        if state != "fresh":
            self.run(3)

    def begin(self, role: str, id: str, incarnation: int) -> object:
        setup, terrain, truth = self.setup(role, id, incarnation), self.terrain, PACE

        def make(bus, post):  # type: ignore[no-untyped-def]
            match role:
                case "router":
                    return RouterService(Peer(role, id, incarnation), bus, post)
                case "keeper":
                    self.stores.append(KeeperStore(":memory:"))
                    return KeeperService(setup, terrain, bus, post, self.stores[-1])
                case "monitor":
                    return MonitorService(setup, terrain, bus, post, rr.RecordingStream("lied"))
                case "planner":
                    return PlannerService(setup, terrain, bus, post, InlineWorker(self.scheduler))
                case "targets":
                    return TargetsService(setup, terrain, truth, bus, post)
            return AgentService(setup, terrain, truth, bus, post, self.promises[id])

        service = self.start(f"{role}-{id}", make)
        self.services = {**getattr(self, "services", {}), f"{role}-{id}": service}
        return service

    def disturb(self, step: int) -> None:
        """What happens to the processes while they are lied to."""
        if self.state == "cut" and step in (4, 12):
            for node in ("agent-a0", "planner-t0"):
                (self.cut if step == 4 else self.heal)(self.buses[node])
        if self.state == "restarted" and step == 6:
            for role, id in (("planner", "t0"), ("agent", "a0"), ("keeper", "0")):
                self.kill(f"{role}-{id}")
                self.begin(role, id, 2)

    def routes(self, cell: int) -> list[RouteReply]:
        heard: list[RouteReply] = []

        def post(event: Event) -> None:
            if isinstance(event, Replied) and isinstance(event.message, RouteReply):
                heard.append(event.message)

        self.ear.ask(ROUTE, RouteRequest(cells=[cell]), post, tag="q", target="t0")
        self.run(0.1)
        return heard

    def take_back(self) -> None:
        """Whoever reaches the router may give orders, so an operator takes back what was ordered."""
        heard: list[Event] = []
        self.ear.ask(GIVE_ORDER, GiveOrder(), heard.append, tag="o", keeper="0")
        self.ear.ask(ZONES, ZoneOrder(), heard.append, tag="z", keeper="0")
        self.run(0.2)
        for event in heard:
            match event:
                case Replied(message=Orders(orders=orders)):
                    for order in orders:
                        given = GiveOrder(subject=order.subject, name=order.name, off=True)
                        if order.subject == "target":
                            given = GiveOrder(
                                subject="target", name=order.name, new=order.off, cell=80, walk="still"
                            )
                        self.ear.ask(GIVE_ORDER, given, ignore, tag="o", keeper="0")
                case Replied(message=Zones(zones=zones)):
                    for zone in zones:
                        removal = ZoneOrder(action="remove", name=zone.name)
                        self.ear.ask(ZONES, removal, ignore, tag="z", keeper="0")
        self.run(0.2)

    def close(self) -> None:
        for store in self.stores:
            store.close()


def ignore(event: Event) -> None:
    pass


def lied_to(state: str, seed: int, steps: int, besides: tuple[object, ...] = ()) -> Lied:
    """A swarm after many lies of every kind."""
    swarm = Lied(state, seed)
    liar = swarm.liar
    # Only a process that nobody has confirmed yet ends when it is told of another run.
    liar.serve(tuple(t for t in asked() if t not in besides and (t is not RUN or state == "running")))
    puts = [topic for topic in published() if topic not in besides]
    for step in range(steps):
        for topic in puts:
            liar.put(topic)
        for topic in asked():
            if topic not in besides:
                liar.ask(topic, ignore)
        if not besides and step % 5 == 0:
            liar.token(swarm.chance.choice(ROLES))
        swarm.disturb(step)
        swarm.run(0.1)
    liar.serving = False
    liar.bus.close()
    return swarm


def test_no_field_of_any_message_is_without_bounds() -> None:
    assert [lack for kind in Message.__subclasses__() for lack in unbounded(kind)] == []


@pytest.mark.parametrize("state", STATES)
def test_no_service_raises_on_what_passes_the_door_in_any_state(state: str) -> None:
    swarm = lied_to(state, 1, 20)
    assert swarm.liar.told > 500
    swarm.run(3)
    swarm.close()


@pytest.mark.parametrize("state", [state for state in STATES if state != "without target"])
def test_after_the_lies_each_service_does_its_work_again(state: str) -> None:
    swarm = lied_to(state, 7, 16)
    swarm.take_back()
    swarm.run(8)
    [targets] = [each for name, each in swarm.services.items() if name == "targets-0"]
    truth = targets._world._targets["t0"].walker.cell
    grid = swarm.terrain.grid
    [reply] = swarm.routes(grid.cell(2, 2))
    assert reply.target_cell is not None
    assert grid.distance_cells(reply.target_cell, truth) <= 3
    assert reply.routes[0].status is RouteStatus.OK
    agents = [swarm.services["agent-a0"], swarm.services["agent-a1"]]
    before = [vehicle.motion.place_m() for agent in agents for vehicle in agent.agent.vehicles.values()]
    swarm.run(8)
    after = [vehicle.motion.place_m() for agent in agents for vehicle in agent.agent.vehicles.values()]
    assert len(after) == 4
    assert sum(was != now for was, now in zip(before, after, strict=True)) >= 2
    writer = swarm.writer("all.w.1")
    writer.sync.publish(writer.replica.write([grid.cell(39, 71)], MarkKind.PACE, 7.0, swarm.now_ns))
    swarm.run(2)
    planner, keeper = swarm.services["planner-t0"], swarm.services["keeper-0"]
    assert planner._cost_map.pace_s_per_m[39, 71] == 7.0
    assert keeper.replica.held.get(grid.tile_of(grid.cell(39, 71)), "all.w.1") is not None
    swarm.close()
