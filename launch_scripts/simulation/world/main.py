"""The process that moves the simulated targets and referees the run."""

from __future__ import annotations

from collections.abc import Callable

from launch_scripts.simulation.world.service import TICK_HZ, TargetsService
from shared_map.class_grounds import load_classes
from shared_map.terrain.store import load_terrain, load_truth
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.recording.recording import recorded
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process, end_with
from swarm.runtime.role import RoleSetup
from swarm.runtime.run_secret import authenticator_of


def run(setup: RoleSetup, stop_when: Callable[[], None] | None) -> None:
    """Moves all targets of the scenario until SIGTERM, SIGINT or the end of the launcher."""
    terrain = load_terrain(setup)
    load_classes(setup, terrain)
    truth = load_truth(setup, terrain)
    inbox = Inbox()
    network = setup.scenario.network
    with (
        open_bus(network, patient=True, authenticator=authenticator_of(network, setup.run_id)) as bus,
        recorded(setup, terrain.digest) as boundary,
    ):
        service = TargetsService(setup, terrain, truth, boundary.bus(bus), inbox.post)
        process = Process(boundary.service(service), inbox, MonotonicClock(), TICK_HZ, health=setup.health)
        process.stop_on_signals()
        if stop_when is not None:
            end_with(stop_when, process.stop)
        process.run()
