"""What a run said in words: notes, alarms and captures, as lines of a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from launch_scripts.gateways.ros2.messages import Severity
from launch_scripts.observe.alarms import Alarm
from launch_scripts.report.geo.track_file import Track
from swarm.clock import NS_PER_S
from swarm.errors import StoreError
from swarm.wire.messages.map_data import STAMP_LIMIT_NS


class _Note(msgspec.Struct):
    t_s: float
    kind: str
    text: str
    sender: str = msgspec.field(name="from")


class _Alarm(msgspec.Struct):
    kind: str
    about: str
    text: str
    since_s: float | None
    over_s: float | None


class _Words(msgspec.Struct):
    """The part of report.json that is read here."""

    notes: list[_Note] | None = None
    alarms: list[_Alarm] | None = None


@dataclass(frozen=True, slots=True, order=True)
class Line:
    """time_ns as `RunTracks` counts; name, who says it"""

    time_ns: int
    severity: Severity
    name: str
    text: str


def lines_of(report: Mapping[str, Any], path: Path, began_ns: int, captures: list[Track]) -> list[Line]:
    """All lines in order of time. Raises StoreError if the report is damaged; `path` is how the sentence calls it.

    An alarm is a line where it begins, and another where it is over. A capture has the words of its note; those
    whose notes are forgotten, as in a long run, get words here.

    began_ns  from which the time of the run counts
    """
    try:
        words = msgspec.convert(dict(report), _Words)
    except msgspec.ValidationError as error:
        raise StoreError(f"{path} is damaged: {error}") from error

    def at(t_s: float) -> int:
        return min(max(round(began_ns + t_s * NS_PER_S), 0), STAMP_LIMIT_NS - 1)

    notes = words.notes or []
    lines = [Line(at(note.t_s), Severity.INFO, note.sender, note.text) for note in notes]
    first_ns = min((line.time_ns for line in lines), default=STAMP_LIMIT_NS)
    for each in captures:
        if each.time_ns[0] < first_ns - NS_PER_S:
            lines.append(Line(int(each.time_ns[0]), Severity.INFO, "targets", f"{each.id} was captured"))
    for told in words.alarms or []:
        alarm = Alarm(told.kind, told.about, told.text, told.since_s, told.over_s)
        severity = Severity.ERROR if alarm.serious else Severity.WARN
        if told.since_s is not None:
            lines.append(Line(at(told.since_s), severity, told.about, f"{alarm.label}: {told.text}"))
        if told.over_s is not None and told.over_s != told.since_s:
            lines.append(Line(at(told.over_s), Severity.INFO, told.about, f"{alarm.label} is over: {told.text}"))
    return sorted(lines)
