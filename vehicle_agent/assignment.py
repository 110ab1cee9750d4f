"""Which target each vehicle goes for: the one that it reaches at the lowest cost, if the change is worth it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.wire.messages.vehicles import VehicleState
from vehicle_agent.driving.vehicle import Vehicle

_RETRY_NS = NS_PER_S // 2
_STRANDED_RETRY_NS = 3 * NS_PER_S


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


class Assignment:
    """Asks all planners for the costs of all vehicles of an agent, and assigns each vehicle its target.

    targets     those that the vehicles may go for
    stagger     share of the period by which the first request is followed early, so that agents ask one after the
                other
    """

    def __init__(self, targets: Sequence[str], reassign_s: float, stagger: float) -> None:
        self._targets = targets
        self._reassign_ns = int(reassign_s * NS_PER_S)
        self._stagger_ns = int(stagger * self._reassign_ns)
        self._due_ns = 0
        self._open: AskCosts | None = None
        self._costs_s: dict[str, NDArray[np.float32]] = {}
        """Target -> the costs that its planner answered to the open request."""

    def due(self, now_ns: int) -> bool:
        return now_ns >= self._due_ns and self._open is None

    def ask(self, request: int, vehicles: Mapping[str, Vehicle], now_ns: int) -> AskCosts:
        """The request to send now, under this number."""
        self._costs_s = {}
        self._open = AskCosts(request, tuple(vehicles), tuple(vehicle.cell for vehicle in vehicles.values()))
        first = self._due_ns == 0
        self._due_ns = now_ns + (self._stagger_ns if first else self._reassign_ns)
        return self._open

    def ask_soon(self, now_ns: int) -> None:
        """A target has jumped or has a planner again, so that costs are not what they were, or vehicles are new."""
        self._due_ns = min(self._due_ns, now_ns + _RETRY_NS)

    def costs_given(self, request: int, target: str, costs_s: NDArray[np.float32]) -> None:
        """One planner's answer; one of the wrong length is ignored."""
        asked = self._open
        if asked is not None and asked.request == request and len(costs_s) == len(asked.cells):
            self._costs_s[target] = costs_s

    def costs_ended(
        self, request: int, vehicles: Mapping[str, Vehicle], planners: Mapping[str, int], now_ns: int
    ) -> None:
        """All planners that will answer have: each vehicle takes the cheapest target."""
        asked = self._open
        if asked is None or asked.request != request:
            return
        self._open = None
        stuck = not self._costs_s
        for index, id in enumerate(asked.vehicles):
            vehicle = vehicles.get(id)
            if vehicle is None:
                continue
            costs_s = {target: float(column[index]) for target, column in self._costs_s.items()}
            self._assign(vehicle, costs_s, planners, now_ns)
            stuck = stuck or vehicle.state in (VehicleState.IDLE, VehicleState.STRANDED)
        if stuck:
            retry_ns = _STRANDED_RETRY_NS if self._costs_s else _RETRY_NS
            self._due_ns = min(self._due_ns, now_ns + retry_ns)

    def _assign(
        self, vehicle: Vehicle, costs_s: Mapping[str, float], planners: Mapping[str, int], now_ns: int
    ) -> None:
        given_up = vehicle.planner_gone and not vehicle.route.left
        given_up = given_up and now_ns - vehicle.gone_since_ns > self._reassign_ns
        choice = choose(costs_s, self._targets, planners, vehicle.target, not given_up)
        if choice.target is not None:
            vehicle.assign(choice.target, now_ns)
            if vehicle.target not in planners and not vehicle.planner_gone:
                vehicle.lose_planner(now_ns)
        elif choice.settled:
            vehicle.no_way()
