"""Every role started by hand, as on several machines: a part of a swarm that joins the rest, and what a role tells
probes, a supervisor and a collector of logs."""

import json
import signal
import socket
from pathlib import Path

import pytest
from support.live_swarm import Hands, swarm
from support.processes import eventually

from launch_scripts.ports import free_ports
from launch_scripts.web.health_probe import ask
from swarm.errors import BusError
from swarm.wire.route_columns import RouteStatus

pytestmark = [pytest.mark.network, pytest.mark.slow]


def test_roles_started_one_by_one_find_the_run_and_serve_routes(hands: Hands) -> None:
    scenario = (str(hands.path),)
    hands.start("role", "router", *scenario)
    eventually(lambda: swarm("status", "--connect", hands.network.connect[0]).returncode == 0, 30, "the router")
    hands.start("role", "keeper", *scenario, "--run-id", "by-hand")
    eventually(lambda: ("keeper", "0", "by-hand") in hands.members(), 60, "the keeper")
    for role in (("targets",), ("planner", "--target", "t0")):
        hands.start("role", *role, *scenario)
    eventually(lambda: len(hands.members()) == 4, 60, "all four")
    assert {(role, run_id) for role, _, run_id in hands.members()} == {
        ("router", ""), ("keeper", "by-hand"), ("targets", "by-hand"), ("planner", "by-hand"),
    }  # fmt: skip

    eventually(lambda: hands.route_status() in (RouteStatus.OK, RouteStatus.LETHAL_START), 30, "a route")
    part = hands.start("up", str(hands.path), "--connect", hands.network.connect[0], "--only", "agent", "--plain")
    eventually(lambda: ("agent", "a1", "by-hand") in hands.members(), 60, "the agents")
    told = swarm("role", "agent", "--id", "a1", *scenario, "--runs", hands.folder / "runs")
    assert told.returncode == 5
    assert told.stderr.endswith("swarm: agent a1 takes part in run by-hand already; stop it first\n")
    status = json.loads(swarm("status", "--connect", hands.network.connect[0], "--json").stdout)
    assert status["run_id"] == "by-hand"
    for process in (part, *(child.process for child in reversed(hands.started[:-1]))):
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0, hands.logs()


def test_a_keeper_waits_is_ready_hangs_and_loses_its_router(
    hands: Hands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [port] = free_ports(1)
    url = f"http://127.0.0.1:{port}"
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(tmp_path / "notify"))
    manager.settimeout(60)
    with manager:
        monkeypatch.setenv("NOTIFY_SOCKET", manager.getsockname())
        keeper = hands.start("role", "keeper", str(hands.path), "--health-port", str(port), "--log-format", "json")
        monkeypatch.delenv("NOTIFY_SOCKET")
        assert manager.recv(100) == b"STATUS=its start"

        def missing() -> list[str] | None:
            """The keeper's stated lack; None while no keeper answers."""
            try:
                answer = ask(url, live=False)
            except BusError:
                return None
            found: list[str] = answer.page["missing"]
            assert answer.ok == (not found)
            return found

        eventually(lambda: missing() == ["keeper-0: its router"], 60, "that it waits for its router")
        assert ask(url, live=True).ok, "waiting is no fault"
        router = hands.start("role", "router", str(hands.path))
        while b"READY=1" not in manager.recv(1000):
            pass
        eventually(lambda: missing() == [], 60, "that it is ready")
        assert swarm("health", "--url", url).stdout == "ready\n"
        router.send_signal(signal.SIGINT)
        eventually(lambda: missing() == ["keeper-0: its router"], 60, "that its router is gone")
        assert ask(url, live=True).ok
        keeper.send_signal(signal.SIGINT)
        assert keeper.wait(60) == 0, hands.logs()
    [log] = hands.folder.glob("role-keeper*.log")
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert {(line["role"], line["id"]) for line in lines} == {("keeper", "0")}
    assert any("keeper started" in line["message"] for line in lines)
    assert sum("yet: waiting for one" in line["message"] for line in lines) == 1
