"""Roles that are started by hand tell probes, a supervisor and a collector of logs how they are, router or not."""

from __future__ import annotations

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

pytestmark = pytest.mark.network


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
            found: list[str] = answer.told["missing"]
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
