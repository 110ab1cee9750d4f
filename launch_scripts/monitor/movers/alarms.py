"""Where alarms are drawn: marked places with a short text, which fade once they are over. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from launch_scripts.monitor.movers.looks import ALARM_COLOUR, Colour
from launch_scripts.monitor.movers.points import Places
from launch_scripts.observe.alarms import Alarm
from launch_scripts.observe.latest_state import VehicleColumns
from swarm.config.agents import agent_of
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import VehicleState

FADES_S = 8.0
"""An alarm that is over is seen for so long, ever greyer."""
_FADED: Colour = (96, 100, 106)
_MOST = 24
"""Marks at most: the serious come first, as in the list of alarms."""
_STRANDED = "stranded"


@dataclass(frozen=True, slots=True)
class AlarmMark:
    """A place, in metres from the grid's north-west corner, and what happened there."""

    east_m: float
    south_m: float
    text: str
    colour: Colour


def alarm_marks(
    alarms: Iterable[Alarm], now_s: float, places_m: Places, vehicles: VehicleColumns, grid: GridSpec
) -> list[AlarmMark]:
    """The alarms that have a place, and vehicles that are stranded.

    An alarm is where it says; or where its target is; or, if it is about an agent, in the middle of its vehicles.
    """
    marks: dict[tuple[float, float], AlarmMark] = {}
    for place_m, text, age_s in (*_placed(alarms, now_s, places_m, vehicles, grid), *_stranded(vehicles)):
        if age_s <= FADES_S and len(marks) < _MOST:
            share = max(age_s, 0.0) / FADES_S
            red, green, blue = (
                round((1 - share) * own + share * grey) for own, grey in zip(ALARM_COLOUR, _FADED, strict=True)
            )
            marks.setdefault(place_m, AlarmMark(*place_m, text, (red, green, blue)))
    return list(marks.values())


_Placed = tuple[tuple[float, float], str, float]
"""East and south in metres, text, and for how many seconds it has been over."""


def _placed(
    alarms: Iterable[Alarm], now_s: float, places_m: Places, vehicles: VehicleColumns, grid: GridSpec
) -> Iterator[_Placed]:
    for alarm in alarms:
        place_m = None
        if place := alarm.place(grid):
            row, col = place
            place_m = (col + 0.5) * grid.resolution_m, (row + 0.5) * grid.resolution_m
        elif alarm.target is not None:
            place_m = places_m.get(alarm.target)
        elif alarm.about.startswith("agent-"):
            place_m = _middle(vehicles, alarm.about.removeprefix("agent-"))
        if place_m is not None:
            over_s = now_s if alarm.over_s is None else alarm.over_s
            yield place_m, f"{alarm.label}: {alarm.about}", now_s - over_s


def _middle(vehicles: VehicleColumns, agent: str) -> tuple[float, float] | None:
    its = np.array([agent_of(id) == agent for id in vehicles.ids], np.bool_)
    if not its.any():
        return None
    return float(np.median(vehicles.east_m[its])), float(np.median(vehicles.south_m[its]))


def _stranded(vehicles: VehicleColumns) -> Iterator[_Placed]:
    for n in np.flatnonzero(vehicles.states == VehicleState.STRANDED)[:_MOST].tolist():
        yield (float(vehicles.east_m[n]), float(vehicles.south_m[n])), f"{_STRANDED}: {vehicles.ids[n]}", 0.0
