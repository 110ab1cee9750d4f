"""kill -9 of a keeper process at random instants under load, over real zenoh: what its digests acknowledged is in
its file. By hand, more often: `python tests/live/test_keeper_kill.py 200`."""

import json
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from support.far_processes import on_free_port
from support.made_up_swarm import some_set

from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.pace_measurements import ONE, Measurement, columns_of
from shared_map.replication.mark_sets import Statements, mark_set
from shared_map.replication.tiles import beyond_region, beyond_tile
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import Event, Heard
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import MapConfig, NetworkConfig, Scenario
from swarm.grid import GridSpec
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.map_data import DIGEST_ROW, SEQ_STEP, Digest
from swarm.wire.topics import DIGEST, MARKS

SIDE = 256
TILES = 64
PER_TILE = 20
GRID = GridSpec(SIDE, SIDE, 10.0)
LEARNED = beyond_tile(GRID)


def keeper_process(network: NetworkConfig, path: Path) -> None:
    scenario = Scenario(network=network, map=MapConfig(digest_s=0.05, learning=True))
    setup = RoleSetup(scenario, "run", "keeper", "k", time.time_ns(), 0)
    terrain = terrain_of_pace(np.ones((SIDE, SIDE), np.float32), GRID.resolution_m)
    with KeeperStore(path) as store, open_bus(network) as bus:
        inbox = Inbox()
        service = KeeperService(setup, terrain, bus, inbox.post, store)
        Process(service, inbox, MonotonicClock(), tick_hz=50, gather=bus.gather).run()


class Load:
    """An author that puts sets as fast as it can and notes what the keeper acknowledged."""

    def __init__(self, bus: ZenohBus) -> None:
        self.acknowledged: dict[int, int] = {}
        self.put = 0
        self._bus = bus
        bus.subscribe(DIGEST, self._hear)

    def _hear(self, event: Event) -> None:
        if isinstance(event, Heard) and isinstance(event.message, Digest):
            for rows in event.message.held.values():
                for tile, _, seq in np.frombuffer(rows, DIGEST_ROW).tolist():
                    self.acknowledged[tile] = max(seq, self.acknowledged.get(tile, 0))

    def run(self, until_s: float) -> None:
        while time.monotonic() < until_s:
            for tile in range(TILES):
                self.put += 1
                each = some_set(tile, self.put * SEQ_STEP, PER_TILE, author="load.1")
                self._bus.publish(MARKS, each, region=0, tile=tile, author="load.1")
            self._learn()
            time.sleep(0.002)

    def _learn(self) -> None:
        """Publishes measurements of two kinds of ground: sets of marks like all others, but about no cell."""
        self.put += 1
        said = {0: Measurement(self.put, ONE, ONE // 10), 7: Measurement(5, -ONE, 0)}
        word = mark_set("load.1", "all", LEARNED, 1, self.put * SEQ_STEP, Statements(*columns_of(said, self.put)))
        self._bus.publish(MARKS, word, region=beyond_region(GRID), tile=LEARNED, author="load.1")


def kill_rounds(rounds: int, folder: Path, seed: int = 1) -> dict[str, int]:
    """Kills a keeper so often; returns how much was put, acknowledged and lost."""
    chance = random.Random(seed)
    network = on_free_port()
    spawning = multiprocessing.get_context("forkserver")
    spawning.set_forkserver_preload([__name__ if __name__ != "__main__" else "test_keeper_kill"])
    path = folder / "map.sqlite"
    found = {"rounds": rounds, "sets_put": 0, "acknowledgements": 0, "words_acknowledged": 0, "lost": 0}
    with open_bus(network, mode="router"), open_bus(network) as bus:
        load = Load(bus)
        for _ in range(rounds):
            before = dict(load.acknowledged)
            child = spawning.Process(target=keeper_process, args=(network, path))
            child.start()
            deadline = time.monotonic() + 30
            while load.acknowledged == before:
                load.run(time.monotonic() + 0.02)
                assert child.is_alive(), f"the keeper ended by itself: {child.exitcode}"
                assert time.monotonic() < deadline, "the keeper acknowledges nothing"
            load.run(time.monotonic() + chance.random() * 0.3)
            assert child.pid is not None
            os.kill(child.pid, signal.SIGKILL)
            child.join()
            time.sleep(0.05)  # for digests under way: what they acknowledge counts as well
            acknowledged = dict(load.acknowledged)
            with KeeperStore(path) as store:
                on_disk = {each.tile: each.seq for each in store.load()}
            found["acknowledgements"] += sum(acknowledged[t] != before.get(t) for t in acknowledged)
            found["words_acknowledged"] += acknowledged.get(LEARNED) != before.get(LEARNED)
            found["lost"] += sum(on_disk.get(tile, -1) < seq for tile, seq in acknowledged.items())
        found["sets_put"] = load.put
    return found


@pytest.mark.network
def test_what_was_acknowledged_survives_kill_9_of_the_keeper_at_any_instant(tmp_path: Path) -> None:
    found = kill_rounds(4, tmp_path)
    assert found["lost"] == 0
    assert found["acknowledgements"] >= 4 * TILES // 2
    assert found["words_acknowledged"] >= 2


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        sys.stdout.write(json.dumps(kill_rounds(int(sys.argv[1]), Path(name))) + "\n")
