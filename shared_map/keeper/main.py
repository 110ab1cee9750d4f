"""The keeper process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from shared_map.keeper.mark_store import KEEPER_STORE, KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.terrain.store import load_terrain
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.recording.recording import recorded
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process, end_with
from swarm.runtime.role import RoleSetup
from swarm.runtime.run_secret import authenticator_of

TICK_HZ = 10.0


def run(
    setup: RoleSetup,
    stop_when: Callable[[], None] | None,
    store_path: Path | None = None,
    rebuild: bool = False,
) -> None:
    """Keep the map until told to stop.

    store_path  the SQLite file; if not given, `map.sqlite` in the run's folder (`map-ID.sqlite` of a keeper whose
                id is not 0), or memory where there is none
    rebuild     a damaged store is moved aside and filled anew from the swarm
    """
    terrain = load_terrain(setup)
    if store_path is None and setup.run_dir is not None:
        store_path = setup.run_dir / ("map.sqlite" if setup.id == "0" else f"map-{setup.id}.sqlite")
    network = setup.scenario.network
    with (
        KeeperStore(store_path or ":memory:", rebuild=rebuild) as store,
        open_bus(network, patient=True, authenticator=authenticator_of(network, setup.run_id)) as bus,
        recorded(setup, terrain.digest) as boundary,
    ):
        inbox = Inbox()
        kept = boundary.external(store, KEEPER_STORE)
        service = KeeperService(setup, terrain, boundary.bus(bus), inbox.post, kept)
        process = Process(boundary.service(service), inbox, MonotonicClock(), TICK_HZ, health=setup.health)
        process.stop_on_signals()
        if stop_when is not None:
            end_with(stop_when, process.stop)
        process.run()
