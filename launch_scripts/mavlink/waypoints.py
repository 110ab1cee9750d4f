"""From a route of many cells to the few points that an autopilot gets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

Point = tuple[float, float]
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
    nearest, at, share = math.inf, 0, 0.0
    for number, (a, b) in enumerate(pairwise(points)):
        along = _share(a, b, place)
        distance = math.dist(_between(a, b, along), place)
        if distance < nearest:
            nearest, at, share = distance, number, along
    while True:
        a, b = points[at], points[at + 1]
        step_m = math.dist(a, b)
        left_m = step_m * (1 - share)
        if lead_m < left_m:
            first = _between(a, b, share + lead_m / step_m)
            return turns([first, *points[at + 1 :]])
        if at + 2 == len(points):
            return [b]
        lead_m, at, share = lead_m - left_m, at + 1, 0.0


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


def _share(a: Point, b: Point, place: Point) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    long = dx * dx + dy * dy
    return min(1.0, max(0.0, ((place[0] - a[0]) * dx + (place[1] - a[1]) * dy) / long)) if long else 0.0


def _between(a: Point, b: Point, share: float) -> Point:
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])
