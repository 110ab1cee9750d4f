"""Messages about targets: poses and sightings."""

from __future__ import annotations

from swarm.wire.fields import Cell, Count, Distance, Id, Incarnation, LeaseSeconds, Metres, Natural, StampNs
from swarm.wire.messages.base import Message, schema_of

CELL_OF_PLACE = -1
"""In a pose: the sender knows no grid, and each receiver finds the cell by its own."""
POSE_LEASE_S = 2.0
"""Of a tracker that tells at least twice a second, as simulated targets do."""


class TargetPose(Message, frozen=True, kw_only=True, tag=schema_of("pose")):
    """Where a target is, by one of its trackers. Whose poses count is decided by `swarm.runtime.tracking`.

    tracker      name of the tracker; a later incarnation of the same name takes over at once. Without a name each
                 incarnation is a tracker of its own
    incarnation  when the tracker began to track this target, by the clock of `stamp_ns`
    seq          grows within an incarnation
    lease_s      the tracker counts as lost when no pose of it has arrived for so long; 0 hands the target over
    cell         the cell of the place; left out it is that of `x_m`, `y_m`
    captures     how often it was captured
    jumps        how often it was put somewhere else, as after a capture
    """

    target: Id
    tracker: Id | None = None
    incarnation: Incarnation
    seq: Natural
    lease_s: LeaseSeconds = POSE_LEASE_S
    stamp_ns: StampNs
    cell: Cell = CELL_OF_PLACE
    x_m: Metres
    y_m: Metres
    captures: Count = 0
    jumps: Count = 0


class Sighted(Message, frozen=True, kw_only=True, tag=schema_of("sighted")):
    """A sighting: a vehicle of this author saw a target within `uncertainty_m` of the place. It expires at
    `until_ns`, and the author's next sighting of the target replaces it."""

    author: Id
    group: Id
    target: Id
    seq: Natural
    stamp_ns: StampNs
    until_ns: StampNs
    cell: Cell
    x_m: Metres
    y_m: Metres
    uncertainty_m: Distance
