"""Laws of every simulation under any faults, which no process could check itself.

`LawBook` watches a simulation from its beginning, runs it to its end and says which of these broke:

    no collision, no lethal entry     by where vehicles truly are, at every tick of their agents
    obstacles are avoided                no vehicle enters a cell that an obstacle had closed in time
    acknowledged marks stay           what a keeper said it had committed is on its disk
    no wait without a reason          of ten seconds while everything works
    vehicles are routed again         within five seconds of the last fault, or say that they are stranded, and
                                      no way leads to any target
    marks reach everybody             what an agent said four seconds before the end, every process holds
    replicas are equal                once no process publishes anything new
"""

from __future__ import annotations

import contextlib
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from launch_scripts.simulation.faults import OBSERVER
from launch_scripts.simulation.simulate import Node, Simulation
from launch_scripts.simulation.world.walks import TrueTerrain
from planner_service.target_search import LISTEN_NS
from shared_map.replication.replica import MapReplica
from shared_map.vehicle_class_grounds import class_grounds
from swarm.bus.bus import Event, Heard
from swarm.clock import NS_PER_S
from swarm.config.scenario import plan_agents, traffic_grid
from swarm.config.vehicle_classes import flies
from swarm.errors import ProtocolError
from swarm.wire.codec import decode
from swarm.wire.messages.map_data import DIGEST_ROW, Digest
from swarm.wire.messages.vehicles import Obstacle, VehicleState
from swarm.wire.topics import DIGEST, OBSTACLE
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.service import AgentService
from vehicle_agent.start_cells import spawn_cells
from vehicle_agent.traffic.obstacles import capsule_of

LONGEST_WAIT_S = 10.0
"""Time that a vehicle may wait without a reason."""
ROUTED_WITHIN_S = 5.0
"""Time from a vehicle's first request to its first route."""
SLOW_MS = 200.0
"""From this delay of every message on the two limits above do not hold: a grant of a cell takes some round trips,
and in a crowd the vehicles behind wait for each. All other laws hold at any delay."""
SETTLED_S = 4.0
"""Age at the end of messages that have reached every process."""
LAST_WORDS_S = 6.0
"""Time without new messages after which all replicas are equal."""
_SHOWN = 3
"""Reported cases of one law in a run: consequences of the first say little."""
_ROUTED = (VehicleState.FOLLOWING, VehicleState.SEARCHING, VehicleState.ARRIVED)
_UNDER_WAY = (VehicleState.FOLLOWING, VehicleState.SEARCHING, VehicleState.WAITING)

Sets = dict[tuple[str, int], tuple[int, int]]
"""(author, tile) -> (epoch, seq)."""
_NEVER = (-1, -1)
"""A stamp below that of any set, whose epoch and number are 0 or more."""


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
    """Returns the sets that a digest names."""
    rows = ((author, row) for author, packed in held.items() for row in np.frombuffer(packed, DIGEST_ROW))
    return {(author, int(row["tile"])): (int(row["epoch"]), int(row["seq"])) for author, row in rows}


def missing(has: Sets, wanted: Sets) -> list[tuple[str, int]]:
    return [key for key, stamp in wanted.items() if has.get(key, _NEVER) < stamp]


@dataclass(eq=False)
class _Generation:
    """Inputs and actions of one generation of an agent.

    cells      vehicle -> where it is. It stays there when the process dies, until the next generation. The cell in
               which a generation finds a vehicle first is no step. Empty once a younger generation drives them
    reports    (obstacle, incarnation) -> the newest report that was delivered to it, and when
    ticked_ns  its last tick; None before the first
    """

    cells: dict[str, int] = field(default_factory=dict)
    reports: dict[tuple[str, int], tuple[Obstacle, int]] = field(default_factory=dict)
    ticked_ns: int | None = None

    def take(self, report: Obstacle, now_ns: int) -> None:
        known, received_ns = self.reports.get((report.id, report.incarnation), (None, 0))
        if known is None or report.seq > known.seq or now_ns - received_ns >= known.lease_s * NS_PER_S:
            self.reports[report.id, report.incarnation] = report, now_ns


class LawBook:
    """Watches all agents of a simulation.

    collisions    by where vehicles truly are; those of a dead process stay put
    lethal        entries of cells that are lethal in truth to the vehicle's class
    driven_into   entries of cells that a report had closed, which was delivered to the agent before its last tick
                  and whose lease lasted
    acknowledged  the newest of each set that a keeper ever said it had committed
    longest_s     the longest time on one cell, less the time to drive across it, of a vehicle that has somewhere to
                  go. A second counts if every process works: one that is dead, hung or cut off may hold the cell
                  ahead, or be the planner or leader that is waited for. Messages that are lost are no reason;
                  obstacles that leave a vehicle no step are one
    longest       when that wait was last seen, vehicle and cell
    whole_s       when all processes worked for the first time since the quiet began; None until then
    routed_s      vehicle -> when it first had a route after that, to its target or to where it searches for it, or
                  its target within reach; or was rightly stranded
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self._slow = simulation.faults.delay_ms >= SLOW_MS
        self.collisions: list[BrokenLaw] = []
        self.lethal: list[BrokenLaw] = []
        self.driven_into: list[BrokenLaw] = []
        self.acknowledged: Sets = {}
        self.longest_s = 0.0
        self.longest: tuple[float, str, int] | None = None
        self.whole_s: float | None = None
        self.routed_s: dict[str, float] = {}
        scenario, grid = simulation.scenario, simulation.terrain.grid
        self._traffic = traffic_grid(scenario, grid)
        grounds = class_grounds(scenario, simulation.terrain, simulation.truth)
        self._grounds = {of: TrueTerrain(grid, g.truth, g.terrain.climb, g.homes) for of, g in grounds.items()}
        self._across_m = math.sqrt(2) * self._traffic.resolution_m / scenario.time_scale
        plans = plan_agents(scenario)
        self._vehicles = [id for plan in plans for id in plan.vehicle_ids]
        self._aloft = {id for plan in plans if flies(scenario, plan.group.vehicle_class) for id in plan.vehicle_ids}
        spawns = spawn_cells(scenario, grid, grounds)
        self._unmoved = {id: cell for each in spawns.values() for id, cell in each.items()}
        """Vehicle -> cell, of those that no process has placed yet."""
        self._generations: defaultdict[str, _Generation] = defaultdict(_Generation)
        """Node -> its newest generation."""
        self._waited: dict[str, tuple[int, float]] = {}
        """Vehicle -> its cell, and the seconds that count since it came there."""
        simulation.after_boot.append(self._booted)
        simulation.after_tick.append(self._ticked)
        simulation.network.bus(OBSERVER, scenario.network.namespace).subscribe(DIGEST, self._take_digest)
        self._trace = simulation.network.trace
        simulation.network.trace = self._delivered

    # --- while it runs --------------------------------------------------------------------------------------

    def _booted(self, node: Node) -> None:
        # Simulated vehicles are nowhere until the new generation has places for them.
        self._generations[node.name] = _Generation()

    def _delivered(self, now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
        if self._trace is not None:
            self._trace(now_ns, source, destination, topic, payload)
        if topic == OBSTACLE.name and destination.startswith("agent-"):
            with contextlib.suppress(ProtocolError):  # an invalid report closes nothing
                self._generations[destination].take(decode(payload, Obstacle), now_ns)

    def _take_digest(self, event: Event) -> None:
        if isinstance(event, Heard) and isinstance(event.message, Digest) and event.message.role == "keeper":
            for key, stamp in sets_of(event.message.held).items():
                self.acknowledged[key] = max(stamp, self.acknowledged.get(key, _NEVER))

    def _ticked(self, node: Node) -> None:
        simulation, now_s = self.simulation, self.simulation.now_s
        disturbed = simulation.disturbed()
        if self.whole_s is None and now_s >= (simulation.faults.quiet_s or 0.0) and not disturbed:
            self.whole_s = now_s
        if not isinstance(node.service, AgentService):
            return
        agent, now_ns = node.service.agent, simulation.now_ns
        generation = self._generations[node.name]
        cells = generation.cells
        ticked_ns, generation.ticked_ns = generation.ticked_ns or now_ns, now_ns
        ground = self._grounds[agent.plan.group.vehicle_class]
        truth = ground.pace_s_per_m.reshape(-1)
        for id, vehicle in agent.vehicles.items():
            pace = truth.item(vehicle.terrain_cell)
            if cells.get(id) != vehicle.cell:
                if not math.isfinite(pace):
                    text = f"lethal entry at {now_s:.2f} s: {id} on cell {vehicle.cell}"
                    self.lethal.append(BrokenLaw("no lethal entry", text, now_s))
                if id in cells:
                    self.driven_into += self._obstacles_entered(generation, vehicle, ticked_ns)
            cells[id] = vehicle.cell
            self._unmoved.pop(id, None)
            if self.whole_s is not None and id not in self.routed_s and self._routed(ground, vehicle):
                self.routed_s[id] = now_s
            to_go = vehicle.state in _UNDER_WAY and not (agent.stopped(id) or id in agent.shut_in)
            counts_s = 0.0 if disturbed else (now_ns - ticked_ns) / NS_PER_S
            self._wait(vehicle, to_go, counts_s, self._across_m * pace)
        if agent.holdings.replaced:  # its successor drives them; it may begin again later, and then holds nothing
            cells.clear()
        self._collide()

    def _routed(self, ground: TrueTerrain, vehicle: Vehicle) -> bool:
        """Returns True if a vehicle has a route, or is stranded and in truth no way leads from it to a target."""
        if vehicle.state is not VehicleState.STRANDED:
            return vehicle.state in _ROUTED
        poses = self.simulation.recorder.observed.poses.values()
        return ground.reached_from(vehicle.terrain_cell).isdisjoint(pose.cell for pose in poses)

    def _obstacles_entered(self, generation: _Generation, vehicle: Vehicle, ticked_ns: int) -> Iterator[BrokenLaw]:
        """The obstacles onto which a vehicle has driven since the last tick of its agent."""
        now_ns, now_s = self.simulation.now_ns, self.simulation.now_s
        grid, middle = self._traffic, self._traffic.centre_m(vehicle.cell)
        for obstacle, at_ns in generation.reports.values():
            lasts = at_ns <= ticked_ns and now_ns < at_ns + obstacle.lease_s * NS_PER_S
            near = math.dist(middle, (obstacle.x_m, obstacle.y_m)) <= obstacle.radius_m + grid.resolution_m
            if lasts and near and vehicle.cell in capsule_of(obstacle, grid, 0.0).cells(grid):
                text = f"driven into obstacle {obstacle.id} at {now_s:.2f} s: {vehicle.id} on cell {vehicle.cell}"
                yield BrokenLaw("obstacles are avoided", text, now_s)

    def _wait(self, vehicle: Vehicle, to_go: bool, counts_s: float, across_s: float) -> None:
        cell, waited_s = self._waited.get(vehicle.id, (-1, 0.0))
        waited_s = waited_s + counts_s if to_go and cell == vehicle.cell else 0.0
        self._waited[vehicle.id] = (vehicle.cell, waited_s)
        if waited_s - across_s > self.longest_s:
            self.longest_s, self.longest = waited_s - across_s, (self.simulation.now_s, vehicle.id, vehicle.cell)

    def _collide(self) -> None:
        now_s = self.simulation.now_s
        driven = [each.cells for each in self._generations.values()]
        on: dict[tuple[int, bool], str] = {}
        for cells in (self._unmoved, *driven):
            for id, cell in cells.items():
                other = on.setdefault((cell, id in self._aloft), id)
                if other != id:
                    first, second = sorted((other, id))
                    text = f"collision at {now_s:.2f} s: {first} and {second} on cell {cell}"
                    self.collisions.append(BrokenLaw("no collision", text, now_s))

    # --- at the end -----------------------------------------------------------------------------------------

    def run(self, seconds: float) -> list[BrokenLaw]:
        """Returns the laws that broke. At the end the agents die, so that nothing new is said."""
        simulation = self.simulation
        simulation.run_until(seconds - SETTLED_S)
        published: Sets = {}
        for name, replica in self._replicas().items():
            if simulation.nodes[name].spec.role == "agent":
                published |= sets_of(replica.own_digest())
        simulation.run_until(seconds)
        broken: list[BrokenLaw] = []
        for name, replica in self._replicas().items() if simulation.scenario.map.interest == "all" else ():
            if lacks := missing(sets_of(replica.held.ledger.held()), published):
                first = f"{len(lacks)} sets that were said {SETTLED_S:g} s ago, such as {lacks[0]}"
                broken.append(BrokenLaw("marks reach everybody", f"{name} lacks {first}"))
        for node in simulation.nodes.values():
            if node.spec.role == "agent":
                node.crash()
        simulation.run_until(seconds + LAST_WORDS_S)
        broken += self.collisions[:_SHOWN] + self.lethal[:_SHOWN]
        broken += [*self._marks_lost(), *self.driven_into[:_SHOWN], *self._waits(), *self._unrouted()]
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

    def _marks_lost(self) -> Iterator[BrokenLaw]:
        held = self.simulation.nodes["keeper-0"].store.load()
        stored = {(each.author, each.tile): (each.epoch, each.seq) for each in held}
        if lost := missing(stored, self.acknowledged):
            text = f"{len(lost)} acknowledged sets are lost, such as {lost[0]}"
            yield BrokenLaw("acknowledged marks stay", text)

    def _waits(self) -> Iterator[BrokenLaw]:
        if self.longest is not None and self.longest_s > LONGEST_WAIT_S and not self._slow:
            when_s, vehicle, cell = self.longest
            wait = f"{vehicle} waits {self.longest_s:.1f} s on cell {cell}"
            yield BrokenLaw("no wait without a reason", f"{wait} without a reason, until {when_s:.1f} s", when_s)

    def never_routed(self) -> list[str]:
        """Vehicles that have had no route since `whole_s`."""
        return [id for id in self._vehicles if id not in self.routed_s]

    @property
    def routed_after_s(self) -> float | None:
        """Seconds from `whole_s` until the last vehicle had a route; None if one has none."""
        if self.whole_s is None or self.never_routed():
            return None
        return max(self.routed_s.values()) - self.whole_s

    def _unrouted(self) -> Iterator[BrokenLaw]:
        # A planner that has just started listens for a while before it searches for an untracked target.
        listens_s = LISTEN_NS / NS_PER_S if self.simulation.scenario.untracked else 0.0
        if self.whole_s is None:
            yield BrokenLaw("processes start again", "a process did not start again")
        elif late := self.never_routed():
            text = f"{len(late)} vehicles have no route any more, such as {', '.join(late[:_SHOWN])}"
            yield BrokenLaw("vehicles are routed again", text)
        elif not self._slow and (after_s := self.routed_after_s or 0.0) > ROUTED_WITHIN_S + listens_s:
            text = f"the last vehicle has a route {after_s:.1f} s after the last fault"
            yield BrokenLaw("vehicles are routed again", text, after_s)
