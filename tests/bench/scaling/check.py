"""How wrong the model is: against simulations and live runs that it was not fitted to. Pure.

Two checks. *Held out*: runs that no fit ever uses, most of them larger than those of the fit. *Left out*: each run
of the fit, predicted by a fit to all others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from bench.scaling.cost_model import relative_error
from bench.scaling.model import (
    ROLES,
    Model,
    Row,
    fit_sent,
    fit_work,
    live_quantities,
    simulated_quantities,
)
from bench.scaling.needs import crossings_of
from bench.whole_swarm.figures import keeps_pace
from swarm.errors import ConfigError

_COUNTED = ("agent", "planner", "keeper")
"""Roles whose buses count every message: what only watches passes over some, and a router counts none."""


@dataclass(frozen=True)
class Compared:
    """One figure of one run: what was measured, what the model says, and whether the run is held out."""

    run: str
    figure: str
    measured: float
    said: float
    held_out: bool

    @property
    def error(self) -> float:
        return relative_error(self.said, self.measured)


def usable(rows: Sequence[Row]) -> tuple[list[Row], list[str]]:
    """Rows whose rates say what a swarm costs, and why the others do not."""
    kept, said = [], []
    for row in rows:
        if row.run.kind == "simulated" and not row.figures["complete"]:
            said.append(f"{row.run.key}: the simulation was not done within its limit of CPU")
        elif row.run.kind == "live" and not keeps_pace(row.figures):
            late = 100 * row.figures["ticks"]["agent"]["late_share"]
            said.append(f"{row.run.key}: {late:.0f} % of agents' ticks were late, so it did less than it should")
        elif row.run.kind == "live" and row.figures["routed_share"] < 1:
            said.append(f"{row.run.key}: not every vehicle was answered before the measurement")
        else:
            kept.append(row)
    return kept, said


def model_of(rows: Sequence[Row]) -> Model:
    """The model, fitted to the rows that are for it. Raises ConfigError if there are none of a kind."""
    simulated, live = _of(rows, "simulated", "fit"), _of(rows, "live", "fit")
    if not simulated or not live:
        lacking = "simulations" if not simulated else "live runs"
        raise ConfigError(f"the cost model has no measurements of {lacking}: run ./launch_scripts/bench scaling")
    return fit_work(fit_sent(simulated), live)


def without_each(rows: Sequence[Row]) -> list[Model]:
    """A model without each of the live runs of the fit: how far they differ says how sure the whole is."""
    live = _of(rows, "live", "fit")
    sent = fit_sent(_of(rows, "simulated", "fit"))
    return [fit_work(sent, _without(live, row)) for row in live]


def compare(rows: Sequence[Row]) -> list[Compared]:
    """Every figure of every run beside what a model says that has not seen the run."""
    simulated, live = _of(rows, "simulated", "fit"), _of(rows, "live", "fit")
    model = model_of(rows)
    found: list[Compared] = []
    for row in _of(rows, "simulated", "check"):
        found += _of_simulated(model, row, held_out=True)
    for row in _of(rows, "live", "check"):
        found += _of_live(model, row, held_out=True)
    for row in simulated:
        found += _of_simulated(fit_sent(_without(simulated, row)), row, held_out=False)
    sent = fit_sent(simulated)
    for row in live:
        found += _of_live(fit_work(sent, _without(live, row)), row, held_out=False)
    return found


def summary(compared: Sequence[Compared], wanted: Callable[[Compared], bool] = lambda _: True) -> dict[str, float]:
    """Figure -> median error. In the order in which figures come."""
    figures = list(dict.fromkeys(each.figure for each in compared if wanted(each)))
    return {
        figure: median(each.error for each in compared if each.figure == figure and wanted(each))
        for figure in figures
    }


def _of_simulated(model: Model, row: Row, *, held_out: bool) -> list[Compared]:
    q = simulated_quantities(row.run)
    flows = model.flows(q)
    counted = row.figures["flows"]
    found = [
        ("messages", sum(each["messages_per_s"] for each in counted), sum(flow.messages for flow in flows)),
        ("bytes", sum(each["bytes_per_s"] for each in counted), sum(flow.bytes for flow in flows)),
    ]
    for machines, crossings in row.figures["crossings"].items():
        said = list(crossings_of(flows, q, int(machines)))
        measured = crossings.values()
        found.append(
            (f"messages, {machines} machines", sum(each[0] for each in measured), sum(each[1] for each in said))
        )
        found.append(
            (f"bytes, {machines} machines", sum(each[1] for each in measured), sum(each[2] for each in said))
        )
    return [Compared(row.run.key, name, measured, said, held_out) for name, measured, said in found]


def _of_live(model: Model, row: Row, *, held_out: bool) -> list[Compared]:
    q = live_quantities(row.run)
    flows = [flow for flow in model.flows(q) if flow.to in _COUNTED]
    figures = row.figures
    traffic = [each for role, each in figures["traffic"].items() if role in _COUNTED]
    cpu, memory = model.cpu_ms_per_s(q), model.memory_mb(q)
    measured_cpu = {role: figures["cpu_ms_per_s"].get(role, 0.0) for role in ROLES}
    measured_memory = {role: figures["pss_mb"].get(role, 0.0) for role in ROLES}
    found = [
        ("CPU", sum(measured_cpu.values()), sum(cpu.values())),
        *((f"CPU, {role}", measured_cpu[role], cpu[role]) for role in ROLES),
        ("memory", sum(measured_memory.values()), sum(memory.values())),
        ("messages taken", sum(each["messages_in"] for each in traffic), sum(flow.messages for flow in flows)),
        ("bytes taken", sum(each["bytes_in"] for each in traffic), sum(flow.bytes for flow in flows)),
    ]
    return [Compared(row.run.key, name, measured, said, held_out) for name, measured, said in found]


def _of(rows: Sequence[Row], kind: str, use: str) -> list[Row]:
    return [row for row in rows if row.run.kind == kind and row.run.use == use]


def _without(rows: Sequence[Row], out: Row) -> list[Row]:
    return [row for row in rows if row is not out]
