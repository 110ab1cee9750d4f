"""Asks planners what every vehicle would need to every target, and gives each vehicle the target to go for.

Once a period (`vehicles.reassign_s`) an agent asks all planners for the costs of all its vehicles. When their
answers have come, the assigner shares the targets out (`assignment`), and each vehicle takes its own if the change
is worth it. If the assigner asks for it, the agents of a group publish their costs to each other (`GroupCosts`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.wire.fields import column, pack_column
from swarm.wire.messages.vehicles import MOST_SHARED_TARGETS, NO_TARGET, SharedCosts, VehicleState
from vehicle_agent.assignment import HYSTERESIS, Assigner, CostTable
from vehicle_agent.driving.driven_vehicle import STRANDED_RETRY_NS, Vehicle

_RETRY_NS = NS_PER_S // 2
"""Vehicles for which no planner has answered ask again so soon: a planner needs about that long to start."""
_JUMPS_APART_NS = NS_PER_S // 50
"""For each target: this time after a request a jump of a target may cause the next. With many targets one always
jumps, and every agent would ask every planner all the time. Up to 25 targets nothing waits for it."""
_LEASE_PERIODS = 3
"""An agent of the group without costs for this number of periods has ended."""
_MOST_AGENTS = 256
"""The agents of one group that are listened to: strangers may invent as many as they like."""


class GroupCosts:
    """The newest messages of the other agents of a group.

    agent   id of this agent; its own messages are ignored
    """

    def __init__(self, author: str, group: str, agent: str) -> None:
        self._author = author
        self._group = group
        self._agent = agent
        self._heard: dict[str, tuple[SharedCosts, int]] = {}
        """Agent -> its newest word, and when that came."""

    def report(
        self,
        vehicles: Sequence[str],
        costs_s: Mapping[str, NDArray[np.float32]],
        chased: Sequence[str | None],
        now_ns: int,
    ) -> SharedCosts:
        """The message with the costs of our vehicles.

        costs_s  target -> float32 (vehicles,), s, inf where there is no path
        chased   the target of each vehicle
        """
        targets = sorted(costs_s)[:MOST_SHARED_TARGETS]
        table = [costs_s[target] for target in targets]
        index = {target: n for n, target in enumerate(targets)}
        return SharedCosts(
            author=self._author,
            group=self._group,
            stamp_ns=now_ns,
            ids=list(vehicles),
            target_ids=targets,
            costs_s=pack_column(np.stack(table, 1) if table else [], "<f4"),
            targets=bytes(NO_TARGET if each is None else index.get(each, NO_TARGET) for each in chased),
        )

    def receive(self, message: SharedCosts, now_ns: int) -> None:
        """Takes another agent's message; of two generations of an agent the latest message counts."""
        agent = message.agent
        if agent == self._agent or message.group != self._group:
            return
        held = self._heard.get(agent)
        if held is not None and message.stamp_ns < held[0].stamp_ns:
            return
        if held is None and len(self._heard) >= _MOST_AGENTS:
            del self._heard[min(self._heard, key=lambda each: (self._heard[each][1], each))]
        self._heard[agent] = message, now_ns

    def expire(self, since_ns: int) -> None:
        """Forgets agents that were not heard since then: they are gone."""
        self._heard = {agent: word for agent, word in self._heard.items() if word[1] >= since_ns}

    @property
    def targets(self) -> set[str]:
        """Targets in the costs of others."""
        return {target for message, _ in self._heard.values() for target in message.target_ids}

    def rows(self, targets: Sequence[str]) -> tuple[tuple[str, ...], NDArray[np.float64], tuple[int, ...]]:
        """Returns ids of the others' vehicles, ascending; float64 (targets, vehicles) their costs in s, inf where
        unknown; and the index of the target of each, -1 for none of these."""
        ids: list[str] = []
        parts: list[NDArray[np.float64]] = []
        chased: list[int] = []
        for message, _ in self._heard.values():
            costs_s = column(message.costs_s, "<f4").reshape(len(message.ids), len(message.target_ids))
            part = np.full((len(targets), len(message.ids)), np.inf)
            at = {target: n for n, target in enumerate(targets)}
            for n, target in enumerate(message.target_ids):
                if target in at:
                    part[at[target]] = costs_s[:, n]
            ids += message.ids
            parts.append(part)
            names = (None if each == NO_TARGET else message.target_ids[each] for each in message.targets)
            chased += [-1 if name is None else at.get(name, -1) for name in names]
        if not ids:
            return (), np.full((len(targets), 0), np.inf), ()
        order = sorted(range(len(ids)), key=ids.__getitem__)
        table = np.concatenate(parts, 1)[:, order]
        return tuple(ids[n] for n in order), table, tuple(chased[n] for n in order)


@dataclass(frozen=True, slots=True)
class AskCosts:
    """One request to every planner: the cost-to-go of these cells, one per vehicle."""

    request: int
    vehicles: tuple[str, ...]
    cells: tuple[int, ...]


def choose(
    costs_s: Mapping[str, float],
    allowed: Sequence[str],
    alive: Mapping[str, int],
    current: str | None,
    keep_silent: bool,
) -> str | None:
    """The cheapest of a vehicle's targets; None if no route to any is known.

    costs_s      cost-to-go per target that answered, inf where there is no route
    allowed      the vehicle's targets
    alive        targets whose planner is alive
    keep_silent  stay with a current target whose planner has not answered
    """
    if current is not None and current not in costs_s and (keep_silent or current in alive):
        return current
    best, best_s = None, math.inf
    for target in allowed:
        cost_s = costs_s.get(target, math.inf)
        if cost_s < best_s:
            best, best_s = target, cost_s
    if current is not None and math.inf > best_s > (1.0 - HYSTERESIS) * costs_s.get(current, math.inf):
        return current
    return best


def have_answered(costs_s: Collection[str], allowed: Collection[str], alive: Collection[str]) -> bool:
    """True if every living planner of these targets answered, and at least one did: then no route means no path."""
    return any(target in costs_s for target in allowed) and all(
        target in costs_s for target in allowed if target in alive
    )


@dataclass
class Assignment:
    """Asks all planners for the costs of all vehicles of an agent, and assigns each vehicle its target.

    vehicles    those of the agent, which changes them in place
    targets     those that the vehicles may go for; the agent sets others
    assigner    which of them each goes for
    stagger     how much earlier the second request comes, as a share of the period, so that agents ask one after
                the other
    group       costs of the group's other agents; None if the assigner does not ask for them
    """

    vehicles: Mapping[str, Vehicle]
    targets: Sequence[str]
    assigner: Assigner
    reassign_s: float
    stagger: float
    group: GroupCosts | None = None
    _due_ns: int = 0
    _asked_ns: int = 0
    """Time when it was asked last."""
    _open: AskCosts | None = None
    _costs_s: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    """Target -> the costs that its planner answered to the open request."""

    def __post_init__(self) -> None:
        self.set_period(self.reassign_s)
        self._stagger_ns = int(self.stagger * self._reassign_ns)

    def set_period(self, reassign_s: float) -> None:
        """Sets the interval of the vehicles' queries."""
        self._reassign_ns = int(reassign_s * NS_PER_S)

    def due(self, now_ns: int) -> bool:
        return now_ns >= self._due_ns and self._open is None and bool(self._choosing())

    def ask(self, request: int, now_ns: int) -> AskCosts:
        """The request to send now, under this number."""
        self._costs_s = {}
        vehicles = self._choosing()
        self._open = AskCosts(request, tuple(vehicles), tuple(each.terrain_cell for each in vehicles.values()))
        first = self._due_ns == 0
        self._due_ns = now_ns + (self._stagger_ns if first else self._reassign_ns)
        self._asked_ns = now_ns
        return self._open

    def _choosing(self) -> dict[str, Vehicle]:
        """The vehicles that chase targets: none that was sent to a place."""
        return {id: vehicle for id, vehicle in self.vehicles.items() if vehicle.goal is None}

    def ask_soon(self, now_ns: int) -> None:
        """A target has a planner again, so that costs are not what they were, or vehicles are new."""
        self._due_ns = min(self._due_ns, now_ns + _RETRY_NS)

    def target_jumped(self, now_ns: int) -> None:
        """A target is elsewhere all at once, or known for the first time: its costs are not what they were."""
        rested_ns = self._asked_ns + len(self.targets) * _JUMPS_APART_NS
        self._due_ns = min(self._due_ns, max(now_ns + _RETRY_NS, rested_ns))

    def costs_given(self, request: int, target: str, costs_s: NDArray[np.float32]) -> None:
        """One planner's answer; one of the wrong length is ignored."""
        asked = self._open
        if asked is not None and asked.request == request and len(costs_s) == len(asked.cells):
            self._costs_s[target] = costs_s

    def all_given(self, planners: Collection[str]) -> bool:
        """Returns True if all these planners, which live, have answered the open request. If a message was lost,
        the request may end seconds later."""
        return self._open is not None and have_answered(self._costs_s, self.targets, planners)

    def costs_ended(
        self,
        request: int,
        planners: Mapping[str, int],
        now_ns: int,
        empty: Collection[str] = (),
        standing: Collection[str] = (),
    ) -> SharedCosts | None:
        """All planners that will answer have: each vehicle takes its target. Returns what to tell the group.

        planners  target -> incarnation of its planner, of those which live
        empty     targets not found where their planner has them; vehicles prefer any other that they can reach
        standing  vehicles that an operator lets stand: no target's pursuers where costs are shared
        """
        asked = self._open
        if asked is None or asked.request != request:
            return None
        self._open = None
        stuck = not self._costs_s
        if self.group is not None:
            self.group.expire(now_ns - _LEASE_PERIODS * self._reassign_ns)
        vehicles = self._choosing()
        shares = self._share_out(asked, vehicles, empty, standing)
        for index, id in enumerate(asked.vehicles):
            vehicle = vehicles.get(id)
            if vehicle is None:
                continue
            costs_s = {target: float(column[index]) for target, column in self._costs_s.items()}
            if id in shares:
                costs_s = {each: cost_s if each == shares[id] else math.inf for each, cost_s in costs_s.items()}
            there = {target: cost_s for target, cost_s in costs_s.items() if target not in empty}
            leaves = any(map(math.isfinite, there.values()))
            current = None if leaves and vehicle.target in empty else vehicle.target
            offered = there if leaves else costs_s
            given_up = vehicle.planner_gone and not vehicle.route.left
            given_up = given_up and now_ns - vehicle.gone_since_ns > self._reassign_ns
            target = choose(offered, self.targets, planners, current, not given_up)
            if target is not None:
                vehicle.assign(target, now_ns)
                if target not in planners and not vehicle.planner_gone:
                    vehicle.lose_planner(now_ns)
            elif have_answered(offered, self.targets, planners):
                vehicle.no_way()
            stuck = stuck or vehicle.state in (VehicleState.IDLE, VehicleState.STRANDED)
        if stuck:
            retry_ns = STRANDED_RETRY_NS if self._costs_s else _RETRY_NS
            self._due_ns = min(self._due_ns, now_ns + retry_ns)
        if self.group is None:
            return None
        # Input of the others: the costs of vehicles that may chase any target.
        may = [n for n, id in enumerate(asked.vehicles) if id in vehicles and id not in standing]
        shared_s = {
            target: column[may]
            for target, column in self._costs_s.items()
            if target in self.targets and target not in empty
        }
        ids = [asked.vehicles[n] for n in may]
        return self.group.report(ids, shared_s, [vehicles[id].target for id in ids], now_ns)

    def _share_out(
        self,
        asked: AskCosts,
        vehicles: Mapping[str, Vehicle],
        empty: Collection[str],
        standing: Collection[str],
    ) -> dict[str, str]:
        """The target of each vehicle that has a choice, so that not all go for the same."""
        targets = [target for target in self.targets if target in self._costs_s and target not in empty]
        # A vehicle whose planner is silent keeps to it, or is informed that there is no data.
        held = {id: vehicles[id].target for id in asked.vehicles if id in vehicles}
        now = {id: None if target in empty else target for id, target in held.items()}
        free = [n for n, id in enumerate(asked.vehicles) if id in now and now[id] in (None, *targets)]
        if self.group is not None:
            free = [n for n in free if asked.vehicles[n] not in standing]
        if not free or not targets:
            return {}
        others = None
        if self.group is not None:
            targets = sorted({*targets, *self.group.targets.difference(empty).intersection(self.targets)})
            ids, table, theirs = self.group.rows(targets)
            others = CostTable(tuple(targets), ids, table, theirs)
        unknown = np.full(len(asked.vehicles), np.inf)
        costs_s = np.array([self._costs_s.get(target, unknown) for target in targets], np.float64)[:, free]
        current = [-1 if (target := now[asked.vehicles[n]]) is None else targets.index(target) for n in free]
        names = tuple(asked.vehicles[n] for n in free)
        chosen = self.assigner.assign(CostTable(tuple(targets), names, costs_s, tuple(current), others))
        return {id: targets[each] for id, each in zip(names, chosen.tolist(), strict=True) if each >= 0}
