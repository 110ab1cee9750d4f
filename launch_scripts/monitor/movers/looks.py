"""How everything that moves looks, and what the legend says of it. Pure: no rerun.

The one place of these colours. They are Okabe and Ito's, which the colour-blind tell apart. Hue says whose a
vehicle is, brightness how it does, shape what something is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Bytes
from launch_scripts.observe import palette
from swarm.wire.messages.vehicles import VehicleState

Colour = tuple[int, int, int]
Shape = Literal["ball", "box", "pin", "ring", "disc", "line", "fill", "hatch"]


HUES: tuple[Colour, ...] = tuple(
    map(
        palette.rgb,
        (palette.SKY, palette.ORANGE, "#F0E442", palette.PINK, palette.GREEN, "#E8601C", "#0F6FC6"),
    )
)
"""In turn for groups, or targets. Blue and vermilion are lighter than theirs: the ground is dark."""
NOBODY: Colour = (170, 176, 182)
"""Of vehicles without a target, where hues are targets."""
TARGET_COLOUR: Colour = (255, 255, 255)
"""Of all targets, where hues are groups."""
LOST_COLOUR: Colour = (120, 124, 130)
BODY_COLOUR: Colour = (118, 84, 60)
SIGHTED_COLOUR: Colour = (255, 255, 255)
SEARCHED_COLOUR: Colour = (253, 174, 107)
ROUTE_COLOUR: Colour = (205, 212, 220)
ALARM_COLOUR: Colour = (255, 64, 48)
HINT = "point at a vehicle or target to read who it is"
_GROUPS = 4
"""Groups in the legend: more have no place there."""


@dataclass(frozen=True, slots=True)
class Shade:
    """How a hue is changed: `share` of `towards` is mixed in.

    meaning  the legend's words; None where another state's entry says it
    """

    towards: Colour
    share: float
    meaning: str | None


SHADES: dict[VehicleState, Shade] = {
    VehicleState.FOLLOWING: Shade((0, 0, 0), 0.0, "on its way"),
    VehicleState.ARRIVED: Shade((255, 255, 255), 0.65, "arrived"),
    VehicleState.WAITING: Shade((0, 0, 0), 0.55, "waits"),
    VehicleState.IDLE: Shade((0, 0, 0), 0.55, None),
    VehicleState.STRANDED: Shade((0, 0, 0), 0.9, "stranded"),
    VehicleState.LOST: Shade((128, 132, 138), 0.85, "planner or target lost"),
    VehicleState.OUTDATED: Shade((128, 132, 138), 0.85, None),
    VehicleState.SEARCHING: Shade((255, 255, 255), 0.35, "searches"),
}


@dataclass(frozen=True, slots=True)
class Look:
    """One line of the legend: a shape in a colour, and what it stands for."""

    shape: Shape
    colour: Colour
    meaning: str


def shaded(hue: Colour, state: VehicleState) -> Colour:
    """The colour of a vehicle whose group or target has this hue."""
    shade = SHADES[state]
    red, green, blue = (
        round((1 - shade.share) * own + shade.share * other) for own, other in zip(hue, shade.towards, strict=True)
    )
    return red, green, blue


def dimmed(colours: Bytes) -> Bytes:
    """Of trails: darker than the vehicles that leave them."""
    darker: Bytes = (colours * np.float32(0.62)).astype(np.uint8)
    return darker


class Looks:
    """The colours of one run. Where all vehicles are of one group, hues are targets: vehicles, their routes and the
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
        """Of routes to a target: darker than its vehicles, which are on top of them."""
        hue = self._hue.get(target, ROUTE_COLOUR) if self.by_target else ROUTE_COLOUR
        red, green, blue = (round(0.85 * value) for value in hue)
        return red, green, blue

    def legend(self) -> list[Look]:
        """What is drawn of all that moves."""
        first = next(iter(self._hue.values()), NOBODY)
        if self.by_target:
            who = [Look("ball", first, "vehicle, hue by target")]
        else:
            who = [Look("ball", self._hue[name], f"of {name[:14]}") for name in self.groups[:_GROUPS]]
        states = [
            Look("ball", shaded(first, state), shade.meaning)
            for state, shade in SHADES.items()
            if shade.meaning is not None and state != VehicleState.FOLLOWING
        ]
        return [
            *who,
            *states,
            Look("box", (240, 243, 246), "around guests"),
            Look("pin", self.target(next(iter(self.target_ids), "")), "target"),
            Look("ring", SIGHTED_COLOUR, "hidden target seen"),
            Look("disc", BODY_COLOUR, "body to keep off"),
            Look("line", self.route(next(iter(self.target_ids), "")), "route, trail"),
            Look("pin", ALARM_COLOUR, "alarm"),
        ]
