"""What a run leaves as ROS messages in order of time. Pure; one message is made at a time.

A viewer that jumps to an instant shows the last message of each topic. So each message holds all of its topic: all
vehicles, all routes, all marks; what would be too much is told less often.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from launch_scripts.gateways.ros2 import map_messages
from launch_scripts.gateways.ros2.map_messages import (
    UNKNOWN,
    Colour,
    Drawing,
    Form,
    marker_array,
    occupancy_grid,
    occupancy_of,
)
from launch_scripts.gateways.ros2.ros_messages import (
    TERRAIN_FRAME,
    RosMessages,
    Severity,
    frames_of,
    headings_along,
    ros_name,
)
from launch_scripts.observe.run_alarms import Alarm
from launch_scripts.report.exporter import turns_of
from launch_scripts.report.run_arrays import GroundPace, RunTracks, Track
from shared_map.terrain.map_frame import middles_of
from swarm.clock import NS_PER_S
from swarm.errors import StoreError
from swarm.wire.messages.map_data import STAMP_LIMIT_NS, MarkKind

CAPTURE: Colour = (1.0, 0.85, 0.1, 1.0)
_SHOWN_NS = 5 * NS_PER_S
"""Captures are drawn for so long."""
_MOST_POINTS, _MOST_CELLS = 2_000_000, 64_000_000
"""Of all routes drawn, and of all grids of marks, in a recording: 48 MB and 64 MB before compression."""
_LEAST, _MOST = 8, 600
"""Messages that drawings and grids of marks get, as far as there is news for them."""


class Told(NamedTuple):
    """One message of a recording."""

    time_ns: int
    topic: str
    message: Any


def told(
    messages: RosMessages,
    tracks: RunTracks,
    ground: GroundPace | None,
    lines: Sequence[Line],
    colours: Mapping[str, Colour],
) -> Iterator[Told]:
    """All messages in order of time.

    colours  vehicle -> of its route; those of others are `map_messages.ROUTE`
    """
    moving = (*tracks.vehicles, *tracks.targets, *tracks.captures)
    ends = [int(each.time_ns[n]) for each in moving if len(each.time_ns) for n in (0, -1)]
    ends += [route.time_ns for route in tracks.routes] + [line.time_ns for line in lines]
    if not ends:
        return
    first_ns, last_ns = min(ends), max(ends)
    frames = frame_names(each.id for each in tracks.vehicles)
    yield from heapq.merge(
        _still(messages, ground, frames, first_ns),
        _moving(messages, tracks.vehicles, "/swarm/poses", frames),
        _moving(messages, tracks.targets, "/targets"),
        _marks(messages, tracks, ground, first_ns, last_ns),
        _drawn(messages, tracks, colours, first_ns, last_ns),
        (
            Told(line.time_ns, "/rosout", messages.log(line.time_ns, line.severity, line.name, line.text))
            for line in lines
        ),
        key=lambda each: each.time_ns,
    )


def _still(
    messages: RosMessages, ground: GroundPace | None, frames: Mapping[str, str], first_ns: int
) -> Iterator[Told]:
    map = messages.map
    still = [messages.transform(first_ns, (TERRAIN_FRAME, map.frame), map.origin_m)]
    still += [messages.transform(first_ns, (map.frame, frames_of(name)[0])) for name in frames.values()]
    yield Told(first_ns, "/tf_static", messages.transforms(still))
    if ground is not None:
        occupancy = occupancy_of(ground.pace_s_per_m, ground.best_s_per_m)
        yield Told(first_ns, "/map", occupancy_grid(messages, first_ns, occupancy, ground.side))


# --- what moves ---------------------------------------------------------------------------------------------------


def _moving(
    messages: RosMessages, tracks: Sequence[Track], topic: str, frames: Mapping[str, str] | None = None
) -> Iterator[Told]:
    """The samples of all tracks, time by time. Headings lead from each sample to the next of its track.

    frames  vehicle -> its name in frames, of which transforms are told; None: none are
    """
    tracks = sorted((each for each in tracks if len(each.time_ns)), key=lambda each: (each.id, each.piece))
    if not tracks:
        return
    times = np.concatenate([each.time_ns for each in tracks])
    xy_m = np.concatenate([each.xy_m for each in tracks])
    headings = np.concatenate([headings_along(each.xy_m) for each in tracks])
    ids = [each.id for each in tracks for _ in each.time_ns]
    order = np.argsort(times, kind="stable")
    begins = np.flatnonzero(np.diff(times[order]))
    for some in np.split(order, begins + 1):
        now_ns = int(times[some[0]])
        if frames is not None:
            bases = [
                messages.transform(now_ns, frames_of(frames[ids[n]]), messages.map.to_ros(*xy_m[n]), headings[n])
                for n in some.tolist()
            ]
            yield Told(now_ns, "/tf", messages.transforms(bases))
        yield Told(now_ns, topic, messages.pose_array(now_ns, xy_m[some], headings[some].tolist()))


def frame_names(ids: Iterable[str]) -> dict[str, str]:
    """Vehicle -> its name in frames, as of the gateway: a0-07 -> a0_07, or its id where another has that name."""
    ids = sorted(set(ids))
    names = {id: id for id in ids if ros_name(id) == id}
    taken = set(names)
    for id in ids:
        if id not in names:
            names[id] = id if ros_name(id) in taken else ros_name(id)
            taken.add(names[id])
    return names


# --- what changes now and then ------------------------------------------------------------------------------------


def instants_of(changes: Iterable[int], first_ns: int, last_ns: int, most: int) -> list[int]:
    """When to tell what changes at these times: at or soon after each change, at most once a second, at most `most`
    times, and never after the end."""
    period_ns = max(NS_PER_S, -(-(last_ns - first_ns) // max(most - 1, 1)))
    told_ns = {
        first_ns + -(-(min(max(each, first_ns), last_ns) - first_ns) // period_ns) * period_ns for each in changes
    }
    return sorted({min(each, last_ns) for each in told_ns})


def _marks(
    messages: RosMessages, tracks: RunTracks, ground: GroundPace | None, first_ns: int, last_ns: int
) -> Iterator[Told]:
    """What was marked at the end, each cell from its newest mark on: -1 where nothing is."""
    grid, marks = tracks.grid, tracks.marks
    side = 1 if ground is None else ground.side
    while (-(-grid.rows // side)) * (-(-grid.cols // side)) > 1 << 20:
        side *= 2
    stands = np.isin(marks.kinds, (MarkKind.LETHAL, MarkKind.PACE))
    paces = np.where(marks.kinds == MarkKind.LETHAL, np.inf, marks.paces.astype(np.float64))[stands]
    best_s_per_m = ground.best_s_per_m if ground is not None else float(paces.min(initial=1.0))
    values = occupancy_of(paces, max(best_s_per_m, 1e-6))
    rows, cols = np.divmod(marks.cells[stands], grid.cols)
    order = np.argsort(marks.stamps_ns[stands], kind="stable")
    rows, cols, values = rows[order] // side, cols[order] // side, values[order]
    stamps_ns = np.clip(marks.stamps_ns[stands][order], first_ns, last_ns)
    occupancy = np.full((-(-grid.rows // side), -(-grid.cols // side)), UNKNOWN, np.int8)
    most = min(max(_MOST_CELLS // occupancy.size, _LEAST), _MOST)
    done = 0
    for now_ns in instants_of(np.unique(stamps_ns).tolist(), first_ns, last_ns, most):
        until = int(np.searchsorted(stamps_ns, now_ns, "right"))
        np.maximum.at(occupancy, (rows[done:until], cols[done:until]), values[done:until])
        done = until
        yield Told(now_ns, "/marks", occupancy_grid(messages, now_ns, occupancy.copy(), side))


def _drawn(
    messages: RosMessages,
    tracks: RunTracks,
    colours: Mapping[str, Colour],
    first_ns: int,
    last_ns: int,
) -> Iterator[Told]:
    """The route that each vehicle has begun last, and captures for a while."""
    routes = sorted(tracks.routes, key=lambda route: route.time_ns)
    captures_ns = [int(each.time_ns[0]) for each in tracks.captures]
    changes = {route.time_ns for route in routes}.union(captures_ns, (each + _SHOWN_NS for each in captures_ns))
    points = sum(len(turns_of(route.cells, tracks.grid)) for route in routes)
    at_once = len({route.vehicle for route in routes}) * points // max(len(routes), 1)
    most = min(max(_MOST_POINTS // max(at_once, 1), _LEAST), _MOST)
    current: dict[str, Drawing] = {}
    done, side_m = 0, 3 * tracks.grid.resolution_m
    for now_ns in instants_of(changes, first_ns, last_ns, most):
        while done < len(routes) and routes[done].time_ns <= now_ns:
            vehicle, cells = routes[done].vehicle, turns_of(routes[done].cells, tracks.grid)
            middles_m, colour = middles_of(tracks.grid, cells).T, colours.get(vehicle, map_messages.ROUTE)
            current[vehicle] = map_messages.route(tracks.grid, middles_m, colour)
            done += 1
        captured = {
            each.id: Drawing("captures", Form.CUBES, each.xy_m[:1], CAPTURE, side_m)
            for each, at_ns in zip(tracks.captures, captures_ns, strict=True)
            if at_ns <= now_ns < at_ns + _SHOWN_NS
        }
        drawings = [*current.values(), *captured.values()]
        yield Told(now_ns, "/swarm/markers", marker_array(messages, now_ns, drawings))


# --- what a run said in words, as lines of a log ------------------------------------------------------------------


class _Note(msgspec.Struct):
    t_s: float
    kind: str
    text: str
    sender: str = msgspec.field(name="from")


class _Words(msgspec.Struct):
    """The part of report.json that is read here."""

    notes: list[_Note] | None = None
    alarms: list[Alarm] | None = None


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
    for alarm in words.alarms or []:
        severity = Severity.ERROR if alarm.serious else Severity.WARN
        if alarm.since_s is not None:
            lines.append(Line(at(alarm.since_s), severity, alarm.about, f"{alarm.label}: {alarm.text}"))
        if alarm.over_s is not None and alarm.over_s != alarm.since_s:
            lines.append(Line(at(alarm.over_s), Severity.INFO, alarm.about, f"{alarm.label} is over: {alarm.text}"))
    return sorted(lines)
