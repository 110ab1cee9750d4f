"""The processes that plan: the planner of one target, and that of routes to places."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import closing

from planner_service.growth_times import is_slow_to_grow
from planner_service.kernel_build import KernelLoader, NeededKernels, needed_kernels, place_kernels
from planner_service.places_service import PlacesService
from planner_service.planning_process import Planning, shared_costs
from planner_service.service import PlannerService
from shared_map.terrain.store import load_terrain
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import load_classes
from swarm.bus.bus import Bus
from swarm.errors import ConfigError
from swarm.peers import job_of
from swarm.recording.record_inputs import run_role
from swarm.recording.service_boundary import Boundary
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import JobSlots, Service, ThreadWorker, tick_phase
from swarm.runtime.role_setup import RoleSetup

log = logging.getLogger(__name__)


def run(setup: RoleSetup, built: Callable[[], None]) -> None:
    """Plan for one target, as its planner or a standby, until SIGTERM, SIGINT or the end of the launcher."""
    scenario = setup.scenario
    target = job_of(setup.id)
    if target not in scenario.target_ids:
        ids = ", ".join(scenario.target_ids)
        raise ConfigError(f"scenario {scenario.name} has no target {target}; it has {ids}")
    terrain = _load_ground(setup)
    kernels = _load_kernels(needed_kernels(scenario), whole=is_slow_to_grow(terrain.grid))
    costs = shared_costs(setup.run_dir, terrain, scenario.planner)

    def make(boundary: Boundary, planning: Planning) -> Service:
        stopwatch = boundary.function("stopwatch", time.thread_time_ns, int)
        all_kernels = boundary.function("all kernels", lambda: kernels.complete, bool)
        return PlannerService(planning, all_kernels, stopwatch, costs)

    _serve(setup, terrain, built, make, "grow-tree", JobSlots(setup.run_dir))


def run_places(setup: RoleSetup, built: Callable[[], None]) -> None:
    """Plan to any place until SIGTERM, SIGINT or the end of the launcher."""
    terrain = _load_ground(setup)
    kernels = _load_kernels(place_kernels(setup.scenario), whole=False)

    def make(boundary: Boundary, planning: Planning) -> Service:
        return PlacesService(planning, boundary.function("all kernels", lambda: kernels.complete, bool))

    _serve(setup, terrain, built, make, "grow-places")


def _load_ground(setup: RoleSetup) -> Terrain:
    terrain = load_terrain(setup)
    load_classes(setup, terrain)
    return terrain


def _load_kernels(needed: NeededKernels, whole: bool) -> KernelLoader:
    kernels = KernelLoader(needed, whole)
    kernels.load_first(log.info)
    return kernels


def _serve(
    setup: RoleSetup,
    terrain: Terrain,
    built: Callable[[], None],
    make: Callable[[Boundary, Planning], Service],
    worker_name: str,
    slots: JobSlots | None = None,
) -> None:
    inbox = Inbox()
    with closing(ThreadWorker(worker_name, inbox, slots)) as worker:

        def service(boundary: Boundary, bus: Bus, stop: Callable[[], None]) -> Service:
            return make(boundary, Planning(setup, terrain, bus, inbox.post, boundary.worker(worker)))

        run_role(setup, terrain.digest, built, service, inbox, setup.scenario.planner.tick_hz, tick_phase(setup.id))
