"""A run on two machines, as the page says: certificates, a launcher on each, a name that is revoked."""

import json
import shutil
import signal
import time
from pathlib import Path

import msgspec
import pytest
from support.live_swarm import Hands, swarm
from support.processes import eventually

from launch_scripts.commands.shared_options import Tls
from launch_scripts.launcher.run_options import as_process
from launch_scripts.ports import free_ports
from swarm.bus.bus import Event, Heard
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.client import Swarm, connect
from swarm.config.scenario_files import load_scenario
from swarm.wire.messages.processes import Stats
from swarm.wire.topics import STATS

pytestmark = [pytest.mark.network, pytest.mark.slow]


def tls(folder: Path) -> list[str]:
    return ["--tls-ca", str(folder / "ca.pem"), "--tls-cert", str(folder), "--tls-key", str(folder)]


def opened(hands: Hands, role: str, id: str, certs: Path, endpoint: str) -> ZenohBus:
    """A session with the certificate of a process."""
    scenario = load_scenario(hands.path)
    files = Tls(None, str(certs / "ca.pem"), str(certs), str(certs)).tls()
    network = msgspec.structs.replace(scenario.network, connect=(endpoint,), tls=files)
    return open_bus(as_process(msgspec.structs.replace(scenario, network=network), role, id).network)


def issue(hands: Hands, *arguments: str) -> Path:
    certs = hands.folder / "certs"
    told = swarm("deploy", "certs", certs, "--scenario", hands.path, *arguments)
    assert told.returncode == 0, told.stderr
    return certs


def test_launchers_on_two_machines_make_one_run_each_with_certificates_of_its_own_processes(
    hands: Hands,
) -> None:
    hands.path.write_text(hands.path.read_text().replace("[network]", '[network]\nadmit = ["rover.all.r1"]'))
    certs = issue(hands)
    car = hands.folder / "car"
    car.mkdir()
    for path in (certs / "ca.pem", *certs.glob("agent.*"), *certs.glob("operator.*")):
        shutil.copy(path, car)
    endpoint = f"tls/localhost:{free_ports(1)[0]}"
    elsewhere = ["--connect", endpoint, *tls(car)]
    told = swarm("up", hands.path, *elsewhere, "--only", "planner", "--runs", hands.folder / "car-runs")
    assert told.returncode == 2
    assert "car/planner.t0.pem, which planner.t0 needs" in told.stderr
    roles = [option for role in ("router", "keeper", "targets", "planner") for option in ("--only", role)]
    base = hands.start("up", str(hands.path), *roles, "--listen", endpoint, *tls(certs), "--plain")
    eventually(lambda: swarm("status", *elsewhere).returncode == 0, 90, "the router")
    eventually(lambda: len(hands.members()) == 5, 60, "all of the base")
    part = hands.start(
        "up", str(hands.path), *elsewhere, "--only", "agent", "--plain", runs=hands.folder / "car-runs"
    )

    def routed() -> int:
        told = swarm("status", *elsewhere, "--json")
        status = json.loads(told.stdout) if told.returncode == 0 else {}
        return sum(planner["routes_served"] for planner in status.get("planners", ()))

    eventually(lambda: routed() >= 12, 90, "routes for all vehicles")

    def joined(name: str) -> Swarm:
        files = [str(certs / file) for file in ("ca.pem", f"{name}.pem", f"{name}.key")]
        return connect(endpoint, ca=files[0], certificate=files[1], key=files[2])

    operator = next(certs.glob("operator.*.pem")).stem
    with joined(operator) as watcher, watcher.observer() as seen, joined("rover.all.r1") as program:
        for id in ("r2", "r1"):
            program.vehicle(id).at(*program.frame.centre_m(program.frame.grid.cell(40, 60)))
        eventually(lambda: "r1" in seen.vehicles, 10, "the vehicle of its own name")
        assert "r2" not in seen.vehicles
    for process in (part, base):
        process.send_signal(signal.SIGINT)
        eventually(lambda process=process: process.poll() is not None, 30, "its end")  # type: ignore[misc]
        assert process.returncode == 0, hands.logs()
    reports = list(hands.folder.glob("*/small-*/report.json"))
    assert [path.parent.parent.name for path in reports] == ["runs"]
    assert json.loads(reports[0].read_text())["routes_served"] >= 12
    told = swarm("runs", "report", *(path.parent for path in hands.folder.glob("car-runs/small-*/run.json")))
    assert told.returncode != 0
    assert "the launcher of another machine records the run" in told.stderr


def test_a_name_that_is_revoked_is_denied_while_the_router_runs_and_its_successor_is_not(hands: Hands) -> None:
    certs = issue(hands)
    endpoint = f"tls/localhost:{free_ports(1)[0]}"
    start = ("role", "router", str(hands.path), "--listen", endpoint, *tls(certs))
    heard: list[str] = []

    def tell(event: Event) -> None:
        if isinstance(event, Heard):
            heard.append(event.fields["id"])

    def stats(bus: ZenohBus, id: str) -> None:
        said = Stats(role="agent", id=id, incarnation=1, stamp_ns=1, counts={}, gauges={}, histograms={})
        bus.publish(STATS, said, role="agent", id=id)

    def says(bus: ZenohBus, id: str) -> bool:
        """True if its message is received; a0 speaks meanwhile, so that silence is no matter of time."""
        heard.clear()
        until_s = time.monotonic() + 10
        while heard.count("a0") < 5 and time.monotonic() < until_s:
            stats(bus, id)
            stats(other, "a0")
            time.sleep(0.05)
        assert heard.count("a0") >= 5
        return id in heard

    router = hands.start(*start)
    eventually(lambda: swarm("status", "--connect", endpoint, *tls(certs)).returncode == 0, 30, "the router")
    with (
        opened(hands, "launcher", "0", certs, endpoint) as operator,
        opened(hands, "agent", "a0", certs, endpoint) as other,
        opened(hands, "agent", "a1", certs, endpoint) as stolen,
    ):
        operator.subscribe(STATS, tell, role="agent")
        assert says(stolen, "a1")
        (certs / "revoked").write_text("no name\n")  # which the router names in its log, and goes on
        time.sleep(1)
        assert says(stolen, "a1")
        (certs / "revoked").unlink()
        told = swarm("deploy", "revoke", certs, "agent.all.a1")
        assert told.returncode == 0, told.stderr
        eventually(lambda: not says(stolen, "a1"), 20, "that it is denied")
        assert router.poll() is None
        issue(hands, "agent.all.a1", "--renew")
        with opened(hands, "agent", "a1", certs, endpoint) as successor:
            assert says(successor, "a1")
            assert not says(stolen, "a1")
    assert "line 1: 'no name' is no name in a certificate" in hands.logs()
