"""Messages about targets: poses and sightings."""

from __future__ import annotations

from swarm.wire.fields import Cell, Count, Distance, Id, Incarnation, Metres, Natural, StampNs
from swarm.wire.messages.base import Message, schema_of


class TargetPose(Message, frozen=True, kw_only=True, tag=schema_of("pose")):
    """Where a target is.

    seq       grows within an incarnation of the process that tracks it
    captures  how often it was captured
    jumps     how often it was put somewhere else, as after a capture
    """

    target: Id
    incarnation: Incarnation
    seq: Natural
    stamp_ns: StampNs
    cell: Cell
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
