"""Who chases what, from the costs of all: even shares, or need first, each target's pursuers by a matching of least
total cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Costs = NDArray[np.float64]

HYSTERESIS = 0.15
"""Another target must be cheaper than the current one by this share, so that vehicles do not turn round at every
change of the map."""

_LONGEST_S = 1e7
"""Longer ways count as so long, so that all sums in whole milliseconds are exact in float64."""


def spread(costs_s: Costs, current: Sequence[int], before: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Which target each vehicle goes for: the cheapest pairs first, to each target an even share of the vehicles.

    If each took the cheapest, all would end up in one herd (docs/method.md): those which chase one target stand
    together when it is caught, and have the same cheapest target again.

    Parameters
    ----------
    costs_s : (targets, vehicles) float64, inf where there is no route
    current : (vehicles,) the target of each now, -1 for none; another must be cheaper by `HYSTERESIS`
    before  : (vehicles,) int64, the target of those that have one for sure, -1 for the rest; none if not given

    Returns
    -------
    (vehicles,) int64, index of a target. -1 for a vehicle all whose targets have their share or are out of reach.
    """
    targets, vehicles = costs_s.shape
    most = -(-vehicles // targets)
    costs_s = costs_s.copy()
    for vehicle, target in enumerate(current):
        if target >= 0:
            costs_s[target, vehicle] *= 1.0 - HYSTERESIS
    chosen = np.full(vehicles, -1, np.int64) if before is None else before.copy()
    left = (most - np.bincount(chosen[chosen >= 0], minlength=targets)).tolist()
    order = np.argsort(costs_s, axis=None, kind="stable")[: int(np.isfinite(costs_s).sum())]
    for target, vehicle in zip(*(each.tolist() for each in np.divmod(order, vehicles)), strict=True):
        if chosen[vehicle] < 0 < left[target]:
            chosen[vehicle] = target
            left[target] -= 1
    return chosen


def need_first(costs_s: Costs, current: Sequence[int], pursuers: int) -> NDArray[np.int64]:
    """Which vehicles the targets need as pursuers.

    Each target gets `pursuers` of them, or as many as there are for each where vehicles are fewer, one at least;
    the sum of their costs is the least. Where not all that are needed have a way, as many targets as can be get
    their first pursuer, then as many their second. Ties go by index: whoever sorts alike finds the same.

    Parameters
    ----------
    costs_s : (targets, vehicles) float64, s, inf where there is no way
    current : (vehicles,) the target of each now, -1 for none; another must be cheaper by `HYSTERESIS`

    Returns
    -------
    (vehicles,) int64, index of a target that the vehicle has a way to; -1 for those that no target needs
    """
    found = np.full(costs_s.shape[1], -1, np.int64)
    reached = np.isfinite(costs_s)
    targets, vehicles = np.flatnonzero(reached.any(1)), np.flatnonzero(reached.any(0))
    if not targets.size:
        return found
    costs = np.minimum(costs_s, _LONGEST_S) * 1e3
    held = np.flatnonzero(np.asarray(current) >= 0)
    costs[np.asarray(current)[held], held] *= 1.0 - HYSTERESIS
    costs = np.where(reached, np.rint(costs) * (targets.size + 1), np.inf)
    each = min(pursuers, max(1, vehicles.size // targets.size))
    matched = _Matching(costs[np.ix_(targets, vehicles)])
    for place in range(each):
        for target in range(targets.size):
            matched.add(target, place)
    needed = matched.owner >= 0
    found[vehicles[needed]] = targets[matched.owner[needed]]
    return found


class _Matching:
    """Vehicles matched to targets at least total cost, grown by one place of a target at a time.

    Successive shortest paths (Busacker and Gowen, 1960) over the targets alone: target a is followed by b at what
    it costs more to have one of b's vehicles chase a. There are few targets and the paths are short, so relaxing
    all pairs at once (Bellman and Ford) takes a few calls of NumPy, whatever the number of vehicles. Costs are
    whole multiples of a number greater than that of targets, so that sums are exact: no rounding makes a circle of
    exchanges look like a gain.

    owner   (vehicles,) int64, the target of each, -1 for none
    filled  (targets,) int64, how many vehicles each has
    """

    def __init__(self, costs: Costs) -> None:
        targets, vehicles = costs.shape
        self.owner = np.full(vehicles, -1, np.int64)
        self.filled = np.zeros(targets, np.int64)
        self._costs = costs
        self._free = costs.copy()
        """As `_costs`, inf for vehicles that have an owner: they have one for good, if not the same."""
        self._swap = np.where(np.eye(targets, dtype=bool), 0.0, np.inf)
        """[a, b]: what it costs more to have the vehicle `_swapped` chase a instead of its owner b, and one more,
        so that of equal paths that of fewest exchanges is the shortest; 0 where a is b."""
        self._swapped = np.zeros((targets, targets), np.int64)

    def add(self, start: int, place: int) -> None:
        """Fill this place of a target, its first being 0, if the one before is: by a free vehicle, if one can be
        had. Else the target which has this place at the highest cost gives it up, or this one goes without."""
        if self.filled[start] < place:
            return
        dist = self._lengths(start)
        ends = dist + self._free.min(1)
        last = int(ends.argmin())
        self.filled[start] += 1
        if ends[last] < np.inf:
            vehicle = int(self._free[last].argmin())
            self._free[:, vehicle] = np.inf
            self.owner[vehicle] = last
        else:
            last = int(np.where(self.filled > place, dist, np.inf).argmin())
            self.filled[last] -= 1
        changed = [last]
        while last != start:
            taker = int(np.delete(dist + self._swap[:, last], last).argmin())
            taker += taker >= last
            self.owner[self._swapped[taker, last]] = taker
            changed.append(last := taker)
        for target in changed:
            self._compare(target)

    def _lengths(self, start: int) -> Costs:
        """What the cheapest exchanges cost from a target to every other, by ever longer paths."""
        dist = np.full(len(self.filled), np.inf)
        dist[start] = 0.0
        while True:
            low = (dist[:, None] + self._swap).min(0)
            if (low == dist).all():
                return dist
            dist = low

    def _compare(self, target: int) -> None:
        """What others would pay for a vehicle of this target."""
        self._swap[:, target] = np.inf
        own = np.flatnonzero(self.owner == target)
        if own.size:
            more = self._costs[:, own] - self._costs[target, own]
            best = more.argmin(1)
            self._swapped[:, target] = own[best]
            self._swap[:, target] = more[np.arange(len(best)), best] + 1.0
        self._swap[target, target] = 0.0
