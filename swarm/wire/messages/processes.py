"""Messages about processes: which run they belong to, what they counted, notes for people."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from swarm.grid import REGION_CELLS
from swarm.wire import fields
from swarm.wire.messages import Message, schema_of


class RunInfo(Message, frozen=True, kw_only=True, tag=schema_of("run")):
    """The run that a process belongs to. `terrain` is a digest of grid, pace without marks and cost rules:
    processes with different ones must not share a map.

    rows, cols, resolution_m  of the grid; 0 of a router, which has none
    west_m, north_m, crs      where its north-west corner is, and in which coordinate system
    now_ns                    its clock when it answered, as of its last tick; 0 before the first
    vehicles, crew            how many vehicles the scenario has, and which processes it needs, as `role-id`
    restarts                  how often the process was started again in this run
    classes                   the classes of vehicles beside "ground", in the order of their numbers
    wire_version              of its build
    shard_cells               side of a shard of right of way: two layouts in one run would grant a cell twice
    """

    run_id: fields.Word
    role: fields.Id
    id: fields.Id
    incarnation: fields.Incarnation
    scenario: fields.Word
    terrain: fields.Word
    rows: fields.GridSideOrNone
    cols: fields.GridSideOrNone
    resolution_m: fields.Distance
    started_ns: fields.StampNs
    west_m: fields.Metres = 0.0
    north_m: fields.Metres = 0.0
    crs: fields.LongText = "local"
    now_ns: fields.StampNs = 0
    vehicles: fields.Count = 0
    crew: Annotated[list[fields.Word], Meta(max_length=fields.MOST_IDS)] = []
    restarts: fields.Count = 0
    classes: Annotated[list[fields.Id], fields.IDS] = []
    wire_version: fields.Count = 8
    shard_cells: fields.Count = REGION_CELLS

    @property
    def plans_to_places(self) -> bool:
        """True if a process of the run plans routes between any two places."""
        return any(name.startswith("places-") for name in self.crew)


class Alarm(msgspec.Struct, frozen=True, kw_only=True):
    """A process's notice to people that watch the run: a collision, an author beyond its quota.

    kind      a word of `launch_scripts.observe.alarms.KINDS`; any other is shown as it is
    about     the process, target, author or vehicle that it is about
    since_ns  when it began; over_ns when it was over, None while it lasts
    """

    kind: fields.Word
    about: fields.Word
    text: fields.Text
    since_ns: fields.StampNs
    over_ns: fields.StampNs | None = None
    cell: fields.CellIndex | None = None
    target: fields.Id | None = None


class Stats(Message, frozen=True, kw_only=True, tag=schema_of("stats")):
    """Counters of a process. Histograms are as in `swarm.runtime.stats`.

    counts_by, histograms_by    name -> id of a target or vehicle -> the same, of that one alone
    since                       counts are those of all incarnations of this process from this one on; 0: of its own
    alarms                      open alarms, and the newest of the closed ones
    web_port                    port of its own machine where people can look at it in a browser; 0: none
    """

    role: fields.Id
    id: fields.Id
    incarnation: fields.Incarnation
    stamp_ns: fields.StampNs
    counts: Annotated[dict[fields.Word, fields.Count], fields.SMALL]
    gauges: Annotated[dict[fields.Word, fields.Gauge], fields.SMALL]
    histograms: Annotated[
        dict[fields.Word, Annotated[dict[fields.Bucket, fields.Count], Meta(max_length=40_000)]], fields.SMALL
    ]
    counts_by: Annotated[
        dict[fields.Word, Annotated[dict[fields.Id, fields.Count], fields.IDS]], Meta(max_length=16)
    ] = {}
    histograms_by: Annotated[
        dict[
            fields.Word,
            Annotated[
                dict[fields.Id, Annotated[dict[fields.Bucket, fields.Count], Meta(max_length=40_000)]], fields.IDS
            ],
        ],
        Meta(max_length=16),
    ] = {}
    since: fields.Incarnation = 0
    alarms: Annotated[list[Alarm], Meta(max_length=64)] = []
    web_port: fields.WebPort = 0


class Heartbeat(Message, frozen=True, kw_only=True, tag=schema_of("beat")):
    """State of a candidate for one job, such as a planner or a standby. `ready`: it can do the job. `leads`: it
    does. `seq`: number in its sender's life; only a greater one counts. `heard`: incarnations whose heartbeats its
    sender has received."""

    role: fields.Id
    id: fields.Id
    incarnation: fields.Incarnation
    ready: bool
    leads: bool
    seq: fields.Natural
    heard: Annotated[list[fields.Incarnation], Meta(max_length=64)] = []


class Note(Message, frozen=True, kw_only=True, tag=schema_of("note")):
    """An event for people: a capture, a restart, a closed road found. `cell` is its place, if it has one, `target`
    the target that it is about."""

    role: fields.Id
    id: fields.Id
    stamp_ns: fields.StampNs
    kind: fields.Word
    text: fields.Text
    cell: fields.CellIndex | None = None
    target: fields.Id | None = None
