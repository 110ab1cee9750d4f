"""The figures beside the view, as Markdown."""

from __future__ import annotations

from launch_scripts.monitor.shown_text import in_markdown
from launch_scripts.observe import facts
from launch_scripts.observe.alarms import KINDS
from launch_scripts.observe.state import RunState
from swarm.runtime.role import RoleSetup

_WARNINGS = ("restart", "crash", "lost", "stranded", "mismatch", "gone", "refused", "outside", "teleported")
_SHOWN_TARGETS = 12
_SHOWN_ALARMS = 8


def level_of(kind: str) -> str:
    """Log level of a note, as rerun names it."""
    return "WARN" if kind in KINDS or any(word in kind for word in _WARNINGS) else "INFO"


def summary_markdown(setup: RoleSetup, state: RunState) -> str:
    """The state of a run beside the view."""
    time = facts.fact("elapsed_s")
    lines = [f"**{in_markdown(setup.scenario.name)}**, {time.label} {time.shown(state)}  "]
    lines += [f"{line}  " for line in facts.lines(state)]
    lines += [f"**{in_markdown(line)}**  " for line in facts.alarm_lines(state, _SHOWN_ALARMS)]
    labels, rows = facts.table(state)
    lines += ["", f"| {' | '.join(labels)} |", f"|{'---|' * len(labels)}"]
    lines += [f"| {' | '.join(map(in_markdown, row))} |" for row in rows[:_SHOWN_TARGETS]]
    if len(rows) > _SHOWN_TARGETS:
        lines.append(f"\n{len(rows) - _SHOWN_TARGETS} more targets")
    return "\n".join(lines)
