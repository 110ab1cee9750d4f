"""A table of what processes take up, each or by role."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from launch_scripts.launcher.live_table import columns
from launch_scripts.observe import facts
from launch_scripts.observe.process_load import ProcessLoad, RoleLoad


def loads_table(lines: Sequence[ProcessLoad | RoleLoad], *, each: bool) -> Table:
    """At most 80 columns wide.

    each  whether a line is a process, else it is a role
    """
    table = columns("process" if each else "role", "up", "CPU %", "memory", "late/s", "messages/s", "restarts")
    if not each:
        table.add_column("busiest", no_wrap=True, overflow="ellipsis")
    for line in lines:
        table.add_row(*_row(line), style=_style(line))
    return table


def _row(line: ProcessLoad | RoleLoad) -> tuple[str, ...]:
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


def _style(line: ProcessLoad | RoleLoad) -> str | None:
    whole = line.alive if isinstance(line, ProcessLoad) else line.alive == line.known
    return "yellow" if line.restarts and whole else None if whole else "red"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"
