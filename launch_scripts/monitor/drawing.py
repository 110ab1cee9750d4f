"""Logs figures and notes to rerun. What lies still is logged in `ground/`, what moves in `movers/`.

Few entities with many instances each, arrays instead of lists, style logged once: see what was measured in
docs/decisions/0008-the-live-view.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from launch_scripts.monitor.movers.looks import HUES
from launch_scripts.monitor.serving.sinks import Streams
from launch_scripts.monitor.shown_text import shown
from launch_scripts.observe.history import Sample
from swarm.wire.messages.vehicles import VehicleState


class Drawing:
    """Logs the scene to one recording stream."""

    def __init__(self, rec: rr.RecordingStream | Streams, target_ids: Sequence[str]) -> None:
        self._rec = rec
        self._target_ids = list(target_ids)

    def set_time(self, frame: int, seconds: float) -> None:
        """Sets the time of all that follows. What is logged before the first call is on no timeline."""
        self._rec.set_time("tick", sequence=frame)
        self._rec.set_time("sim_time", duration=seconds)

    def begin(self) -> None:
        """Logs what never changes: the styles."""
        states = [state.name.lower() for state in VehicleState]
        self._series("states", states, HUES[: len(states)])
        self._series("captures_and_marks", ["captures", "marks / 100"], [(255, 210, 31), (170, 110, 240)])
        for chart in ("gap", "growth_ms"):
            self._series(chart, self._target_ids, self._colours())
        self._series("messages", ["all processes"], [(86, 180, 233)])

    def _colours(self) -> list[tuple[int, ...]]:
        return [HUES[n % len(HUES)] for n in range(len(self._target_ids))]

    def _series(self, chart: str, names: list[str], colours: Sequence[tuple[int, ...]]) -> None:
        self._rec.log(f"plots/{chart}", rr.SeriesLines(names=names, colors=colours, widths=1.5), static=True)

    def plots(self, sample: Sample, messages_per_s: float | None) -> None:
        log = self._scalars
        log("states", [float(n) for n in sample.states])
        marks = None if sample.marks is None else sample.marks / 100
        log("captures_and_marks", [sample.captures, marks])
        excess = {id: (gap - 1) * 100 for id, gap in sample.gaps.items()}
        log("gap", [excess.get(id) for id in self._target_ids])
        log("growth_ms", [sample.growth_ms.get(id) for id in self._target_ids])
        log("messages", [messages_per_s])

    def _scalars(self, chart: str, values: Sequence[float | None]) -> None:
        if any(value is not None for value in values):
            numbers = np.array([math.nan if value is None else value for value in values])
            self._rec.log(f"plots/{chart}", rr.Scalars(numbers))

    def summary(self, markdown: str) -> None:
        self._rec.log("summary", rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def note(self, text: str, level: str) -> None:
        self._rec.log("log", rr.TextLog(shown(text), level=level))
