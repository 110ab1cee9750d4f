"""The live table in the terminal, and its one-line form where there is no terminal."""

from __future__ import annotations

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from launch_scripts.observe import facts
from launch_scripts.observe.state import RunState, TargetLine

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
