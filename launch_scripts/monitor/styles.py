"""Styles of moving entities, their level of detail and rate, and their entries in the legend. No rerun.

The one place of these colours. They are Okabe and Ito's, which the colour-blind tell apart. Hue says whose a
vehicle is, brightness how it does, shape what something is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.rerun_outputs import Colour
from launch_scripts.monitor.terrain_mesh import Bytes
from launch_scripts.observe import palette
from swarm.wire.messages.vehicles import VehicleState

Shape = Literal["ball", "ring", "line", "fill", "hatch"]

HUES: tuple[Colour, ...] = tuple(
    map(palette.rgb, (palette.SKY, palette.ORANGE, "#F0E442", palette.PINK, palette.GREEN, "#E8601C", "#0F6FC6"))
)
"""In turn for groups, or targets. Blue and vermilion are lighter than theirs: the ground is dark."""
NOBODY: Colour = (170, 176, 182)
"""Colour of vehicles without a target, where hues are targets."""
TARGET_COLOUR: Colour = (255, 255, 255)
"""Colour of all targets, where hues are groups."""
LOST_COLOUR: Colour = (120, 124, 130)
OBSTACLE_COLOUR: Colour = (118, 84, 60)
SIGHTED_COLOUR: Colour = (255, 255, 255)
SEARCHED_COLOUR: Colour = (253, 174, 107)
ROUTE_COLOUR: Colour = (205, 212, 220)
ALARM_COLOUR: Colour = (255, 64, 48)
FLAG_COLOUR: Colour = (110, 220, 120)
FOLLOWED_ENTITY = "world/followed"
"""The vehicle or target that the camera follows: an entity whose origin moves."""
HINT = "point at a vehicle or target to read who it is"
_GROUPS = 4
"""Groups in the legend: more have no place there."""


SHADES: dict[VehicleState, tuple[Colour, float]] = {
    VehicleState.FOLLOWING: ((0, 0, 0), 0.0),
    VehicleState.ARRIVED: ((255, 255, 255), 0.65),
    VehicleState.WAITING: ((0, 0, 0), 0.55),
    VehicleState.IDLE: ((0, 0, 0), 0.55),
    VehicleState.STRANDED: ((0, 0, 0), 0.9),
    VehicleState.LOST: ((128, 132, 138), 0.85),
    VehicleState.OUTDATED: ((128, 132, 138), 0.85),
    VehicleState.SEARCHING: ((255, 255, 255), 0.35),
}
"""Colour mixed into a hue, and its share."""


class Entry(NamedTuple):
    """One line of the legend: a shape in a colour, and what it stands for."""

    shape: Shape
    colour: Colour
    meaning: str


def mixed(colour: Colour, other: Colour, share: float) -> Colour:
    """A colour with a share of another one."""
    red, green, blue = (round((1 - share) * own + share * its) for own, its in zip(colour, other, strict=True))
    return red, green, blue


def shaded(hue: Colour, state: VehicleState) -> Colour:
    """The colour of a vehicle whose group or target has this hue."""
    return mixed(hue, *SHADES[state])


def dimmed(colours: Bytes) -> Bytes:
    """Returns the colour of trails: darker than the vehicles that leave them."""
    darker: Bytes = (colours * np.float32(0.62)).astype(np.uint8)
    return darker


class Colours:
    """The colours of one run. If all vehicles are of one group, hues are targets: vehicles, their routes and the
    target that they chase have one. With several groups they are groups, and all targets look alike."""

    def __init__(self, groups: Sequence[str], target_ids: Sequence[str]) -> None:
        self.by_target = len(groups) <= 1
        self.groups = list(groups)
        self.target_ids = list(target_ids)
        self._hue = {name: HUES[n % len(HUES)] for n, name in enumerate(target_ids if self.by_target else groups)}
        self._shaded = np.array(
            [[shaded(hue, state) for state in VehicleState] for hue in (*self._hue.values(), NOBODY)], np.uint8
        )
        self._row = {name: n for n, name in enumerate(self._hue)}

    def rows(self, names: Sequence[str | None]) -> list[int]:
        """The rows of `vehicles` for groups or targets; unknown ones and None have the last."""
        return [-1 if name is None else self._row.get(name, -1) for name in names]

    def vehicles(self, rows: NDArray[np.intp], states: Bytes) -> Bytes:
        """uint8 (n, 3)."""
        colours: Bytes = self._shaded[rows, states]
        return colours

    def target(self, id: str, lost: bool = False) -> Colour:
        if lost:
            return LOST_COLOUR
        return self._hue.get(id, TARGET_COLOUR) if self.by_target else TARGET_COLOUR

    def route(self, target: str) -> Colour:
        """Returns the colour of routes to a target: darker than its vehicles, which are on top of them."""
        hue = self._hue.get(target, ROUTE_COLOUR) if self.by_target else ROUTE_COLOUR
        return mixed(hue, (0, 0, 0), 0.15)

    def legend(self) -> list[Entry]:
        """Returns the legend of all moving entities."""
        first, target = next(iter(self._hue.values()), NOBODY), next(iter(self.target_ids), "")
        if self.by_target:
            who = [Entry("ball", first, "vehicle, hue by target")]
        else:
            who = [Entry("ball", self._hue[name], f"of {name[:14]}") for name in self.groups[:_GROUPS]]
        alike: dict[Colour, list[str]] = {}
        for state in [*SHADES][1:]:  # a vehicle that is following has the hue itself
            alike.setdefault(shaded(first, state), []).append(state.name.lower())
        states = [Entry("ball", colour, ", ".join(names)) for colour, names in alike.items()]
        return [
            *who,
            *states,
            Entry("ball", self.target(target), "target on a pole"),
            Entry("ring", SIGHTED_COLOUR, "hidden target seen"),
            Entry("ball", OBSTACLE_COLOUR, "obstacle to keep off"),
            Entry("line", self.route(target), "route, trail"),
            Entry("ball", ALARM_COLOUR, "alarm on a pole"),
            Entry("ball", FLAG_COLOUR, "place of an order"),
        ]


class Level(NamedTuple):
    """Level of detail of each vehicle: the less, the more vehicles there are.

    most            vehicles for which it is used, at most
    radius_px       of a vehicle's ball, in points of the viewer's window
    line_px         of trails and routes
    frames          vehicles are drawn in every n-th frame
    trail_every_s   a piece of each trail is drawn at this interval
    trail_s         a trail is shown for this time
    details_s       interval of each vehicle's description and state
    routes_s        all routes are drawn once in this time
    route_stride    cells between two points of a route
    names           whether vehicles' ids are shown all the time
    """

    most: int
    radius_px: float
    line_px: float
    frames: int
    trail_every_s: float
    trail_s: float
    details_s: float
    routes_s: float
    route_stride: int
    names: bool


LEVELS = (
    Level(30, 6.5, 1.4, 1, 0.5, 25.0, 1.0, 1.5, 2, True),
    Level(150, 5.4, 1.2, 1, 0.5, 25.0, 1.0, 1.5, 3, False),
    Level(400, 4.6, 1.0, 1, 0.5, 20.0, 2.0, 3.0, 3, False),
    Level(2000, 3.8, 0.7, 2, 1.0, 12.0, 4.0, 4.0, 4, False),
    Level(1 << 62, 2.4, 0.6, 5, 2.0, 10.0, 10.0, 10.0, 6, False),
)


def level_for(vehicles: int) -> Level:
    """Returns the level of detail for a number of vehicles."""
    return next(level for level in LEVELS if vehicles <= level.most)
