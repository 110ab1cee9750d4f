"""Figures beside the view: plots, a summary and a log."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from launch_scripts.monitor.movers.styles import HUES
from launch_scripts.monitor.pen import in_markdown, shown
from launch_scripts.monitor.sinks import Rec
from launch_scripts.observe import facts
from launch_scripts.observe.alarms import KINDS
from launch_scripts.observe.history import Sample
from launch_scripts.observe.state import RunState
from swarm.runtime.role import RoleSetup
from swarm.wire.messages.vehicles import VehicleState

_WARNINGS = ("restart", "crash", "lost", "stranded", "mismatch", "gone", "refused", "outside", "teleported")
_SHOWN_TARGETS = 12
_SHOWN_ALARMS = 8


class FiguresPanel:
    """Logs plots, the summary and notes to one recording stream, and sets its time."""

    def __init__(self, rec: Rec, target_ids: Sequence[str]) -> None:
        self._rec = rec
        self._target_ids = list(target_ids)

    def set_time(self, frame: int, seconds: float) -> None:
        """Sets the time of all that follows. What is logged before the first call is on no timeline."""
        self._rec.set_time("tick", sequence=frame)
        self._rec.set_time("sim_time", duration=seconds)

    def begin(self) -> None:
        """Logs what never changes: the styles."""
        targets = [HUES[n % len(HUES)] for n in range(len(self._target_ids))]
        states = [state.name.lower() for state in VehicleState]
        for chart, names, colours in (
            ("states", states, HUES[: len(states)]),
            ("captures_and_marks", ["captures", "marks / 100"], [(255, 210, 31), (170, 110, 240)]),
            ("gap", self._target_ids, targets),
            ("growth_ms", self._target_ids, targets),
            ("messages", ["all processes"], [(86, 180, 233)]),
        ):
            self._rec.log(f"plots/{chart}", rr.SeriesLines(names=names, colors=colours, widths=1.5), static=True)

    def plots(self, sample: Sample) -> None:
        """Logs a point of each line whose value is known."""
        excess = {id: (gap - 1) * 100 for id, gap in sample.gaps.items()}
        charts: dict[str, Sequence[float | None]] = {
            "states": [float(n) for n in sample.states],
            "captures_and_marks": [sample.captures, None if sample.marks is None else sample.marks / 100],
            "gap": [excess.get(id) for id in self._target_ids],
            "growth_ms": [sample.growth_ms.get(id) for id in self._target_ids],
            "messages": [sample.messages_per_s],
        }
        for chart, values in charts.items():
            if any(value is not None for value in values):
                numbers = np.array([math.nan if value is None else value for value in values])
                self._rec.log(f"plots/{chart}", rr.Scalars(numbers))

    def summary(self, markdown: str) -> None:
        """Logs the text beside the view."""
        self._rec.log("summary", rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def note(self, text: str, level: str) -> None:
        """Logs a line, at a level as rerun names it."""
        self._rec.log("log", rr.TextLog(shown(text), level=level))


def level_of(kind: str) -> str:
    """Log level of a note, as rerun names it."""
    return "WARN" if kind in KINDS or any(word in kind for word in _WARNINGS) else "INFO"


def summary_markdown(setup: RoleSetup, state: RunState) -> str:
    """The state of a run, as Markdown."""
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
