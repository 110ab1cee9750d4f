"""The assigners: which of an agent's vehicles goes for which target, from the costs of all.

`spread` gives even shares, `cheapest` each vehicle its nearest, `balanced` each target its pursuers first, by a
matching of least total cost; a plug-in may do otherwise. An assigner is a function of its table: it keeps nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarm.plugins import Guard, Nonsense, OnFault, Plugin

Costs = NDArray[np.float64]

HYSTERESIS = 0.15
"""Another target must be cheaper than the current one by this share, so that vehicles do not turn round at every
change of the map."""

_LONGEST_S = 1e7
"""Longer ways count as so long, so that all sums in whole milliseconds are exact in float64."""


@dataclass(frozen=True, slots=True)
class AssignmentWorld:
    """Arguments with which an assigner is made.

    agent    id of the agent whose vehicles it assigns
    group    their group
    targets  those that the group may chase at the start; operators add and remove some
    seed     of the run
    pursuers how many vehicles of the group each target shall get first
    """

    agent: str
    group: str
    targets: tuple[str, ...]
    seed: int
    pursuers: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class CostTable:
    """Costs from each vehicle to each target.

    targets   targets with a reply of their planner; with shared costs also others' targets, then ascending
    vehicles  those that have a choice
    costs_s   (targets, vehicles) float64, inf where there is no route
    current   (vehicles,) index of the target of each now, -1 for none
    others    with shared costs: the same, for the vehicles of the group's other agents, as last received
    """

    targets: tuple[str, ...]
    vehicles: tuple[str, ...]
    costs_s: NDArray[np.float64]
    current: tuple[int, ...]
    others: CostTable | None = None


class Assigner(Protocol):
    """Decides which vehicle of an agent chases which target. A plug-in is made as
    `Name(world: AssignmentWorld, options)`.

    An assigner with a true attribute `shares_costs` receives the costs of the whole group: its agents publish
    theirs to each other, once a period.
    """

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        """Returns int64 (vehicles,): the index of a target to which the vehicle has a route; -1 lets it keep its
        target, or take the cheapest."""
        ...


class Spread:
    """Even shares: see `spread`."""

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        return spread(table.costs_s, table.current)


class Cheapest:
    """Gives each vehicle the target that it reaches first, whatever the others do."""

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        return np.full(len(table.vehicles), -1, np.int64)


class Balanced:
    """Gives each target its number of pursuers from the whole group (`need_first`), then spreads the other vehicles
    evenly (`spread`).

    All agents solve the same problem, independent of message order, and each applies the part for its own vehicles.
    If they have received different messages, a target may have more pursuers for a period.
    """

    shares_costs = True

    def __init__(self, pursuers: int) -> None:
        self._pursuers = pursuers

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        tables = [table] if table.others is None else [table, table.others]
        ids = list(chain.from_iterable(each.vehicles for each in tables))
        rows = sorted(range(len(table.targets)), key=table.targets.__getitem__)
        columns = sorted(range(len(ids)), key=ids.__getitem__)
        place = {row: n for n, row in enumerate(rows)} | {-1: -1}
        costs_s = np.concatenate([each.costs_s for each in tables], 1)[np.ix_(rows, columns)]
        now = list(chain.from_iterable(each.current for each in tables))
        current = [place[now[n]] for n in columns]
        shared = spread(costs_s, current, need_first(costs_s, current, self._pursuers))
        chosen = np.full(len(ids), -1, np.int64)
        chosen[columns] = [rows[each] if each >= 0 else -1 for each in shared.tolist()]
        return chosen[: len(table.vehicles)]


ASSIGNERS: Mapping[str, Callable[[AssignmentWorld], Assigner]] = {
    "spread": lambda world: Spread(),
    "cheapest": lambda world: Cheapest(),
    "balanced": lambda world: Balanced(world.pursuers),
}
"""The built-in assigners."""


def shares_costs(assigner: Assigner) -> bool:
    """Returns True if the agents of a group publish their costs for it."""
    return getattr(assigner, "shares_costs", False) is True


def assigner_of(plugin: Plugin, world: AssignmentWorld, report: OnFault) -> Assigner:
    """Returns the assigner that a scenario names, built-in or a plug-in. Raises ConfigError if it cannot be made.

    report  called with the fault if the plug-in fails later
    """
    if plugin.factory is None:
        return ASSIGNERS[plugin.named.name](world)
    return PluginAssigner(plugin.make(world), Guard(plugin, report))


class PluginAssigner:
    """Assignment by a plug-in; even shares once it has failed."""

    def __init__(self, assigner: Assigner, guard: Guard) -> None:
        self._assigner = assigner
        self._guard = guard
        self.shares_costs = shares_costs(assigner)

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        others = table.others and replace(table.others, costs_s=table.others.costs_s.copy())
        copied = replace(table, costs_s=table.costs_s.copy(), others=others)
        return self._guard.ask(
            lambda: self._assigner.assign(copied),
            lambda chosen: _checked(chosen, table.costs_s),
            lambda: spread(table.costs_s, table.current),
        )


def _checked(chosen: object, costs_s: NDArray[np.float64]) -> NDArray[np.int64]:
    targets, vehicles = costs_s.shape
    found = np.asarray(chosen)
    if found.shape != (vehicles,) or found.dtype.kind not in "iu":
        raise Nonsense(f"{found.dtype} {found.shape}, expected whole numbers, one for each of {vehicles} vehicles")
    wrong = (found < -1) | (found >= targets)
    if wrong.any():
        raise Nonsense(f"target {found[wrong][0]}, expected -1 to {targets - 1}")
    at = np.flatnonzero(found >= 0)
    lost = at[~np.isfinite(costs_s[found[at].astype(np.intp), at])]
    if lost.size:
        raise Nonsense(f"target {found[lost[0]]} for vehicle {lost[0]}, which has no route to it")
    return found.astype(np.int64)


# --- even shares, and need first ---


def spread(costs_s: Costs, current: Sequence[int], before: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Returns which target each vehicle goes for: the cheapest pairs first, to each target an even share of the
    vehicles.

    If each took the cheapest, all would end up in one herd (docs/method/paper.md): those which chase one target
    are together when it is captured, and have the same cheapest target again.

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
    """Returns which vehicles the targets need as pursuers.

    Each target gets `pursuers` vehicles or, if there are too few, an equal share, at least one; the sum of their
    costs is the least. If not all needed vehicles have a path, as many targets as possible get their first pursuer,
    then as many their second. Ties go by index, so that the result is the same everywhere.

    Parameters
    ----------
    costs_s : (targets, vehicles) float64, s, inf where there is no path
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

    Successive shortest paths (Busacker and Gowen, 1960) over the targets alone: the edge a-b costs what it adds to
    let a vehicle of b chase a. There are few targets and the paths are short, so relaxing all pairs at once
    (Bellman and Ford) takes a few calls of NumPy, whatever the number of vehicles. Costs are whole multiples of a
    number greater than that of targets, so that sums are exact: no rounding makes a circle of exchanges look like a
    gain.

    owner   (vehicles,) int64, the target of each, -1 for none
    filled  (targets,) int64, how many vehicles each has
    """

    def __init__(self, costs: Costs) -> None:
        targets, vehicles = costs.shape
        self.owner = np.full(vehicles, -1, np.int64)
        self.filled = np.zeros(targets, np.int64)
        self._costs = costs
        self._free = costs.copy()
        """Same as `_costs`, inf for vehicles that have an owner: they keep one, if not the same."""
        self._swap = np.where(np.eye(targets, dtype=bool), 0.0, np.inf)
        """[a, b]: what it costs more to have the vehicle `_swapped` chase a instead of its owner b, and one more,
        so that of equal paths that of fewest exchanges is the shortest; 0 where a is b."""
        self._swapped = np.zeros((targets, targets), np.int64)

    def add(self, start: int, place: int) -> None:
        """Fills this place of a target, its first being 0, if the one before is: by a free vehicle, if one can be
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
        """Computes the costs of the cheapest exchanges from a target to every other, by ever longer paths."""
        dist = np.full(len(self.filled), np.inf)
        dist[start] = 0.0
        while True:
            low = (dist[:, None] + self._swap).min(0)
            if (low == dist).all():
                return dist
            dist = low

    def _compare(self, target: int) -> None:
        """Computes what each other target adds by taking a vehicle of this one."""
        self._swap[:, target] = np.inf
        own = np.flatnonzero(self.owner == target)
        if own.size:
            more = self._costs[:, own] - self._costs[target, own]
            best = more.argmin(1)
            self._swapped[:, target] = own[best]
            self._swap[:, target] = more[np.arange(len(best)), best] + 1.0
        self._swap[target, target] = 0.0
