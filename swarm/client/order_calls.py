"""Orders to a running swarm, as `swarm pause`, `swarm order zone` and the other commands give them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import msgspec

from swarm.client.session import Session
from swarm.errors import ConfigError
from swarm.runtime.operator import Acknowledged, Operator
from swarm.wire.codec import field_fault
from swarm.wire.messages import Message
from swarm.wire.messages.orders import GiveOrder, Order, SendVehicle, Then, VehicleGoals, Zone, ZoneOrder
from swarm.wire.versions import schema_of_type

M = TypeVar("M", bound=Message)


class Orders:
    """Gives orders. Made by `Swarm.orders`. Each call waits until a keeper has stored the order and the processes
    concerned obey it. It returns the processes that obey and those that have not replied.

    Each raises ConfigError where the order is not possible, in the keeper's words, and BusError without a keeper.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._operator = Operator(session.bus)

    def pause(self) -> Acknowledged:
        """Stops all vehicles and simulated targets where they are."""
        return self._give(subject="pause")

    def resume(self) -> Acknowledged:
        """Resumes all."""
        return self._give(subject="pause", off=True)

    def stop(self, vehicle: str) -> Acknowledged:
        """Stops one vehicle of the swarm."""
        return self._give(subject="vehicle", name=vehicle)

    def go(self, vehicle: str) -> Acknowledged:
        """Resumes it."""
        return self._give(subject="vehicle", name=vehicle, off=True)

    def send(self, vehicle: str, places: Sequence[str], *, then: Then = "hold") -> Acknowledged:
        """Sends a vehicle of the swarm to places, one after the other, instead of an earlier order.

        places  as commands have them: "46.81,9.84", "xy:X,Y" or "cell:ROW,COL"
        then    after the last: "hold" there, "chase" targets again, or "repeat" from the first
        """
        return self._operator.give(_checked(SendVehicle, vehicle=vehicle, places=list(places), then=then))[1]

    def recall(self, vehicle: str) -> Acknowledged:
        """Returns it to the chase of targets."""
        return self._operator.give(_checked(SendVehicle, vehicle=vehicle, off=True))[1]

    def goals(self) -> list[VehicleGoals]:
        """The places to which vehicles were sent."""
        return list(self._operator.goals().goals)

    def chase(self, group: str, targets: Sequence[str] | None) -> Acknowledged:
        """States which targets the vehicles of a group may chase; None: those of the scenario."""
        return self._give(subject="group", name=group, targets=list(targets or ()), off=targets is None)

    def add_target(
        self, id: str, x_m: float, y_m: float, *, walk: str | None = None, speed_m_per_s: float | None = None
    ) -> Acknowledged:
        """Puts a new simulated target somewhere."""
        cell = self._session.frame.cell(x_m, y_m)
        return self._give(subject="target", name=id, cell=cell, walk=walk, speed_m_per_s=speed_m_per_s, new=True)

    def move_target(self, id: str, x_m: float, y_m: float) -> Acknowledged:
        """Puts a simulated target somewhere else."""
        return self._give(subject="target", name=id, cell=self._session.frame.cell(x_m, y_m))

    def remove_target(self, id: str) -> Acknowledged:
        """No vehicle chases it any more."""
        return self._give(subject="target", name=id, off=True)

    def set(self, key: str, value: float | None) -> Acknowledged:
        """Changes a setting of the scenario that may change live; None: what the scenario says."""
        return self._give(subject="set", name=key, value=value, off=value is None)

    def add_zone(
        self,
        polygon_m: Sequence[tuple[float, float]],
        *,
        name: str = "",
        pace_s_per_m: float | None = None,
        for_s: float | None = None,
        vehicle_class: str | None = None,
    ) -> tuple[str, Acknowledged]:
        """Closes an area, or give it a pace. Returns the zone's name, too.

        polygon_m     corners (x_m, y_m)
        name          a zone that has it is replaced; the keeper finds one if it is empty
        pace_s_per_m  None: no vehicle enters
        for_s         the zone ends by itself; None: never
        vehicle_class  for vehicles of this class only; None: for all
        """
        zones, acknowledged = self._operator.zone(
            _checked(
                ZoneOrder, action="add", name=name, kind="lethal" if pace_s_per_m is None else "pace",
                pace_s_per_m=pace_s_per_m, polygon_m=[*map(list, polygon_m)],
                lasts_s=for_s, vehicle_class=vehicle_class,
            )
        )  # fmt: skip
        return zones.changed, acknowledged

    def remove_zone(self, name: str) -> Acknowledged:
        """Opens an area again."""
        return self._operator.zone(_checked(ZoneOrder, action="remove", name=name))[1]

    def zones(self) -> list[Zone]:
        """The zones that stand."""
        return list(self._operator.zones().zones)

    def given(self) -> list[Order]:
        """All else that is ordered."""
        return list(self._operator.orders().orders)

    def _give(self, **fields: Any) -> Acknowledged:
        return self._operator.give(_checked(GiveOrder, **fields))[1]


def _checked(message_type: type[M], /, **fields: Any) -> M:
    given = {name: value for name, value in fields.items() if value is not None}
    try:
        return msgspec.convert({**given, "schema": schema_of_type(message_type)}, message_type)
    except (msgspec.ValidationError, ValueError) as error:
        raise ConfigError(f"the order is not possible: {field_fault(error, given)}") from None
