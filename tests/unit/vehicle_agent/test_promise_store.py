"""The file of an agent's promises: what was written is there after a kill, and nobody else writes it."""

from __future__ import annotations

from pathlib import Path

import pytest

from swarm.errors import StoreError
from swarm.wire.messages.traffic import Grant, Table
from vehicle_agent import promise_store
from vehicle_agent.promise_store import FilePromiseStore
from vehicle_agent.traffic.right_of_way import OwnRecord


def table(plot: int, seq: int) -> Table:
    return Table(plot=plot, agent="a0", epoch=3, seq=seq, hosts={}, grants={"a0-00": Grant([seq], (3, seq))})


def test_what_was_saved_is_there_again(tmp_path: Path) -> None:
    store = FilePromiseStore(tmp_path / "run" / "promises-a0")
    disk = store.own.disk
    own = OwnRecord(disk=disk, lives=[7], noted={"a1": 5}, noted_by=["a1"])
    store.save_own(own)
    for seq in range(3):
        store.save(3, table(0, seq))
    store.save(8, table(4, 1))
    store.close()
    again = FilePromiseStore(tmp_path / "run" / "promises-a0")
    assert again.own == own
    assert again.saved == {0: (3, table(0, 2)), 4: (8, table(4, 1))}
    again.close()


def test_a_record_that_a_kill_cut_short_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "promises-a0"
    store = FilePromiseStore(path)
    store.save(3, table(0, 1))
    store.save(3, table(0, 2))
    store.close()
    path.write_bytes(path.read_bytes()[:-3])
    again = FilePromiseStore(path)
    assert again.saved == {0: (3, table(0, 1))}
    again.close()


def test_a_second_process_on_the_same_file_is_refused(tmp_path: Path) -> None:
    store = FilePromiseStore(tmp_path / "promises-a0")
    with pytest.raises(StoreError, match="runs here already"):
        FilePromiseStore(tmp_path / "promises-a0")
    store.close()


def test_a_file_that_is_none_of_ours_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "promises-a0"
    path.write_bytes((5).to_bytes(4, "little") + b"hello")
    with pytest.raises(StoreError, match="damaged at byte 0"):
        FilePromiseStore(path)


def test_a_file_that_has_grown_is_written_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(promise_store, "_LARGEST_BYTES", 2000)
    path = tmp_path / "promises-a0"
    store = FilePromiseStore(path)
    for seq in range(200):
        store.save(3, table(seq % 3, seq))
        assert path.stat().st_size < 2200
    store.close()
    again = FilePromiseStore(path)
    assert {plot: saved.seq for plot, (_, saved) in again.saved.items()} == {0: 198, 1: 199, 2: 197}
    again.close()
