"""The message of vehicles that are not the swarm's own, and of whatever else moves and must not be driven into."""

from __future__ import annotations

import math
from typing import Annotated

from msgspec import Meta

from swarm.wire.fields import Distance, Id, Incarnation, Metres, Natural, StampNs, VehicleId
from swarm.wire.messages.base import Message, schema_of

LONGEST_LEASE_S = 10.0
MOST_RADIUS_M = 100.0
MOST_M_PER_S = 340.0
"""What drives quicker than sound is no vehicle, as of marks. Whoever hears more of a body names it and goes on."""
Heading = Annotated[float, Meta(ge=-2 * math.tau, le=2 * math.tau)]
Speed = Annotated[float, Meta(ge=0, le=1e6)]


class Body(Message, frozen=True, kw_only=True, tag=schema_of("body")):
    """Where something is that vehicles must not drive into: a disc on the map. The newest replaces the older.

    group          whose it is, for those who watch
    incarnation    when its sender started, in ns: two senders under one id are told apart, the later counts
    seq            grows with each message of an incarnation
    stamp_ns       when it was there, by the sender's clock; nothing is decided by it
    x_m, y_m       in the terrain's frame, as of a `TargetPose`
    heading_rad    clockwise from north; None if it may go any way
    speed_m_per_s  by the wall clock
    radius_m       around the place
    lease_s        the body is forgotten so long after this message was heard; 0 takes it away at once
    """

    id: VehicleId
    group: Id = "all"
    incarnation: Incarnation
    seq: Natural
    stamp_ns: StampNs = 0
    x_m: Metres
    y_m: Metres
    heading_rad: Heading | None = None
    speed_m_per_s: Speed = 0.0
    radius_m: Distance
    lease_s: Annotated[float, Meta(ge=0, le=LONGEST_LEASE_S)] = 1.0
