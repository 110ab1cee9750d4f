"""The live table in the terminal, and its one-line form where there is no terminal."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Group
from rich.table import Table
from rich.text import Text

from launch_scripts.report.recorder import LiveSummary, TargetLine
from launch_scripts.report.results.certified_gap import percent

SHOWN_TARGETS = 24


def live_table(summary: LiveSummary, processes: Mapping[str, tuple[int, int]], restarts: int, title: str) -> Group:
    """The table of one instant.

    processes  role -> (alive, all)
    """
    table = Table(title=title, title_justify="left", expand=False, pad_edge=False)
    table.add_column("target")
    for heading in ("following", "nearest m", "re-plans", "ms", "certified gap", "captures"):
        table.add_column(heading, justify="right")
    for line in summary.targets[:SHOWN_TARGETS]:
        table.add_row(*_row(line), style=_style(line))
    if len(summary.targets) > SHOWN_TARGETS:
        table.add_row(f"... {len(summary.targets) - SHOWN_TARGETS} more")
    lines = [Text(line, overflow="ellipsis", no_wrap=True) for line in _totals(summary)]
    crew = Text("processes  ")
    for role, (alive, every) in processes.items():
        crew.append(f"{role} {alive}/{every}  ", style="green" if alive == every else "bold red")
    crew.append(f"restarts {restarts}", style="bold yellow" if restarts else "")
    return Group(table, *lines, crew)


def plain_line(summary: LiveSummary, processes: Mapping[str, tuple[int, int]], restarts: int) -> str:
    """The summary in one line."""
    alive = sum(count for count, _ in processes.values())
    every = sum(count for _, count in processes.values())
    following = sum(line.following for line in summary.targets)
    lost = [line.id for line in summary.targets if line.lost]
    untracked = f"; lost targets: {', '.join(lost[:SHOWN_TARGETS])}" if lost else ""
    states = ", ".join(f"{count} {state}" for state, count in summary.states.items() if count)
    return (
        f"{summary.elapsed_s:5.1f} s  {alive}/{every} processes, {restarts} restarts; "
        f"{states or 'no vehicles yet'}; {following} assigned; {_count(summary.captures)} captures, "
        f"{_count(summary.reroute_requests)} re-route requests, {_count(summary.marks)} marks, "
        f"{_count(summary.messages_per_s)} messages/s, "
        f"certified gap {percent(summary.certified_gap.mean)}{untracked}"
    )


def _style(line: TargetLine) -> str | None:
    return "red" if not line.planner_up else "yellow" if line.lost else None


def _row(line: TargetLine) -> tuple[str, ...]:
    return (
        line.title,
        str(line.following),
        "-" if line.nearest_m is None else f"{line.nearest_m:.0f}",
        _count(line.growths),
        "-" if line.growth_ms is None else f"{line.growth_ms:.1f}",
        "-" if line.gap is None else percent(line.gap.mean),
        str(line.captures),
    )


def _totals(summary: LiveSummary) -> list[str]:
    states = "  ".join(f"{state} {count}" for state, count in summary.states.items())
    counts = {
        "captures": summary.captures,
        "re-route requests": summary.reroute_requests,
        "marks": summary.marks,
        "messages/s": summary.messages_per_s,
    }
    in_all = "  ".join(f"{name} {_count(count)}" for name, count in counts.items())
    return [f"vehicles   {states}", f"in all     {in_all}", f"certified  gap {summary.certified_gap}"]


def _count(value: float | None) -> str:
    return "-" if value is None else f"{value:,.0f}"
