"""Tables for the terminal: a run, its targets, what its processes take up; and a run in one line."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from launch_scripts.observe import fact_table as facts
from launch_scripts.observe.process_load import ProcessLoad, RoleLoad
from launch_scripts.observe.run_state import RunState, TargetLine

SHOWN_ALARMS = 5
_FEWEST_TARGETS = 3


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
    """What is to be seen in any case, and below it as many targets as the console has lines for."""
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
        f"{facts.fact(name).label} {facts.fact(name).shown(state)}"
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


def loads_table(lines: Sequence[ProcessLoad | RoleLoad], *, each: bool) -> Table:
    """At most 80 columns wide.

    each  whether a line is a process, else it is a role
    """
    table = columns("process" if each else "role", "up", "CPU %", "memory", "late/s", "messages/s", "restarts")
    if not each:
        table.add_column("busiest", no_wrap=True, overflow="ellipsis")
    for line in lines:
        table.add_row(*_load_row(line), style=_load_style(line))
    return table


def _load_row(line: ProcessLoad | RoleLoad) -> tuple[str, ...]:
    told = (
        _number(line.cpu_percent),
        "-" if line.rss_bytes is None else f"{line.rss_bytes / (1 << 20):,.0f} MB",
        _number(line.late_per_s),
        facts.count(line.messages_per_s),
        str(line.restarts),
    )
    if isinstance(line, ProcessLoad):
        return line.name, facts.seconds(line.up_s) if line.alive else "gone", *told
    busiest = f"{line.busiest.name} {line.busiest.cpu_percent:.0f} %" if line.busiest and line.known > 1 else ""
    return line.role, f"{line.alive} of {line.known}", *told, busiest


def _load_style(line: ProcessLoad | RoleLoad) -> str | None:
    whole = line.alive if isinstance(line, ProcessLoad) else line.alive == line.known
    return "yellow" if line.restarts and whole else None if whole else "red"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"
