"""Wind that blows everywhere alike: how fast what flies is over the ground, by the direction of its flight.

A vehicle of air speed 1 in a wind w, a vector shorter than 1, flies over the ground in direction d at

    sqrt(1 - (w x d)^2) + w . d

as it heads into the wind by as much as holds it on its course: the wind triangle. A metre then takes

    (sqrt(1 - (w x d)^2) - w . d) / (1 - |w|^2)

of the time that it takes in still air. This is a norm of the vector that is flown, which need not be symmetric: no
way around is shorter in time than the straight one. What goes out and comes back the same way always takes longer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Wind:
    """A uniform wind, in air speeds of what flies in it. Raises ValueError unless it is slower than that.

    south, east  what it blows towards
    """

    south: float = 0.0
    east: float = 0.0

    def __post_init__(self) -> None:
        if not math.hypot(self.south, self.east) < 1.0:
            raise ValueError(f"wind ({self.south:g}, {self.east:g}) is not slower than what flies in it")

    @property
    def calm(self) -> bool:
        """Whether there is none."""
        return self.south == self.east == 0.0

    def time_m(self, south_m: float, east_m: float) -> float:
        """How far one comes in still air, m, while one flies this far: the length times the factor of its
        direction."""
        across = self.east * south_m - self.south * east_m
        along = self.south * south_m + self.east * east_m
        here = math.sqrt(south_m * south_m + east_m * east_m - across * across) - along
        return here / (1.0 - self.south * self.south - self.east * self.east)

    def factor(self, south_m: float, east_m: float) -> float:
        """What a metre in a direction takes, over what it takes in still air; 1 of no direction."""
        length_m = math.hypot(south_m, east_m)
        return self.time_m(south_m, east_m) / length_m if length_m else 1.0


STILL = Wind()
"""No wind."""


def wind_of(speed_mps: float, from_deg: float, airspeed_mps: float) -> Wind:
    """Wind as it is told: its speed, and where it comes from, clockwise from north."""
    share, towards = speed_mps / airspeed_mps, math.radians(from_deg % 360.0 + 180.0)
    return Wind(south=-share * math.cos(towards), east=share * math.sin(towards))
