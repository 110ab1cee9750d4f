"""Messages about vehicles that leave while the swarm runs (decision 40)."""

from __future__ import annotations

from typing import Annotated

from swarm.wire.fields import SMALL, Count, Id, VehicleId
from swarm.wire.messages.base import Message, schema_of


class RemoveVehicles(Message, frozen=True, kw_only=True, tag=schema_of("remove-vehicles")):
    """An operator asks an agent to let vehicles leave; all that it hosts if none is named. To ask again is
    harmless."""

    vehicles: Annotated[list[VehicleId], SMALL] = []


class Removed(Message, frozen=True, kw_only=True, tag=schema_of("removed")):
    """What has become of such a request.

    left     the vehicles asked for that are gone from the agent
    unknown  those that it does not host, and has not let leave
    held     of those that left: how many hold cells that are not known to be free yet
    """

    agent: Id
    left: Annotated[list[VehicleId], SMALL]
    unknown: Annotated[list[VehicleId], SMALL] = []
    held: Count = 0
