"""What a swarm needs on several machines: cores, memory and bytes on links of each, and what is full first. Pure.

Agents and planners go to machines in equal blocks; keeper, targets and monitor run on the first. Each machine has a
router and a launcher, that of the first records, and every router is linked with every other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bench.scaling.model import Flow, Model, term_values, work_values
from bench.scaling.quantities import Quantities, quantities_of
from bench.scaling.terms import NO_CHANGE, Change, Sent
from bench.whole_swarm.size import Size
from swarm.errors import ConfigError

USED_SHARE = 0.6
"""Of the cores of a machine, and of one core by a process: beyond it work waits (decision 58)."""
LINK_SHARE = 0.5
"""Of a link's capacity."""
OVERHEAD_BYTES = 100
"""Of a message on a link: key, Zenoh's and TCP/IP's headers. Assumed, not measured."""
MOST_MACHINES = 2000
MOST_SESSIONS = 8192
"""`transport/unicast/max_sessions` of a router (swarm/bus/zenoh_config.py)."""
SINGLE = ("targets", "keeper", "monitor")
"""Roles of one process, all on the first machine."""


class TooMuchError(ConfigError):
    """No number of machines carries a swarm.

    full  what is full on each of the most machines
    """

    def __init__(self, full: Sequence[str]) -> None:
        super().__init__(f"no number of machines up to {MOST_MACHINES} carries this swarm: {'; '.join(full)}")
        self.full = full


@dataclass(frozen=True)
class Machine:
    """A kind of machine."""

    cores: int
    memory_gb: float
    link_mbit_per_s: float


@dataclass(frozen=True)
class Needs:
    """What a swarm takes on so many machines.

    cpu_cores        role -> cores of all its processes, all machines together
    process          role -> share of a core that one process takes; of launchers the one that records
    machine_cores    cores that work on each machine
    first_cores      on the first
    memory_gb, first_memory_gb  of each machine, of the first
    crossings_per_s  messages from one machine to another
    link_mbit_per_s, first_link_mbit_per_s  into each machine, and as much out of it where each router is linked
                     with each other; into the first
    link_out_mbit_per_s  out of each machine where a router of the region passes on: each message leaves once
    sessions         of a machine's router
    """

    size: Size
    machines: int
    cpu_cores: dict[str, float]
    process: dict[str, float]
    machine_cores: float
    first_cores: float
    memory_gb: float
    first_memory_gb: float
    crossings_per_s: float
    link_mbit_per_s: float
    link_out_mbit_per_s: float
    first_link_mbit_per_s: float
    sessions: int

    @property
    def cores(self) -> float:
        return sum(self.cpu_cores.values())


def needs(
    model: Model, size: Size, machines: int, *, standbys: int = 0, monitors: int = 1, change: Change = NO_CHANGE
) -> Needs:
    """What the model says of a swarm on so many machines, with the protocol as it is or changed."""
    q = quantities_of(size, standbys=standbys, monitors=monitors, machines=machines)
    flows = model.flows(q, change)
    crossings = list(crossings_of(flows, q, machines))
    crossed = sum(messages for _, messages, _ in crossings)
    crossed_bytes = sum(each for _, _, each in crossings)
    cpu = {role: each / 1000 for role, each in model.cpu_ms_per_s(q, change).items()}
    cpu["router"] += _router_cores(model, crossed, crossed_bytes)
    records = _recorder_cores(model, q, flows, machines)
    watches = (cpu["launcher"] - records) / (machines - 1) if machines > 1 else 0.0
    count = {
        "agent": q.agents,
        "planner": q.planners,
        "router": machines,
        "targets": 1,
        "keeper": q.keepers,
        "monitor": max(monitors, 1),
    }
    shared_cores = sum(each for role, each in cpu.items() if role not in (*SINGLE, "launcher")) / machines
    # A process takes one core at most, and falls behind.
    single = min(records, 1.0) + sum(min(cpu[role], 1.0) for role in SINGLE)
    memory = _memory_gb(model, q, machines)
    leaving = sum(
        min(1.0, reached) * (first.put_bytes + OVERHEAD_BYTES * first.puts)
        for first, reached in _reached(flows, q, machines)
    )
    mbit = 8e-6 * (crossed_bytes + OVERHEAD_BYTES * crossed) / machines
    return Needs(
        size=size,
        machines=machines,
        cpu_cores=cpu,
        process={role: records if role == "launcher" else cpu[role] / count[role] for role in cpu},
        machine_cores=shared_cores + (watches if machines > 1 else records),
        first_cores=shared_cores + single,
        memory_gb=memory[0],
        first_memory_gb=memory[1],
        crossings_per_s=crossed,
        link_mbit_per_s=mbit,
        link_out_mbit_per_s=8e-6 * leaving / machines,
        first_link_mbit_per_s=_first_link_mbit_per_s(flows, q, machines),
        sessions=math.ceil((q.agents + q.planners) / machines) + len(SINGLE) + 1 + machines - 1,
    )


def crossings_of(flows: Sequence[Flow], q: Quantities, machines: int) -> Iterator[tuple[Sent, float, float]]:
    """For each row of the table: messages and bytes a second from one machine to another, where each goes once to
    each machine that has somebody who takes it."""
    for first, reached in _reached(flows, q, machines):
        yield first.sent, first.puts * reached, first.put_bytes * reached


def _reached(flows: Sequence[Flow], q: Quantities, machines: int) -> Iterator[tuple[Flow, float]]:
    """One flow of each row of the table, and how many other machines one of its messages goes to."""
    rows: dict[int, list[Flow]] = {}
    for flow in flows:
        rows.setdefault(id(flow.sent), []).append(flow)
    for same in rows.values():
        missed = math.prod(1.0 - reached_share(flow, q, machines) for flow in same)
        yield same[0], (machines - 1) * (1.0 - missed)


def reached_share(flow: Flow, q: Quantities, machines: int) -> float:
    """How probably a given other machine has a process of the role that takes a message."""
    if machines == 1:
        return 0.0
    who = flow.sent.to[flow.to]
    if flow.copies == 0:
        return 0.0
    if who == "launchers":
        return min(1.0, flow.copies / machines)
    if who == "agents near":
        # Who holds a region next to each other hold agents that are next to each other in order.
        span = (flow.copies - 1) / max(q.agents / machines, 1.0)
        return min(1.0, span / (machines - 1))
    if flow.to in ("agent", "planner"):
        return min(1.0, flow.copies / machines)
    return 1 / machines  # on the first, whichever machine sends


def _first_link_mbit_per_s(flows: Sequence[Flow], q: Quantities, machines: int) -> float:
    """Into the first machine: what a process takes that runs there alone comes from all others, once however many
    take it; all else is shared out as on the other machines."""
    alone = {
        id(flow.sent)
        for flow in flows
        if (flow.to in SINGLE or flow.to == "launcher") and flow.sent.source in ("agent", "planner")
    }
    elsewhere = 1 - 1 / machines
    return 8e-6 * sum(
        (first.put_bytes + OVERHEAD_BYTES * first.puts)
        * (elsewhere if id(first.sent) in alone else reached / machines)
        for first, reached in _reached(flows, q, machines)
    )


def _recorder_cores(model: Model, q: Quantities, flows: Sequence[Flow], machines: int) -> float:
    """Of the launcher that records: it takes a copy of all that launchers hear, and has a machine's share of the
    processes."""
    heard = [flow for flow in flows if flow.to == "launcher"]
    values = {
        **term_values(q),
        "launchers": 1.0,
        "processes": term_values(q)["processes"] / machines,
        "messages": sum(flow.puts for flow in heard),
        "bytes": sum(flow.put_bytes for flow in heard),
    }
    return sum(each * values[term] for term, each in model.cpu["launcher"].coefficients.items()) / 1000


def _router_cores(model: Model, messages: float, size: float) -> float:
    """A message between machines passes one router more: in and out."""
    router = model.cpu["router"].coefficients
    return (2 * messages * router.get("messages", 0.0) + 2 * size * router.get("bytes", 0.0)) / 1000


def _memory_gb(model: Model, q: Quantities, machines: int) -> tuple[float, float]:
    """Of one machine and of the first. What processes share is there once on each machine."""
    each = first = 0.0
    shares = {
        "agents": 1 / machines,
        "vehicles": 1 / machines,
        "planners": 1 / machines,
        "planners x cells": 1 / machines,
        "processes": 1 / machines,
        "launchers": 1 / machines,
        "cells": 1.0,
    }
    values = term_values(q)
    for role, fitted in model.memory.items():
        mb = sum(
            coefficient * values[term] * (1.0 if role in SINGLE else shares[term])
            for term, coefficient in fitted.coefficients.items()
        )
        first += mb
        each += 0.0 if role in SINGLE else mb
    return each / 1000, first / 1000


def fewest_machines(model: Model, size: Size, machine: Machine, *, standbys: int = 0) -> Needs:
    """The fewest machines of a kind that carry a swarm. Raises TooMuchError if no number does."""
    machines = 1
    while machines <= MOST_MACHINES:
        found = needs(model, size, machines, standbys=standbys)
        full = [each for each in too_much(found, machine) if not each.startswith("one ")]
        if not full:
            return found
        machines += max(1, machines // 50)
    raise TooMuchError(full)


def too_much(found: Needs, machine: Machine) -> list[str]:
    """What is fuller than it may be, in sentences; those that begin with "one" no further machine mends."""
    said = [
        f"one {role} process takes {share:.2f} of a core"
        for role, share in sorted(found.process.items(), key=lambda each: -each[1])
        if share > USED_SHARE and role != "router"
    ]
    if found.first_cores > USED_SHARE * machine.cores:
        said.append(f"cores: {found.first_cores:.1f} of {machine.cores}")
    if found.first_memory_gb > USED_SHARE * machine.memory_gb:
        said.append(f"memory: {found.first_memory_gb:.1f} of {machine.memory_gb:g} GB")
    if found.first_link_mbit_per_s > LINK_SHARE * machine.link_mbit_per_s:
        said.append(f"link: {found.first_link_mbit_per_s:,.0f} of {machine.link_mbit_per_s:,.0f} Mbit/s")
    if found.sessions > MOST_SESSIONS:
        said.append(f"sessions of a router: {found.sessions} of {MOST_SESSIONS}")
    return said


def work_of(model: Model, q: Quantities, role: str) -> dict[str, float]:
    """Term -> ms of CPU a second that a role spends on it."""
    values = work_values(q, model.flows(q), role)
    return {name: each * values[name] for name, each in model.cpu[role].coefficients.items()}
