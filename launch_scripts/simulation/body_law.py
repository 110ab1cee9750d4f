"""The law of bodies in a simulation: no vehicle drives into a body that was reported in time.

It is judged from outside: by what the network delivered to each agent, and by where rovers truly are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from launch_scripts.simulation.node import Node
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.world.rovers import Rover
from launch_scripts.simulation.world.service import TargetsService
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.codec import decode
from swarm.wire.messages.vehicles import Body
from swarm.wire.topics import BODY
from vehicle_agent.service import AgentService


@dataclass(slots=True)
class _Delivered:
    body: Body
    at_ns: int


class BodyLaw:
    """Looks at every step of every vehicle.

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
        self._delivered: dict[str, dict[tuple[str, int], _Delivered]] = {}
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
            known[key] = _Delivered(body, now_ns)

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
