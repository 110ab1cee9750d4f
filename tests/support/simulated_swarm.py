"""A small swarm in a simulation, and the laws that hold in every one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from launch_scripts.process_table import processes_of
from launch_scripts.simulation.faults import FaultPlan, random_plan
from launch_scripts.simulation.simulate import SIMULATED_ROLES, Node, Simulation
from shared_map.replication.replica import MapReplica
from swarm.bus.bus import Event, Heard
from swarm.config.load import parse_scenario
from swarm.config.scenario import Scenario
from swarm.wire.messages.marks import DIGEST_ROW, Digest
from swarm.wire.topics import DIGEST

SMALL = parse_scenario("""
name = "small"
time_scale = 10
[terrain]
source = "synthetic"
rows = 48
cols = 64
resolution_m = 30
relief_m = 200
roads = 3
[terrain.hidden]
closed_roads = 2
rubble_fields = 4
flooded_share = 0.02
[cost]
max_slope_deg = 25
[[targets]]
count = 2
speed_m_per_s = 3
[[groups]]
vehicles = 10
[vehicles]
per_agent = 4
sense_range_m = 120
capture_range_m = 60
""")

WIDE_TERRAIN = """
time_scale = 40
[terrain]
source = "synthetic"
rows = 280
cols = 800
resolution_m = 30
relief_m = 200
"""
"""Begins a scenario with eight regions, in which vehicles drive ten cells a second and cross borders."""

Stamp = tuple[int, int]
Sets = dict[tuple[str, int], Stamp]
"""(author, tile) -> (epoch, seq)."""


def seeded(seed: int, scenario: Scenario = SMALL) -> Scenario:
    return msgspec.structs.replace(scenario, seed=seed)


def names(scenario: Scenario) -> list[str]:
    return [spec.name for spec in processes_of(scenario, SIMULATED_ROLES)]


def planned(seed: int, seconds: float) -> FaultPlan:
    return random_plan(seed, names(SMALL), seconds)


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


class Laws:
    """Looks at everything in a simulation that no process could see.

    collisions    (when, vehicle, vehicle, cell), by where vehicles truly are; those of a dead agent stay put
    lethal        (when, vehicle, cell), of cells that are lethal in truth
    acknowledged  the newest of each set that a keeper ever said it had committed
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.collisions: list[tuple[float, str, str, int]] = []
        self.lethal: list[tuple[float, str, int]] = []
        self.acknowledged: Sets = {}
        self._cells: dict[str, int] = {}
        self._passable = np.isfinite(simulation.truth).ravel()
        simulation.after_tick.append(self._look)
        bus = simulation.network.bus("recorder-0", simulation.scenario.network.namespace)
        bus.subscribe(DIGEST, self._hear)

    def _look(self, node: Node) -> None:
        if node.spec.role != "agent":
            return
        service: Any = node.service
        now_s = self.simulation.now_s
        for id, vehicle in service.agent.vehicles.items():
            if self._cells.get(id) != vehicle.cell and not self._passable[vehicle.cell]:
                self.lethal.append((now_s, id, vehicle.cell))
            self._cells[id] = vehicle.cell
        on: dict[int, str] = {}
        for id, cell in sorted(self._cells.items()):
            if cell in on:
                self.collisions.append((now_s, on[cell], id, cell))
            on[cell] = id

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
