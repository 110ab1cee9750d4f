"""`runs export --format mcap`: a run as an MCAP file with the types of ROS 2, for Foxglove, rosbags or `ros2 bag`.

A viewer that jumps to an instant shows the last message of each topic. Each message therefore holds all of its
topic: all vehicles, all routes, all marks; large topics are written less often. One message is made at a time.
"""

from __future__ import annotations

import heapq
import importlib.metadata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer

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
    RosMap,
    RosMessages,
    Severity,
    frames_of,
    headings_along,
    ros_name,
)
from launch_scripts.gateways.ros2.ros_types import RosTypes, types_of
from launch_scripts.observe.alarms import Alarm
from launch_scripts.observe.palette import GROUPS, colours_of_groups, rgb
from launch_scripts.observe.run_folders import REPORT_FILE, read_report
from launch_scripts.report.gis_formats import turns_of
from launch_scripts.report.report_and_tracks import GROUND_PACE_FILE, GroundPace, RunTracks, Track, read_ground
from launch_scripts.report.run_gis_layers import free_places, groups_of, tracks_of_run
from shared_map.terrain.map_frame import middles_of
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError, StoreError
from swarm.files import replacing
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import STAMP_LIMIT_NS, MarkKind

_PROFILE, _SCHEMAS, _MESSAGES = "ros2", "ros2msg", "cdr"
"""Words of MCAP's registry: what the file is for, how types are written in it, how messages."""
_CAPTURE: Colour = (1.0, 0.85, 0.1, 1.0)
_SHOWN_NS = 5 * NS_PER_S
"""Captures are drawn for this time."""
_MOST_POINTS, _MOST_CELLS = 2_000_000, 64_000_000
"""Limits for all routes drawn, and for all grids of marks, in a recording: 48 MB and 64 MB before compression."""
_LEAST, _MOST = 8, 600
"""Messages that drawings and grids of marks get, as far as there is news for them."""


def export_mcap(folder: Path, out: Path | None, force: bool) -> str:
    """Writes the recording of a run; returns a line about it. Raises ConfigError or StoreError in one sentence."""
    tracks = tracks_of_run(folder)
    report = read_report(folder) if (folder / REPORT_FILE).exists() else {}
    ground = read_ground(folder, tracks.grid)
    lines = lines_of(report, folder / REPORT_FILE, tracks.began_ns, tracks.captures)
    run = folder.resolve().name
    if not any(len(each.time_ns) for each in (*tracks.vehicles, *tracks.targets)):
        raise ConfigError(f"{folder} has no tracks: no messages about vehicles and targets")
    (path,) = free_places(folder, [f"{run}.mcap"], out, force)
    types = types_of("jazzy")
    timeline = _Timeline(RosMessages(types, RosMap(tracks.grid)), tracks, ground, _colours(report))
    counts = _write(path, timeline.messages_in_order(lines), types, _facts(run, report, tracks.grid))
    topics = ", ".join(f"{count:,} {topic}" for topic, count in sorted(counts.items()))
    without = "" if ground is not None else f"; no /map: there is no {GROUND_PACE_FILE} of it"
    return f"{path}: {topics}{without}"


class TimedMessage(NamedTuple):
    """One message of a recording."""

    time_ns: int
    topic: str
    message: Any


def _write(path: Path, timeline: Iterable[TimedMessage], types: RosTypes, facts: Mapping[str, str]) -> Counter[str]:
    """Writes messages as they come, in compressed chunks of a megabyte; returns how many each topic has.
    Raises StoreError.

    facts  about the run, for a reader of the file
    """
    counts: Counter[str] = Counter()
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    with replacing(path) as half, half.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(_PROFILE, f"terrain-swarm {importlib.metadata.version('terrain-swarm')}")
        writer.add_metadata("run", dict(facts))
        for now_ns, topic, message in timeline:
            name = message.__msgtype__
            if name not in schemas:
                schemas[name] = writer.register_schema(name, _SCHEMAS, types.definition_of(name).encode())
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, _MESSAGES, schemas[name])
            writer.add_message(channels[topic], now_ns, types.pack(message, name), now_ns, counts[topic])
            counts[topic] += 1
        writer.finish()  # type: ignore[no-untyped-call]
    return counts


def _colours(report: Mapping[str, Any]) -> dict[str, Colour]:
    """Vehicle -> colour of its group, as in all pictures of a run."""
    groups = colours_of_groups(report)
    of_vehicle = {vehicle: rgb(groups.get(group, GROUPS[0])) for vehicle, group in groups_of(report).items()}
    return {
        vehicle: (red / 255, green / 255, blue / 255, 1.0) for vehicle, (red, green, blue) in of_vehicle.items()
    }


def _facts(run: str, report: Mapping[str, Any], grid: GridSpec) -> dict[str, str]:
    """Returns the meaning of positions and times, and the identity of the run."""
    known = {name: report[name] for name in ("scenario", "seed", "version") if report.get(name) is not None}
    place = {"crs": grid.crs, "west_m": grid.west_m, "north_m": grid.north_m, "resolution_m": grid.resolution_m}
    return {name: str(value)[:1000] for name, value in {"run": run, **known, **place}.items()}


# --- all messages in order of time --------------------------------------------------------------------------------


class _Timeline:
    """Makes the messages of a run.

    colours  vehicle -> of its route; those of others are `map_messages.ROUTE`
    """

    def __init__(
        self, messages: RosMessages, tracks: RunTracks, ground: GroundPace | None, colours: Mapping[str, Colour]
    ) -> None:
        self._messages, self._tracks, self._ground, self._colours = messages, tracks, ground, colours
        self._frames = frame_names(each.id for each in tracks.vehicles)
        self._first_ns = self._last_ns = 0

    def messages_in_order(self, lines: Sequence[Line]) -> Iterator[TimedMessage]:
        """All messages in order of time."""
        messages, tracks = self._messages, self._tracks
        moving = (*tracks.vehicles, *tracks.targets, *tracks.captures)
        ends = [int(each.time_ns[n]) for each in moving if len(each.time_ns) for n in (0, -1)]
        ends += [route.time_ns for route in tracks.routes] + [line.time_ns for line in lines]
        self._first_ns, self._last_ns = min(ends), max(ends)
        logged = (
            TimedMessage(line.time_ns, "/rosout", messages.log(line.time_ns, line.severity, line.name, line.text))
            for line in lines
        )
        return heapq.merge(
            self._still(),
            self._moving(tracks.vehicles, "/swarm/poses", frames=True),
            self._moving(tracks.targets, "/targets", frames=False),
            self._marks(),
            self._drawn(),
            logged,
            key=lambda each: each.time_ns,
        )

    def _still(self) -> Iterator[TimedMessage]:
        messages, first_ns, map = self._messages, self._first_ns, self._messages.map
        still = [messages.transform(first_ns, (TERRAIN_FRAME, map.frame), map.origin_m)]
        still += [messages.transform(first_ns, (map.frame, frames_of(each)[0])) for each in self._frames.values()]
        yield TimedMessage(first_ns, "/tf_static", messages.transforms(still))
        if (ground := self._ground) is not None:
            occupancy = occupancy_of(ground.pace_s_per_m, ground.best_s_per_m)
            yield TimedMessage(first_ns, "/map", occupancy_grid(messages, first_ns, occupancy, ground.side))

    def _moving(self, tracks: Sequence[Track], topic: str, *, frames: bool) -> Iterator[TimedMessage]:
        """The samples of all tracks, time by time. Headings lead from each sample to the next of its track.

        frames  whether transforms are written, too
        """
        tracks = sorted((each for each in tracks if len(each.time_ns)), key=lambda each: (each.id, each.piece))
        if not tracks:
            return
        messages = self._messages
        times = np.concatenate([each.time_ns for each in tracks])
        xy_m = np.concatenate([each.xy_m for each in tracks])
        headings = np.concatenate([headings_along(each.xy_m) for each in tracks])
        ids = [each.id for each in tracks for _ in each.time_ns]
        order = np.argsort(times, kind="stable")
        for some in np.split(order, np.flatnonzero(np.diff(times[order])) + 1):
            now_ns = int(times[some[0]])
            if frames:
                bases = [
                    messages.transform(
                        now_ns, frames_of(self._frames[ids[n]]), messages.map.to_ros(*xy_m[n]), headings[n]
                    )
                    for n in some.tolist()
                ]
                yield TimedMessage(now_ns, "/tf", messages.transforms(bases))
            yield TimedMessage(now_ns, topic, messages.pose_array(now_ns, xy_m[some], headings[some].tolist()))

    def _marks(self) -> Iterator[TimedMessage]:
        """Marks at the end, each cell from its newest mark on: -1 without a mark."""
        grid, marks, ground = self._tracks.grid, self._tracks.marks, self._ground
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
        stamps_ns = np.clip(marks.stamps_ns[stands][order], self._first_ns, self._last_ns)
        occupancy = np.full((-(-grid.rows // side), -(-grid.cols // side)), UNKNOWN, np.int8)
        done = 0
        for now_ns in self._instants(np.unique(stamps_ns).tolist(), _MOST_CELLS // occupancy.size):
            until = int(np.searchsorted(stamps_ns, now_ns, "right"))
            np.maximum.at(occupancy, (rows[done:until], cols[done:until]), values[done:until])
            done = until
            yield TimedMessage(now_ns, "/marks", occupancy_grid(self._messages, now_ns, occupancy.copy(), side))

    def _drawn(self) -> Iterator[TimedMessage]:
        """The route that each vehicle has begun last, and captures for a while."""
        grid = self._tracks.grid
        routes = sorted(self._tracks.routes, key=lambda route: route.time_ns)
        captures = [(int(each.time_ns[0]), each) for each in self._tracks.captures]
        changes = {route.time_ns for route in routes}
        changes.update(at_ns + later_ns for at_ns, _ in captures for later_ns in (0, _SHOWN_NS))
        points = sum(len(turns_of(route.cells, grid)) for route in routes)
        at_once = len({route.vehicle for route in routes}) * points // max(len(routes), 1)
        current: dict[str, Drawing] = {}
        done = 0
        for now_ns in self._instants(changes, _MOST_POINTS // max(at_once, 1)):
            while done < len(routes) and routes[done].time_ns <= now_ns:
                vehicle, cells = routes[done].vehicle, turns_of(routes[done].cells, grid)
                colour = self._colours.get(vehicle, map_messages.ROUTE)
                current[vehicle] = map_messages.route(grid, middles_of(grid, cells).T, colour)
                done += 1
            captured = {
                each.id: Drawing("captures", Form.CUBES, each.xy_m[:1], _CAPTURE, 3 * grid.resolution_m)
                for at_ns, each in captures
                if at_ns <= now_ns < at_ns + _SHOWN_NS
            }
            drawings = [*current.values(), *captured.values()]
            yield TimedMessage(now_ns, "/swarm/markers", marker_array(self._messages, now_ns, drawings))

    def _instants(self, changes: Iterable[int], room_for: int) -> list[int]:
        return instants_of(changes, self._first_ns, self._last_ns, min(max(room_for, _LEAST), _MOST))


def frame_names(ids: Iterable[str]) -> dict[str, str]:
    """Vehicle -> its name in frames, as of the gateway: a0-07 -> a0_07, or its id where another has that name."""
    names: dict[str, str] = {}
    for id in sorted(set(ids), key=lambda id: (ros_name(id) != id, id)):
        names[id] = id if ros_name(id) in names.values() else ros_name(id)
    return names


def instants_of(changes: Iterable[int], first_ns: int, last_ns: int, most: int) -> list[int]:
    """Time when to tell what changes at these times: at or soon after each change, at most once a second, at most
    `most` times, and never after the end."""
    period_ns = max(NS_PER_S, -(-(last_ns - first_ns) // max(most - 1, 1)))
    times_ns = {
        first_ns + -(-(min(max(each, first_ns), last_ns) - first_ns) // period_ns) * period_ns for each in changes
    }
    return sorted({min(each, last_ns) for each in times_ns})


# --- what a run said in words, as lines of a log ------------------------------------------------------------------


class _Note(msgspec.Struct):
    t_s: float
    text: str
    sender: str = msgspec.field(name="from")


class _Words(msgspec.Struct):
    """The part of report.json that is read here."""

    notes: list[_Note] | None = None
    alarms: list[Alarm] | None = None


@dataclass(frozen=True, slots=True, order=True)
class Line:
    """The time is counted as by `RunTracks`; the name is that of the sender."""

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
        # Bounded before it is rounded: a report may tell of a time beyond all whole numbers.
        return round(min(max(began_ns + t_s * NS_PER_S, 0), STAMP_LIMIT_NS - 1))

    lines = [Line(at(note.t_s), Severity.INFO, note.sender, note.text) for note in words.notes or []]
    first_ns = min((line.time_ns for line in lines), default=STAMP_LIMIT_NS)
    for each in captures:
        if each.time_ns[0] < first_ns - NS_PER_S:
            lines.append(Line(int(each.time_ns[0]), Severity.INFO, "targets", f"{each.id} was captured"))
    for alarm in words.alarms or []:
        text, severity = f"{alarm.label}: {alarm.text}", Severity.ERROR if alarm.serious else Severity.WARN
        if alarm.since_s is not None:
            lines.append(Line(at(alarm.since_s), severity, alarm.about, text))
        if alarm.over_s is not None and alarm.over_s != alarm.since_s:
            over = f"{alarm.label} is over: {alarm.text}"
            lines.append(Line(at(alarm.over_s), Severity.INFO, alarm.about, over))
    return sorted(lines)
