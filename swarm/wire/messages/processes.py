"""Messages about processes: which run they belong to, what they counted, notes for people."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from swarm.grid import REGION_CELLS
from swarm.wire.fields import (
    IDS,
    MOST_IDS,
    SMALL,
    Bucket,
    CellIndex,
    Count,
    Distance,
    Gauge,
    GridSideOrNone,
    Id,
    Incarnation,
    LongText,
    Metres,
    Natural,
    StampNs,
    Text,
    WebPort,
    Word,
)
from swarm.wire.messages import Message, schema_of


class RunInfo(Message, frozen=True, kw_only=True, tag=schema_of("run")):
    """The run that a process belongs to. `terrain` is a digest of grid, prior pace and cost rules: processes with
    different ones must not share a map.

    rows, cols, resolution_m  of the grid; 0 of a router, which has none
    west_m, north_m, crs      where its north-west corner is, and in which coordinate system
    now_ns                    its clock when it answered, as of its last tick; 0 before the first
    vehicles, crew            how many vehicles the scenario has, and which processes it needs, as `role-id`
    restarts                  how often the process was started again in this run
    classes                   the classes of vehicles beside "ground", in the order of their numbers
    wire_version              of its build. This message is read by builds of all wire versions: it never steps to
                              another version, so that each can say which the other speaks
                              (docs/design/wire-format.md)
    shard_cells               side of a shard of right of way: two layouts in one run would grant a cell twice
    """

    run_id: Word
    role: Id
    id: Id
    incarnation: Incarnation
    scenario: Word
    terrain: Word
    rows: GridSideOrNone
    cols: GridSideOrNone
    resolution_m: Distance
    started_ns: StampNs
    west_m: Metres = 0.0
    north_m: Metres = 0.0
    crs: LongText = "local"
    now_ns: StampNs = 0
    vehicles: Count = 0
    crew: Annotated[list[Word], Meta(max_length=MOST_IDS)] = []
    restarts: Count = 0
    classes: Annotated[list[Id], IDS] = []
    wire_version: Count = 8
    shard_cells: Count = REGION_CELLS


class Alarm(msgspec.Struct, frozen=True, kw_only=True):
    """A process's notice to people that watch the run: a collision, an author beyond its quota.

    kind      a word of `launch_scripts.observe.run_alarms.KINDS`; any other is shown as it is
    about     the process, target, author or vehicle that it is about
    since_ns  when it began; over_ns when it was over, None while it lasts
    """

    kind: Word
    about: Word
    text: Text
    since_ns: StampNs
    over_ns: StampNs | None = None
    cell: CellIndex | None = None
    target: Id | None = None


class Stats(Message, frozen=True, kw_only=True, tag=schema_of("stats")):
    """Counters of a process. Histograms are as in `swarm.runtime.stats`.

    counts_by, histograms_by    name -> id of a target or vehicle -> the same, of that one alone
    since                       counts are those of all incarnations of this process from this one on; 0: of its own
    alarms                      open alarms, and the newest of the closed ones
    web_port                    port of its own machine where people can look at it in a browser; 0: none
    """

    role: Id
    id: Id
    incarnation: Incarnation
    stamp_ns: StampNs
    counts: Annotated[dict[Word, Count], SMALL]
    gauges: Annotated[dict[Word, Gauge], SMALL]
    histograms: Annotated[dict[Word, Annotated[dict[Bucket, Count], Meta(max_length=40_000)]], SMALL]
    counts_by: Annotated[dict[Word, Annotated[dict[Id, Count], IDS]], Meta(max_length=16)] = {}
    histograms_by: Annotated[
        dict[Word, Annotated[dict[Id, Annotated[dict[Bucket, Count], Meta(max_length=40_000)]], IDS]],
        Meta(max_length=16),
    ] = {}
    since: Incarnation = 0
    alarms: Annotated[list[Alarm], Meta(max_length=64)] = []
    web_port: WebPort = 0


class Heartbeat(Message, frozen=True, kw_only=True, tag=schema_of("beat")):
    """State of a candidate for one job, such as a planner or a standby. `ready`: it can do the job. `leads`: it
    does. `seq`: number in its sender's life; only a greater one counts. `heard`: incarnations whose heartbeats its
    sender has received."""

    role: Id
    id: Id
    incarnation: Incarnation
    ready: bool
    leads: bool
    seq: Natural
    heard: Annotated[list[Incarnation], Meta(max_length=64)] = []


class Note(Message, frozen=True, kw_only=True, tag=schema_of("note")):
    """An event for people: a capture, a restart, a closed road found. `cell` is its place, if it has one, `target`
    the target that it is about."""

    role: Id
    id: Id
    stamp_ns: StampNs
    kind: Word
    text: Text
    cell: CellIndex | None = None
    target: Id | None = None
