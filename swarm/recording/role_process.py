"""The process of a recorded role, from its bus to its end."""

from __future__ import annotations

from collections.abc import Callable

from swarm.bus.bus import Bus
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.recording.record_inputs import recorded
from swarm.recording.service_boundary import Boundary
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process, Service
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.run_secret import authenticator_of

Make = Callable[[Boundary, Bus, Callable[[], None]], Service]
"""Makes a service, given its boundary, its bus, which is behind that, and what ends the process."""


def run_role(
    setup: RoleSetup,
    terrain: str,
    built: Callable[[], None],
    make: Make,
    inbox: Inbox,
    tick_hz: float,
    phase: float | None = None,
) -> None:
    """Runs a role's service until SIGTERM or SIGINT.

    terrain  digest (hash) of the terrain on which the role runs
    built    called once the service is there
    phase    as of `Process`
    """
    network = setup.scenario.network
    with (
        open_bus(network, patient=True, authenticator=authenticator_of(network, setup.run_id)) as bus,
        recorded(setup, terrain) as boundary,
    ):
        service = make(boundary, boundary.bus(bus), lambda: process.stop())
        process = Process(
            boundary.service(service), inbox, MonotonicClock(), tick_hz, phase, setup.health, bus.gather
        )
        process.stop_on_signals()
        built()
        process.run()
