"""The keeper process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from shared_map.keeper.mark_store import KEEPER_STORE, KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.keeper.zone_orders import ZONE_MODULES
from shared_map.terrain.store import load_terrain
from swarm.bus.bus import Bus
from swarm.recording.record_inputs import run_role
from swarm.recording.service_boundary import Boundary
from swarm.runtime.inbox import Inbox
from swarm.runtime.loop_health import Modules
from swarm.runtime.role_setup import RoleSetup

TICK_HZ = 10.0
"""Marks wait a tenth of a second for the disk at most, and one commit takes in what came meanwhile."""


def run(setup: RoleSetup, built: Callable[[], None], store_path: Path | None = None, rebuild: bool = False) -> None:
    """Keeps the map until told to stop.

    store_path  the SQLite file; if not given, `map.sqlite` in the run's folder (`map-ID.sqlite` of a keeper whose
                id is not 0), or memory where there is none
    rebuild     a damaged store is moved aside, and a new one is filled from the swarm
    """
    terrain = load_terrain(setup)
    if store_path is None and setup.run_dir is not None:
        store_path = setup.run_dir / ("map.sqlite" if setup.id == "0" else f"map-{setup.id}.sqlite")
    with KeeperStore(store_path or ":memory:", rebuild=rebuild) as store:
        inbox = Inbox()

        def make(boundary: Boundary, bus: Bus, stop: Callable[[], None]) -> KeeperService:
            modules = boundary.function("modules of zones", Modules(ZONE_MODULES).there, bool)
            return KeeperService(setup, terrain, bus, inbox.post, boundary.external(store, KEEPER_STORE), modules)

        run_role(setup, terrain.digest, built, make, inbox, TICK_HZ)
