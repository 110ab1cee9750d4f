"""The latency of a route query as a client beside the swarm sees it, and of a raw Zenoh get of the same bytes."""

from __future__ import annotations

import random
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import zenoh

from bench.wire.queries import ask_route
from bench.wire.remote import RAW, beside, read_on_thread
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import NetworkConfig
from swarm.runtime.inbox import Inbox
from swarm.wire.codec import encode
from swarm.wire.messages.planning import RouteReply, RouteRequest

_EVERY_S = 0.05
_LONGEST_S = 2.0
_KEY = f"{RAW}/swarm-route"


def raw_answerer(network: NetworkConfig, pipe: Connection) -> None:
    """Joins when asked to; then answers raw queries with as many bytes as each asks for, until told to end."""
    pipe.send("ready")
    if pipe.recv() == "end":
        return

    def answer(query: zenoh.Query) -> None:
        query.payload.to_bytes()  # type: ignore[union-attr]
        query.reply(_KEY, bytes(int(query.parameters["bytes"] or 0)))
        query.drop()  # type: ignore[no-untyped-call]

    with open_bus(network) as bus:
        kept = read_on_thread(bus.session.declare_queryable(_KEY, zenoh.handlers.FifoChannel(64)), answer)
        pipe.send("joined")
        pipe.recv()
        del kept


def route_client(network: NetworkConfig, pipe: Connection) -> None:
    """Joins when asked to; then asks for routes, and raw, in turn.

    Answers (targets, cells, route_cells, seconds, seed) with quantiles in microseconds, and ours over raw.
    """
    pipe.send("ready")
    if pipe.recv() == "end":
        return
    with open_bus(network) as bus:
        inbox = Inbox()
        pipe.send("joined")
        while (question := pipe.recv()) != "end":
            pipe.send(_ask_for(bus, inbox, *question))


def _ask_for(
    bus: ZenohBus, inbox: Inbox, targets: list[str], cells: list[int], route_cells: int, seconds: float, seed: int
) -> dict[str, Any]:
    chance = random.Random(seed)
    ours_us: list[float] = []
    raw_us: list[float] = []
    reply_bytes: list[int] = []
    unanswered = 0
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        request = RouteRequest(cells=[chance.choice(cells)], max_cells=route_cells)
        began_ns = time.monotonic_ns()
        reply = ask_route(bus, inbox, request, chance.choice(targets), _LONGEST_S)
        took_us = (time.monotonic_ns() - began_ns) / 1e3
        time.sleep(_EVERY_S / 2)
        raw_took_us = None if reply is None else _raw(bus, request, reply)
        if reply is None or raw_took_us is None:
            unanswered += 1
        else:
            ours_us.append(took_us)
            raw_us.append(raw_took_us)
            reply_bytes.append(len(encode(reply)))
        time.sleep(_EVERY_S / 2)
    mean_bytes = round(float(np.mean(reply_bytes))) if reply_bytes else None
    told = {"queries": len(ours_us), "unanswered": unanswered, "reply_bytes": mean_bytes}
    return {**told, **beside(ours_us, raw_us, "us")}


def _raw(bus: ZenohBus, request: RouteRequest, reply: RouteReply) -> float | None:
    """Microseconds of a get which carries as many bytes both ways."""
    asked, size = encode(request), len(encode(reply))
    began_ns = time.monotonic_ns()
    answers = bus.session.get(
        f"{_KEY}?bytes={size}", zenoh.handlers.FifoChannel(4), payload=asked, timeout=_LONGEST_S
    )
    sizes = [len(each.ok.payload.to_bytes()) for each in answers if each.ok is not None]
    return (time.monotonic_ns() - began_ns) / 1e3 if sizes == [size] else None
