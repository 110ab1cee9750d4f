"""Orders to real processes: each command returns when all obey, and an order outlives the processes that obey
it."""

from __future__ import annotations

import json
import os
import signal
import time
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


OPTIONS = ("--no-live",)


def order(live: LiveSwarm, *words: object, code: int = 0) -> Any:
    """The output of a command, as JSON."""
    done = swarm("order", *words, "--connect", live.endpoint, "--json")
    assert done.returncode == code, done.stdout + done.stderr
    return json.loads(done.stdout) if code == 0 else done.stderr


def places(live: LiveSwarm, seconds: float) -> list[dict[str, int]]:
    """The cells of all vehicles, at the first and the last report within the given seconds."""
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


def standing(live: LiveSwarm) -> dict[str, int]:
    """The cells of all vehicles while none drives, once all have reported."""
    found: dict[str, int] = {}
    eventually(lambda: found.update(places(live, 1.0)[1]) or len(found) == 12, 40, "reports of all vehicles")
    return found


def test_zones_are_added_listed_and_removed(live: LiveSwarm) -> None:
    added = order(live, "zone", "add", "--polygon", "10,10 10,20 20,20 20,10", "--name", "z", "--for", "10m")
    assert added["silent"] == []
    assert {"agent-a0", "agent-a1", "planner-t0", "planner-t1"} <= added["obeyed_s"].keys()
    (zone,) = order(live, "zone", "ls")["zones"]
    assert (zone["name"], zone["kind"], zone["cells"]) == ("z", "lethal", 100)
    place = ("--target", "t0", "--from", "cell:15,15", "--connect", live.endpoint)
    # A planner that is alive may not have heard its target yet.
    eventually(lambda: "lethal" in swarm("route", *place).stdout, 20, "a route from a closed cell")
    assert order(live, "zone", "remove", "z")["zones"] == []


def test_a_pause_outlives_an_agent_that_is_killed(live: LiveSwarm) -> None:
    assert order(live, "pause")["silent"] == []
    time.sleep(3.0)
    before = standing(live)
    os.kill(live.pid_of("agent-a0"), signal.SIGKILL)
    eventually(lambda: live.said("agent-a0: killed"), 20, "the end of the agent")
    assert standing(live) == before
    assert order(live, "resume")["silent"] == []
    eventually(lambda: len(set(map(str, places(live, 2.0)))) > 1, 20, "vehicles that drive again")


def test_an_added_target_gets_a_planner_and_is_chased(live: LiveSwarm) -> None:
    assert order(live, "target", "add", "x", "--at", "48,64", "--walk", "still")["silent"] == []

    def routed() -> bool:
        found = swarm("route", "--target", "x", "--from", "cell:40,60", "--connect", live.endpoint)
        return found.returncode == 0 and "to x at cell:" in found.stdout

    eventually(routed, 40, "a route to the new target")
    assert order(live, "group", "all", "x")["silent"] == []
    removed = order(live, "target", "remove", "x")
    assert removed["given"]["off"]
    order(live, "unset", "groups.all")
    eventually(lambda: "planner-x" not in swarm("status", "--connect", live.endpoint).stdout, 20, "its end")


def test_a_person_gives_an_order_by_a_selector_and_reads_json(live: LiveSwarm) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([live.endpoint]))
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
        (("set", "seed", "4"), "cannot change while the swarm runs"),
        (("set", "time_scale", "-3"), "-3.0 is not in 0.001 ... 1000"),
    ],
)
def test_a_bad_order_gets_a_sentence(live: LiveSwarm, words: tuple[str, ...], says: str) -> None:
    error = order(live, *words, code=2)
    assert says in error
    assert error.count("\n") == 1
    assert "Traceback" not in error


def test_settings_and_stops_are_obeyed(live: LiveSwarm) -> None:
    assert order(live, "set", "time_scale", "5")["silent"] == []
    assert order(live, "vehicle", "stop", "a0-00")["silent"] == []
    said = swarm("order", "ls", "--connect", live.endpoint).stdout
    assert "set time_scale 5" in said
    assert "vehicle a0-00" in said
    order(live, "vehicle", "start", "a0-00")
    order(live, "unset", "time_scale")
    assert "no orders" in swarm("order", "ls", "--connect", live.endpoint).stdout
