"""From a route of many cells to the few points that an autopilot gets."""

from __future__ import annotations

import math
from collections.abc import Sequence

from swarm.client.frame import Point
from swarm.client.route import along, between

MOST_POINTS = 60
"""Of one mission: what lies behind is uploaded when half of it is driven. Uploads take a round trip an item."""
_STRAIGHT = 1e-9


def turns(points: Sequence[Point]) -> list[Point]:
    """The points in which a line turns, with its ends, each once: they lead over the same ground."""
    kept: list[Point] = []
    for point in points:
        if kept and math.dist(kept[-1], point) == 0:
            continue
        if len(kept) > 1 and _straight(kept[-2], kept[-1], point):
            kept.pop()
        kept.append(point)
    return kept


def rest(points: Sequence[Point], place: Point, lead_m: float) -> list[Point]:
    """What is left of a line for whoever is at a place: the point of it that lies `lead_m` after the nearest, and
    the turns behind that. Its end at least, unless the line is empty."""
    if len(points) < 2:
        return list(points)
    at, share = along(points, place, lead_m)
    if at + 2 == len(points) and share == 1.0:
        return [points[-1]]
    return turns([between(points[at], points[at + 1], share), *points[at + 1 :]])


def is_end_of(points: Sequence[Point], whole: Sequence[Point]) -> bool:
    """Whether points, but for the first, are the end of others: who drives those drives these."""
    behind = points[1:] or points
    return len(behind) <= len(whole) and all(
        math.dist(a, b) < 0.01 for a, b in zip(reversed(behind), reversed(whole), strict=False)
    )


def _straight(a: Point, b: Point, c: Point) -> bool:
    ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1]
    long = math.hypot(ux, uy) * math.hypot(vx, vy)
    return abs(ux * vy - uy * vx) <= _STRAIGHT * long and ux * vx + uy * vy > 0
