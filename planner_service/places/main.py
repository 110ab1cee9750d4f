"""The planner of routes to places, as a process."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import closing

from planner_service.kernel_build import KernelLoader, place_kernels
from planner_service.places.service import PlacesService
from shared_map.terrain.store import load_terrain
from shared_map.vehicle_class_grounds import load_classes
from swarm.bus.bus import Bus
from swarm.recording.role_process import run_role
from swarm.recording.service_boundary import Boundary
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import ThreadWorker, tick_phase
from swarm.runtime.role import RoleSetup

log = logging.getLogger(__name__)


def run(setup: RoleSetup, stop_when: Callable[[], None] | None) -> None:
    """Plan to any place until SIGTERM, SIGINT or the end of the launcher."""
    scenario = setup.scenario
    terrain = load_terrain(setup)
    load_classes(setup, terrain)
    kernels = KernelLoader(place_kernels(scenario), whole=False)
    kernels.load_first(log.info)
    inbox = Inbox()

    def make(boundary: Boundary, bus: Bus, stop: Callable[[], None]) -> PlacesService:
        return PlacesService(
            setup,
            terrain,
            bus,
            inbox.post,
            boundary.worker(worker),
            boundary.function("all kernels", lambda: kernels.complete, bool),
        )

    with closing(ThreadWorker("grow-places", inbox)) as worker:
        run_role(setup, terrain.digest, stop_when, make, inbox, scenario.planner.tick_hz, tick_phase(setup.id))
