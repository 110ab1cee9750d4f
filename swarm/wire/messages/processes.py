"""Messages about processes: which run they belong to, what they counted, notes for people."""

from __future__ import annotations

from swarm.wire.fields import TOP_BUCKET, ZERO_BUCKET, Cell, Natural, check_finite, check_id
from swarm.wire.messages.base import Message, schema_of


class RunInfo(Message, frozen=True, kw_only=True, tag=schema_of("run")):
    """The run that a process belongs to. `terrain` is a digest of grid, prior pace and cost rules: processes with
    different ones must not share a map."""

    run_id: str
    role: str
    id: str
    incarnation: Natural
    scenario: str
    terrain: str
    rows: Natural
    cols: Natural
    resolution_m: float
    started_ns: Natural


class Stats(Message, frozen=True, kw_only=True, tag=schema_of("stats")):
    """What a process has counted since its incarnation began. Histograms are as in `swarm.runtime.stats`."""

    role: str
    id: str
    incarnation: Natural
    stamp_ns: Natural
    counts: dict[str, Natural]
    gauges: dict[str, float]
    histograms: dict[str, dict[int, Natural]]

    def __post_init__(self) -> None:
        check_id("role", self.role)
        check_id("id", self.id)
        check_finite("a gauge", *self.gauges.values())
        for name, buckets in self.histograms.items():
            for bucket in buckets:
                if not ZERO_BUCKET <= bucket <= TOP_BUCKET:
                    raise ValueError(f"histogram {name[:80]} has a bucket {bucket}")


class Note(Message, frozen=True, kw_only=True, tag=schema_of("note")):
    """An event for people: a capture, a restart, a closed road found. `cell` is its place, if it has one."""

    role: str
    id: str
    stamp_ns: Natural
    kind: str
    text: str
    cell: Cell | None = None

    def __post_init__(self) -> None:
        check_id("role", self.role)
        check_id("id", self.id)
