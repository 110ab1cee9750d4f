"""Messages about processes: which run they belong to, what they counted, notes for people."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from swarm.grid import MOST_SHARD_REGIONS, REGION_CELLS
from swarm.wire import fields
from swarm.wire.messages import Message, schema_of

TrafficParts = Annotated[int, Meta(ge=1, le=MOST_SHARD_REGIONS)]
"""Cells of right of way across a cell of the terrain."""


class RunInfo(Message, frozen=True, kw_only=True, tag=schema_of("run")):
    """The run of a process. `terrain` is a digest of grid, pace without marks and cost rules: processes with
    different ones must not share a map.

    rows, cols       0 of a router
    west_m, north_m  the north-west corner of the grid
    crs              its coordinate system
    now_ns           clock at the last tick; 0 before the first
    vehicles         of the scenario
    crew             processes which the scenario needs, as `role-id`
    restarts         in this run
    classes          of vehicles beside "ground", in the order of their numbers
    shard_cells      side of a shard: two layouts in one run would grant a cell twice
    traffic_parts    cells of right of way across a cell of the grid, 1 if absent. The cells in messages about right
                     of way, and in `Fleet`, are numbered in the finer grid
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
    traffic_parts: TrafficParts | msgspec.UnsetType = msgspec.UNSET

    @property
    def plans_to_places(self) -> bool:
        """True if a process of the run plans routes between any two places."""
        return any(name.startswith("places-") for name in self.crew)


class Alarm(msgspec.Struct, frozen=True, kw_only=True):
    """Notice to people: a collision, an author beyond its quota.

    kind     a kind in docs/reference/wire.md#values; any other word is shown as it is
    about    process, target, author or vehicle
    over_ns  when it ended; None while it lasts
    """

    kind: fields.Word
    about: fields.Word
    text: fields.Text
    since_ns: fields.StampNs
    over_ns: fields.StampNs | None = None
    cell: fields.CellIndex | None = None
    target: fields.Id | None = None


class Stats(Message, frozen=True, kw_only=True, tag=schema_of("stats")):
    """Counters of a process. A histogram maps a bucket to a count: bucket n has values near 1.04^n, bucket -20000
    those of 0 and below.

    counts_by      name -> id of a target or vehicle -> its count
    histograms_by  the same of histograms
    since          first incarnation of this process whose counts are included; 0: its own only
    alarms         open ones, and the newest closed ones
    web_port       port of its live page on its machine; 0: none
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
    """State of a candidate for one job, such as a planner or a standby.

    ready  it can do the job
    leads  it does the job
    seq    only a greater one of an incarnation counts
    heard  incarnations whose heartbeats the sender has received
    """

    role: fields.Id
    id: fields.Id
    incarnation: fields.Incarnation
    ready: bool
    leads: bool
    seq: fields.Natural
    heard: Annotated[list[fields.Incarnation], Meta(max_length=64)] = []


class Note(Message, frozen=True, kw_only=True, tag=schema_of("note")):
    """An event for people: a capture, a restart, a closed road found."""

    role: fields.Id
    id: fields.Id
    stamp_ns: fields.StampNs
    kind: fields.Word
    text: fields.Text
    cell: fields.CellIndex | None = None
    target: fields.Id | None = None
