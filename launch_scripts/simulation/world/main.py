"""The process that moves the simulated targets and referees the run."""

from __future__ import annotations

from collections.abc import Callable

from launch_scripts.simulation.world.service import TICK_HZ, TargetsService
from launch_scripts.simulation.world.walks import WAY_MODULES
from shared_map.terrain.store import load_terrain, load_truth
from shared_map.vehicle_class_grounds import load_classes
from swarm.bus.bus import Bus
from swarm.recording.record_inputs import run_role
from swarm.recording.service_boundary import Boundary
from swarm.runtime.inbox import Inbox
from swarm.runtime.loop_health import Modules
from swarm.runtime.role_setup import RoleSetup


def run(setup: RoleSetup, built: Callable[[], None]) -> None:
    """Moves all targets of the scenario until SIGTERM, SIGINT or the end of the launcher."""
    modules = Modules(WAY_MODULES)
    modules.there()  # they begin to load
    terrain = load_terrain(setup)
    load_classes(setup, terrain)
    truth = load_truth(setup, terrain)
    inbox = Inbox()

    def make(boundary: Boundary, bus: Bus, stop: Callable[[], None]) -> TargetsService:
        modules.wait()
        return TargetsService(setup, terrain, truth, bus, inbox.post)

    run_role(setup, terrain.digest, built, make, inbox, TICK_HZ)
