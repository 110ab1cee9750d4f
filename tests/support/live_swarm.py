"""A swarm of real processes on free ports of this machine: all at once (`LiveSwarm`) or one by one (`Hands`)."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from support.processes import Child, eventually

from launch_scripts.ports import free_ports
from swarm.bus.bus import AskEnded, Replied
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import NetworkConfig, Scenario
from swarm.config.scenario_files import load_scenario
from swarm.runtime.inbox import Inbox
from swarm.wire.messages import Message, Nothing
from swarm.wire.messages.planning import RouteRequest
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import ROUTE, RUN, Topic

SWARM = [sys.executable, "-c", "import sys; from launch_scripts.cli import main; sys.exit(main())"]

SMALL_TERRAIN = """
[terrain]
source = "synthetic"
rows = 96
cols = 128
resolution_m = 30
relief_m = 300
roads = 4
"""
SMALL_WORLD = f"""{SMALL_TERRAIN}
[terrain.hidden]
rubble_fields = 5

[[targets]]
count = 2
walk = "waypoints"

[[groups]]
vehicles = 12
"""
_SCENARIO = f"""
name = "small"
seed = 3
seconds = 3600
time_scale = 10
{SMALL_WORLD}
[vehicles]
per_agent = 6
"""
_ENDS = """
[network]
listen = ["tcp/127.0.0.1:{port}"]
connect = ["tcp/127.0.0.1:{port}"]

[monitor]
web_port = 0
"""


def write_scenario(folder: Path, also: str = "", text: str = _SCENARIO) -> Path:
    """A small scenario on a free port; `also` are further sections of it, `text` is another one."""
    path = folder / "small.toml"
    path.write_text(text + _ENDS.format(port=free_ports(1)[0]) + also)
    return path


def folders_of_runs(runs: Path) -> list[Path]:
    """The folders of all runs, of which `LAST` is a link to the newest."""
    return [each for each in runs.resolve().iterdir() if not each.is_symlink()] if runs.exists() else []


def swarm(*arguments: object, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    """Runs the command `swarm` to its end."""
    command = [*SWARM, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


class LiveSwarm(Child):
    """`swarm up` under way, in a session of its own."""

    def __init__(self, folder: Path, *options: object, also: str = "", text: str = _SCENARIO) -> None:
        self.path = write_scenario(folder, also, text)
        self.scenario: Scenario = load_scenario(self.path)
        self.runs = folder / "runs"
        words = ("up", self.path, "--runs", self.runs, "--plain", *options)
        super().__init__(folder / "output.txt", *SWARM, *words, start_new_session=True)

    @property
    def network(self) -> NetworkConfig:
        return self.scenario.network

    @property
    def endpoint(self) -> str:
        return self.network.connect[0]

    @property
    def run_dir(self) -> Path:
        (run_dir,) = folders_of_runs(self.runs)
        return run_dir

    def said(self, text: str) -> bool:
        assert self.process.poll() is None, self.text
        return text in self.text

    def pid_of(self, name: str) -> int:
        """Process id of the newest incarnation, from its log."""
        log = (self.run_dir / f"{name}.log").read_text()
        return int(re.findall(r"starts, pid (\d+)", log)[-1])

    def end(self) -> int:
        """Ctrl-C, as a terminal sends it: to everybody."""
        os.killpg(self.process.pid, signal.SIGINT)
        return self.process.wait(60)


@contextlib.contextmanager
def running(folder: Path, *options: object, also: str = "", text: str = _SCENARIO) -> Iterator[LiveSwarm]:
    """A swarm all of whose processes are alive, and which is killed in the end."""
    with LiveSwarm(folder, *options, also=also, text=text) as live:
        eventually(lambda: live.said("all processes are alive"), 90, "the start of the swarm")
        yield live


class Hands:
    """Processes of one run, started one by one as on several machines."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = write_scenario(folder)
        self.network = load_scenario(self.path).network
        self.started: list[Child] = []

    def start(self, *arguments: str, runs: Path | None = None) -> subprocess.Popen[bytes]:
        name = "-".join(arguments[:3]).replace("/", "_")
        words = (*arguments, "--runs", runs or self.folder / "runs")
        self.started.append(Child(self.folder / f"{name}.log", *SWARM, *words))
        return self.started[-1].process

    def members(self) -> list[tuple[str, str, str]]:
        with client(self.network) as bus:
            return sorted((info.role, info.id, info.run_id) for info in ask(bus, RUN, Nothing(), timeout_s=1.0))

    def route_status(self) -> RouteStatus | None:
        """Status of a route that the planner of t0 answers with; None if it does not answer."""
        with client(self.network) as bus:
            replies = ask(bus, ROUTE, RouteRequest(row=8, col=8), target="t0")
        return replies[0].routes[0].status if replies else None

    def logs(self) -> str:
        return "\n".join(f"{path.name}:\n{path.read_text()}" for path in self.folder.glob("*.log"))


def ask(bus: ZenohBus, topic: Topic, request: Message, timeout_s: float = 2.0, **fields: str) -> list[Any]:
    """All replies to one question."""
    inbox = Inbox()
    bus.ask(topic, request, inbox.post, tag="test", timeout_s=timeout_s, **fields)
    replies = []
    while not isinstance(event := inbox.take(timeout_s + 5), AskEnded):
        assert isinstance(event, Replied), event
        replies.append(event.message)
    return replies


def client(network: NetworkConfig) -> ZenohBus:
    return open_bus(msgspec.structs.replace(network, connect_timeout_s=5.0))
