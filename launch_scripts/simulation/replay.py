"""Replay of a run's recordings: each recorded process is built again as this build makes it, fed with what it was
fed, and compared with what it did."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from launch_scripts.process_table import SIMULATED_ROLES
from launch_scripts.simulation.simulate import built
from shared_map.array_files import Floats
from shared_map.terrain.store import load_terrain, load_truth
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import load_classes
from swarm.config.scenario_files import parse_scenario
from swarm.errors import ConfigError, StoreError, SwarmError, TerrainError
from swarm.recording.record_inputs import versions
from swarm.recording.recording_file import FOLDER, SUFFIX, Head, RecordReader
from swarm.recording.replay_service import Outcome, Replaying, replay
from swarm.runtime.process import Service
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.codec import decode
from swarm.wire.messages.processes import Stats


def setup_of(head: Head, folder: Path) -> RoleSetup:
    """Returns the arguments of a recorded process. Raises ConfigError if this version cannot read its scenario, and
    ProtocolError if its recorded counters are not a valid `Stats` message."""
    given = msgspec.structs.asdict(head)
    del given["terrain"], given["versions"]
    given["scenario"] = parse_scenario(head.scenario)
    given["before"] = decode(head.before, Stats) if head.before else None
    return RoleSetup(**given, run_dir=folder)


class Recorded(NamedTuple):
    """One generation of a process, in a file.

    generation  which of its generations it is, from 1
    """

    path: Path
    generation: int
    head: Head

    @property
    def process(self) -> str:
        return f"{self.head.role}-{self.head.id}"


class Replayed(NamedTuple):
    """Result of replaying one recording.

    outcome  None if it could not be replayed, and `why` says why
    """

    recorded: Recorded
    outcome: Outcome | None
    why: str | None = None

    @property
    def same(self) -> bool:
        """True if it was replayed to its end without a difference."""
        return self.outcome is not None and self.outcome.difference is None and self.outcome.damaged is None


def recordings_of(folder: Path, process: str | None = None) -> tuple[list[Recorded], list[str]]:
    """The recordings in a run's folder, in the order of roles and ids, and a sentence for each file that is none
    from its first record on, as where a disk was full when the process began. Raises ConfigError if there is none,
    and StoreError if none of them can be read."""
    found: list[tuple[Head, Path]] = []
    refused: list[tuple[Path, str]] = []
    for path in sorted((folder / FOLDER).glob(f"*{SUFFIX}")):
        try:
            with RecordReader(path) as reader:
                found.append((reader.head, path))
        except StoreError as error:
            refused.append((path, str(error)))
    if refused and not found:
        raise StoreError(refused[0][1])
    if not found:
        raise ConfigError(
            f"{folder} holds no recorded inputs: `swarm up` and `swarm demo` record them with --record-inputs, "
            "`swarm simulate` always does"
        )

    def order(each: tuple[Head, Path]) -> tuple[int, int, str, int]:
        head = each[0]
        roles = (*SIMULATED_ROLES, head.role)  # one that this build does not know is last
        return roles.index(head.role), len(head.id), head.id, head.incarnation  # t2 before t10

    generations: Counter[tuple[str, str]] = Counter()
    recorded: list[Recorded] = []
    for head, path in sorted(found, key=order):
        generations[head.role, head.id] += 1
        recorded.append(Recorded(path=path, generation=generations[head.role, head.id], head=head))
    some = [each for each in recorded if process in (None, each.process)]
    if not some:
        there = ", ".join(dict.fromkeys(each.process for each in recorded))
        raise ConfigError(f"no process {process!r} is recorded in {folder}; there are {there}")
    return some, [why for path, why in refused if process is None or path.name.startswith(f"{process}.")]


def replay_run(folder: Path, process: str | None = None, until_s: float | None = None) -> Iterator[Replayed]:
    """Feeds the recordings of a run to the services of this build, each in turn. Raises as `recordings_of`."""
    grounds: dict[str, tuple[Terrain, Floats]] = {}
    for recorded in recordings_of(folder, process)[0]:
        outcome, why = None, None
        try:
            outcome = _outcome(recorded, folder, grounds, until_s)
        except SwarmError as error:
            why = str(error)
        yield Replayed(recorded, outcome, why)


def _outcome(
    recorded: Recorded, folder: Path, grounds: dict[str, tuple[Terrain, Floats]], until_s: float | None
) -> Outcome:
    """Feeds one recording to its service. Raises SwarmError if it cannot be replayed.

    grounds  scenario -> terrain and truth, of those that earlier recordings had; prepared files in the run's folder
             are used
    """
    head, setup = recorded.head, setup_of(recorded.head, folder)
    if head.scenario not in grounds:
        terrain = load_terrain(setup)
        load_classes(setup, terrain)
        grounds[head.scenario] = terrain, load_truth(setup, terrain)
    terrain, truth = grounds[head.scenario]
    if terrain.digest != head.terrain:
        raise TerrainError(
            f"{recorded.process} was recorded on terrain {head.terrain}, but its scenario makes terrain "
            f"{terrain.digest} here: terrain files or the rules of cost have changed"
        )

    def make(boundary: Replaying) -> Service:
        nobody: Any = boundary.nobody  # what the process sent itself is in the recording, too
        return built(setup, terrain, truth, boundary, nobody, nobody, lambda event: None)

    with RecordReader(recorded.path) as reader:
        return replay(reader, make, setup.scenario.network.namespace, until_s)


def other_versions(recorded: Recorded) -> dict[str, tuple[str, str]]:
    """Package -> (version that it was recorded with, version here), where they differ."""
    here = versions()
    both = {name: (version, here.get(name, "none")) for name, version in recorded.head.versions.items()}
    return {name: (then, now) for name, (then, now) in both.items() if then != now}
