"""No service raises on a message that `decode` accepts, in any state; after the lies each does its work again."""

import contextlib
import random
import typing
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest
import rerun as rr
from support.bus_world import Box
from support.effort import few, paired
from support.liar import Liar, asked, published
from support.message_fuzzer import NAMES, ROLES, MessageFuzzer
from support.simulated import DRONE, WALKER, WINDY
from support.swarm_model import SwarmModel
from support.wire_strategies import types_of_the_wire

from launch_scripts.launcher.router import RouterService
from launch_scripts.monitor.ground_view import Scene
from launch_scripts.monitor.rerun_outputs import Pen
from launch_scripts.monitor.service import MonitorService
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from launch_scripts.simulation.world.service import TargetsService
from planner_service.planning_process import Planning
from planner_service.service import PlannerService
from shared_map.array_files import Floats
from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.terrain.terrain import Terrain, build_terrain, terrain_of_pace
from shared_map.terrain.true_ground import build_truth
from swarm.bus.bus import Replied
from swarm.bus.scheduler import InlineWorker
from swarm.config.scenario import Scenario, plan_agents
from swarm.config.scenario_files import parse_scenario
from swarm.errors import ProtocolError
from swarm.peers import Peer
from swarm.right_of_way.promise_store import PromiseStore
from swarm.wire.access import Act, Authenticator
from swarm.wire.codec import decode
from swarm.wire.fields import LONGEST_LEASE_S, OR_INFINITE, Column, taken_apart
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.planning import RouteReply, RouteRequest
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import MARKS, PUSHED_ROUTE, ROUTE, RUN, SIGHTED, Topic
from vehicle_agent.service import AgentService

PLAIN = """
name = "lied-to"
time_scale = 10
[[targets]]
count = 2
speed_m_per_s = 2
[[groups]]
vehicles = 4
"""
WHOLE = """
name = "lied-to-whole"
seed = 3
time_scale = 10
[terrain]
source = "synthetic"
rows = 48
cols = 64
relief_m = 150.0
[terrain.hidden]
rubble_fields = 6
class_factor = { grass = 3.0 }
[cost]
max_slope_deg = 22.0
[map]
learning = true
[[targets]]
speed_m_per_s = 2
[[targets]]
name = "h"
speed_m_per_s = 2
tracker = "sighted"
[[groups]]
assignment = "balanced"
vehicles = 4
[[groups]]
name = "walkers"
class = "walker"
targets = ["h"]
vehicles = 2
[[groups]]
name = "drones"
class = "drone"
vehicles = 2
"""
"""A run with all features: classes that drive and that fly, in a wind, pulled routes, a hidden target, a group that
shares its targets out, and learned ground."""
BOTH = """
[vehicles]
per_agent = 2
sense_range_m = 60
capture_range_m = 20
reassign_s = 1.0
[standbys]
planner = 1
targets = 1
[monitor]
live = false
"""
TEXTS = {"plain": PLAIN + BOTH, "whole": WHOLE + WALKER + DRONE + WINDY + BOTH}
NAMED = ("t", "h", "h.r1", "walkers", "drones", *(f"a{n}-0{m}" for n in range(4) for m in range(2)))
AUTHORS = ("all.a0.1", "all.a1.1", "all.a1.2", "walkers.a2.1", "drones.a3.1")
PACE = np.ones((40, 72), np.float32) / 5
PACE[10:30, 30] = np.inf
STATES = ("fresh", "running", "cut", "without target", "restarted")

OFTEN = (MARKS, MARKS, MARKS, SIGHTED, PUSHED_ROUTE)
"""Types that are sent more often than others, because most of their statements name things that do not exist."""


class Lied(SwarmModel):
    """The processes of a run which receive lies: router, keeper, targets, monitor and first planner or, for the
    whole run, all of them, the agents, and a liar.

    run     of TEXTS
    secret  whether the liar has the secret of the run: then all lies pass the door
    """

    def __init__(self, run: str, state: str, seed: int, *, secret: bool = False) -> None:
        scenario, terrain, self.truth = world(run)
        super().__init__(terrain=terrain, scenario=scenario)
        self.authenticator = Authenticator(b"secret", "run")
        self.chance = random.Random(seed)
        self.state = state
        self.ear = self.bus("ear")
        self.stores: list[KeeperStore] = []
        agents = [plan.id for plan in plan_agents(scenario)]
        self.target, *others = scenario.target_ids
        planners = [self.target] if run == "plain" else [self.target, *others]
        self.promises = {id: PromiseStore(n) for n, id in enumerate(agents, 1)}
        classes = [each.name for each in scenario.classes]
        names = tuple(dict.fromkeys((*NAMES, *NAMED, *AUTHORS)))
        fuzzer = MessageFuzzer(terrain.grid, seed, names, classes, lambda: self.now_ns)
        self.liar = Liar(self.bus("liar", authenticator=self.authenticator if secret else None), fuzzer, seed)
        for role in ROLES:
            for id in {"agent": agents, "planner": planners}.get(role, ["0"]):
                if not (role == "targets" and state == "without target"):
                    self.begin(role, id, 1)
        if state != "fresh":
            self.run(3 if run == "plain" else 7)  # the searching planner has begun

    def begin(self, role: str, id: str, incarnation: int) -> object:
        setup, terrain, truth = self.setup(role, id, incarnation), self.terrain, self.truth

        def make(bus, post):  # type: ignore[no-untyped-def]
            match role:
                case "router":
                    return RouterService(Peer(role, id, incarnation), bus, post)
                case "keeper":
                    self.stores.append(KeeperStore(":memory:"))
                    return KeeperService(setup, terrain, bus, post, self.stores[-1])
                case "monitor":
                    scene = Scene(Pen([rr.RecordingStream("lied")], TerrainMesh(terrain)))
                    return MonitorService(setup, terrain, bus, post, scene)
                case "planner":
                    return PlannerService(Planning(setup, terrain, bus, post, InlineWorker(self.scheduler)))
                case "targets":
                    return TargetsService(setup, terrain, truth, bus, post)
            return AgentService(setup, terrain, truth, bus, post, self.promises[id])

        service = self.start(f"{role}-{id}", make)
        self.services = {**getattr(self, "services", {}), f"{role}-{id}": service}
        return service

    def disturb(self, step: int, steps: int) -> None:
        """Disturbs the processes while they receive lies, in the middle third of the steps."""
        begins, ends = step == steps // 3, step == 2 * steps // 3
        if self.state == "cut" and (begins or ends):
            for node in ("agent-a0", f"planner-{self.target}"):
                (self.cut if begins else self.heal)(self.buses[node])
        if self.state == "restarted" and step == steps // 2:
            for role, id in (("planner", self.target), ("agent", "a0"), ("keeper", "0")):
                self.kill(f"{role}-{id}")
                self.begin(role, id, 2)

    def routes(self, cell: int) -> list[RouteReply]:
        answer = Box()
        self.ear.ask(ROUTE, RouteRequest(cells=[cell]), answer, tag="q", target=self.target)
        self.run(0.1)
        return [reply.message for reply in answer.of(Replied)]

    def close(self) -> None:
        for store in self.stores:
            store.close()


@cache
def world(run: str) -> tuple[Scenario, Terrain, Floats]:
    """Scenario, terrain and truth."""
    scenario = parse_scenario(TEXTS[run])
    if run == "plain":
        return scenario, terrain_of_pace(PACE, 10.0), PACE
    terrain = build_terrain(scenario)
    return scenario, terrain, build_truth(scenario, terrain)


May = Callable[[Topic, Act], bool]


def lied_to(
    run: str, state: str, seed: int, steps: int, altered: bool, *, secret: bool = True, may: May | None = None
) -> Lied:
    """A swarm after many lies of every kind.

    altered  half of the lies are real messages with one field altered
    may      which acts the liar uses; None: all, refusals and tokens too
    """
    tells = may or (lambda topic, act: True)
    swarm = Lied(run, state, seed, secret=secret)
    liar = swarm.liar
    if altered:
        liar.listen()
    # Only a process that has no confirmation yet ends when it hears of another run.
    served = (topic for topic in asked() if topic is not RUN or state == "running")
    liar.serve([topic for topic in served if tells(topic, "answer")], refuses=may is None)
    for step in range(steps):
        for topic in filter(lambda topic: tells(topic, "put"), (*published(), *OFTEN)):
            liar.put(topic)
        for topic in filter(lambda topic: tells(topic, "ask"), asked()):
            liar.ask(topic, liar.hear)
        if step % 5 == 0 and may is None:
            liar.token(swarm.chance.choice(ROLES))
        swarm.disturb(step, steps)
        swarm.run(0.1)
    liar.serving = False
    liar.bus.close()
    return swarm


def unbounded(struct: type[msgspec.Struct]) -> Iterator[str]:
    """The fields of a struct whose type leaves something unbounded, each with what it lacks."""
    for name, hint in typing.get_type_hints(struct, include_extras=True).items():
        yield from (f"{struct.__name__}.{name}: {lack}" for lack in _lacking(hint))


def _lacking(hint: Any) -> Iterator[str]:
    bare, notes = taken_apart(hint)
    origin = typing.get_origin(bare) or bare
    metas = [note for note in notes if isinstance(note, msgspec.Meta)]
    sized = any(meta.max_length is not None for meta in metas)
    if origin in (int, float):
        below = any(meta.ge is not None or meta.gt is not None for meta in metas)
        above = any(meta.le is not None or meta.lt is not None for meta in metas) or OR_INFINITE in notes
        if not (below and above):
            yield f"{origin.__name__} without bounds"
    elif origin is bytes:
        if not sized and not any(isinstance(note, Column) and note.per for note in notes):
            yield "bytes without a length"
    elif origin in (str, list, dict) and not sized:
        yield f"{origin.__name__} without a length"
    elif isinstance(origin, type) and issubclass(origin, msgspec.Struct):
        yield from unbounded(origin)
    for part in typing.get_args(bare):
        yield from _lacking(part)


def test_no_field_of_any_message_is_without_bounds() -> None:
    assert [lack for kind in types_of_the_wire() for lack in unbounded(kind)] == []


def test_the_whole_run_searches_pulls_and_flies_and_lies_reach_classes_and_what_is_learned() -> None:
    swarm = lied_to("whole", "running", 1, 20, False)
    said = [(node, topic, payload) for _, node, _, topic, payload in swarm.deliveries if node.startswith("planner")]
    replies = [reply for _, topic, payload in said if topic == "route" and (reply := route_reply(payload))]
    pulled = {(reply.target, reply.vehicle_class) for reply in replies if reply.routes.legs}
    assert {("t", "ground"), ("t", "drone")} <= pulled
    assert any(route.status is RouteStatus.SEARCHING for reply in replies for route in reply.routes)
    grid, keeper, planner = swarm.terrain.grid, swarm.services["keeper-0"], swarm.services["planner-t"]
    held = [grid.class_of_tile(tile) for tile in keeper.replica.held.tiles]
    assert {number for number, tile in held if tile < grid.tiles} >= {0, 1, 2}
    assert (planner._cost_maps["ground"].factors != 1).any()
    swarm.close()


def route_reply(payload: bytes) -> RouteReply | None:
    with contextlib.suppress(ProtocolError):
        return decode(payload, RouteReply)
    return None


@pytest.mark.parametrize("run", ["whole", pytest.param("plain", marks=pytest.mark.thorough)])
@pytest.mark.parametrize(("state", "altered"), paired(STATES, [(False,), (True,)]))
def test_no_service_raises_on_what_passes_the_door_in_any_state(run: str, state: str, altered: bool) -> None:
    swarm = lied_to(run, state, 2, few(26), altered)
    assert swarm.liar.told > 250
    swarm.run(3)
    swarm.close()


def test_a_liar_that_listens_alters_more_of_what_it_has_heard() -> None:
    altered = []
    for listens in (False, True):
        swarm = lied_to("plain", "running", 2, 8, listens)
        altered.append(swarm.liar.altered)
        swarm.close()
    assert altered[1] > 1.2 * altered[0]


@pytest.mark.parametrize(
    ("state", "run"), paired(("fresh", "cut", "running", "restarted"), [("plain",), ("whole",)])
)
def test_after_the_lies_each_service_does_its_work_again(run: str, state: str) -> None:
    """The liar is a stranger on loopback."""
    swarm = lied_to(run, state, 9, few(53), False, secret=False)
    swarm.run(8)
    walker = swarm.services["targets-0"]._world._targets[swarm.target].walker
    grid = swarm.terrain.grid
    planner, keeper = swarm.services[f"planner-{swarm.target}"], swarm.services["keeper-0"]
    agents = [each for each in swarm.services.values() if isinstance(each, AgentService)]
    own = {agent._author.rpartition(".")[0] for agent in agents}
    assert {author.rpartition(".")[0] for author in keeper.replica.held.ledger.authors_from(0, 1000)} <= own
    home = int(np.flatnonzero(np.isfinite(planner._cost_maps["ground"].pace_s_per_m))[0])
    for _ in range(int(LONGEST_LEASE_S)):  # for this time a lie about the target's place may stand
        [reply] = swarm.routes(home)
        if reply.target_cell is not None and grid.distance_cells(reply.target_cell, walker.cell) <= 3:
            break
        swarm.run(1)
    assert reply.target_cell is not None
    assert grid.distance_cells(reply.target_cell, walker.cell) <= 3
    assert reply.routes[0].status is RouteStatus.OK
    vehicles = [vehicle for agent in agents for vehicle in agent.agent.vehicles.values()]
    before = [vehicle.motion.place_m() for vehicle in vehicles]
    swarm.run(8)
    assert len(vehicles) == 2 * len(agents)
    assert sum(vehicle.motion.place_m() != was for vehicle, was in zip(vehicles, before, strict=True)) >= len(
        agents
    )
    writer = swarm.writer("all.w.1")
    row, col = grid.row_col(home)
    writer.sync.publish(writer.replica.write([home], MarkKind.PACE, 7.0, swarm.now_ns))
    swarm.run(2)
    assert planner._cost_maps["ground"].pace_s_per_m[row, col] == 7.0
    assert keeper.replica.held.get(grid.tile_of(home), "all.w.1") is not None
    swarm.close()
