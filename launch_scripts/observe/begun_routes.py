"""The routes that vehicles began, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass

from swarm.wire.messages.vehicles import Followed


@dataclass(frozen=True, slots=True)
class BegunRoute:
    time_ns: int
    route: Followed


class BegunRoutes:
    """Routes over the whole run, at most `limit` steps of them: when there are so many every second route is
    forgotten, and from then on half as many are kept."""

    def __init__(self, limit: int = 8_000_000) -> None:
        self.kept: list[BegunRoute] = []
        self._limit = limit
        self._stride = 1
        self._heard = 0
        self._steps = 0

    def add(self, now_ns: int, route: Followed) -> None:
        if self._heard % self._stride == 0:
            self.kept.append(BegunRoute(now_ns, route))
            self._steps += _size(route)
        self._heard += 1
        while self._steps > self._limit and len(self.kept) > 1:
            self.kept = self.kept[::2]
            self._stride *= 2
            self._steps = sum(_size(each.route) for each in self.kept)


def _size(route: Followed) -> int:
    return len(route.directions) + 64  # what a route takes beside its steps
