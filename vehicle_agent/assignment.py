"""Which target each vehicle goes for: at low cost, shared out over the targets, if the change is worth it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.plugins.find import Plugin
from swarm.plugins.guard import Guard, Nonsense, Tell
from swarm.wire.messages.vehicles import SharedCosts, VehicleState
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.group_costs import GroupCosts
from vehicle_agent.matching import HYSTERESIS, need_first, spread

_RETRY_NS = NS_PER_S // 2
_STRANDED_RETRY_NS = 3 * NS_PER_S
_JUMPS_APART_NS = NS_PER_S // 50
"""For each target: so long after a request a jump of a target may cause the next. With many targets one always
jumps, and every agent would ask every planner all the time. Up to 25 targets nothing waits for it."""
_LEASE_PERIODS = 3
"""An agent of the group that has told no costs for so many periods is gone."""


@dataclass(frozen=True, slots=True)
class AskCosts:
    """One request to every planner: the cost-to-go of these cells, one per vehicle."""

    request: int
    vehicles: tuple[str, ...]
    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Choice:
    """target   the one to go for; None if there is no route to any
    settled  False where too few planners have answered to say anything
    """

    target: str | None
    settled: bool = True


UNSETTLED = Choice(None, settled=False)


def choose(
    costs_s: Mapping[str, float],
    allowed: Sequence[str],
    alive: Mapping[str, int],
    current: str | None,
    keep_silent: bool,
) -> Choice:
    """The cheapest of a vehicle's targets.

    costs_s      cost-to-go per target that answered, inf where there is no route
    allowed      the vehicle's targets
    alive        targets whose planner is alive
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


@dataclass(frozen=True, slots=True)
class AssignmentWorld:
    """What an assigner is made with.

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
    """What each vehicle would need to each target.

    targets   those whose planners have answered; where costs are shared, ascending, those that others told of too
    vehicles  those that have a choice
    costs_s   (targets, vehicles) float64, inf where there is no route
    current   (vehicles,) index of the target of each now, -1 for none
    others    where costs are shared: the same, of the vehicles of the group's other agents, as they told it last
    """

    targets: tuple[str, ...]
    vehicles: tuple[str, ...]
    costs_s: NDArray[np.float64]
    current: tuple[int, ...]
    others: CostTable | None = None


class Assigner(Protocol):
    """Says which vehicle of an agent goes for which target. A plug-in is made as
    `Name(world: AssignmentWorld, options)`.

    One that has an attribute `shares_costs`, and it is true, is told the costs of the whole group: its agents tell
    each other theirs, once a period.
    """

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        """(vehicles,) index of a target that the vehicle has a route to; -1 lets it keep its target, or take the
        cheapest."""
        ...


class Spread:
    """Even shares: see `spread`."""

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        return spread(table.costs_s, table.current)


class Cheapest:
    """Each vehicle the target that it reaches first, whatever the others do."""

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        return np.full(len(table.vehicles), -1, np.int64)


class Balanced:
    """First every target's pursuers out of the whole group, then even shares: see `need_first` and `spread`.

    All agents solve one problem, which does not depend on who solves it or in which order words came, and each
    takes what it says of its own vehicles. Where they hold different words, a target may have more pursuers for a
    period.
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
    """Whether the agents of a group tell each other their costs for it."""
    return getattr(assigner, "shares_costs", False) is True


def assigner_of(plugin: Plugin, world: AssignmentWorld, tell: Tell) -> Assigner:
    """The assigner that a scenario names. Raises ConfigError if it cannot be made; `tell` takes its later fault."""
    if plugin.factory is None:
        return ASSIGNERS[plugin.named.name](world)
    return PluginAssigner(plugin.make(world), Guard(plugin, tell))


class PluginAssigner:
    """What a plug-in assigns; even shares once it has failed."""

    def __init__(self, assigner: Assigner, guard: Guard) -> None:
        self._assigner = assigner
        self._guard = guard
        self.shares_costs = shares_costs(assigner)

    def assign(self, table: CostTable) -> NDArray[np.int64]:
        others = table.others and replace(table.others, costs_s=table.others.costs_s.copy())
        told = replace(table, costs_s=table.costs_s.copy(), others=others)
        return self._guard.ask(
            lambda: self._assigner.assign(told),
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


class Assignment:
    """Asks all planners for the costs of all vehicles of an agent, and assigns each vehicle its target.

    targets     those that the vehicles may go for
    assigner    which of them each goes for
    stagger     share of the period by which the first request is followed early, so that agents ask one after the
                other
    group       what the group's other agents told; None if the assigner does not ask for it
    """

    def __init__(
        self,
        targets: Sequence[str],
        assigner: Assigner,
        reassign_s: float,
        stagger: float,
        group: GroupCosts | None = None,
    ) -> None:
        self._targets = targets
        self._group = group
        self._assigner = assigner
        self._reassign_ns = int(reassign_s * NS_PER_S)
        self._stagger_ns = int(stagger * self._reassign_ns)
        self._due_ns = 0
        self._asked_ns = 0
        """When it was asked last."""
        self._open: AskCosts | None = None
        self._costs_s: dict[str, NDArray[np.float32]] = {}
        """Target -> the costs that its planner answered to the open request."""

    def set_targets(self, targets: Sequence[str]) -> None:
        """Those that the vehicles may go for from now on."""
        self._targets = targets

    def set_period(self, reassign_s: float) -> None:
        """How often vehicles ask from now on."""
        self._reassign_ns = int(reassign_s * NS_PER_S)

    def due(self, now_ns: int) -> bool:
        return now_ns >= self._due_ns and self._open is None

    def ask(self, request: int, vehicles: Mapping[str, Vehicle], now_ns: int) -> AskCosts:
        """The request to send now, under this number."""
        self._costs_s = {}
        self._open = AskCosts(request, tuple(vehicles), tuple(vehicle.cell for vehicle in vehicles.values()))
        first = self._due_ns == 0
        self._due_ns = now_ns + (self._stagger_ns if first else self._reassign_ns)
        self._asked_ns = now_ns
        return self._open

    def ask_soon(self, now_ns: int) -> None:
        """A target has a planner again, so that costs are not what they were, or vehicles are new."""
        self._due_ns = min(self._due_ns, now_ns + _RETRY_NS)

    def target_jumped(self, now_ns: int) -> None:
        """A target is elsewhere all at once, or known for the first time: its costs are not what they were."""
        rested_ns = self._asked_ns + len(self._targets) * _JUMPS_APART_NS
        self._due_ns = min(self._due_ns, max(now_ns + _RETRY_NS, rested_ns))

    def costs_given(self, request: int, target: str, costs_s: NDArray[np.float32]) -> None:
        """One planner's answer; one of the wrong length is ignored."""
        asked = self._open
        if asked is not None and asked.request == request and len(costs_s) == len(asked.cells):
            self._costs_s[target] = costs_s

    def costs_ended(
        self,
        request: int,
        vehicles: Mapping[str, Vehicle],
        planners: Mapping[str, int],
        now_ns: int,
        empty: Collection[str] = (),
        standing: Collection[str] = (),
    ) -> SharedCosts | None:
        """All planners that will answer have: each vehicle takes its target. Returns what to tell the group.

        empty     targets that are not where their planners lead to: whoever has a way to another goes for that
        standing  vehicles that an operator lets stand: no target's pursuers where costs are shared
        """
        asked = self._open
        if asked is None or asked.request != request:
            return None
        self._open = None
        stuck = not self._costs_s
        if self._group is not None:
            self._group.expire(now_ns - _LEASE_PERIODS * self._reassign_ns)
        told = self._spread(asked, vehicles, empty, standing)
        for index, id in enumerate(asked.vehicles):
            vehicle = vehicles.get(id)
            if vehicle is None:
                continue
            costs_s = {target: float(column[index]) for target, column in self._costs_s.items()}
            if id in told:
                costs_s = {target: cost_s if target == told[id] else math.inf for target, cost_s in costs_s.items()}
            there = {target: cost_s for target, cost_s in costs_s.items() if target not in empty}
            leaves = any(map(math.isfinite, there.values()))
            current = None if leaves and vehicle.target in empty else vehicle.target
            self._assign(vehicle, there if leaves else costs_s, current, planners, now_ns)
            stuck = stuck or vehicle.state in (VehicleState.IDLE, VehicleState.STRANDED)
        if stuck:
            retry_ns = _STRANDED_RETRY_NS if self._costs_s else _RETRY_NS
            self._due_ns = min(self._due_ns, now_ns + retry_ns)
        return self._tell(asked, vehicles, empty, standing, now_ns)

    def hear(self, told: SharedCosts, now_ns: int) -> None:
        """What another agent of the group told of its vehicles."""
        if self._group is not None:
            self._group.hear(told, now_ns)

    def _tell(
        self,
        asked: AskCosts,
        vehicles: Mapping[str, Vehicle],
        empty: Collection[str],
        standing: Collection[str],
        now_ns: int,
    ) -> SharedCosts | None:
        """What the other agents of the group reckon with: the costs of those vehicles that may chase any target."""
        if self._group is None:
            return None
        may = [n for n, id in enumerate(asked.vehicles) if id in vehicles and id not in standing]
        costs_s = {
            target: column[may]
            for target, column in self._costs_s.items()
            if target in self._targets and target not in empty
        }
        ids = [asked.vehicles[n] for n in may]
        return self._group.tell(ids, costs_s, [vehicles[id].target for id in ids], now_ns)

    def _spread(
        self,
        asked: AskCosts,
        vehicles: Mapping[str, Vehicle],
        empty: Collection[str],
        standing: Collection[str] = (),
    ) -> dict[str, str]:
        """The target of each vehicle that has a choice, so that not all go for the same."""
        targets = [target for target in self._targets if target in self._costs_s and target not in empty]
        # A vehicle whose planner is silent keeps to it, or is told that nothing is known.
        held = {id: vehicles[id].target for id in asked.vehicles if id in vehicles}
        now = {id: None if target in empty else target for id, target in held.items()}
        free = [n for n, id in enumerate(asked.vehicles) if id in now and now[id] in (None, *targets)]
        if self._group is not None:
            free = [n for n in free if asked.vehicles[n] not in standing]
        if not free or not targets:
            return {}
        others = None
        if self._group is not None:
            targets = sorted({*targets, *self._group.targets.difference(empty).intersection(self._targets)})
            ids, table, theirs = self._group.rows(targets)
            others = CostTable(tuple(targets), ids, table, theirs)
        unknown = np.full(len(asked.vehicles), np.inf)
        costs_s = np.array([self._costs_s.get(target, unknown) for target in targets], np.float64)[:, free]
        current = [-1 if (target := now[asked.vehicles[n]]) is None else targets.index(target) for n in free]
        names = tuple(asked.vehicles[n] for n in free)
        chosen = self._assigner.assign(CostTable(tuple(targets), names, costs_s, tuple(current), others))
        return {
            asked.vehicles[n]: targets[each] for n, each in zip(free, chosen.tolist(), strict=True) if each >= 0
        }

    def _assign(
        self,
        vehicle: Vehicle,
        costs_s: Mapping[str, float],
        current: str | None,
        planners: Mapping[str, int],
        now_ns: int,
    ) -> None:
        given_up = vehicle.planner_gone and not vehicle.route.left
        given_up = given_up and now_ns - vehicle.gone_since_ns > self._reassign_ns
        choice = choose(costs_s, self._targets, planners, current, not given_up)
        if choice.target is not None:
            vehicle.assign(choice.target, now_ns)
            if vehicle.target not in planners and not vehicle.planner_gone:
                vehicle.lose_planner(now_ns)
        elif choice.settled:
            vehicle.no_way()
