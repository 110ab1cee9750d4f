"""The laws that hold in every simulation, whatever goes wrong in it: what no process could see.

A `Law` watches a simulation from its beginning and says at the end what broke. `LawBook` runs a simulation to its
end and holds it against all of them:

    no collision, no lethal entry     by where vehicles truly are, at every tick of their agents
    acknowledged marks stay           what a keeper said it had committed is on its disk
    marks reach everybody             what an agent said four seconds before the end, every process holds
    replicas are equal                once nobody says anything new
    bodies are avoided                no vehicle enters a cell that a body had closed in time
    no wait without a reason          of ten seconds while everything works
    vehicles are routed again         within five seconds of the last fault
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from launch_scripts.simulation.faults import OBSERVER
from launch_scripts.simulation.node import Node
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.world.service import TargetsService
from planner_service.search.target_search import LISTEN_NS
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

LONGEST_WAIT_S = 10.0
ROUTED_WITHIN_S = 5.0
SETTLED_S = 4.0
"""What was said so long before the end has reached everybody."""
LAST_WORDS_S = 6.0
"""Once nobody says anything new, all hold the same after so long."""
_SHOWN = 3
"""Cases of one law that are told of a run: what follows on the first says little."""

Sets = dict[tuple[str, int], tuple[int, int]]
"""(author, tile) -> (epoch, seq)."""
_NEVER = (-1, -1)


class BrokenLaw(msgspec.Struct, frozen=True):
    """A law that did not hold.

    law       its name, of a few words
    sentence  what happened
    at_s      when; None: it is only seen at the end
    """

    law: str
    sentence: str
    at_s: float | None = None

    def __str__(self) -> str:
        return self.sentence


def sets_of(held: Mapping[str, bytes]) -> Sets:
    """What a digest says."""
    rows = ((author, row) for author, packed in held.items() for row in np.frombuffer(packed, DIGEST_ROW))
    return {(author, int(row["tile"])): (int(row["epoch"]), int(row["seq"])) for author, row in rows}


def missing(has: Sets, wanted: Sets) -> list[tuple[str, int]]:
    return [key for key, stamp in wanted.items() if has.get(key, _NEVER) < stamp]


class Law:
    """Watches the agents of a simulation."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        simulation.after_tick.append(self._ticked)

    def _ticked(self, node: Node) -> None:
        if isinstance(node.service, AgentService):
            self.look(node, node.service, self.simulation.now_s)

    def look(self, node: Node, service: AgentService, now_s: float) -> None:
        """Takes in the state of an agent after a tick."""
        raise NotImplementedError

    def broken_at_end(self) -> list[BrokenLaw]:
        """What did not hold, once the run is over."""
        raise NotImplementedError


class Laws(Law):
    """No vehicles on one cell, none on a lethal one, and no acknowledged mark lost.

    collisions    by where vehicles truly are; those of a dead process stay put
    lethal        entries of cells that are lethal in truth to the vehicle's class
    acknowledged  the newest of each set that a keeper ever said it had committed
    """

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(simulation)
        self.collisions: list[BrokenLaw] = []
        self.lethal: list[BrokenLaw] = []
        self.acknowledged: Sets = {}
        scenario = simulation.scenario
        grounds = class_grounds(scenario, simulation.terrain, simulation.truth)
        spawns = spawn_cells(scenario, simulation.terrain.grid, grounds)
        self._unmoved = {id: cell for each in spawns.values() for id, cell in each.items()}
        """Vehicle -> cell, of those that no process has placed yet."""
        self._bodies: dict[str, dict[str, int]] = {}
        """Node -> vehicle -> cell. A body stands where it is when its process dies."""
        self._last: dict[str, Node] = {}
        """Agent -> the node on which its newest life began."""
        self._passable = {name: np.isfinite(each.truth).ravel() for name, each in grounds.items()}
        """Class of vehicles -> the cells that it may enter, in truth."""
        flying = [plan for plan in plan_agents(scenario) if flies(scenario, plan.group.vehicle_class)]
        self._aloft = {id for plan in flying for id in plan.vehicle_ids}
        simulation.after_boot.append(self._began)
        simulation.network.bus(OBSERVER, scenario.network.namespace).subscribe(DIGEST, self._take_digest)

    def _began(self, node: Node) -> None:
        if self._last.get(node.spec.id, node) is not node:
            self._bodies.pop(node.name, None)  # they have been driven from elsewhere since
        self._last[node.spec.id] = node

    def look(self, node: Node, service: AgentService, now_s: float) -> None:
        agent = service.agent
        bodies = self._bodies.setdefault(node.name, {})
        passable = self._passable[agent.plan.group.vehicle_class]
        for id, vehicle in agent.vehicles.items():
            if bodies.get(id) != vehicle.cell and not passable[vehicle.cell]:
                text = f"lethal entry at {now_s:.2f} s: {id} on cell {vehicle.cell}"
                self.lethal.append(BrokenLaw("no lethal entry", text, now_s))
            bodies[id] = vehicle.cell
            self._unmoved.pop(id, None)
        if agent.holdings.replaced:
            bodies.clear()  # the younger life drives them
        on: dict[tuple[int, bool], str] = {}
        for each in (self._unmoved, *self._bodies.values()):
            for id, cell in each.items():
                other = on.setdefault((cell, id in self._aloft), id)
                if other != id:
                    first, second = sorted((other, id))
                    text = f"collision at {now_s:.2f} s: {first} and {second} on cell {cell}"
                    self.collisions.append(BrokenLaw("no collision", text, now_s))

    def _take_digest(self, event: Event) -> None:
        assert isinstance(event, Heard)
        digest = event.message
        if isinstance(digest, Digest) and digest.role == "keeper":
            for key, stamp in sets_of(digest.held).items():
                self.acknowledged[key] = max(stamp, self.acknowledged.get(key, _NEVER))

    def broken_at_end(self) -> list[BrokenLaw]:
        broken = self.collisions[:_SHOWN] + self.lethal[:_SHOWN]
        store = self.simulation.nodes["keeper-0"].store
        assert store is not None
        stored = {(each.author, each.tile): (each.epoch, each.seq) for each in store.load()}
        if lost := missing(stored, self.acknowledged):
            text = f"{len(lost)} acknowledged sets are lost, such as {lost[0]}"
            broken.append(BrokenLaw("acknowledged marks stay", text))
        return broken


class Waits(Law):
    """How long vehicles are on one cell, less the time to drive across it, although they have somewhere to go and
    nothing is down.

    A second counts if every process works: one that is dead, hung or cut off is a reason to stand, as it may hold
    the cell ahead, or be the planner or a warden that a vehicle waits for. Messages that are lost or late are none.

    longest  when the longest wait ended or was last seen, vehicle and cell
    """

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(simulation)
        self.longest_s = 0.0
        self.longest: tuple[float, str, int] | None = None
        truths = class_truths(simulation.scenario, simulation.terrain, simulation.truth)
        across_m = math.sqrt(2) * simulation.terrain.grid.resolution_m
        self._across_s = {name: across_m / simulation.scenario.time_scale * each for name, each in truths.items()}
        """Class of vehicles -> the time to drive across each cell."""
        self._waited_s: dict[str, tuple[int, float]] = {}
        """Vehicle -> its cell, and the seconds that count since it came there."""
        self._looked_s: dict[str, float] = {}

    def look(self, node: Node, service: AgentService, now_s: float) -> None:
        passed_s = now_s - self._looked_s.get(node.name, now_s)
        self._looked_s[node.name] = now_s
        counts_s = 0.0 if self.simulation.disturbed() else passed_s
        across_s = self._across_s[service.agent.plan.group.vehicle_class]
        for vehicle in service.agent.vehicles.values():
            cell, waited_s = self._waited_s.get(vehicle.id, (-1, 0.0))
            to_go = vehicle.state in (VehicleState.FOLLOWING, VehicleState.SEARCHING, VehicleState.WAITING)
            waits = to_go and cell == vehicle.cell and not service.agent.stopped(vehicle.id)
            waited_s = waited_s + counts_s if waits else 0.0
            self._waited_s[vehicle.id] = (vehicle.cell, waited_s)
            wait_s = waited_s - across_s.item(vehicle.cell)
            if wait_s > self.longest_s:
                self.longest_s, self.longest = wait_s, (now_s, vehicle.id, vehicle.cell)

    def broken_at_end(self) -> list[BrokenLaw]:
        if self.longest is None or self.longest_s <= LONGEST_WAIT_S:
            return []
        when_s, vehicle, cell = self.longest
        text = f"{vehicle} waits {self.longest_s:.1f} s on cell {cell} without a reason, until {when_s:.1f} s"
        return [BrokenLaw("no wait without a reason", text, when_s)]


class Routed(Law):
    """When vehicles have a route, to their target or to where they search for it, or their target within reach,
    once nothing goes wrong any more.

    whole_s  when all processes worked for the first time since the quiet began; None until then
    """

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(simulation)
        self.whole_s: float | None = None
        self._at_s: dict[str, float] = {}

    def _ticked(self, node: Node) -> None:
        simulation, now_s = self.simulation, self.simulation.now_s
        if self.whole_s is None and now_s >= (simulation.faults.quiet_s or 0.0) and not simulation.disturbed():
            self.whole_s = now_s
        super()._ticked(node)

    def look(self, node: Node, service: AgentService, now_s: float) -> None:
        for vehicle in service.agent.vehicles.values() if self.whole_s is not None else ():
            if vehicle.state in (VehicleState.FOLLOWING, VehicleState.SEARCHING, VehicleState.ARRIVED):
                self._at_s.setdefault(vehicle.id, now_s)

    def missing(self) -> list[str]:
        """Vehicles that have had no route since."""
        every = [id for plan in plan_agents(self.simulation.scenario) for id in plan.vehicle_ids]
        return [id for id in every if id not in self._at_s]

    @property
    def after_s(self) -> float | None:
        """Seconds from `whole_s` until the last vehicle had a route; None if one has none."""
        if self.whole_s is None or self.missing():
            return None
        return max(self._at_s.values()) - self.whole_s

    def broken_at_end(self) -> list[BrokenLaw]:
        if self.whole_s is None:
            return [BrokenLaw("processes start again", "a process did not start again")]
        if late := self.missing():
            text = f"{len(late)} vehicles have no route any more, such as {', '.join(late[:_SHOWN])}"
            return [BrokenLaw("vehicles are routed again", text)]
        # A planner that has just begun listens for a while before it searches for a target that nobody tracks.
        listens_s = LISTEN_NS / NS_PER_S if self.simulation.scenario.untracked else 0.0
        if (after_s := self.after_s) is None or after_s <= ROUTED_WITHIN_S + listens_s:
            return []
        text = f"the last vehicle has a route {after_s:.1f} s after the last fault"
        return [BrokenLaw("vehicles are routed again", text, after_s)]


class BodyLaw(Law):
    """No vehicle drives into a body that was reported in time: judged by what the network delivered to each agent,
    and by where rovers truly are, at every step of every vehicle.

    broken   a vehicle entered a cell that a report had closed, which its agent had been delivered at an earlier
             tick, and whose lease lasted
    met      (when, vehicle, rover, cell): it entered a cell on which a rover truly was, reported in time or not
    entered  cells that vehicles entered in all
    near     of these, how many were within two cells of a rover
    """

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(simulation)
        self.broken: list[BrokenLaw] = []
        self.met: list[tuple[float, str, str, int]] = []
        self.entered = self.near = 0
        self._grid = simulation.terrain.grid
        self._delivered: dict[str, dict[tuple[str, int], tuple[Body, int]]] = {}
        """Node -> (body, incarnation) -> the newest report, and when it was delivered."""
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

    def _boot(self, node: Node) -> None:
        self._delivered.pop(node.name, None)
        self._cells = {key: cell for key, cell in self._cells.items() if key[0] != node.name}
        self._looked_ns.pop(node.name, None)

    def _deliver(self, body: Body, agent: str, now_ns: int) -> None:
        known = self._delivered.setdefault(agent, {})
        last = known.get((body.id, body.incarnation))
        if last is None or body.seq > last[0].seq or now_ns - last[1] >= last[0].lease_s * NS_PER_S:
            known[body.id, body.incarnation] = body, now_ns

    def look(self, node: Node, service: AgentService, now_s: float) -> None:
        now_ns = self.simulation.scheduler.clock.now_ns()
        looked_ns = self._looked_ns.get(node.name, now_ns)
        self._looked_ns[node.name] = now_ns
        for id, vehicle in service.agent.vehicles.items():
            cell = vehicle.cell
            before, self._cells[node.name, id] = self._cells.get((node.name, id)), cell
            if before is None or before == cell:
                continue
            self.entered += 1
            for body, at_ns in self._delivered.get(node.name, {}).values():
                lasts = at_ns <= looked_ns and now_ns < at_ns + body.lease_s * NS_PER_S
                if lasts and from_square_m(self._grid, cell, body.x_m, body.y_m) < body.radius_m:
                    text = f"driven into body {body.id} at {now_s:.2f} s: {id} on cell {cell}"
                    self.broken.append(BrokenLaw("bodies are avoided", text, now_s))
            for other in self.simulation.nodes.values():
                if not isinstance(other.service, TargetsService) or not other.service.leads:
                    continue
                for rover in other.service.rovers.all:
                    far_m = from_square_m(self._grid, cell, rover.x_m, rover.y_m) - rover.config.radius_m
                    self.near += far_m <= 2 * self._grid.resolution_m
                    if far_m < 0.0:
                        self.met.append((now_s, id, rover.id, cell))

    def broken_at_end(self) -> list[BrokenLaw]:
        return self.broken[:_SHOWN]


def from_square_m(grid: GridSpec, cell: int, x_m: float, y_m: float) -> float:
    """Distance of a place from the square of a cell."""
    row, col = divmod(cell, grid.cols)
    west_m, north_m = grid.west_m + col * grid.resolution_m, grid.north_m - row * grid.resolution_m
    east = max(west_m - x_m, x_m - west_m - grid.resolution_m, 0.0)
    south = max(y_m - north_m, north_m - grid.resolution_m - y_m, 0.0)
    return math.hypot(east, south)


class LawBook:
    """Runs a simulation to its end and holds it against every law."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.bodies, self.laws = BodyLaw(simulation), Laws(simulation)
        self.waits, self.routed = Waits(simulation), Routed(simulation)

    def run(self, seconds: float) -> list[BrokenLaw]:
        """Returns the laws that broke. At the end the agents die, so that nothing new is said."""
        simulation = self.simulation
        simulation.run_until(seconds - SETTLED_S)
        said: Sets = {}
        for name, replica in self._replicas().items():
            if simulation.nodes[name].spec.role == "agent":
                said |= sets_of(replica.own_digest())
        simulation.run_until(seconds)
        broken: list[BrokenLaw] = []
        for name, replica in self._replicas().items() if simulation.scenario.map.interest == "all" else ():
            if lacks := missing(sets_of(replica.held.ledger.held()), said):
                first = f"{len(lacks)} sets that were said {SETTLED_S:g} s ago, such as {lacks[0]}"
                broken.append(BrokenLaw("marks reach everybody", f"{name} lacks {first}"))
        for node in simulation.nodes.values():
            if node.spec.role == "agent":
                node.crash()
        simulation.run_until(seconds + LAST_WORDS_S)
        for law in (self.laws, self.bodies, self.waits, self.routed):
            broken += law.broken_at_end()
        prints: dict[object, list[str]] = {}
        for name, replica in self._replicas().items():
            prints.setdefault(replica.held.fingerprint(), []).append(name)
        if len(prints) > 1:
            apart = " | ".join(", ".join(names) for names in prints.values())
            broken.append(BrokenLaw("replicas are equal", f"replicas differ: {apart}"))
        return broken

    def _replicas(self) -> dict[str, MapReplica]:
        """The map of each living process that has one, by the name of its node."""
        found: dict[str, MapReplica] = {}
        for name, node in self.simulation.nodes.items():
            service: Any = node.service
            replica = getattr(service, "replica", None) or getattr(service, "_replica", None)
            if isinstance(replica, MapReplica):
                found[name] = replica
        return found
