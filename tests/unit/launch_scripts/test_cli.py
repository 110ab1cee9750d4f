"""The command line: valid input, and the answers to it. Mistakes get a sentence and an exit code."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from support.command import Swarm

from launch_scripts import ports
from launch_scripts.launcher import options
from swarm.config.load import load_scenario
from swarm.config.scenario import Scenario, TlsConfig
from swarm.errors import BusError


def test_the_version_is_the_packages(swarm: Swarm) -> None:
    assert swarm("--version") == (0, f"swarm {version('terrain-swarm')}\n", "")


def test_help_is_quick_because_it_imports_neither_zenoh_nor_numpy() -> None:
    program = "import launch_scripts.cli, sys; sys.exit('zenoh' in sys.modules or 'numpy' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_the_launcher_never_imports_numba_or_rerun() -> None:
    program = "import launch_scripts.launcher.up, sys; sys.exit('numba' in sys.modules or 'rerun' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_folder_stands_for_the_three_files_of_tls(tmp_path: Path) -> None:
    names = ("ca.pem", "ca.key", "operator.anna.pem", "operator.anna.key")
    files = [tmp_path / name for name in names]
    for file in files:
        file.write_text("")
    (ca, _, certificate, key) = map(str, files)
    assert options.tls_of(None, None, None, str(tmp_path)) == TlsConfig(ca=ca, certificate=certificate, key=key)
    (tmp_path / "planner.t0.key").write_text("")  # of several, each process finds its own
    own = options.tls_of(None, None, None, str(tmp_path))
    assert own == TlsConfig(ca=ca, certificate=str(tmp_path), key=str(tmp_path))


def test_options_override_the_network_of_the_file() -> None:
    changed = options.with_network(Scenario(), connect="tcp/127.0.0.1:9", namespace="other").network
    assert (changed.connect, changed.namespace) == (("tcp/127.0.0.1:9",), "other")


def test_a_port_gives_the_live_view_the_two_after_it_and_0_picks_free_ones() -> None:
    scenario = options.with_port(Scenario(), 8000)
    assert scenario.network.listen == scenario.network.connect == ("tcp/127.0.0.1:8000",)
    assert (scenario.monitor.grpc_port, scenario.monitor.web_port) == (8001, 8002)
    free = options.with_port(Scenario(), 0)
    found = {free.network.listen[0].rpartition(":")[2], str(free.monitor.grpc_port), str(free.monitor.web_port)}
    assert len(found) == 3
    ports.check_ports(free, ("router", "monitor"))


def test_ports_of_the_live_view_matter_only_if_it_is_served_here() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        import msgspec

        scenario = options.with_port(Scenario(), 0)
        monitor = msgspec.structs.replace(scenario.monitor, web_port=port)
        scenario = msgspec.structs.replace(scenario, monitor=monitor)
        with pytest.raises(BusError, match=f"port {port}, which the live view needs"):
            ports.check_ports(scenario, ("router", "monitor"))
        ports.check_ports(scenario, ("router", "agent"))


def test_a_run_has_one_folder_whenever_it_is_started_again(tmp_path: Path) -> None:
    assert options.make_run_dir(tmp_path, "20260101-000000").name == "20260101-000000"
    assert options.make_run_dir(tmp_path, "20260101-000000").name == "20260101-000000", "a run keeps its folder"


def test_simulate_prints_the_report_of_a_run_and_leaves_its_folder(swarm: Swarm, tmp_path: Path) -> None:
    code, out, _ = swarm(
        "simulate", "synthetic", "--seconds", "2", "--seed", "9", "--runs", str(tmp_path), "--json"
    )
    assert code == 0
    printed = json.loads(out)
    assert printed["scenario"] == "synthetic"
    last = tmp_path / "LAST"
    report = json.loads((last / "report.json").read_text())
    assert {name: report[name] for name in printed if name != "run_id"} == {
        name: value for name, value in printed.items() if name != "run_id"
    }
    assert report["run_id"] == last.resolve().name
    again = load_scenario(last / "scenario.toml")
    assert (again.name, again.seed, again.seconds) == ("synthetic", 9, 2.0)
