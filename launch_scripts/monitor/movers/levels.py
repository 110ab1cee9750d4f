"""How much is drawn of each vehicle: the less, the more vehicles there are. Pure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Level:
    """One level of detail.

    most            vehicles for which it is used, at most
    radius_px       of a vehicle's ball, in points of the viewer's window
    line_px         of trails and routes
    frames          vehicles are drawn in every so many frames
    trail_every_s   a piece of each trail is drawn so often
    trail_s         so long a trail is seen
    details_s       who each vehicle is and what it does is told again so often
    routes_s        all routes are drawn once in this time
    route_stride    a route has a point for so many cells
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
    """The level of detail for so many vehicles."""
    return next(level for level in LEVELS if vehicles <= level.most)
