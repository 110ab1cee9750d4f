"""The cost model: fitted to measurements, and asked for swarms of any size. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from bench.scaling.cost_model import Fitted, Terms, fit
from bench.scaling.design import Run
from bench.scaling.quantities import Quantities, quantities_of
from bench.scaling.terms import (
    HEARERS,
    KINDS_OF_BYTES,
    NO_CHANGE,
    PUT,
    SENT,
    TERMS,
    WORK,
    Change,
    Sent,
    one,
)

ROLES = tuple(work.role for work in WORK)


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One measurement as it is kept: the run, its figures and the machine."""

    run: Run
    figures: dict[str, Any]
    machine: dict[str, Any]


@dataclass(frozen=True)
class Flow:
    """What one role sends on one topic to another, in a second: each put once, and each copy that is taken."""

    sent: Sent
    to: str
    puts: float
    put_bytes: float
    copies: float

    @property
    def messages(self) -> float:
        return self.puts * self.copies

    @property
    def bytes(self) -> float:
        return self.put_bytes * self.copies


@dataclass(frozen=True)
class Model:
    """Fitted costs.

    sent    of each row of `SENT`: messages, bytes
    cpu     role -> ms of CPU a second
    memory  role -> MB
    """

    sent: Sequence[tuple[Fitted, Fitted]]
    cpu: Mapping[str, Fitted]
    memory: Mapping[str, Fitted]

    def flows(self, q: Quantities, change: Change = NO_CHANGE) -> list[Flow]:
        values = term_values(q)

        def scale(sent: Sent, to: str) -> float:
            return change.get((sent.topic, sent.source, to), one)(q)

        return [
            Flow(
                sent,
                to,
                messages.at(values) * scale(sent, PUT),
                size.at(values) * scale(sent, PUT),
                HEARERS[many](q) * scale(sent, to),
            )
            for sent, (messages, size) in zip(SENT, self.sent, strict=True)
            for to, many in sent.to.items()
        ]

    def cpu_ms_per_s(self, q: Quantities, change: Change = NO_CHANGE) -> dict[str, float]:
        flows = self.flows(q, change)
        return {role: each.at(work_values(q, flows, role)) for role, each in self.cpu.items()}

    def memory_mb(self, q: Quantities) -> dict[str, float]:
        values = term_values(q)
        return {role: each.at(values) for role, each in self.memory.items()}


def fit_sent(rows: Sequence[Row]) -> Model:
    """The messages, of counts in simulations; roles are left empty."""
    values = [term_values(simulated_quantities(row.run)) for row in rows]

    def fitted(sent: Sent, terms: Terms, figure: str) -> Fitted:
        return fit(terms, values, [_put(row, sent, figure) for row in rows])

    return Model(
        [(fitted(each, each.messages, "messages_per_s"), fitted(each, each.bytes, "bytes_per_s")) for each in SENT],
        {},
        {},
    )


def fit_work(model: Model, rows: Sequence[Row]) -> Model:
    """CPU and memory of roles, of live runs; messages are those that the model says."""
    quantities = [live_quantities(row.run) for row in rows]
    flows = [model.flows(q) for q in quantities]

    def fitted(terms: Callable[[Any], Terms], figure: str) -> dict[str, Fitted]:
        return {
            work.role: fit(
                terms(work),
                [work_values(q, flow, work.role) for q, flow in zip(quantities, flows, strict=True)],
                [row.figures[figure].get(work.role, 0.0) for row in rows],
            )
            for work in WORK
        }

    return Model(
        model.sent, fitted(lambda work: work.cpu, "cpu_ms_per_s"), fitted(lambda work: work.memory, "pss_mb")
    )


def simulated_quantities(run: Run) -> Quantities:
    """A simulation has no monitor and no router; what watches it stands for the launcher."""
    return quantities_of(run.size, monitors=0)


def live_quantities(run: Run) -> Quantities:
    return quantities_of(run.size)


def term_values(q: Quantities) -> dict[str, float]:
    return {name: value(q) for name, value in TERMS.items()}


def work_values(q: Quantities, flows: Sequence[Flow], role: str) -> dict[str, float]:
    """Terms, with what a role sends and takes; the router takes every message that leaves a process once, and sends
    each copy."""
    puts = {(flow.sent.topic, flow.sent.source): (flow.puts, flow.put_bytes) for flow in flows}
    if role == "router":
        out = sum(each[0] for each in puts.values()), sum(each[1] for each in puts.values())
        taken = list(flows)
    else:
        own = [each for (_, source), each in puts.items() if source == role]
        out = sum(each[0] for each in own), sum(each[1] for each in own)
        taken = [flow for flow in flows if flow.to == role]
    moved: dict[str, float] = {"map": 0.0, "costs": 0.0, "other": 0.0}
    for flow in taken:
        moved[KINDS_OF_BYTES.get(flow.sent.topic, "other")] += flow.bytes
    for (topic, source), (_, size) in puts.items():
        if source == role or role == "router":
            moved[KINDS_OF_BYTES.get(topic, "other")] += size
    return {
        **term_values(q),
        "messages": out[0] + sum(flow.messages for flow in taken),
        "bytes": sum(moved.values()),
        **{f"{kind} bytes": size for kind, size in moved.items()},
    }


def _put(row: Row, sent: Sent, figure: str) -> float:
    """What a simulation counted of one row of the table; 0 if there was none."""
    return sum(
        float(each[figure])
        for each in row.figures["puts"]
        if each["topic"] == sent.topic and each["source"] == sent.source
    )
