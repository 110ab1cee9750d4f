"""The tables of the cost model, for a terminal and for the page: a title, columns, rows, remarks. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from bench.scaling.check import Compared, without_each
from bench.scaling.cost_model import Fitted
from bench.scaling.model import ROLES, Model, Row
from bench.scaling.needs import (
    Machine,
    Needs,
    TooMuchError,
    crossings_of,
    fewest_machines,
    needs,
    too_much,
)
from bench.scaling.quantities import Quantities, quantities_of
from bench.scaling.terms import ALL_CHANGES, CHANGES, SENT, WORK
from bench.tables import number
from bench.whole_swarm.size import Size, size_of

MACHINE = Machine(cores=16, memory_gb=64, link_mbit_per_s=1000)
"""The kind of machine that the page reckons with."""
GOAL = size_of(100_000, 1000, per_agent=200)
"""What the page is about: 100,000 vehicles, 1,000 targets; on 100 machines."""
GOAL_MACHINES = 100
_SIZES = ((1000, 10, 1), (10_000, 100, 1), (10_000, 100, 10), (100_000, 1000, 10), (100_000, 1000, 100))
_SHARDS = (1, 4, 10, 25, 50, 100, 200)
NAMES = ("check", "sent", "work", "needs", "growth", "first", "changes", "shards")
"""Of all tables, in the order of the page."""
_KIND = f"{MACHINE.cores} cores, {MACHINE.memory_gb:g} GB and {MACHINE.link_mbit_per_s:,.0f} Mbit/s"
_FIRST = (
    f"A target for each 100 vehicles, a machine of {_KIND} for each 1,000. Full is a process that takes over 60 % "
    "of a core, a machine over 60 % of its cores or memory, a link over half."
)
_POWER = (
    "*Power*: by which what is delivered grows, from a tenth of all to the whole, and from a tenth of the vehicles "
    "and agents with all targets."
)
_PARTS = (
    f"Vehicles, targets and machines of each part, of {_KIND}; machines and cores of all; the link of a part's "
    "first machine; the process which takes most of a core. `-`: no number of machines carries it."
)


@dataclass(frozen=True)
class Block:
    """One table.

    wide  for the page only: it does not fit a terminal
    """

    name: str
    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    remarks: Sequence[str] = field(default=())
    wide: bool = False


def sent_block(model: Model) -> Block:
    """Each row of the table of messages with its coefficients."""
    rows = [
        [
            f"`{sent.topic}`, {sent.source}",
            _sum(messages),
            _sum(size),
            ", ".join(f"{role}: {who}" if who != f"{role}s" else who for role, who in sent.to.items()),
            sent.why,
        ]
        for sent, (messages, size) in zip(SENT, model.sent, strict=True)
    ]
    return Block(
        "sent",
        "Sent a second, each message once",
        ("topic, sender", "messages", "bytes", "a copy to", "what"),
        rows,
        wide=True,
    )


def work_block(model: Model) -> Block:
    """Each role with its coefficients."""
    rows = [[work.role, _sum(model.cpu[work.role]), _sum(model.memory[work.role]), work.why] for work in WORK]
    return Block(
        "work",
        "CPU and memory of all processes of a role",
        ("role", "ms of CPU a second", "MB", "what"),
        rows,
        wide=True,
    )


def check_block(compared: Sequence[Compared], rows: Sequence[Row]) -> Block:
    """How wrong the model is: median and worst error of each figure."""
    lines = []
    for figure in dict.fromkeys(each.figure for each in compared):
        cells = [figure]
        for held_out in (True, False):
            errors = sorted(each.error for each in compared if each.figure == figure and each.held_out is held_out)
            cells += [_percent(errors[len(errors) // 2]), _percent(errors[-1])] if errors else ["-", "-"]
        lines.append(cells)
    simulated = sum(row.run.kind == "simulated" for row in rows)
    machines = sorted(
        {f"{row.machine['cores']} x {row.machine['machine']}" for row in rows if row.run.kind == "live"}
    )
    loads = [row.machine["load"] for row in rows if row.run.kind == "live"]
    remark = (
        f"{simulated} simulations and {len(rows) - simulated} live runs, those on {', '.join(machines) or '-'}, "
        f"load {min(loads, default=0):g} to {max(loads, default=0):g}."
    )
    return Block(
        "check",
        "Median errors in runs that the fit has not seen",
        ("error, %", "held out", "worst", "left out", "worst"),
        lines,
        [remark],
    )


def needs_block(model: Model, rows: Sequence[Row]) -> Block:
    """What swarms need; beyond the largest that was measured it is extrapolated, and marked."""
    cells, spans = [], []
    others = without_each(rows)
    for vehicles, targets, machines in _SIZES:
        size = size_of(vehicles, targets, per_agent=200)
        found = needs(model, size, machines)
        cells.append((found, extrapolated(found, rows)))
        spans.append(span_of_cores(others, found))
    lines = [
        ["targets", *(f"{found.size.targets:,}" for found, _ in cells)],
        ["machines", *(f"{found.machines:,}" for found, _ in cells)],
        ["agents", *(f"{found.size.agents:,}" for found, _ in cells)],
        ["cells a side", *(f"{found.size.side:,}" for found, _ in cells)],
        ["cores, any one run left out", *spans],
        *_needs_lines([found for found, _ in cells]),
        ["extrapolated", *("yes" if extrapolated else "no" for _, extrapolated in cells)],
    ]
    headings = ["vehicles", *(f"{found.size.vehicles:,}" for found, _ in cells)]
    return Block("needs", "What swarms need", headings, lines)


def span_of_cores(models: Sequence[Model], found: Needs) -> str:
    """The least and the most cores that any of the models says of the same swarm."""
    cores = [needs(model, found.size, found.machines).cores for model in models]
    return f"{number(min(cores))} to {number(max(cores))}"


def size_block(found: Needs, others: Sequence[Model]) -> Block:
    """What one swarm needs, role by role."""
    lines = [["cores, any one run left out", span_of_cores(others, found)], *map(list, _needs_lines([found]))]
    return Block("size", "What this swarm needs", ("", f"{found.machines:,} machines"), lines)


def first_block(model: Model) -> Block:
    """What is full first on the way to the goal: the least number of vehicles at which each limit is met, with a
    target for each 100 vehicles and a machine for each 1,000."""
    vehicles = [round(1000 * 10 ** (step / 10)) for step in range(21)]
    met: dict[str, str] = {}
    for count in vehicles:
        size = size_of(count, max(count // 100, 1), per_agent=200)
        for each in too_much(needs(model, size, max(count // 1000, 1)), MACHINE):
            what = each.partition(" takes")[0].partition(":")[0]
            met.setdefault(what, f"{count:,}")
    lines = [[what, count] for what, count in met.items()]
    return Block(
        "first",
        "What is full first",
        ("full", "from so many vehicles on"),
        lines,
        [_FIRST],
    )


def growth_block(model: Model) -> Block:
    """By which power each topic's delivered bytes grow from a tenth of the goal to the goal, and what they are."""
    tenth = size_of(GOAL.vehicles // 10, GOAL.targets // 10, per_agent=GOAL.per_agent)
    few = size_of(GOAL.vehicles // 10, GOAL.targets, per_agent=GOAL.per_agent)
    at_goal, at_tenth, at_few = (_delivered(model, size) for size in (GOAL, tenth, few))
    crossed = {
        (sent.topic, sent.source): (messages, size)
        for sent, messages, size in crossings_of(
            model.flows(_q(GOAL, GOAL_MACHINES)), _q(GOAL, GOAL_MACHINES), GOAL_MACHINES
        )
    }
    all_messages = sum(each[0] for each in at_goal.values())
    all_bytes = sum(each[1] for each in at_goal.values())
    lines = []
    for key in sorted(at_goal, key=lambda each: -at_goal[each][1]):
        messages, size = at_goal[key]
        lines.append(
            [
                f"`{key[0]}`, {key[1]}",
                number(messages),
                _percent(messages / all_messages),
                number(size / 1e6),
                _percent(size / all_bytes),
                number(crossed[key][1] / 1e6),
                _power(at_tenth[key][1], size),
                _power(at_few[key][1], size),
            ]
        )
    return Block(
        "growth",
        "Delivered in the goal's swarm",
        (
            "topic, sender",
            "messages/s",
            "% of all",
            "MB/s",
            "% of all",
            "MB/s between machines",
            "power, all together",
            "power, vehicles alone",
        ),
        lines,
        [_POWER],
        wide=True,
    )


def changes_block(model: Model) -> Block:
    """What the goal's swarm would need if the protocol were changed."""
    lines = []
    for name, change in [*CHANGES.items(), ("all of these", ALL_CHANGES)]:
        found = needs(model, GOAL, GOAL_MACHINES, change=change)
        lines.append(
            [
                name,
                number(found.cores),
                *(number(found.cpu_cores[role]) for role in ("agent", "planner", "router", "launcher")),
                number(found.crossings_per_s),
                number(found.link_mbit_per_s),
            ]
        )
    return Block(
        "changes",
        "The goal's swarm if the protocol were changed",
        ("change", "cores", "agents", "planners", "routers", "launchers", "messages/s", "Mbit/s"),
        lines,
        ["Messages from machine to machine, and Mbit/s into each."],
        wide=True,
    )


def shards_block(model: Model) -> Block:
    """The goal's swarm cut into swarms of regions that know nothing of each other, at the same density."""
    lines = []
    for shards in _SHARDS:
        size = size_of(GOAL.vehicles // shards, GOAL.targets // shards, per_agent=GOAL.per_agent)
        try:
            found = fewest_machines(model, size, MACHINE)
        except TooMuchError as error:
            why = "; ".join(error.full)
            lines.append([f"{shards:,}", f"{size.vehicles:,}", f"{size.targets:,}", *["-"] * 4, why])
            continue
        worst = max((share, role) for role, share in found.process.items() if role != "router")
        lines.append(
            [
                f"{shards:,}",
                f"{size.vehicles:,}",
                f"{size.targets:,}",
                f"{found.machines:,}",
                f"{found.machines * shards:,}",
                number(found.cores * shards),
                number(found.first_link_mbit_per_s),
                f"{worst[1]}: {worst[0]:.2f}",
            ]
        )
    return Block(
        "shards",
        "The goal's swarm in parts",
        (
            "parts",
            "vehicles",
            "targets",
            "machines",
            "in all",
            "cores",
            "Mbit/s",
            "fullest process",
        ),
        lines,
        [_PARTS],
        wide=True,
    )


def blocks(model: Model, compared: Sequence[Compared], rows: Sequence[Row]) -> list[Block]:
    """All tables, in the order of the page."""
    return [
        check_block(compared, rows),
        sent_block(model),
        work_block(model),
        needs_block(model, rows),
        growth_block(model),
        first_block(model),
        changes_block(model),
        shards_block(model),
    ]


def _needs_lines(found: Sequence[Needs]) -> Iterator[list[str]]:
    yield ["cores, all machines", *(number(each.cores) for each in found)]
    for role in ROLES:
        yield [f"  {role}", *(number(each.cpu_cores[role]) for each in found)]
    yield ["cores, a machine", *(number(each.machine_cores) for each in found)]
    yield ["cores, the first", *(number(each.first_cores) for each in found)]
    yield ["memory, a machine, GB", *(number(each.memory_gb) for each in found)]
    yield ["memory, the first, GB", *(number(each.first_memory_gb) for each in found)]
    yield ["between machines, messages/s", *(number(each.crossings_per_s) for each in found)]
    yield ["link of a machine, in, Mbit/s", *(number(each.link_mbit_per_s) for each in found)]
    yield ["link of the first, in, Mbit/s", *(number(each.first_link_mbit_per_s) for each in found)]
    yield ["out, routers each with each, Mbit/s", *(number(each.link_mbit_per_s) for each in found)]
    yield ["out, by a router of the region, Mbit/s", *(number(each.link_out_mbit_per_s) for each in found)]
    yield ["sessions of a router", *(f"{each.sessions:,}" for each in found)]


def _delivered(model: Model, size: Size) -> dict[tuple[str, str], tuple[float, float]]:
    found: dict[tuple[str, str], tuple[float, float]] = {}
    for flow in model.flows(_q(size, GOAL_MACHINES)):
        key = flow.sent.topic, flow.sent.source
        messages, bytes = found.get(key, (0.0, 0.0))
        found[key] = messages + flow.messages, bytes + flow.bytes
    return found


def _q(size: Size, machines: int) -> Quantities:
    return quantities_of(size, machines=machines)


def _power(tenth: float, whole: float) -> str:
    return f"{math.log10(whole / tenth):.2f}" if tenth > 0 and whole > 0 else "-"


def extrapolated(found: Needs, rows: Sequence[Row]) -> bool:
    live = [row.run.size for row in rows if row.run.kind == "live"]
    size = found.size
    return found.machines > 1 or any(
        getattr(size, name) > max((getattr(each, name) for each in live), default=0)
        for name in ("vehicles", "targets", "agents", "side")
    )


def _sum(fitted: Fitted) -> str:
    shown = [f"{each:.3g} {name}" for name, each in fitted.coefficients.items() if each > 0]
    return " + ".join(shown) or "0"


def _percent(share: float) -> str:
    return f"{100 * share:.0f}" if share >= 0.0095 or share == 0 else f"{100 * share:.1f}"
