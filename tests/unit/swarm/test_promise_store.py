"""The file of an agent's promises: records survive a kill, and no other process writes it."""

import errno
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from random import Random

import psutil
import pytest
from support.effort import few
from support.simulated import agents

from launch_scripts.simulation.sample_worlds import SMALL, seeded
from launch_scripts.simulation.simulate import Simulation
from swarm.config.revocations import revoke
from swarm.config.scenario import NetworkConfig, TlsConfig
from swarm.errors import StoreError
from swarm.journal import SEAL_BYTES
from swarm.right_of_way import promise_store
from swarm.right_of_way.agent_core import OwnRecord, RightOfWay
from swarm.right_of_way.promise_store import FilePromiseStore, PromiseStore
from swarm.wire.messages.traffic import Held, Table


def table(shard: int, seq: int) -> Table:
    return Table(shard=shard, agent="a0", epoch=3, seq=seq, hosts={}, grants={"a0-00": Held.of([(seq, 3, seq)])})


def saved_in(path: Path) -> tuple[OwnRecord, dict[int, tuple[int, Table]]]:
    """The content of the file, as the next generation finds it."""
    store = FilePromiseStore(path)
    store.close()
    return store.own, store.saved


def test_what_was_saved_is_there_again_and_a_second_process_is_refused_and_leaves_no_file_open(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run" / "promises-a0"
    store, before = FilePromiseStore(path), psutil.Process().num_fds()
    with pytest.raises(StoreError, match="runs here already"):
        FilePromiseStore(path)
    assert psutil.Process().num_fds() == before
    own = OwnRecord(disk=store.own.disk, generations=[7], noted={"a1": 5}, noted_by=["a1"])
    store.save_own(own)
    for seq in range(3):
        store.save(3, table(0, seq))
    store.save(8, table(4, 1))
    store.close()
    assert saved_in(path) == (own, {0: (3, table(0, 2)), 4: (8, table(4, 1))})


@pytest.mark.parametrize("gone", ["promises-a0.lock", "promises-a0.spare"])
def test_promises_go_on_and_stay_locked_though_a_file_beside_them_is_deleted(tmp_path: Path, gone: str) -> None:
    path = tmp_path / "run" / "promises-a0"
    store = FilePromiseStore(path)
    for seq in range(12_000):  # the file is full twice
        store.save(3, table(0, seq))
        if seq == 1000:
            (path.parent / gone).unlink()
            with pytest.raises(StoreError, match="is in use by the same agent"):
                FilePromiseStore(path)  # it makes another lock file
    store.sync()
    assert (path.parent / "promises-a0.lock").read_bytes() == path.read_bytes()[:SEAL_BYTES]
    with pytest.raises(StoreError, match="is in use by the same agent"):
        FilePromiseStore(path)
    store.close()
    assert saved_in(path) == (store.own, {0: (3, table(0, 11_999))})


def test_a_sync_covers_all_records_before_it_and_without_any_it_asks_nothing_of_the_disk(tmp_path, monkeypatch):
    syncs: list[int] = []
    store = FilePromiseStore(tmp_path / "promises-a0")
    monkeypatch.setattr(os, "fdatasync", syncs.append)
    for seq in range(20):
        store.save(3, table(seq % 4, seq))
    store.sync()
    store.sync()
    assert len(syncs) == 1
    store.close()


_PROMISES = """
import itertools, sys
from pathlib import Path
from swarm.wire.messages.traffic import Held, Table
from swarm.right_of_way.promise_store import FilePromiseStore
store = FilePromiseStore(Path(sys.argv[1]))
start = max((promised for promised, _ in store.saved.values()), default=0)
for promised in itertools.count(start + 1):
    for shard in range(3):
        grants = {f"a0-{n}": Held.of([(n, promised, n)]) for n in range(40)}
        store.save(promised, Table(shard=shard, agent="a0", epoch=promised, seq=1, hosts={}, grants=grants))
    store.sync()
    print(promised, flush=True)
"""


def test_promises_that_were_synced_survive_a_kill_at_any_instant(tmp_path: Path) -> None:
    chance, acknowledged = Random(3), 0
    for _ in range(few(12)):
        command = [sys.executable, "-c", _PROMISES, str(tmp_path / "promises-a0")]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as agent:
            for _ in range(chance.randrange(1, 60)):
                acknowledged = int(agent.stdout.readline())
            time.sleep(chance.uniform(0, 0.003))
            agent.kill()
            acknowledged = max([acknowledged, *map(int, agent.stdout.read().split())])
        _, saved = saved_in(tmp_path / "promises-a0")
        assert min(promised for promised, _ in saved.values()) >= acknowledged


def test_one_that_waits_goes_on_with_what_the_generation_before_has_left(tmp_path: Path) -> None:
    path = tmp_path / "promises-a0"
    first = FilePromiseStore(path)
    found: list[FilePromiseStore] = []
    waiting = threading.Thread(target=lambda: found.append(FilePromiseStore(path, waits=True)))
    waiting.start()
    waiting.join(0.2)
    assert found == []
    first.save(3, table(0, 1))
    first.close()
    waiting.join(30)
    assert [store.saved for store in found] == [{0: (3, table(0, 1))}]
    found[0].close()


@pytest.mark.parametrize(("shards", "grows"), [(3, False), (300, True)])
def test_a_file_that_is_full_is_written_again_and_grows_for_what_counts_only(tmp_path, monkeypatch, shards, grows):
    monkeypatch.setattr(promise_store, "_SIZE_BYTES", 3000)
    path = tmp_path / "promises-a0"
    store = FilePromiseStore(path)
    for seq in range(300):
        store.save(3, table(seq % shards, seq))
        assert grows or path.stat().st_size == 3000
        assert store.ready
    store.close()
    _, found = saved_in(path)
    assert {shard: saved.seq for shard, (_, saved) in found.items()} == {seq % shards: seq for seq in range(300)}


class Disk:
    """Overwrites what it has, and gives no more space while it is full."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.full = False
        self._pwrite = os.pwrite
        monkeypatch.setattr(os, "pwrite", self.pwrite)

    def pwrite(self, file: int, data: bytes, at: int) -> int:
        if self.full and at + len(data) > os.fstat(file).st_size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._pwrite(file, data, at)


def test_on_a_full_disk_promises_are_kept_until_the_space_is_used_up_and_again_when_there_is_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(promise_store, "_SIZE_BYTES", 2000)
    disk, path = Disk(monkeypatch), tmp_path / "promises-a0"
    store = FilePromiseStore(path)
    for seq in range(30):
        store.save(3, table(0, seq))
    disk.full = True
    seq = 30
    while store.ready:
        store.save(3, table(0, seq))
        seq += 1
    assert seq > 32
    assert store.reserve() == f"cannot write {path}.spare: No space left on device"
    store.save(3, table(0, seq))  # what one event still brings
    assert not path.with_name("promises-a0.spare").exists(), "nobody else's space is taken for nothing"
    store.close()
    again = FilePromiseStore(path)  # a generation that begins meanwhile
    assert again.saved[0][1].seq == seq
    assert not again.ready
    disk.full = False
    assert again.reserve() is None
    assert again.ready
    for later in range(seq, seq + 100):
        again.save(3, table(0, later))
    assert again.ready
    again.close()


def test_an_agent_knows_the_names_which_are_revoked_beside_its_certificate(tmp_path: Path) -> None:
    tls = TlsConfig(ca="ca.pem", certificate=str(tmp_path / "agent.all.a1.pem"), key="a1.key")
    store = FilePromiseStore(tmp_path / "promises-a1", network=NetworkConfig(tls=tls, revoked=("tracker.t",)))
    assert store.revoked() == ["tracker.t"]
    revoke(tmp_path, ["agent.all.a0"])
    assert store.revoked() == ["tracker.t", "agent.all.a0"]
    (tmp_path / "revoked").write_text("no name\n")
    assert store.revoked() == ["tracker.t", "agent.all.a0"]


def test_members_are_told_of_an_agent_whose_certificate_is_revoked_and_of_its_next_one(monkeypatch):
    names: list[str] = ["planner.t0"]
    told: list[str] = []
    monkeypatch.setattr(PromiseStore, "revoked", lambda self: list(names))
    monkeypatch.setattr(RightOfWay, "revoke", lambda self, agents, now_ns: told.extend(agents))
    simulation = Simulation(seeded(1, SMALL))
    group = simulation.scenario.groups[0].name
    for looks, new in enumerate((f"agent.{group}.a0", f"agent.{group}.a0~2", "monitor.0")):
        simulation.run_until(4.0 * (looks + 1))
        assert told == ["a0"] * looks * len(agents(simulation))
        names.append(new)
