"""The table of transitions that `vehicle_agent.driving` gives, and a recorder of those that a vehicle makes."""

import functools
import re
from collections.abc import Callable
from typing import Any

import pytest

import vehicle_agent.driving
from vehicle_agent.driving.driven_vehicle import Vehicle

Transition = tuple[str, str, str]
"""(state, name of the method that is called, state after it)."""


def table() -> set[Transition]:
    rows = re.findall(r"^    (\w+) +([A-Z, ]+) -> ([A-Z]+)$", vehicle_agent.driving.__doc__ or "", re.MULTILINE)
    return {(before, event, after) for event, states, after in rows for before in states.split(", ")}


def record(patch: pytest.MonkeyPatch) -> set[Transition]:
    """The transitions that vehicles make from now on, by any of their methods."""
    made: set[Transition] = set()

    def watched(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def call(vehicle: Vehicle, *args: Any, **options: Any) -> Any:
            before = vehicle.state
            result = method(vehicle, *args, **options)
            if vehicle.state is not before:
                made.add((before.name, name, vehicle.state.name))
            return result

        return call

    for name, method in vars(Vehicle).items():
        if callable(method) and not name.startswith("_"):
            patch.setattr(Vehicle, name, watched(name, method))
    return made
