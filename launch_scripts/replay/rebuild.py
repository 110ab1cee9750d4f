"""A recorded process as this build makes it: scenario, terrain and service behind a boundary."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import msgspec

from launch_scripts.simulation.world.service import TargetsService
from planner_service.prepared_costs import PREPARED_COSTS, PreparedCosts
from planner_service.service import PlannerService
from shared_map.arrays import Floats
from shared_map.keeper.service import KeeperService
from shared_map.keeper.store import KEEPER_STORE, KeeperStore
from shared_map.prepared_classes import load_classes
from shared_map.terrain.store import load_terrain, load_truth
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Bus, Event, Worker
from swarm.config.load import parse_scenario
from swarm.config.scenario import Scenario
from swarm.errors import StoreError, TerrainError
from swarm.recording.records import Head
from swarm.recording.replaying import Replaying
from swarm.runtime.process import Service
from swarm.runtime.role import RoleSetup
from swarm.wire.codec import decode
from swarm.wire.messages.processes import Stats
from vehicle_agent.promise_store import PROMISE_STORE, PromiseStore
from vehicle_agent.service import AgentService


@dataclass(frozen=True, eq=False)
class Ground:
    """The terrain that a service is given, and what it truly is."""

    terrain: Terrain
    truth: Floats


class Grounds:
    """The terrain of recordings, built once for all that have the same.

    folder  a run's: what is prepared there is taken, if it is of the same scenario
    given   in place of the scenario's own, where that says nothing of it
    """

    def __init__(self, folder: Path, given: Ground | None = None) -> None:
        self._folder = folder
        self._given = given
        self._built: dict[bytes, Ground] = {}

    def of(self, setup: RoleSetup, digest: str) -> Ground:
        """Raises TerrainError where this build makes another of the same scenario."""
        if self._given is not None:
            return self._given
        scenario = setup.scenario
        key = msgspec.msgpack.encode((scenario.terrain, scenario.cost, scenario.classes, scenario.seed))
        ground = self._built.get(key)
        if ground is None:
            terrain = load_terrain(setup)
            load_classes(setup, terrain)
            ground = self._built[key] = Ground(terrain, load_truth(setup, terrain))
        if ground.terrain.digest != digest:
            raise TerrainError(
                f"{setup.role} {setup.id} was recorded on terrain {digest}, but its scenario makes terrain "
                f"{ground.terrain.digest} here: terrain files or the rules of cost have changed"
            )
        return ground


def setup_of(head: Head, folder: Path) -> RoleSetup:
    """What a recorded process was started with. Raises ConfigError where its scenario cannot be read here, and
    ProtocolError on counts that are none."""
    return RoleSetup(
        scenario=parse_scenario(head.scenario),
        run_id=head.run_id,
        role=head.role,
        id=head.id,
        incarnation=head.incarnation,
        started_ns=head.started_ns,
        run_dir=folder,
        added=head.added,
        restarts=head.restarts,
        before=decode(head.before, Stats) if head.before else None,
        anew=head.anew,
    )


def rebuilt(setup: RoleSetup, ground: Ground, boundary: Replaying) -> Service:
    """The service of a recorded process. Raises StoreError on a role that has none."""

    def post(event: Event) -> None:
        """What a service tells itself is in the recording, too."""

    terrain, truth, bus = ground.terrain, ground.truth, boundary.bus(cast(Bus, boundary.nobody))
    match setup.role:
        case "keeper":
            store = boundary.external(cast(KeeperStore, None), KEEPER_STORE)
            return KeeperService(setup, terrain, bus, post, store)
        case "planner":
            stopwatch: Callable[[], int] | None = boundary.function("stopwatch", None, int)
            kernels: Callable[[], bool] | None = boundary.function("all kernels", None, bool)
            of_classes: Callable[[], bool] | None = boundary.function("kernels of classes", None, bool)
            shelf = boundary.external(cast(PreparedCosts, _Costs(terrain, setup.scenario)), PREPARED_COSTS)
            worker = boundary.worker(cast(Worker, boundary.nobody))
            return PlannerService(setup, terrain, bus, post, worker, stopwatch, kernels, of_classes, shelf)
        case "targets":
            return TargetsService(setup, terrain, truth, bus, post)
        case "agent":
            promises = boundary.external(cast(PromiseStore, None), PROMISE_STORE)
            return AgentService(setup, terrain, truth, bus, post, promises)
    raise StoreError(f"no process of role {setup.role!r} is replayed")


class _Costs:
    """What planners of a machine share that follows from scenario and terrain."""

    def __init__(self, terrain: Terrain, scenario: Scenario) -> None:
        self._terrain = terrain
        self._scenario = scenario

    @property
    def cell_cost(self) -> Floats:
        with tempfile.TemporaryDirectory() as folder:
            return PreparedCosts(Path(folder), self._terrain, self._scenario.planner).cell_cost
