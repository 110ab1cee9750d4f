"""Tables for the terminal: a run, its targets, what its processes take up; and a run in one line."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

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


def whole_output() -> Console:
    """Standard output, for a command that prints once: into a pipe or a file nothing is cut or broken."""
    console = Console(highlight=False, markup=False)
    return console if console.is_terminal else Console(highlight=False, markup=False, width=1000, height=10_000)


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


def targets_table(state: RunState, most: int, *, always: bool = True) -> Table:
    """A line for each target, `most` at most, with the main columns, or with the remaining ones."""
    labels, rows = facts.table(state, always=always)
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
        f"{title}: {facts.fact('processes_well').labelled(state)}, "
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
    groups: dict[str, list[ProcessLoad]] = {}
    for line in processes if each else sorted(processes, key=lambda line: (*ROLES, line.role).index(line.role)):
        groups.setdefault(line.name if each else line.role, []).append(line)
    table = columns(*(("process", "pid") if each else ("role",)), "up", *_LOADS)
    if not each:
        table.add_column("busiest", no_wrap=True, overflow="ellipsis")
    for name, mine in groups.items():
        alive, first = [line for line in mine if line.alive], mine[0]
        row = [name, *(shown(alive, mine) for shown in _LOADS.values())]
        if each:
            row[1:1] = [str(first.pid or "-"), facts.seconds(first.up_s) if alive else "gone"]
        else:
            row[1:1] = [f"{len(alive)} of {len(mine)}"]
            busy = [line for line in alive if line.cpu_percent is not None] if len(mine) > 1 else []
            busiest = max(busy, key=lambda line: line.cpu_percent or 0.0, default=None)
            row += [] if busiest is None else [f"{busiest.name} {busiest.cpu_percent:.0f} %"]
        restarted = any(line.restarts for line in mine)
        table.add_row(*row, style="red" if len(alive) < len(mine) else "yellow" if restarted else None)
    return table


_LOADS: Mapping[str, Callable[[Sequence[ProcessLoad], Sequence[ProcessLoad]], str]] = {
    "CPU %": lambda alive, _: _number(sum_of(line.cpu_percent for line in alive)),
    "memory": lambda alive, _: _number(sum_of(line.rss_bytes for line in alive), 1 << 20, " MB"),
    "late/s": lambda _, mine: _number(
        max((line.late_per_s for line in mine if line.late_per_s is not None), default=None)
    ),
    "messages/s": lambda alive, _: facts.count(sum_of(line.messages_per_s for line in alive)),
    "restarts": lambda _, mine: str(sum(line.restarts for line in mine)),
}
"""Column -> its text, from the processes of a line that are alive, and all of them."""


def _number(value: float | None, unit: float = 1.0, name: str = "") -> str:
    if value is None:
        return facts.NONE
    return f"{value / unit:,.0f}{name}" if value >= 10 else f"{value:.1f}"
