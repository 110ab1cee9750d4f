"""The swarm that a command asks by default: the newest that runs here."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path

import msgspec
import pytest

from launch_scripts.commands.running_swarm import Where, find_swarm
from launch_scripts.observe.run_folder import begin_run
from launch_scripts.ports import free_ports
from swarm.config.scenario import NetworkConfig, Scenario
from swarm.errors import BusError, ConfigError


@pytest.fixture
def listens() -> Iterator[list[int]]:
    """Ports that listen."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(2)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
            each.listen()
        yield [each.getsockname()[1] for each in sockets]


@pytest.fixture(autouse=True)
def _nobody_at_the_usual_endpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    (port,) = free_ports(1)
    usual = NetworkConfig(connect=(f"tcp/127.0.0.1:{port}",))
    monkeypatch.setattr("swarm.config.scenario.NetworkConfig", _usual_is(usual))


def _usual_is(usual: NetworkConfig) -> type[NetworkConfig]:
    class Usual(NetworkConfig, frozen=True, kw_only=True):
        connect: tuple[str, ...] = usual.connect

    return Usual


def make_run(runs: Path, name: str, port: int, began: str, *, namespace: str = "swarm", over: bool = False) -> None:
    folder = runs / name
    folder.mkdir(parents=True)
    endpoint = f"tcp/127.0.0.1:{port}"
    network = NetworkConfig(namespace=namespace, listen=(endpoint,), connect=(endpoint,))
    begin_run(folder, msgspec.structs.replace(Scenario(), network=network), name)
    began_s = datetime.fromisoformat(began).timestamp()
    os.utime(folder / "run.json", (began_s, began_s))
    if over:
        (folder / "report.json").write_text("{}")


def test_the_newest_run_whose_router_listens_is_found_whatever_its_port_and_namespace(
    tmp_path: Path, listens: list[int]
) -> None:
    (silent,) = free_ports(1)
    make_run(tmp_path, "old", listens[0], "2026-11-01T00:00:00Z")
    make_run(tmp_path, "mine", listens[1], "2026-11-02T00:00:00Z", namespace="north")
    make_run(tmp_path, "dead", silent, "2026-11-03T00:00:00Z")
    (tmp_path / "rubbish").mkdir()
    (tmp_path / "rubbish" / "run.json").write_text("[[[")
    found = find_swarm(tmp_path)
    assert (found.run, found.others) == ("mine", ("old",))
    assert (found.network.connect, found.network.namespace) == ((f"tcp/127.0.0.1:{listens[1]}",), "north")
    assert find_swarm(tmp_path, "old").network.connect == (f"tcp/127.0.0.1:{listens[0]}",)
    assert find_swarm(tmp_path, str(tmp_path / "mine")).run == "mine"


def test_a_port_that_a_later_run_took_over_is_that_runs(tmp_path: Path, listens: list[int]) -> None:
    make_run(tmp_path, "earlier", listens[0], "2026-11-01T00:00:00Z")
    make_run(tmp_path, "later", listens[0], "2026-11-02T00:00:00Z")
    make_run(tmp_path, "over", listens[1], "2026-11-03T00:00:00Z", over=True)
    found = find_swarm(tmp_path)
    assert (found.run, found.others) == ("later", ("over",))


def test_what_was_looked_at_is_said_when_nothing_runs(tmp_path: Path) -> None:
    ports = free_ports(5)
    for n, port in enumerate(ports):
        make_run(tmp_path, f"r{n}", port, f"2026-11-0{n + 1}T00:00:00Z")
    make_run(tmp_path, "simulated", ports[0], "2026-12-01T00:00:00Z")
    (tmp_path / "simulated" / "run.json").write_text('{"simulated": true}')
    with pytest.raises(
        BusError, match=rf"no swarm runs here: [^(]*\(r4 at tcp/127\.0\.0\.1:{ports[4]}.* and 3 more"
    ):
        find_swarm(tmp_path)
    with pytest.raises(BusError, match=r"no swarm runs here: .*usual endpoint"):
        find_swarm(tmp_path / "nowhere")
    with pytest.raises(BusError, match=rf"run r1 does not run here: no process listens \(r1 at .*:{ports[1]}\)"):
        find_swarm(tmp_path, "r1")
    with pytest.raises(ConfigError, match="there is no run 'r9'"):
        find_swarm(tmp_path, "r9")


def test_options_say_more_than_the_run_does(tmp_path: Path, listens: list[int]) -> None:
    make_run(tmp_path, "mine", listens[0], "2026-11-02T00:00:00Z", namespace="north")
    assert Where(runs=tmp_path).network().namespace == "north"
    assert Where(runs=tmp_path, namespace="south").network().namespace == "south"
    assert str(Where(runs=tmp_path)) == f"in namespace 'north' at tcp/127.0.0.1:{listens[0]}"
    given = Where(connect="tcp/127.0.0.1:9", runs=tmp_path).network()
    assert (given.connect, given.namespace) == (("tcp/127.0.0.1:9",), "swarm")
    with pytest.raises(ConfigError, match="--connect and --run both say which swarm"):
        Where(connect="tcp/127.0.0.1:9", run="mine", runs=tmp_path).network()
