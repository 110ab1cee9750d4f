"""Every role started by hand, as on several machines, and a part of a swarm that joins the rest."""

from __future__ import annotations

import json
import signal
import time

import pytest
from support.live_swarm import Hands, swarm
from support.processes import eventually

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
    for process in (part, *reversed([p for p in hands.started if p is not part])):
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0, hands.logs()


@pytest.mark.thorough
def test_who_is_started_before_the_router_waits_says_so_once_and_goes_on(hands: Hands) -> None:
    text = hands.path.read_text().replace("[network]", "[network]\nconnect_timeout_s = 1")
    hands.path.write_text(text)
    scenario, connect = str(hands.path), hands.network.connect[0]
    keeper = hands.start("role", "keeper", scenario)
    part = hands.start("up", scenario, "--connect", connect, "--only", "planner", "--plain")
    impatient = hands.start("role", "agent", scenario, "--id", "a0")
    sentence = f"no router at {connect} yet: waiting for one"
    eventually(lambda: hands.logs().count(sentence) == 3, 150, "three who wait")
    impatient.send_signal(signal.SIGINT)
    impatient.wait(10)
    time.sleep(3)  # longer than the timeout of a connection
    assert keeper.poll() is part.poll() is None
    assert hands.logs().count(sentence) == 3
    hands.start("role", "router", scenario)
    eventually(lambda: swarm("status", "--connect", connect).returncode == 0, 60, "the router")
    eventually(lambda: len(hands.members()) == 4, 150, "router, keeper and planners")
    assert len({run_id for role, _, run_id in hands.members() if role != "router"}) == 1
    for process in (part, keeper):
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0, hands.logs()
    assert "Traceback" not in hands.logs()
