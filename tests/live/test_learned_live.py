"""`swarm marks factors` asks a swarm that runs, over real zenoh."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from support.processes import eventually
from typer.testing import CliRunner

from launch_scripts.commands.map_commands import app
from launch_scripts.ports import free_ports
from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.learning.measurements import ONE, Measurement
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import beyond_region, beyond_tile
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import MapConfig, NetworkConfig, Scenario
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process
from swarm.runtime.role import RoleSetup
from swarm.wire.topics import MARKS


@pytest.mark.network
def test_a_running_swarm_says_what_was_learned(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    network = NetworkConfig(listen=(endpoint,), connect=(endpoint,))
    terrain = terrain_of_pace(np.ones((40, 50), np.float32))
    scenario = Scenario(network=network, map=MapConfig(learning=True))
    setup = RoleSetup(scenario, "run", "keeper", "k", time.time_ns(), 0)
    (word,) = MapReplica(terrain.grid, author="all.a1.1").write_learned(
        {0: Measurement(400, ONE, ONE // 10)}, time.time_ns()
    )
    processes: list[Process] = []

    def keep() -> None:
        with KeeperStore(tmp_path / "map.sqlite") as store, open_bus(network) as bus:
            inbox = Inbox()
            service = KeeperService(setup, terrain, bus, inbox.post, store)
            processes.append(Process(service, inbox, MonotonicClock(), tick_hz=50, gather=bus.gather))
            processes[0].run()

    with open_bus(network, mode="router"), open_bus(network) as bus:
        keeper = threading.Thread(target=keep)
        keeper.start()
        try:
            tile = beyond_tile(terrain.grid)

            def told() -> list[dict[str, object]]:
                region = beyond_region(terrain.grid)
                bus.publish(MARKS, word, region=region, tile=tile, author="all.a1.1")
                result = CliRunner().invoke(app, ["factors", "--connect", endpoint, "--json"])
                return json.loads(result.stdout)["kinds"] if result.exit_code == 0 else []

            eventually(told, 30, "the keeper")
            (row,) = told()
            assert (row["kind"], row["cells"], row["authors"]) == ("unknown 0-5", 400, 1)
        finally:
            for process in processes:
                process.stop()
            keeper.join()
