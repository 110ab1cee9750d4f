"""A swarm of several launchers, one for each machine, each with the files of its own version; and how long vehicles
are without a route meanwhile."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from support.live_swarm import SWARM, client, write_scenario
from support.neighbour import ROOT, environment_of
from support.processes import eventually

from launch_scripts.launcher.signals import SAME_S
from swarm.bus.bus import Event, Heard
from swarm.bus.endpoints import listening
from swarm.bus.zenoh_bus import ZenohBus
from swarm.config.load import load_scenario
from swarm.config.scenario import NetworkConfig
from swarm.wire.messages.vehicles import Fleet, VehicleState
from swarm.wire.topics import FLEET

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
        self.started: list[subprocess.Popen[bytes]] = []

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The launcher that was started last."""
        return self.started[-1]

    def start(self, tree: Path, *more: str) -> None:
        """Starts its part of the swarm with the version in `tree`."""
        options = [option for role in self._part.roles for option in ("--only", role)]
        if "router" not in self._part.roles:
            options += ["--connect", self._endpoint]
        if self._part.rank is not None:
            options += ["--rank", str(self._part.rank)]
        command = [*SWARM, "up", str(self._scenario), *options, "--runs", str(self.folder / "runs"), "--plain"]
        with (self.folder / "output.txt").open("ab") as output:
            self.started.append(
                subprocess.Popen(
                    [*command, *more], stdout=output, stderr=output, cwd=tree, env=environment_of(tree)
                )
            )

    def stop(self) -> int:
        """Ends it in order. Returns its exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)

    def said(self) -> str:
        """All output of its launchers."""
        return (self.folder / "output.txt").read_text()

    @property
    def lives(self) -> bool:
        """Asserts that its launcher still runs; shows its output if not."""
        assert self.process.poll() is None, self.said()
        return True

    def up(self) -> bool:
        """True if the launcher that was started last reports that all is up."""
        return self.lives and self.said().count("all processes are alive") >= len(self.started)

    def ask_to_end(self) -> None:
        """For the end of a test: asked twice, it writes no report."""
        for process in self.started:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Waits for the end of the stopped processes, and kills those which do not end."""
        for process in self.started:
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(10)


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


def shared_kernels(tree: Path) -> None:
    """Shares this version's compiled kernels with another version, which leaves its own beside them: their names
    tell their sources."""
    (ROOT / "planner_service" / "kernels" / "__pycache__").mkdir(exist_ok=True)
    (tree / "planner_service" / "kernels" / "__pycache__").symlink_to(
        ROOT / "planner_service" / "kernels" / "__pycache__"
    )
