"""The laws that hold in every simulation, whatever goes wrong in it: what no process could see."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from launch_scripts.simulation.faults import OBSERVER
from launch_scripts.simulation.node import Node
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.world.rovers import Rover
from launch_scripts.simulation.world.service import TargetsService
from shared_map.class_grounds import class_grounds, class_truths
from shared_map.replication.replica import MapReplica
from swarm.bus.bus import Event, Heard
from swarm.clock import NS_PER_S
from swarm.config.agents import plan_agents
from swarm.config.classes import flies
from swarm.grid import GridSpec
from swarm.wire.codec import decode
from swarm.wire.messages.map_data import DIGEST_ROW, Digest
from swarm.wire.messages.vehicles import Body, VehicleState
from swarm.wire.topics import BODY, DIGEST
from vehicle_agent.placement import spawn_cells
from vehicle_agent.service import AgentService

Stamp = tuple[int, int]
Sets = dict[tuple[str, int], Stamp]
"""(author, tile) -> (epoch, seq)."""


def sets_of(held: Mapping[str, bytes]) -> Sets:
    """What a digest says."""
    rows = ((author, row) for author, packed in held.items() for row in np.frombuffer(packed, DIGEST_ROW))
    return {(author, int(row["tile"])): (int(row["epoch"]), int(row["seq"])) for author, row in rows}


def missing(has: Sets, wanted: Sets) -> list[tuple[str, int]]:
    return [key for key, stamp in wanted.items() if has.get(key, (-1, -1)) < stamp]


def replica_of(node: Node) -> MapReplica | None:
    service: Any = node.service
    replica = getattr(service, "replica", None) or getattr(service, "_replica", None)
    assert replica is None or isinstance(replica, MapReplica)
    return replica


_ROUTED = (VehicleState.FOLLOWING, VehicleState.SEARCHING, VehicleState.ARRIVED)
"""States of vehicles that have what they need; those that search have a place to look at."""
_HAS_TO_GO = (VehicleState.FOLLOWING, VehicleState.SEARCHING, VehicleState.WAITING)
"""States of vehicles that have somewhere to go, or ask for it."""


class Laws:
    """Looks at everything in a simulation that no process could see.

    collisions    (when, vehicle, vehicle, cell), by where vehicles truly are; those of a dead process stay put
    lethal        (when, vehicle, cell), of cells that are lethal in truth to the vehicle's class
    acknowledged  the newest of each set that a keeper ever said it had committed
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.collisions: list[tuple[float, str, str, int]] = []
        self.lethal: list[tuple[float, str, int]] = []
        self.acknowledged: Sets = {}
        grounds = class_grounds(simulation.scenario, simulation.terrain, simulation.truth)
        spawns = spawn_cells(simulation.scenario, simulation.terrain.grid, grounds)
        self._unmoved = {id: cell for each in spawns.values() for id, cell in each.items()}
        """Vehicle -> cell, of those that no process has placed yet."""
        self._bodies: dict[str, dict[str, int]] = {}
        """Node -> vehicle -> cell. A body stands where it is when its process dies."""
        self._last: dict[str, Node] = {}
        """Agent -> the node on which its newest life began."""
        self._passable = {name: np.isfinite(each.truth).ravel() for name, each in grounds.items()}
        """Class of vehicles -> the cells that it may enter, in truth."""
        self._aloft = {
            id
            for plan in plan_agents(simulation.scenario)
            if flies(simulation.scenario, plan.group.vehicle_class)
            for id in plan.vehicle_ids
        }
        simulation.after_tick.append(self._look)
        simulation.after_boot.append(self._began)
        bus = simulation.network.bus(OBSERVER, simulation.scenario.network.namespace)
        bus.subscribe(DIGEST, self._hear)

    def _began(self, node: Node) -> None:
        if self._last.get(node.spec.id, node) is not node:
            self._bodies.pop(node.name, None)  # they have been driven from elsewhere since
        self._last[node.spec.id] = node

    def _look(self, node: Node) -> None:
        if not isinstance(node.service, AgentService):
            return
        now_s = self.simulation.now_s
        agent = node.service.agent
        bodies = self._bodies.setdefault(node.name, {})
        passable = self._passable[agent.plan.group.vehicle_class]
        for id, vehicle in agent.vehicles.items():
            if bodies.get(id) != vehicle.cell and not passable[vehicle.cell]:
                self.lethal.append((now_s, id, vehicle.cell))
            bodies[id] = vehicle.cell
            self._unmoved.pop(id, None)
        if agent.holdings.replaced:
            bodies.clear()  # the younger life drives them
        on: dict[tuple[int, bool], str] = {}
        for each in (self._unmoved, *self._bodies.values()):
            for id, cell in each.items():
                place = cell, id in self._aloft
                if on.setdefault(place, id) != id:
                    self.collisions.append((now_s, *sorted((on[place], id)), cell))  # type: ignore[arg-type]

    def _hear(self, event: Event) -> None:
        assert isinstance(event, Heard)
        digest = event.message
        if isinstance(digest, Digest) and digest.role == "keeper":
            for key, stamp in sets_of(digest.held).items():
                self.acknowledged[key] = max(stamp, self.acknowledged.get(key, (-1, -1)))

    def said(self) -> Sets:
        """The newest of each set that a living agent has said itself."""
        told: Sets = {}
        for node in self.simulation.nodes.values():
            replica = replica_of(node)
            if node.spec.role == "agent" and replica is not None:
                told |= sets_of(replica.own_digest())
        return told

    def held(self) -> dict[str, Sets]:
        """What each living process holds."""
        nodes = self.simulation.nodes.values()
        replicas = {node.name: replica_of(node) for node in nodes if node.service is not None}
        return {
            name: sets_of(replica.held.ledger.held()) for name, replica in replicas.items() if replica is not None
        }

    def stored(self) -> Sets:
        """What is on the keeper's disk."""
        store = self.simulation.nodes["keeper-0"].store
        assert store is not None
        return {(each.author, each.tile): (each.epoch, each.seq) for each in store.load()}


class Waits:
    """How long vehicles are on one cell, less the time to drive across it, although they have somewhere to go and
    nothing is down.

    A second counts if every process works: one that is dead, hung or cut off is a reason to stand, as it may hold
    the cell ahead, or be the planner or a warden that a vehicle waits for. Messages that are lost or late are none.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.longest_s = 0.0
        self.longest: tuple[float, str, int] | None = None
        """When the longest wait ended or was last seen, vehicle and cell."""
        self._simulation = simulation
        truths = class_truths(simulation.scenario, simulation.terrain, simulation.truth)
        across_m = math.sqrt(2) * simulation.terrain.grid.resolution_m
        self._across_s = {name: across_m / simulation.scenario.time_scale * each for name, each in truths.items()}
        """Class of vehicles -> the time to drive across each cell."""
        self._waited_s: dict[str, tuple[int, float]] = {}
        """Vehicle -> its cell, and the seconds that count since it came there."""
        self._looked_s: dict[str, float] = {}
        simulation.after_tick.append(self._look)

    def _look(self, node: Node) -> None:
        if not isinstance(node.service, AgentService):
            return
        now_s = self._simulation.now_s
        passed_s = now_s - self._looked_s.get(node.name, now_s)
        self._looked_s[node.name] = now_s
        counts_s = 0.0 if self._simulation.disturbed() else passed_s
        across_s = self._across_s[node.service.agent.plan.group.vehicle_class]
        for vehicle in node.service.agent.vehicles.values():
            cell, waited_s = self._waited_s.get(vehicle.id, (-1, 0.0))
            waits = vehicle.state in _HAS_TO_GO
            waits = waits and not node.service.agent.stopped(vehicle.id)
            waited_s = waited_s + counts_s if waits and cell == vehicle.cell else 0.0
            self._waited_s[vehicle.id] = (vehicle.cell, waited_s)
            wait_s = waited_s - across_s.item(vehicle.cell)
            if wait_s > self.longest_s:
                self.longest_s, self.longest = wait_s, (now_s, vehicle.id, vehicle.cell)


class Routed:
    """When vehicles have a route, to their target or to where they search for it, or their target within reach,
    once nothing goes wrong any more.

    whole_s  when all processes worked for the first time since the quiet began; None until then
    """

    def __init__(self, simulation: Simulation) -> None:
        self.whole_s: float | None = None
        self._simulation = simulation
        self._at_s: dict[str, float] = {}
        simulation.after_tick.append(self._look)

    def _look(self, node: Node) -> None:
        simulation, now_s = self._simulation, self._simulation.now_s
        if self.whole_s is None and now_s >= (simulation.faults.quiet_s or 0.0) and not simulation.disturbed():
            self.whole_s = now_s
        if self.whole_s is None or not isinstance(node.service, AgentService):
            return
        for vehicle in node.service.agent.vehicles.values():
            if vehicle.state in _ROUTED:
                self._at_s.setdefault(vehicle.id, now_s)

    def missing(self) -> list[str]:
        """Vehicles that have had no route since."""
        every = [id for plan in plan_agents(self._simulation.scenario) for id in plan.vehicle_ids]
        return [id for id in every if id not in self._at_s]

    @property
    def after_s(self) -> float | None:
        """Seconds from `whole_s` until the last vehicle had a route; None if one has none."""
        if self.whole_s is None or self.missing():
            return None
        return max(self._at_s.values()) - self.whole_s


@dataclass(slots=True)
class _DeliveredBody:
    body: Body
    at_ns: int


class BodyLaw:
    """No vehicle drives into a body that was reported in time: judged by what the network delivered to each agent,
    and by where rovers truly are, at every step of every vehicle.

    broken   (when, vehicle, body, cell): it entered a cell that a report had closed, which its agent had been
             delivered at an earlier tick, and whose lease lasted
    met      (when, vehicle, rover, cell): it entered a cell on which a rover truly was, reported in time or not
    entered  cells that vehicles entered in all
    near     of these, how many were within two cells of a rover
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.broken: list[tuple[float, str, str, int]] = []
        self.met: list[tuple[float, str, str, int]] = []
        self.entered = self.near = 0
        self._grid = simulation.terrain.grid
        self._delivered: dict[str, dict[tuple[str, int], _DeliveredBody]] = {}
        self._looked_ns: dict[str, int] = {}
        self._cells: dict[tuple[str, str], int] = {}
        """(node, vehicle) -> its cell: two lives of an agent each have their own idea of it."""
        inner = simulation.network.trace

        def trace(now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
            if inner is not None:
                inner(now_ns, source, destination, topic, payload)
            if topic == BODY.name and destination.startswith("agent-"):
                self._deliver(decode(payload, Body), destination, now_ns)

        simulation.network.trace = trace
        simulation.after_boot.append(self._boot)
        simulation.after_tick.append(self._look)

    def _boot(self, node: Node) -> None:
        self._delivered.pop(node.name, None)
        self._cells = {key: cell for key, cell in self._cells.items() if key[0] != node.name}
        self._looked_ns.pop(node.name, None)

    def _deliver(self, body: Body, agent: str, now_ns: int) -> None:
        known = self._delivered.setdefault(agent, {})
        key = body.id, body.incarnation
        last = known.get(key)
        if last is None or body.seq > last.body.seq or now_ns - last.at_ns >= last.body.lease_s * NS_PER_S:
            known[key] = _DeliveredBody(body, now_ns)

    def _look(self, node: Node) -> None:
        if not isinstance(node.service, AgentService):
            return
        now_ns, now_s = self.simulation.scheduler.clock.now_ns(), self.simulation.now_s
        looked_ns = self._looked_ns.get(node.name, now_ns)
        self._looked_ns[node.name] = now_ns
        for id, vehicle in node.service.agent.vehicles.items():
            before, self._cells[node.name, id] = self._cells.get((node.name, id)), vehicle.cell
            if before is None or before == vehicle.cell:
                continue
            self.entered += 1
            for (name, _), each in self._delivered.get(node.name, {}).items():
                lasts = each.at_ns <= looked_ns and now_ns < each.at_ns + each.body.lease_s * NS_PER_S
                far_m = from_square_m(self._grid, vehicle.cell, each.body.x_m, each.body.y_m)
                if lasts and far_m < each.body.radius_m:
                    self.broken.append((now_s, id, name, vehicle.cell))
            for rover in self._rovers():
                far_m = from_square_m(self._grid, vehicle.cell, rover.x_m, rover.y_m) - rover.config.radius_m
                self.near += far_m <= 2 * self._grid.resolution_m
                if far_m < 0.0:
                    self.met.append((now_s, id, rover.id, vehicle.cell))

    def _rovers(self) -> Iterator[Rover]:
        for node in self.simulation.nodes.values():
            if isinstance(node.service, TargetsService) and node.service.leads:
                yield from node.service.rovers.all


def from_square_m(grid: GridSpec, cell: int, x_m: float, y_m: float) -> float:
    """Distance of a place from the square of a cell."""
    row, col = divmod(cell, grid.cols)
    west_m, north_m = grid.west_m + col * grid.resolution_m, grid.north_m - row * grid.resolution_m
    east = max(west_m - x_m, x_m - west_m - grid.resolution_m, 0.0)
    south = max(y_m - north_m, north_m - grid.resolution_m - y_m, 0.0)
    return math.hypot(east, south)
