"""An operator's program on a machine of its own: it notes routed vehicles, answering processes, and
acknowledgements of keepers. Run by `Onlooker` of tests/live/test_deploy_plan.py; its `Notes` serve other tests.

argv: the scenario, the router's endpoint, the folder of certificates, seconds after which it ends by itself. It
prints a line of JSON ten times a second, and ends with its input, too.
"""

from __future__ import annotations

import json
import math
import select
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from launch_scripts.launcher.run_options import as_process
from launch_scripts.process_table import LAUNCHER
from swarm.bus.bus import Event, Heard, Replied
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import TlsConfig
from swarm.config.scenario_files import load_scenario
from swarm.peers import job_of
from swarm.runtime.inbox import Inbox
from swarm.wire.messages.map_data import DIGEST_ROW, Digest, is_keeper
from swarm.wire.messages.planning import PushedRoute, RouteReply, RouteRequest
from swarm.wire.messages.processes import Heartbeat
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, Followed, VehicleState
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import DIGEST, FLEET, FOLLOWED, LEAD, PUSHED_ROUTE, ROUTE

ROUTED = (VehicleState.FOLLOWING, VehicleState.ARRIVED)
ASK_S = 0.05
TELL_S = 0.1


class Notes:
    """Notes about received messages: times are of the monotonic clock, in seconds."""

    def __init__(self) -> None:
        self.routed: dict[str, float] = {}
        """Vehicle -> time of its last report on a route."""
        self.targets: dict[str, str] = {}
        """Vehicle -> its target."""
        self.pushed: dict[str, list[tuple[float, int]]] = {}
        """Vehicle -> when a route was pushed to it, and by which life of a planner."""
        self.followed: dict[str, list[float]] = {}
        """Vehicle -> when it began a route."""
        self.answered: dict[str, dict[int, tuple[float, float]]] = {}
        """Target -> life of a planner -> when that first and last answered, since it was silent for a second."""
        self.leads: dict[str, float] = {}
        """Planner -> time of its last report as leader."""
        self.acknowledged: dict[str, dict[str, tuple[int, int]]] = {}
        """Keeper -> "author/tile" -> (epoch, seq) of the newest set that it reported on its disk."""

    def take(self, event: Event | None) -> None:
        now_s = time.monotonic()
        match event:
            case Heard(message=Fleet() as fleet):
                whose = np.frombuffer(fleet.targets, np.uint8)
                for id, state, target in zip(fleet.ids, np.frombuffer(fleet.states, np.uint8), whose, strict=True):
                    if state in ROUTED:
                        self.routed[id] = now_s
                    if target != NO_TARGET:
                        self.targets[id] = fleet.target_ids[target]
            case Heard(message=PushedRoute() as pushed):
                self.pushed.setdefault(pushed.vehicle, []).append((now_s, pushed.incarnation))
            case Heard(message=Followed() as followed):
                self.followed.setdefault(followed.vehicle, []).append(now_s)
            case Heard(message=Heartbeat(role="planner", leads=True) as heartbeat):
                self.leads[heartbeat.id] = now_s
            case Heard(message=Digest() as digest) if is_keeper(digest.author):
                kept = self.acknowledged.setdefault(digest.author.split(".")[1], {})
                for author, rows in digest.held.items():
                    for tile, epoch, seq in np.frombuffer(rows, DIGEST_ROW).tolist():
                        key = f"{author}/{tile}"
                        kept[key] = max(kept.get(key, (0, 0)), (epoch, seq))
            case Replied(tag=target, message=RouteReply() as reply):
                if reply.routes[0].status is not RouteStatus.NO_TARGET:
                    lives = self.answered.setdefault(target, {})
                    first_s, last_s = lives.get(reply.incarnation, (now_s, now_s))
                    lives[reply.incarnation] = (first_s if now_s - last_s < 1.0 else now_s), now_s


def look_on(bus: ZenohBus, notes: Notes, targets: Sequence[str], goes_on: Callable[[], bool]) -> None:
    """Asks for a route to each target every 50 ms, and notes what comes."""
    inbox = Inbox()
    for topic in (FLEET, PUSHED_ROUTE, FOLLOWED, LEAD, DIGEST):
        bus.subscribe(topic, inbox.post)
    ask_at_s = time.monotonic()
    while goes_on():
        if time.monotonic() >= ask_at_s:
            ask_at_s = time.monotonic() + ASK_S
            for target in targets:
                bus.ask(ROUTE, RouteRequest(row=8, col=8), inbox.post, tag=target, timeout_s=1.0, target=target)
        notes.take(inbox.take(max(ask_at_s - time.monotonic(), 0.0)))
        while (event := inbox.take(0.0)) is not None:
            notes.take(event)


def steady(leads: dict[str, float], planner: str) -> bool:
    """True if a planner leads, by notes, and none of its standbys has led for a while."""
    others = [at_s for id, at_s in [*leads.items()] if id != planner and job_of(id) == planner]
    now_s = time.monotonic()
    return now_s - leads.get(planner, -math.inf) < 1.0 and now_s - max(others, default=-math.inf) > 3.0


def main(path: str, endpoint: str, certificates: str, seconds: str) -> None:
    scenario = load_scenario(Path(path))
    tls = TlsConfig(ca=str(Path(certificates) / "ca.pem"), certificate=certificates, key=certificates)
    network = msgspec.structs.replace(scenario.network, connect=(endpoint,), tls=tls)
    own = as_process(msgspec.structs.replace(scenario, network=network), LAUNCHER, "0")
    notes, until_s = Notes(), time.monotonic() + float(seconds)
    tell_at_s = 0.0

    def tell() -> bool:
        nonlocal tell_at_s
        if time.monotonic() >= tell_at_s:
            tell_at_s = time.monotonic() + TELL_S
            sys.stdout.write(json.dumps(vars(notes)) + "\n")
            sys.stdout.flush()
        return time.monotonic() < until_s and not select.select([sys.stdin], [], [], 0)[0]

    with open_bus(own.network, patient=True) as bus:
        look_on(bus, notes, scenario.target_ids, tell)


if __name__ == "__main__":
    main(*sys.argv[1:])
