"""The live table in the terminal, and its one-line form where there is no terminal."""

from __future__ import annotations

from rich.console import Group
from rich.table import Table
from rich.text import Text

from launch_scripts.report.run_state import facts
from launch_scripts.report.run_state.state import RunState, TargetLine

SHOWN_TARGETS = 24
SHOWN_ALARMS = 5


def live_table(state: RunState, title: str) -> Group:
    """The table of one instant."""
    shown = Table(title=title, title_justify="left", expand=False, pad_edge=False)
    labels, rows = facts.table(state)
    for n, label in enumerate(labels):
        shown.add_column(label, justify="right" if n else "left")
    for line, row in list(zip(state.targets, rows, strict=True))[:SHOWN_TARGETS]:
        shown.add_row(*row, style=_style(line))
    if len(rows) > SHOWN_TARGETS:
        shown.add_row(f"... {len(rows) - SHOWN_TARGETS} more")
    lines = [Text(line, overflow="ellipsis", no_wrap=True) for line in facts.lines(state)]
    crew = Text("")
    for role, (alive, every) in state.crew.items():
        crew.append(f"{role} {alive}/{every}  ", style="green" if alive == every else "bold red")
    for role, alive in state.beside.items():
        crew.append(f"{role} {alive}  ", style="green")
    alarms = [Text(line, style="red") for line in facts.alarm_lines(state, SHOWN_ALARMS)]
    return Group(shown, *lines, crew, *alarms)


def plain_line(state: RunState) -> str:
    """The state in one line."""
    told = ", ".join(
        f"{facts.fact(name).label} {facts.fact(name).shown(state)}"
        for name in ("captures", "reroute_requests", "marks", "messages_now_per_s", "certified_gap")
    )
    alarms = "".join(f"; {line}" for line in facts.alarm_lines(state, SHOWN_ALARMS))
    return (
        f"{state.elapsed_s:5.1f} s  processes {facts.fact('processes_well').shown(state)}, "
        f"restarts {state.restarts}; vehicles {facts.fact('vehicles_driven').shown(state)}: "
        f"{facts.fact('states').shown(state)}; {told}{alarms}"
    )


def _style(line: TargetLine) -> str | None:
    return "red" if not line.planner_up else "yellow" if line.lost else None
