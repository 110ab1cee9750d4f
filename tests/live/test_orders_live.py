"""Orders to real processes: each command returns when all obey, and an order outlives the processes that obey
it."""

import json
import os
import signal
import time
from collections.abc import Iterator
from hashlib import blake2b
from typing import Any

import pytest
import zenoh
from support.live_swarm import LiveSwarm, client, swarm
from support.processes import eventually

from shared_map.learned_factors import name_of
from shared_map.pace_measurements import ONE, Measurement
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import beyond_region, beyond_tile
from swarm.bus.bus import Heard
from swarm.client import connect
from swarm.grid import GridSpec
from swarm.runtime.inbox import Inbox
from swarm.runtime.run_secret import authenticator_of, state_folder
from swarm.wire.fields import column
from swarm.wire.topics import FLEET, MARKS

pytestmark = [pytest.mark.network, pytest.mark.slow]


OPTIONS = ("--no-live",)
ALSO = "\n[map]\nlearning = true\n\n[planner]\nplaces = true\n"


def order(live: LiveSwarm, *words: object) -> Any:
    """The output of a command, as JSON."""
    done = swarm("order", *words, "--connect", live.endpoint, "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout)


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


class Program:
    """A program in any language: JSON, keyed BLAKE2b, and one session on loopback."""

    def __init__(self, session: zenoh.Session, secret: bytes) -> None:
        self.session = session
        (run,) = self.ask("swarm/run/keeper/0?format=json", None, None)
        self.run_key = blake2b(run["run_id"].encode(), key=secret, digest_size=32).digest()

    def code(self, key: str, payload: bytes) -> bytes:
        said = f"{len(key)},0,".encode() + key.encode() + payload
        return blake2b(said, key=self.run_key, digest_size=16).digest()

    def order(self, what: str, **order: Any) -> list[Any]:
        """The replies; a refusal is a text."""
        payload = json.dumps({"key": f"order/0/{what}"} | order).encode()
        return self.ask(f"swarm/order/0/{what}", payload, self.code(f"swarm/order/0/{what}", payload))

    def ask(self, selector: str, payload: bytes | None, code: bytes | None) -> list[Any]:
        encoding = None if payload is None else zenoh.Encoding.APPLICATION_JSON
        found = self.session.get(selector, payload=payload, encoding=encoding, attachment=code, timeout=5.0)
        return [
            each.err.payload.to_string() if each.ok is None else json.loads(each.ok.payload.to_bytes())
            for each in found
        ]


@pytest.fixture
def session(live: LiveSwarm) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([live.endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as opened:
        yield opened


def test_a_program_in_any_language_orders_with_the_secret_and_each_order_counts_once(
    live: LiveSwarm, session: zenoh.Session
) -> None:
    ours = Program(session, (state_folder() / "secret").read_bytes())
    pause = {"subject": "pause", "stamp_ns": time.time_ns()}
    (paused,) = ours.order("give", **pause)
    assert paused["given"]["subject"] == "pause"
    (resumed,) = ours.order("give", subject="pause", off=True, stamp_ns=time.time_ns())
    assert resumed["given"]["off"] is True
    (again,) = ours.order("give", **pause)  # as a stranger copies it off the bus
    assert "counts once" in again
    (undated,) = ours.order("give", subject="pause")
    assert "stamp_ns is 0, expected the time of the order" in undated
    (zones,) = ours.order("zone", action="list")
    assert zones["zones"] == []


def test_settings_and_stops_are_obeyed(live: LiveSwarm) -> None:
    assert order(live, "set", "time_scale", "5")["silent"] == []
    assert order(live, "vehicle", "stop", "a0-00")["silent"] == []
    said = swarm("order", "ls", "--connect", live.endpoint).stdout
    assert "set time_scale 5" in said
    assert "vehicle a0-00" in said
    order(live, "vehicle", "start", "a0-00")
    order(live, "unset", "time_scale")
    assert "no orders" in swarm("order", "ls", "--connect", live.endpoint).stdout


def test_a_running_swarm_says_what_was_learned(live: LiveSwarm) -> None:
    grid = GridSpec(96, 128, 30.0)
    kind = {65: Measurement(400, ONE, ONE // 10)}
    (word,) = MapReplica(grid, author="all.x1.1").write_learned(kind, time.time_ns())

    def told() -> list[dict[str, Any]]:
        bus.publish(MARKS, word, region=beyond_region(grid), tile=beyond_tile(grid), author="all.x1.1")
        done = swarm("marks", "factors", "--connect", live.endpoint, "--json")
        kinds = json.loads(done.stdout)["kinds"] if done.returncode == 0 else []
        return [each for each in kinds if each["kind"] == name_of(65)]

    with client(live.network) as bus:
        bus.trust(authenticator_of(live.network, live.run_dir.name))
        eventually(told, 30, "the keeper")
        (row,) = told()
    assert (row["cells"], row["authors"]) == (400, 1)


def test_vehicles_get_to_their_places_though_their_agent_and_the_planner_of_places_are_killed(
    live: LiveSwarm,
) -> None:
    assert order(live, "pause")["silent"] == []
    time.sleep(3.0)
    began = standing(live)
    ids = sorted(began)
    with connect(live.endpoint) as joined, joined.observer() as seen:
        frame, orders = joined.frame, joined.orders()

        def cell(index: int) -> str:
            return "cell:{},{}".format(*frame.grid.row_col(index))

        ends = ("--from", cell(began[ids[0]]), "--to", cell(began[ids[7]]))
        routed = swarm("route", *ends, "--connect", live.endpoint, "--json")
        assert routed.returncode == 0, routed.stderr
        found = json.loads(routed.stdout)
        assert found["routes"][0]["status"] == "ok"
        assert found["target_cell"] == began[ids[7]]
        same = joined.route(*(frame.centre_m(began[id]) for id in (ids[0], ids[7])))
        assert (same.ok, same.cells[0], same.cells[-1]) == (True, began[ids[0]], began[ids[7]])
        assert same.cost_s >= same.lower_bound_s > 0.999 * same.cost_s
        with joined.vehicle("r1") as rover:
            rover.at(*frame.centre_m(began[ids[0]]))
            routes = rover.follow(cell(began[ids[7]]))
            eventually(lambda: routes.newest is not None and routes.newest.cells == same.cells, 10, "its route")
        # Each goes to where another one has been, so that there is a way.
        goals = {id: began[ids[(n + 7) % len(ids)]] for n, id in enumerate(ids)}
        assert order(live, "vehicle", "send", ids[0], cell(goals[ids[0]]))["silent"] == []
        for id in ids[1:]:
            assert orders.send(id, [cell(goals[id])]).silent == []
        for name in ("agent-a0", "places-all"):
            os.kill(live.pid_of(name), signal.SIGKILL)
            eventually(lambda name=name: live.said(f"{name}: killed"), 20, "its end")  # type: ignore[misc]
        assert orders.resume().silent == []

        def all_there() -> bool:
            told = swarm("status", "--connect", live.endpoint, "--json")
            goals_now = json.loads(told.stdout)["goals"] if told.returncode == 0 else []  # while no process answers
            return len(goals_now) == len(ids) and all(each["state"] == "completed" for each in goals_now)

        eventually(all_there, 240, "all vehicles at their places")
        assert standing(live) == goals
        assert {each.target for each in seen.vehicles.values()} == {None}
        orders.recall(ids[3])
        eventually(lambda: seen.vehicles[ids[3]].target in ("t0", "t1"), 20, "the chase of one that was recalled")
        assert len([each for each in orders.goals() if not each.off]) == len(ids) - 1
