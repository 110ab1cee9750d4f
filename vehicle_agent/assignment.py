"""Which target each vehicle goes for: the one that it reaches at the lowest cost, if the change is worth it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Choice:
    """target  the one to go for; None if there is no way to any
    settled  false where too few planners answered to say anything
    """

    target: str | None
    settled: bool = True


UNSETTLED = Choice(None, settled=False)


HYSTERESIS = 0.15
"""Another target must be cheaper than the current one by this share, so that vehicles do not turn round at every
change of the map."""


def choose(
    costs_s: Mapping[str, float],
    allowed: Sequence[str],
    alive: Mapping[str, int],
    current: str | None,
    keep_silent: bool,
) -> Choice:
    """The cheapest of a vehicle's targets.

    costs_s      per target that answered, inf where there is no way
    alive        targets whose planner is there
    keep_silent  stay with a current target whose planner has not answered
    """
    if current is not None and current not in costs_s and (keep_silent or current in alive):
        return Choice(current)
    best, best_s = None, math.inf
    for target in allowed:
        cost_s = costs_s.get(target, math.inf)
        if cost_s < best_s:
            best, best_s = target, cost_s
    if best is None:
        answered = [target for target in allowed if target in costs_s]
        silent = [target for target in allowed if target in alive and target not in costs_s]
        return Choice(None) if answered and not silent else UNSETTLED
    if current is not None and best_s > (1.0 - HYSTERESIS) * costs_s.get(current, math.inf):
        return Choice(current)
    return Choice(best)
