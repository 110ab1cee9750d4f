"""The agent process."""

from __future__ import annotations

import secrets
from collections.abc import Callable

from shared_map.terrain.store import load_terrain, load_truth
from shared_map.vehicle_class_grounds import load_classes
from swarm.bus.bus import Bus
from swarm.recording.record_inputs import run_role
from swarm.recording.service_boundary import Boundary
from swarm.right_of_way.promise_store import PROMISE_STORE, FilePromiseStore, PromiseStore
from swarm.runtime.inbox import Inbox
from swarm.runtime.loop_health import GENERATION_BEFORE
from swarm.runtime.process import tick_phase
from swarm.runtime.role_setup import RoleSetup
from vehicle_agent.service import AgentService


def run(setup: RoleSetup, built: Callable[[], None]) -> None:
    """Drives the vehicles of one agent until it is told to stop.

    built  called once the service is there
    """
    terrain = load_terrain(setup)
    load_classes(setup, terrain)
    truth = load_truth(setup, terrain)
    if setup.takes_over and setup.health is not None:
        setup.health.starts(GENERATION_BEFORE)
    store: PromiseStore = (
        PromiseStore(secrets.randbits(60))
        if setup.run_dir is None
        else FilePromiseStore(
            setup.run_dir / f"promises-{setup.id}", waits=setup.takes_over, network=setup.scenario.network
        )
    )
    inbox = Inbox()

    def make(boundary: Boundary, bus: Bus, stop: Callable[[], None]) -> AgentService:
        kept = boundary.external(store, PROMISE_STORE)
        service = AgentService(setup, terrain, truth, bus, inbox.post, kept)
        service.when_over = stop
        return service

    tick_hz = setup.scenario.vehicles.tick_hz
    run_role(setup, terrain.digest, built, make, inbox, tick_hz, tick_phase(setup.id))
