"""Orders to real processes: each command returns when all obey, and what was ordered outlives whoever obeys."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from support.live_swarm import LiveSwarm, client, swarm
from support.processes import eventually

from swarm.bus.bus import Heard
from swarm.runtime.inbox import Inbox
from swarm.wire.fields import column
from swarm.wire.topics import FLEET

pytestmark = [pytest.mark.network, pytest.mark.slow]


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveSwarm]:
    folder: Path = tmp_path_factory.mktemp("orders")
    live = LiveSwarm(folder, "--no-live")
    try:
        live.wait_until_up()
        yield live
        assert live.end() == 0, live.output.read_text()
    finally:
        live.kill()


def order(live: LiveSwarm, *words: object, code: int = 0) -> Any:
    """What a command says, as JSON."""
    done = swarm(*words, "--connect", live.endpoint, "--json")
    assert done.returncode == code, done.stdout + done.stderr
    return json.loads(done.stdout) if code == 0 else done.stderr


def places(live: LiveSwarm, seconds: float) -> list[dict[str, int]]:
    """The cells of all vehicles, at the first and the last report of so many seconds."""
    inbox = Inbox()
    first: dict[str, int] = {}
    last: dict[str, int] = {}
    with client(live.network) as bus:
        bus.subscribe(FLEET, inbox.post)
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            event = inbox.take(0.2)
            if isinstance(event, Heard):
                fleet: Any = event.message
                last |= dict(zip(fleet.ids, column(fleet.cells, "<u4").tolist(), strict=True))
                first = {**last, **first}
    return [first, last]


def test_zones_are_added_listed_and_removed(running: LiveSwarm) -> None:
    added = order(running, "zone", "add", "--polygon", "10,10 10,20 20,20 20,10", "--name", "z", "--until", "10m")
    assert added["silent"] == []
    assert {"agent-a0", "agent-a1", "planner-t0", "planner-t1"} <= added["obeyed_s"].keys()
    (zone,) = order(running, "zone", "list")["zones"]
    assert (zone["name"], zone["kind"], zone["cells"]) == ("z", "lethal", 100)
    closed = swarm("route", "--target", "t0", "--row", 15, "--col", 15, "--connect", running.endpoint)
    assert "lethal" in closed.stdout
    assert order(running, "zone", "remove", "z")["zones"] == []


def test_a_pause_outlives_an_agent_that_is_killed(running: LiveSwarm) -> None:
    assert order(running, "pause")["silent"] == []
    time.sleep(3.0)
    before, _ = places(running, 1.0)
    assert len(before) == 12
    os.kill(running.pid_of("agent-a0"), signal.SIGKILL)
    eventually(lambda: running.said("agent-a0: killed"), 20, "the end of the agent")
    eventually(lambda: len(places(running, 1.0)[1]) == 12, 30, "the agent's next life")
    assert places(running, 2.0)[1] == before
    assert order(running, "resume")["silent"] == []
    eventually(lambda: len(set(map(str, places(running, 2.0)))) > 1, 20, "vehicles that drive again")


def test_an_added_target_gets_a_planner_and_is_chased(running: LiveSwarm) -> None:
    assert order(running, "target", "add", "x", "--at", "48,64", "--walk", "still")["silent"] == []

    def routed() -> bool:
        found = swarm("route", "--target", "x", "--row", 40, "--col", 60, "--connect", running.endpoint)
        return found.returncode == 0 and "to x at cell:" in found.stdout

    eventually(routed, 40, "a route to the new target")
    assert order(running, "group", "all", "targets", "x")["silent"] == []
    removed = order(running, "target", "remove", "x")
    assert removed["given"]["off"]
    order(running, "group", "all", "--as-scenario")
    eventually(lambda: "planner-x" not in swarm("status", "--connect", running.endpoint).stdout, 20, "its end")


def test_a_person_gives_an_order_by_a_selector_and_reads_json(running: LiveSwarm) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([running.endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:

        def get(selector: str) -> list[Any]:
            replies = session.get(f"swarm/{selector};format=json", timeout=5.0)
            return [json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]

        (paused,) = get("order/0/give?subject=pause")
        assert paused["given"]["subject"] == "pause"
        (resumed,) = get("order/0/give?subject=pause;off=true")
        assert resumed["given"]["off"] is True
        (zones,) = get("order/0/zones?action=list")
        assert zones["zones"] == []


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("zone", "add", "--polygon", "0,0 5,5 0,5 5,0"), "cross"),
        (("zone", "remove", "nowhere"), "there is no zone"),
        (("vehicle", "stop", "a7-00"), "vehicle 'a7-00': there is none"),
        (("target", "add", "t0", "--at", "4,4"), "is there already"),
        (("target", "move", "t1", "--at", "4000,4"), "outside the terrain"),
        (("group", "grey", "targets", "t0"), "there is none"),
        (("set", "seed", "4"), "cannot change while the swarm runs"),
    ],
)
def test_a_bad_order_gets_a_sentence(running: LiveSwarm, words: tuple[str, ...], says: str) -> None:
    error = order(running, *words, code=2)
    assert says in error
    assert error.count("\n") == 1
    assert "Traceback" not in error


def test_settings_and_stops_are_obeyed(running: LiveSwarm) -> None:
    assert order(running, "set", "time_scale", "5")["silent"] == []
    assert order(running, "vehicle", "stop", "a0-00")["silent"] == []
    said = swarm("orders", "--connect", running.endpoint).stdout
    assert "set time_scale 5" in said
    assert "vehicle a0-00" in said
    order(running, "vehicle", "go", "a0-00")
    order(running, "set", "time_scale", "--as-scenario")
    assert "no orders" in swarm("orders", "--connect", running.endpoint).stdout
