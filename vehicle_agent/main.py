"""The agent process."""

from __future__ import annotations

import secrets
from collections.abc import Callable

from shared_map.class_grounds import load_classes
from shared_map.terrain.store import load_terrain, load_truth
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.recording.recording import recorded
from swarm.runtime.health import LIFE_BEFORE
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process, end_with, tick_phase
from swarm.runtime.role import RoleSetup
from swarm.runtime.run_secret import authenticator_of
from vehicle_agent.promise_store import PROMISE_STORE, FilePromiseStore, PromiseStore
from vehicle_agent.service import AgentService


def run(setup: RoleSetup, stop_when: Callable[[], None] | None) -> None:
    """Drive the vehicles of one agent until it is told to stop.

    stop_when  blocks until the process has to end; None to run until a signal comes
    """
    terrain = load_terrain(setup)
    load_classes(setup, terrain)
    truth = load_truth(setup, terrain)
    if setup.takes_over and setup.health is not None:
        setup.health.starts(LIFE_BEFORE)
    store: PromiseStore = (
        PromiseStore(secrets.randbits(60))
        if setup.run_dir is None
        else FilePromiseStore(setup.run_dir / f"promises-{setup.id}", waits=setup.takes_over)
    )
    network = setup.scenario.network
    with (
        open_bus(network, patient=True, authenticator=authenticator_of(network, setup.run_id)) as bus,
        recorded(setup, terrain.digest) as boundary,
    ):
        inbox = Inbox()
        kept = boundary.external(store, PROMISE_STORE)
        service = AgentService(setup, terrain, truth, boundary.bus(bus), inbox.post, kept)
        tick_hz = setup.scenario.vehicles.tick_hz
        process = Process(
            boundary.service(service), inbox, MonotonicClock(), tick_hz, tick_phase(setup.id), setup.health
        )
        service.when_over = process.stop
        process.stop_on_signals()
        if stop_when is not None:
            end_with(stop_when, process.stop)
        process.run()
