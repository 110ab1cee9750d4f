"""Queries and positions on the wire beside raw Zenoh."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import closing
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import zenoh
from support.far_processes import Far, answered, asked
from support.made_up_swarm import some_fleet
from support.makers import target_pose

from bench.wire.remote import RAW, Parts, beside, read_on_thread, run_service
from planner_service.planning_process import Planning
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import AskEnded, Event, Heard, Replied
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import NetworkConfig, Scenario, TargetConfig
from swarm.errors import SwarmError
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import ThreadWorker
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.codec import encode
from swarm.wire.messages.planning import RouteReply, RouteRequest
from swarm.wire.messages.vehicles import Fleet
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import FLEET, POSE, ROUTE

_SIDE = 512
_TARGET = "t0"
_HZ = 10.0
_LONGEST_S = 60.0
_ANSWER_S = 2.0
_RAW_KEY = f"{RAW}/route"
_SESSIONS = 10
"""Agents per sending process: forty interpreters would measure how they share two cores."""


# --- path queries -------------------------------------------------------------------------------------------


def planner_peer(network: NetworkConfig, pipe: Connection, target: str = _TARGET) -> None:
    """A planner on level terrain of 512 x 512 cells, and one who answers raw queries with as many bytes."""
    from planner_service.kernel_build import load_all
    from planner_service.service import PlannerService

    load_all()
    clock, inbox = MonotonicClock(), Inbox()
    terrain = terrain_of_pace(np.random.default_rng(1).uniform(0.1, 1.0, (_SIDE, _SIDE)).astype(np.float32))
    scenario = Scenario(network=network, targets=(TargetConfig(name=target),))
    setup = RoleSetup(scenario, "bench", "planner", target, time.time_ns(), time.time_ns())
    with open_bus(network) as bus, closing(ThreadWorker("grow-tree", inbox)) as worker:
        service = PlannerService(Planning(setup, terrain, bus, inbox.post, worker), stopwatch=clock.now_ns)
        kept = serve_raw(bus)
        pipe.send("ready")
        run_service(service, bus, inbox, pipe, lambda *_: None)
        del kept


def route_queries(far: Far, queries: int) -> dict[str, Any]:
    """Microseconds from a route request to the parsed reply, beside a raw get of the same bytes, in turn."""
    far.start(planner_peer)
    cells = np.random.default_rng(2).integers(_SIDE * _SIDE, size=queries).tolist()
    with open_bus(far.network) as bus:
        inbox = Inbox()
        _wait_for_route(bus, inbox)
        found = beside_raw(bus, inbox, ((RouteRequest(cells=[cell]), _TARGET) for cell in cells), 0.002)
    far.end()
    if found["unanswered"]:
        raise SwarmError(f"{found['unanswered']} queries were not answered")
    return found


def serve_raw(bus: ZenohBus) -> Any:
    """Answers raw queries with as many bytes as each asks for, while the result is kept."""

    def answer(query: zenoh.Query) -> None:
        query.payload.to_bytes()  # type: ignore[union-attr]
        query.reply(_RAW_KEY, bytes(int(query.parameters["bytes"] or 0)))
        query.drop()  # type: ignore[no-untyped-call]

    return read_on_thread(bus.session.declare_queryable(_RAW_KEY, zenoh.handlers.FifoChannel(64)), answer)


def beside_raw(
    bus: ZenohBus, inbox: Inbox, questions: Iterable[tuple[RouteRequest, str]], pause_s: float
) -> dict[str, Any]:
    """Quantiles of the time of route queries, us, and of raw gets which carry as many bytes both ways, in turn.

    questions  each with the target that it is about
    """
    ours_us: list[float] = []
    raw_us: list[float] = []
    sizes: list[int] = []
    unanswered = 0
    for request, target in questions:
        began_ns = time.monotonic_ns()
        reply = ask_route(bus, inbox, request, target)
        took_ns = time.monotonic_ns() - began_ns
        time.sleep(pause_s)
        raw_ns = None if reply is None else _raw_ns(bus, encode(request), len(encode(reply)))
        time.sleep(pause_s)
        if reply is None or raw_ns is None:
            unanswered += 1
            continue
        ours_us.append(took_ns / 1e3)
        raw_us.append(raw_ns / 1e3)
        sizes.append(len(encode(reply)))
    mean_bytes = round(float(np.mean(sizes))) if sizes else None
    told = {"queries": len(sizes), "unanswered": unanswered, "reply_bytes": mean_bytes}
    return {**told, **beside(ours_us, raw_us, "us")}


def _raw_ns(bus: ZenohBus, payload: bytes, size: int) -> int | None:
    began_ns = time.monotonic_ns()
    answers = bus.session.get(
        f"{_RAW_KEY}?bytes={size}", zenoh.handlers.FifoChannel(4), payload=payload, timeout=_ANSWER_S
    )
    sizes = [len(each.ok.payload.to_bytes()) for each in answers if each.ok is not None]
    return time.monotonic_ns() - began_ns if sizes == [size] else None


def _wait_for_route(bus: ZenohBus, inbox: Inbox) -> None:
    deadline_s = time.monotonic() + _LONGEST_S
    cell = _SIDE * _SIDE // 2 + _SIDE // 2
    pose = target_pose(_TARGET, cell, stamp_ns=time.time_ns())
    while time.monotonic() < deadline_s:
        bus.publish(POSE, pose, target=_TARGET)
        reply = ask_route(bus, inbox, RouteRequest(cells=[0]))
        if reply is not None and reply.routes[0].status is RouteStatus.OK:
            return
        time.sleep(0.1)
    raise SwarmError("the planner was not ready in time")


def ask_route(bus: ZenohBus, inbox: Inbox, request: RouteRequest, target: str = _TARGET) -> RouteReply | None:
    """A planner's answer; None if there is none in time."""
    asked_as = str(time.monotonic_ns())
    bus.ask(ROUTE, request, inbox.post, tag=asked_as, timeout_s=_ANSWER_S, target=target)
    while True:
        match inbox.take(_ANSWER_S + 3.0):
            case Replied(tag=tag, message=RouteReply() as reply) if tag == asked_as and reply.routes:
                return reply
            case AskEnded(tag=tag) if tag == asked_as:
                return None
            case None:
                return None


# --- positions ----------------------------------------------------------------------------------------------


def fleet_sender(network: NetworkConfig, pipe: Connection, first: int, vehicles: int) -> None:
    """Agents, each with its own session, which publish positions ten times a second while they are asked to."""
    buses = [open_bus(network) for _ in range(_SESSIONS)]
    pipe.send("ready")
    seq = 0
    while (question := pipe.recv()) != "end":
        raw, seconds = question
        due_s = time.monotonic()
        sent = 0
        for _ in range(int(seconds * _HZ)):
            seq += 1
            for n, bus in enumerate(buses):
                fleet = _fleet(first + n, seq, vehicles)
                if raw:
                    bus.session.put(f"{RAW}/fleet/{fleet.region}/{fleet.author}", encode(fleet))
                else:
                    bus.publish(FLEET, fleet, region=fleet.region, author=fleet.author)
                sent += 1
            due_s += 1 / _HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
        pipe.send(sent)
    for bus in buses:
        bus.close()


def _fleet(agent: int, seq: int, vehicles: int) -> Fleet:
    places = np.linspace(0.0, 1000.0, vehicles) + seq
    return some_fleet(f"a{agent}", agent, seq, places, places, places, _TARGET)


def watcher_peer(network: NetworkConfig, pipe: Connection) -> None:
    """Receives positions, ours parsed and newest only, raw ones through a FIFO; reports counts and CPU time."""
    received: list[int] = []
    raw_received: list[int] = []
    newest: dict[tuple[int, str], Fleet] = {}
    with open_bus(network) as bus:
        inbox = Inbox()

        def handle(event: Event, now_ns: int) -> None:
            if isinstance(event, Heard) and isinstance(event.message, Fleet):
                received.append(now_ns)
                newest[event.message.region, event.message.author] = event.message

        def answer(_: str) -> tuple[int, int, int, int]:
            return len(received), inbox.superseded, len(raw_received), time.process_time_ns()

        watcher = Parts(lambda now_ns: bus.subscribe(FLEET, inbox.post), handle)
        raw = bus.session.declare_subscriber(f"{RAW}/fleet/**", zenoh.handlers.FifoChannel(1 << 14))
        kept = read_on_thread(raw, lambda sample: raw_received.append(len(sample.payload.to_bytes())))
        pipe.send("ready")
        run_service(watcher, bus, inbox, pipe, answer)
        del kept


def positions(far: Far, agents: int, vehicles: int, seconds: float) -> dict[str, float]:
    """CPU time for all positions in one process: ours, and raw Zenoh which only receives the bytes."""
    watcher = far.start(watcher_peer)
    senders = [far.start(fleet_sender, first, vehicles) for first in range(0, agents, _SESSIONS)]
    figures: dict[str, Any] = {"vehicles": agents * vehicles, "bytes": len(encode(_fleet(0, 1, vehicles)))}
    for name, raw in (("raw", True), ("ours", False)):
        before = asked(watcher, "counts")
        began_s = time.monotonic()
        for sender in senders:
            sender.send((raw, seconds))
        sent = sum(answered(sender, "the question for positions", seconds + _LONGEST_S) for sender in senders)
        time.sleep(0.3)
        took_s = time.monotonic() - began_s - 0.3
        received, superseded, raw_count, cpu_ns = (
            now - then for now, then in zip(asked(watcher, "counts"), before, strict=True)
        )
        figures[f"{name}_cpu_ms_per_s"] = cpu_ns / 1e6 / took_s
        figures[f"{name}_received_per_s"] = (raw_count if raw else received) * vehicles / took_s
        if not raw:
            figures["newer_in_its_place"] = superseded
            figures["lost"] = sent - received - superseded
        else:
            figures["raw_lost"] = sent - raw_count
    for _ in range(len(senders) + 1):
        far.end()
    figures["ratio_cpu_ms_per_s"] = figures["ours_cpu_ms_per_s"] / figures["raw_cpu_ms_per_s"]
    return {name: round(float(value), 2) for name, value in figures.items()}
