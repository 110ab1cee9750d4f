"""The version before this one and this one in one run, as real processes, machine by machine.

The longest time of a vehicle without a route while three machines go from the version before to this one:
`PYTHONPATH=.:tests python tests/live/test_two_versions.py`, and with `--stop-first` without taking over."""

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
from support.live_swarm import SWARM, client, write_scenario
from support.neighbour import ROOT, environment_of, neighbour_tree
from support.processes import Child, eventually

from launch_scripts.stop_requests import SAME_S
from swarm.bus.bus import Event, Heard
from swarm.bus.zenoh_bus import ZenohBus
from swarm.config.scenario import NetworkConfig
from swarm.config.scenario_files import load_scenario
from swarm.endpoints import listening
from swarm.wire.messages.processes import Stats
from swarm.wire.messages.vehicles import Fleet, VehicleState
from swarm.wire.topics import FLEET, STATS

pytestmark = [pytest.mark.network, pytest.mark.slow]

VEHICLES = 12
ROUTED = (VehicleState.FOLLOWING, VehicleState.ARRIVED)
STANDBYS = "\n[standbys]\nplanner = 1\ntargets = 1\n"


@dataclass(frozen=True)
class Part:
    """The processes that run on a machine. `rank` is that of planners and the targets process; None: all ranks."""

    roles: tuple[str, ...]
    rank: int | None = None


TWO = {"base": Part(("router", "keeper", "targets", "agent")), "planners": Part(("planner",))}
"""No kernel is compiled for the first, should its version have others."""
THREE = {
    "base": Part(("router", "keeper")),
    "planners": Part(("planner", "targets"), 0),
    "field": Part(("agent", "planner", "targets"), 1),
}
"""A placement like that of a deployment plan: planners and their standbys apart. The scenario needs `STANDBYS`."""


class Machine:
    """A launcher with a folder of its own, which may be started again with another version."""

    def __init__(self, part: Part, folder: Path, scenario: Path) -> None:
        self._part = part
        self.folder = folder
        self.folder.mkdir()
        self._scenario = scenario
        self._endpoint = load_scenario(scenario).network.connect[0]
        self.started: list[Child] = []

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The launcher that was started last."""
        return self.started[-1].process

    def start(self, tree: Path, *more: str) -> None:
        """Starts its part of the swarm with the version in `tree`."""
        options = [option for role in self._part.roles for option in ("--only", role)]
        if "router" not in self._part.roles:
            options += ["--connect", self._endpoint]
        if self._part.rank is not None:
            options += ["--rank", str(self._part.rank)]
        words = ("up", self._scenario, *options, "--runs", self.folder / "runs", "--plain", *more)
        output = self.folder / f"output-{len(self.started)}.txt"
        self.started.append(Child(output, *SWARM, *words, cwd=tree, env=environment_of(tree)))

    def stop(self) -> int:
        """Ends it in order. Returns its exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)

    def said(self) -> str:
        """All output of its launchers."""
        return "\n".join(child.text for child in self.started)

    @property
    def lives(self) -> bool:
        """Asserts that its launcher still runs; shows its output if not."""
        assert self.process.poll() is None, self.said()
        return True

    def up(self) -> bool:
        """True if the launcher that was started last reports that all is up."""
        return self.lives and "all processes are alive" in self.started[-1].text

    def ask_to_end(self) -> None:
        """For the end of a test: asked twice, it writes no report."""
        for child in self.started:
            child.process.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Waits for the end of the stopped processes, and kills those which do not end."""
        for child in self.started:
            with suppress(subprocess.TimeoutExpired):
                child.process.wait(20)
            child.kill()


class Routed:
    """Hears where vehicles are, and notes for each when it was on a route last and the longest time that it was
    not heard to be."""

    def __init__(self, bus: ZenohBus) -> None:
        self._last_s: dict[str, float] = {}
        self._longest_s: dict[str, float] = {}
        bus.subscribe(FLEET, self._hear)

    def _hear(self, event: Event) -> None:
        assert isinstance(event, Heard)
        assert isinstance(event.message, Fleet)
        now_s = time.monotonic()
        for id, state in zip(event.message.ids, event.message.states, strict=True):
            if state in ROUTED:
                gap_s = now_s - self._last_s.get(id, now_s)
                self._last_s[id] = now_s
                self._longest_s[id] = max(gap_s, self._longest_s.get(id, 0.0))

    def begin(self) -> None:
        """Forgets the longest time."""
        self._longest_s = {}

    def longest_s(self) -> float:
        """The longest time that any vehicle was not heard to be on a route, since `begin`."""
        now_s = time.monotonic()
        ended = dict(self._longest_s)
        return max(max(ended.get(id, 0.0), now_s - last_s) for id, last_s in dict(self._last_s).items())

    def all_since(self, began_s: float) -> bool:
        """True if all vehicles were reported on a route after that time, by the monotonic clock."""
        return sum(last_s > began_s for last_s in dict(self._last_s).values()) == VEHICLES

    def again(self, within_s: float) -> float:
        """Waits until all are on a route from now on. Returns how long that took, s."""
        began_s = time.monotonic()
        eventually(lambda: self.all_since(began_s), within_s, "routes for all vehicles")
        return time.monotonic() - began_s


@contextmanager
def machines_of(
    parts: Mapping[str, Part], trees: Mapping[str, Path], folder: Path
) -> Iterator[tuple[dict[str, Machine], Routed, NetworkConfig]]:
    """Machines, each with the version in its tree, whose vehicles are all on routes."""
    path = write_scenario(folder, STANDBYS if parts is THREE else "")
    network = load_scenario(path).network
    machines = {name: Machine(part, folder / name, path) for name, part in parts.items()}
    first, *others = machines
    try:
        machines[first].start(trees[first])
        eventually(lambda: machines[first].lives and listening(network.connect[0]), 120, "the router")
        with client(network) as bus:
            routed = Routed(bus)
            for name in others:
                machines[name].start(trees[name])
            routed.again(180)
            yield machines, routed, network
    finally:
        for _ in range(2):
            for machine in machines.values():
                machine.ask_to_end()
            time.sleep(2 * SAME_S)  # signals that come together are one
        for machine in machines.values():
            machine.end()


def older_tree(folder: Path) -> Path:
    """The version before. It finds the kernels that this one has compiled, and leaves its own beside them: their
    names tell their sources."""
    tree, compiled = neighbour_tree(folder), Path("planner_service", "kernels", "__pycache__")
    (ROOT / compiled).mkdir(exist_ok=True)
    (tree / compiled).symlink_to(ROOT / compiled)
    return tree


def check_understood(network: NetworkConfig, processes: int) -> None:
    """All processes have published their counters: none has dropped a payload or found a stranger."""
    counted: dict[tuple[str, str], Mapping[str, int]] = {}

    def hear(event: Event) -> None:
        assert isinstance(event, Heard)
        assert isinstance(event.message, Stats)
        counted[event.message.role, event.message.id] = event.message.counts

    with client(network) as bus:
        bus.subscribe(STATS, hear)
        eventually(lambda: len(counted) == processes, 60, "what all processes count")
    wrong = ("payloads_dropped", "strangers")
    assert {name: counts for name, counts in counted.items() if any(map(counts.get, wrong))} == {}


def take_over(machine: Machine, tree: Path) -> None:
    """Goes over to the version in `tree`, beside the one that runs."""
    before = machine.process
    machine.start(tree, "--take-over")
    eventually(lambda: machine.lives and before.poll() is not None, 120, "the end of the launcher before")
    assert before.returncode == 0, machine.said()
    eventually(machine.up, 120, "the successors")


def stop_first(machine: Machine, tree: Path) -> None:
    """Goes over to the version in `tree` once the one that runs has ended."""
    assert machine.stop() == 0, machine.said()
    machine.start(tree)
    eventually(machine.up, 120, "the successors")


def test_two_versions_understand_each_other_and_one_takes_over_from_the_other(tmp_path: Path) -> None:
    trees = {"base": older_tree(tmp_path), "planners": ROOT}
    with machines_of(TWO, trees, tmp_path) as (machines, routed, network):
        check_understood(network, 7)
        take_over(machines["base"], ROOT)
        routed.again(60)
        check_understood(network, 7)


@pytest.mark.thorough
def test_three_machines_are_upgraded_one_after_the_other(tmp_path: Path) -> None:
    old = older_tree(tmp_path)
    with machines_of(THREE, dict.fromkeys(THREE, old), tmp_path) as (machines, routed, network):
        for machine in machines.values():
            take_over(machine, ROOT)
            routed.again(60)
        check_understood(network, 10)


def measured(routed: Routed, machine: Machine, over: bool) -> float:
    routed.begin()
    (take_over if over else stop_first)(machine, ROOT)
    routed.again(60)
    return routed.longest_s()


if __name__ == "__main__":
    over = "--stop-first" not in sys.argv
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        old = older_tree(folder)
        with machines_of(THREE, dict.fromkeys(THREE, old), folder) as (machines, routed, _):
            routed.begin()
            time.sleep(10)
            sys.stdout.write(f"nothing done: {routed.longest_s():.2f} s\n")
            for each in ("field", "planners", "base"):
                sys.stdout.write(f"{each}: {measured(routed, machines[each], over):.2f} s\n")
