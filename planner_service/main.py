"""The planner of one target, as a process."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import closing

from planner_service.growth_times import is_slow_to_grow
from planner_service.kernel_build import KernelLoader, needed_kernels
from planner_service.prepared_costs import PREPARED_COSTS, prepared_costs
from planner_service.service import PlannerService
from shared_map.terrain.store import load_terrain
from shared_map.vehicle_class_grounds import load_classes
from swarm.bus.bus import Bus
from swarm.errors import ConfigError
from swarm.liveness import job_of
from swarm.recording.role_process import run_role
from swarm.recording.service_boundary import Boundary
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import JobSlots, ThreadWorker, tick_phase
from swarm.runtime.role import RoleSetup

log = logging.getLogger(__name__)


def run(setup: RoleSetup, stop_when: Callable[[], None] | None) -> None:
    """Plan for one target, as its planner or a standby, until SIGTERM, SIGINT or the end of the launcher."""
    scenario = setup.scenario
    target = job_of(setup.id)
    if target not in scenario.target_ids:
        ids = ", ".join(scenario.target_ids)
        raise ConfigError(f"scenario {scenario.name} has no target {target}; it has {ids}")
    terrain = load_terrain(setup)
    load_classes(setup, terrain)
    kernels = KernelLoader(needed_kernels(scenario), whole=is_slow_to_grow(terrain.grid))
    kernels.load_first(log.info)
    prepared = prepared_costs(setup.run_dir, terrain, scenario.planner)
    inbox = Inbox()

    def make(boundary: Boundary, bus: Bus, stop: Callable[[], None]) -> PlannerService:
        return PlannerService(
            setup,
            terrain,
            bus,
            inbox.post,
            boundary.worker(worker),
            boundary.function("stopwatch", time.thread_time_ns, int),
            boundary.function("all kernels", lambda: kernels.complete, bool),
            boundary.external(prepared, PREPARED_COSTS),
        )

    with closing(ThreadWorker("grow-tree", inbox, JobSlots(setup.run_dir))) as worker:
        tick_hz = scenario.planner.tick_hz
        run_role(setup, terrain.digest, stop_when, make, inbox, tick_hz, tick_phase(setup.id))
