"""Files of stores that a disk or a program has changed: each is read as it was written, or refused in a sentence.

With more files: `pytest tests/laws/test_rotten_files.py --thorough`."""

import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, TypeVar

import pytest
from msgspec.structs import replace
from support.effort import few
from support.map_strategies import set_of

from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.store import load_homes, load_terrain, load_truth, prepare
from shared_map.vehicle_class_grounds import class_grounds, load_classes, prepare_classes
from swarm.config.scenario_files import parse_scenario
from swarm.errors import DamagedError, SwarmError
from swarm.grid import GridSpec
from swarm.right_of_way.agent_core import OwnRecord
from swarm.right_of_way.generations import GenerationFile
from swarm.right_of_way.promise_store import FilePromiseStore
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.orders import Order
from swarm.wire.messages.traffic import Held, Table

COMMITS = 12
Files = dict[str, bytes]
"""Name -> content, of a store and what lies beside it."""
Parts = tuple[object, ...]
"""The content of a store, in parts each of which one record or commit brings."""
T = TypeVar("T")


@dataclass(frozen=True)
class Kind:
    """A store.

    open     of a path
    save     saves the content of one number
    content  what it holds
    leave    leaves it as a kill would
    beside   endings of the files that belong to it
    """

    open: Callable[[Path], Any]
    save: Callable[[Any, int], object]
    content: Callable[[Any], Parts]
    leave: Callable[[Any], object]
    beside: tuple[str, ...] = (".lock",)

    def read(self, path: Path) -> Parts:
        with closing(self.open(path)) as store:
            return self.content(store)


def save_marks(store: KeeperStore, number: int) -> None:
    store.bind("0123456789abcdef", GridSpec(320, 320, 30.0))
    marks: dict[int, tuple[int, float, int]] = {
        cell: (MarkKind.PACE, 0.5, 100 + cell + number) for cell in range(40)
    }
    store.save([set_of(f"a{author}.1", tile, number + 1, marks) for author in range(3) for tile in range(8)])
    store.save_orders([Order(subject="vehicle", name=f"a1-0{number % 5}", stamp_ns=number + 1)])


def marks_of(store: KeeperStore) -> Parts:
    return list(store.load()), store.orders(), store.terrain, store.grid, store.tiles_set_aside()


def save_promises(store: FilePromiseStore, number: int) -> None:
    grants = {f"a1-{k:02d}": Held.of([(1000 * number + k, number, k)]) for k in range(8)}
    for seq in range(3):
        store.save(number, Table(shard=seq, agent="a1", epoch=number, seq=seq, hosts={"a1": (7, 1)}, grants=grants))
    store.sync()


def promises_of(store: FilePromiseStore) -> Parts:
    return (store.own, *map(store.saved.get, range(3)))


def save_generations(store: GenerationFile, number: int) -> None:
    store.save([*store.generations, number + 1])


MARKS_IN_USE = Kind(KeeperStore, save_marks, marks_of, KeeperStore._unlock, (".lock", "-wal"))
"""The log is not put into the file."""
KINDS = {
    "marks": Kind(KeeperStore, save_marks, marks_of, KeeperStore.close),
    "marks with their log": MARKS_IN_USE,
    "promises": Kind(FilePromiseStore, save_promises, promises_of, FilePromiseStore.close),
    "lives": Kind(GenerationFile, save_generations, lambda store: (store.generations,), GenerationFile.close),
}


class Running:
    """A process with its store."""

    def __init__(self, kind: Kind, path: Path, number: int = 0) -> None:
        self.kind, self.path, self.number, self.store = kind, path, number, kind.open(path)

    def commit(self) -> None:
        self.kind.save(self.store, self.number)
        self.number += 1

    def look(self) -> None:
        """Looks after the store, as it does each second while nothing is to be saved."""
        if isinstance(self.store, FilePromiseStore):
            assert self.store.reserve() is None
        else:
            self.store.check()

    def killed(self, read: Callable[[], T]) -> T:
        """Kills it. Returns the result of a reading after that."""
        self.kind.leave(self.store)
        found = read()
        if self.kind is MARKS_IN_USE:
            self.store.close()
        return found


def versions_of(kind: Kind, folder: Path) -> list[tuple[Files, Parts]]:
    """The files after each commit, and their content."""
    path = folder / "made" / "store"
    path.parent.mkdir(parents=True)

    def files() -> Files:
        return {f"store{end}": path.with_name(f"store{end}").read_bytes() for end in ("", *kind.beside)}

    found = []
    for number in range(COMMITS):
        process = Running(kind, path, number)
        process.commit()
        left = process.killed(files)
        found.append((left, opened(kind, folder, left)))
    return found


def opened(kind: Kind, folder: Path, files: Files) -> Parts:
    spot = folder / "tried"
    shutil.rmtree(spot, ignore_errors=True)
    spot.mkdir()
    for name, content in files.items():
        (spot / name).write_bytes(content)
    return kind.read(spot / "store")


def rotten(chance: Random, content: bytes, what: str) -> bytes:
    """The content of a file after one fault."""
    used = len(content.rstrip(b"\0")) + 4
    bad = bytearray(content)
    size = chance.choice((512, 4096))
    at = min(chance.randrange(used), len(content) - 1)
    other = chance.randrange(used)
    if chance.random() < 0.5:  # most disks rot in whole sectors
        at, other = at // size * size, other // size * size
    match what:
        case "flip":
            bad[at] ^= 1 << chance.randrange(8)
        case "zeros":
            bad[at : at + size] = bytes(len(bad[at : at + size]))
        case "cut":
            del bad[at:]
        case "swapped":
            here, there = content[at : at + size], content[other : other + size]
            if len(here) == len(there) and abs(at - other) >= size:
                bad[at : at + size], bad[other : other + size] = there, here
        case "repeated":
            bad[at : at + size] = content[other : other + size][: len(bad) - at]
    return bytes(bad)


def outcome(read: Callable[[], object], truth: object, sentence: str) -> str:
    """Outcome of reading files that may be damaged.

    sentence  a pattern of the refusal, which names the file
    """
    try:
        return "as it was" if read() == truth else "UNNOTICED"
    except SwarmError as error:
        return "refused" if re.search(sentence, str(error)) else f"WITHOUT THE FILE: {error}"


def tally(kind: Kind, folder: Path, count: int) -> Counter[str]:
    """Fault and outcome -> number of files."""
    versions = versions_of(kind, folder)
    chance = Random(9)
    found: Counter[str] = Counter()
    for _ in range(count):
        at = chance.randrange(COMMITS // 2, COMMITS)
        files, truth = versions[at]
        what = chance.choice(("flip", "flip", "zeros", "cut", "swapped", "repeated", "older", "alone"))
        if what == "older":
            bad = {**versions[chance.randrange(at)][0], "store.lock": files["store.lock"]}
        else:
            name = chance.choice([each for each in files if what != "alone" or each == "store"])
            fault = chance.choice(("flip", "zeros", "cut")) if what == "alone" else what
            bad = {**files, name: rotten(chance, files[name], fault)}
            if what == "alone":
                bad = {"store": bad["store"]} if "store-wal" not in bad else bad
        found[f"{what}: {outcome(partial(opened, kind, folder, bad), truth, 'store')}"] += 1
    return found


@pytest.mark.parametrize("name", KINDS)
def test_no_change_of_a_file_goes_unnoticed(tmp_path: Path, name: str) -> None:
    found = tally(KINDS[name], tmp_path, few(500))
    assert not [each for each in found if not each.endswith((": refused", ": as it was"))], found
    assert {"flip: refused", "zeros: refused", "cut: refused", "older: refused"} <= found.keys()
    assert "older: as it was" not in found


@pytest.mark.parametrize("name", ["marks with their log", "promises"])
def test_a_commit_that_a_kill_cut_short_is_there_record_by_record_or_not(tmp_path: Path, name: str) -> None:
    """The file is cut anywhere in what the last commit wrote, and nothing says yet that there is more."""
    kind, chance = KINDS[name], Random(5)
    versions = versions_of(kind, tmp_path)
    written = "store-wal" if "store-wal" in versions[0][0] else "store"
    for _ in range(few(100)):
        at = chance.randrange(1, COMMITS)
        (before, old), (after, new) = versions[at - 1 : at + 1]
        whole = after[written]
        if written == "store":
            seal = before["store"][:200]  # written last
            whole = seal + whole[200:]
            start = len(before["store"].rstrip(b"\0"))
            cut = chance.randrange(start, len(whole.rstrip(b"\0")) + 1)
            torn = whole[:cut] + bytes(len(whole) - cut)
        else:
            torn = whole[: chance.randrange(len(whole))]
        found = opened(kind, tmp_path, {**after, written: torn, "store.lock": before["store.lock"]})
        assert all(part in each for part, *each in zip(found, old, new, strict=True))


HARMS: dict[str, Callable[[Path, bytes], object]] = {
    "deleted": lambda path, old: path.unlink(),
    "moved away": lambda path, old: path.rename(path.with_name("elsewhere")),
    "folder deleted": lambda path, old: shutil.rmtree(path.parent),
    "replaced": lambda path, old: (path.with_name("new").write_bytes(old), path.with_name("new").replace(path)),
    "truncated": lambda path, old: os.truncate(path, len(old) // 2),
    "emptied": lambda path, old: os.truncate(path, 0),
    "written over": lambda path, old: path.write_bytes(old),
}
"""Deeds of another program to a file in use. It has a copy of it as it was a commit before."""


@pytest.mark.parametrize("idle", [False, True], ids=["at a commit", "at rest"])
@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize("name", ["marks", "promises", "lives", "log of marks"])
def test_a_file_harmed_in_use_is_written_again_or_ends_its_process(
    tmp_path: Path, name: str, harm: str, idle: bool
) -> None:
    name, tail = ("marks", "-wal") if name == "log of marks" else (name, "")
    kind = MARKS_IN_USE if name == "marks" else KINDS[name]
    whole, tried = (Running(kind, tmp_path / f"{each} 5%s %" / "store") for each in ("whole", "tried"))
    for each in (whole, tried):
        for _ in range(3):
            each.commit()
    file = Path(f"{tried.path}{tail}")
    old = file.read_bytes()
    for each in (whole, tried):
        each.commit()
    time.sleep(0.02)  # the clock of file systems ticks a hundred times a second
    HARMS[harm](file, old)
    changed = harm in ("truncated", "emptied", "written over")
    if harm == "replaced" or (changed and name == "marks"):
        with pytest.raises(
            DamagedError, match=re.escape(f"{file} was {'changed' if changed else harm} by another")
        ):
            tried.look() if idle else tried.commit()
        return
    tried.look() if idle else tried.commit()
    if not idle:
        whole.commit()
    tried.look()
    truth, found = (each.killed(partial(kind.read, each.path)) for each in (whole, tried))
    assert comparable(found) == comparable(truth)


def comparable(parts: Parts) -> Parts:
    """Without the number of a file, which is chance."""
    return tuple(replace(part, disk=0) if isinstance(part, OwnRecord) else part for part in parts)


PREPARED = parse_scenario("""
seed = 5
terrain = { source = "synthetic", rows = 24, cols = 32, relief_m = 200.0, hidden = { rubble_fields = 3 } }
cost = { directional = true, vehicle_radius_m = 9.0 }
groups = [{ vehicles = 1 }, { name = "walkers", class = "walker", vehicles = 1 }]
[[classes]]
name = "walker"
max_speed_m_per_s = 1.5
cost = { max_slope_deg = 40.0 }
""")


def read_prepared(folder: Path) -> list[object]:
    """All that a process takes from the terrain in a run's folder."""
    setup = RoleSetup(PREPARED, "run", "agent", "a0", 1, 1, run_dir=folder)
    terrain = load_terrain(setup)
    truth = load_truth(setup, terrain)
    load_classes(setup, terrain)
    grounds = class_grounds(PREPARED, terrain, truth, load_homes(setup, terrain, truth)).values()
    ours = [each.terrain for each in grounds]
    parts = [(each.digest, each.grid, each.notes, each.climb and each.climb.steepest) for each in ours]
    arrays = [array for each in grounds for array in (each.truth, each.homes)]
    arrays += [array for each in ours for array in (each.pace_s_per_m, each.ground_s_per_m, each.elevation_m)]
    arrays += [array for each in ours for array in (each.photo, each.classes)]
    arrays += [each.climb.factors for each in ours if each.climb]
    return [*parts, *(array.tobytes() for array in arrays)]


def test_no_change_of_a_prepared_terrain_goes_unnoticed(tmp_path: Path) -> None:
    whole, tried, chance = tmp_path / "whole", tmp_path / "tried", Random(7)
    prepare_classes(whole, PREPARED, *prepare(whole, PREPARED))
    truth, files = read_prepared(whole), sorted(each for each in whole.rglob("*") if each.is_file())
    found: Counter[str] = Counter()
    for _ in range(few(200)):
        shutil.rmtree(tried, ignore_errors=True)
        shutil.copytree(whole, tried)
        file, what = chance.choice(files), chance.choice(("flip", "flip", "zeros", "cut", "swapped", "repeated"))
        (tried / file.relative_to(whole)).write_bytes(rotten(chance, file.read_bytes(), what))
        sentence = f"{re.escape(str(tried))}.*; delete the folder$"
        found[f"{what}: {outcome(partial(read_prepared, tried), truth, sentence)}"] += 1
    assert not [each for each in found if not each.endswith((": refused", ": as it was"))], found
    assert {"flip: refused", "zeros: refused", "cut: refused"} <= found.keys()
