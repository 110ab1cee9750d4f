"""What the agents of a group tell each other of their costs, so that each can share out targets among them all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm.wire.fields import column, pack_column
from swarm.wire.messages.vehicles import MOST_SHARED_TARGETS, NO_TARGET, SharedCosts

_MOST_AGENTS = 256
"""The agents of one group that are listened to: strangers may invent as many as they like."""


@dataclass(frozen=True, slots=True)
class _Heard:
    message: SharedCosts
    at_ns: int


class GroupCosts:
    """The newest words of the other agents of a group.

    agent   id of this agent; what comes under it is not another's
    """

    def __init__(self, author: str, group: str, agent: str) -> None:
        self._author = author
        self._group = group
        self._agent = agent
        self._heard: dict[str, _Heard] = {}
        """Agent -> its newest word."""

    def tell(
        self,
        vehicles: Sequence[str],
        costs_s: Mapping[str, NDArray[np.float32]],
        chased: Sequence[str | None],
        now_ns: int,
    ) -> SharedCosts:
        """The message with the costs of our vehicles.

        costs_s  target -> float32 (vehicles,), s, inf where there is no way
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

    def hear(self, message: SharedCosts, now_ns: int) -> None:
        """Another agent's word; of two lives of an agent the one that spoke last counts."""
        agent = message.agent
        if agent == self._agent or message.group != self._group:
            return
        held = self._heard.get(agent)
        if held is not None and message.stamp_ns < held.message.stamp_ns:
            return
        if held is None and len(self._heard) >= _MOST_AGENTS:
            del self._heard[min(self._heard, key=lambda each: (self._heard[each].at_ns, each))]
        self._heard[agent] = _Heard(message, now_ns)

    def expire(self, since_ns: int) -> None:
        """Forget agents that were not heard since then: they are gone."""
        self._heard = {agent: heard for agent, heard in self._heard.items() if heard.at_ns >= since_ns}

    @property
    def targets(self) -> set[str]:
        """Those that others have told of."""
        return {target for heard in self._heard.values() for target in heard.message.target_ids}

    def rows(self, targets: Sequence[str]) -> tuple[tuple[str, ...], NDArray[np.float64], tuple[int, ...]]:
        """Ids of the others' vehicles, ascending; float64 (targets, vehicles) their costs in s, inf where nothing
        was told; and the index of the target of each, -1 for none of these."""
        ids: list[str] = []
        parts: list[NDArray[np.float64]] = []
        chased: list[int] = []
        for heard in self._heard.values():
            message = heard.message
            told = column(message.costs_s, "<f4").reshape(len(message.ids), len(message.target_ids))
            part = np.full((len(targets), len(message.ids)), np.inf)
            at = {target: n for n, target in enumerate(targets)}
            for n, target in enumerate(message.target_ids):
                if target in at:
                    part[at[target]] = told[:, n]
            ids += message.ids
            parts.append(part)
            names = (None if each == NO_TARGET else message.target_ids[each] for each in message.targets)
            chased += [-1 if name is None else at.get(name, -1) for name in names]
        if not ids:
            return (), np.full((len(targets), 0), np.inf), ()
        order = sorted(range(len(ids)), key=ids.__getitem__)
        table = np.concatenate(parts, 1)[:, order]
        return tuple(ids[n] for n in order), table, tuple(chased[n] for n in order)
