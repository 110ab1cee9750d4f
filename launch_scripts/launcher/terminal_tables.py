"""Tables for the terminal: a run, its targets, what its processes take up; and a run in one line."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from launch_scripts.observe import fact_table as facts
from launch_scripts.observe.run_state import RunState, TargetLine
from launch_scripts.observe.summed_counts import ProcessLoad, sum_of
from launch_scripts.process_table import ROLES

SHOWN_ALARMS = 5
"""More would leave too few lines of a terminal of 24 for figures and targets."""
_FEWEST_TARGETS = 3
"""Lines of targets where the terminal has no room for any: two targets and how many more there are."""


def live_table(state: RunState, title: str, console: Console) -> Group:
    """The table of one instant, as wide and as high as the console allows: lines that are too long go on in the
    next, and of many targets the first are shown."""
    crew = Text("")
    for role, (alive, every) in state.crew.items():
        crew.append(f"{role} {alive}/{every}  ", style="green" if alive == every else "bold red")
    for role, alive in state.beside.items():
        crew.append(f"{role} {alive}  ", style="green")
    alarms = (Text(line, style="red") for line in facts.alarm_lines(state, SHOWN_ALARMS))
    return fitted(state, [Text(title, style="bold"), *map(Text, facts.lines(state)), crew, *alarms], console)


def fitted(state: RunState, above: list[RenderableType], console: Console) -> Group:
    """Fits the lines to the console: the fixed lines, and below them as many targets as there is room for."""
    options = console.options.update(no_wrap=False, overflow="fold")
    used = len(console.render_lines(Group(*above), options, pad=False))
    targets = targets_table(state, max(console.height - used - 3, _FEWEST_TARGETS))
    return Group(*above, Text(), targets)


def targets_table(state: RunState, most: int) -> Table:
    """A line for each target, `most` at most."""
    labels, rows = facts.table(state)
    shown = columns(*labels)
    kept = most if len(rows) <= most else most - 1
    for line, row in list(zip(state.targets, rows, strict=True))[:kept]:
        shown.add_row(*row, style=_style(line))
    if len(rows) > kept:
        shown.add_row(f"... {len(rows) - kept} more")
    return shown


def columns(*labels: str) -> Table:
    """A table without lines, whose first column has words and the others numbers."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for n, label in enumerate(labels):
        table.add_column(label, justify="right" if n else "left")
    return table


def plain_line(state: RunState, title: str) -> str:
    """The state in one line."""
    told = ", ".join(
        facts.fact(name).labelled(state)
        for name in ("captures", "reroute_requests", "marks", "messages_now_per_s", "certified_gap")
    )
    alarms = "".join(f"; {line}" for line in facts.alarm_lines(state, SHOWN_ALARMS))
    return (
        f"{title}: processes {facts.fact('processes_well').shown(state)}, "
        f"restarts {state.restarts}; vehicles {facts.fact('vehicles_driven').shown(state)}: "
        f"{facts.fact('states').shown(state)}; {told}{alarms}"
    )


def _style(line: TargetLine) -> str | None:
    if not line.planner_up:
        return None if line.starting else "red"
    return "yellow" if line.lost else None


def loads_table(processes: Sequence[ProcessLoad], *, each: bool) -> Table:
    """A line for each process, or else for each role, in the order of the table of processes. At most 80 columns
    wide."""
    first = ("process", "pid") if each else ("role",)
    table = columns(*first, "up", "CPU %", "memory", "late/s", "messages/s", "restarts")
    if each:
        for line in processes:
            up = facts.seconds(line.up_s) if line.alive else "gone"
            pid = "-" if line.pid is None else str(line.pid)
            table.add_row(
                line.name, pid, up, *_load_row([line], [line]), style=_load_style(line.restarts, line.alive)
            )
        return table
    table.add_column("busiest", no_wrap=True, overflow="ellipsis")
    for role in dict.fromkeys([*ROLES, *(line.role for line in processes)]):
        mine = [line for line in processes if line.role == role]
        alive = [line for line in mine if line.alive]
        cpu = {line.name: line.cpu_percent for line in alive if line.cpu_percent is not None}
        busiest = max(cpu, key=cpu.__getitem__) if cpu and len(mine) > 1 else None
        last = "" if busiest is None else f"{busiest} {cpu[busiest]:.0f} %"
        if mine:
            style = _load_style(sum(line.restarts for line in mine), len(alive) == len(mine))
            table.add_row(role, f"{len(alive)} of {len(mine)}", *_load_row(alive, mine), last, style=style)
    return table


def _load_row(alive: Sequence[ProcessLoad], mine: Sequence[ProcessLoad]) -> tuple[str, ...]:
    """Sums of those that are alive; of all of them the worst lateness, and how often they were started again."""
    memory = sum_of(line.rss_bytes for line in alive)
    return (
        _number(sum_of(line.cpu_percent for line in alive)),
        "-" if memory is None else f"{memory / (1 << 20):,.0f} MB",
        _number(max((line.late_per_s for line in mine if line.late_per_s is not None), default=None)),
        facts.count(sum_of(line.messages_per_s for line in alive)),
        str(sum(line.restarts for line in mine)),
    )


def _load_style(restarts: int, whole: bool) -> str | None:
    return ("yellow" if restarts else None) if whole else "red"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"
