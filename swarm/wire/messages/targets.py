"""Messages about targets: poses and sightings."""

from __future__ import annotations

from swarm.wire.fields import Cell, Metres, Natural, check_id
from swarm.wire.messages.base import Message, schema_of


class TargetPose(Message, frozen=True, kw_only=True, tag=schema_of("pose")):
    """Where a target is.

    seq       grows within an incarnation of the process that tracks it
    captures  how often it was captured
    jumps     how often it was put somewhere else, as after a capture
    """

    target: str
    incarnation: Natural
    seq: Natural
    stamp_ns: Natural
    cell: Cell
    x_m: Metres
    y_m: Metres
    captures: Natural = 0
    jumps: Natural = 0

    def __post_init__(self) -> None:
        check_id("target", self.target)


class Sighted(Message, frozen=True, kw_only=True, tag=schema_of("sighted")):
    """A sighting: a vehicle of this author saw a target within `uncertainty_m` of the place. It expires at
    `until_ns`, and the author's next sighting of the target replaces it."""

    author: str
    group: str
    target: str
    seq: Natural
    stamp_ns: Natural
    until_ns: Natural
    cell: Cell
    x_m: Metres
    y_m: Metres
    uncertainty_m: Metres

    def __post_init__(self) -> None:
        check_id("author", self.author)
        check_id("group", self.group)
        check_id("target", self.target)
        if self.uncertainty_m < 0:
            raise ValueError(f"uncertainty_m is {self.uncertainty_m}, expected 0 or more")
