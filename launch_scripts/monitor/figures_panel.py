"""The figures beside the view, as Markdown."""

from __future__ import annotations

from launch_scripts.report.recorder import LiveSummary
from launch_scripts.report.results.certified_gap import percent
from swarm.runtime.role import RoleSetup

_WARNINGS = (
    "restart",
    "crash",
    "lost",
    "stranded",
    "collision",
    "lethal",
    "mismatch",
    "gone",
    "refused",
    "outside",
    "teleported",
)
_SHOWN_TARGETS = 12


def level_of(kind: str) -> str:
    """Log level of a note, as rerun names it."""
    return "WARN" if any(word in kind for word in _WARNINGS) else "INFO"


def summary_markdown(setup: RoleSetup, summary: LiveSummary) -> str:
    scenario = setup.scenario
    states = ", ".join(f"{count} {state}" for state, count in summary.states.items() if count)
    found = f"**{_count(summary.captures)}** captures, **{_count(summary.marks)}** marks"
    traffic = f"{summary.restarts} restarts, {_count(summary.messages_per_s)} messages/s"
    lines = [
        f"**{scenario.name}**: {scenario.vehicle_count} vehicles, {len(scenario.target_ids)} targets  ",
        f"{found}, **{_count(summary.reroute_requests)}** re-route requests  ",
        f"{states or 'no vehicles yet'}  ",
        f"{summary.alive} of {summary.expected} processes alive, {traffic}  ",
        f"certified gap {summary.certified_gap}",
        "",
        "| target | following | nearest | tree | certified gap | captures |",
        "|---|---|---|---|---|---|",
    ]
    for line in summary.targets[:_SHOWN_TARGETS]:
        nearest = "–" if line.nearest_m is None else f"{line.nearest_m / 1000:.1f} km"
        growth = "–" if line.growth_ms is None else f"{line.growth_ms:.1f} ms"
        gap = "–" if line.gap is None else percent(line.gap.mean)
        lines.append(f"| {line.title} | {line.following} | {nearest} | {growth} | {gap} | {line.captures} |")
    if len(summary.targets) > _SHOWN_TARGETS:
        lines.append(f"\n{len(summary.targets) - _SHOWN_TARGETS} more targets")
    return "\n".join(lines)


def _count(value: float | None) -> str:
    return "–" if value is None else f"{value:,.0f}"
