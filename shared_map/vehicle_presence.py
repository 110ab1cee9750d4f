"""Presence: where all vehicles are now. Not stored.

A message lists an author's vehicles in one region, and replaces the author's last message of that region. A message
expires with its lease. Presence therefore needs no merging, and a lost message needs no repeat.
"""

from __future__ import annotations

import numpy as np

from shared_map.array_files import Floats
from shared_map.replication.mark_filter import MarkFilter
from swarm.liveness import Leases
from swarm.wire.messages.vehicles import Fleet


class Presence:
    """The newest message of each (author, region), until its lease ends.

    lease_ns  a message is forgotten so long after it came
    filter    whose vehicles count; None: everybody's
    """

    def __init__(self, lease_ns: int, filter: MarkFilter | None = None) -> None:
        self._filter = filter
        self._leases = Leases(lease_ns)
        self._newest: dict[str, Fleet] = {}

    def receive(self, fleet: Fleet, now_ns: int) -> None:
        """Takes in a message; late and repeated ones change nothing."""
        if self._filter is not None and not self._filter.accepts_author(fleet.author, fleet.group):
            return
        key = f"{fleet.author}/{fleet.region}"
        known = self._newest.get(key)
        if known is not None and fleet.seq <= known.seq:
            return
        self._leases.renew(key, now_ns)
        self._newest[key] = fleet

    def expire(self, now_ns: int) -> None:
        """Forgets messages whose lease has ended."""
        for key in self._leases.expired(now_ns):
            del self._newest[key]

    def places(self) -> dict[str, tuple[float, float]]:
        """Vehicle -> (east_m, south_m) from the grid's west and north border. If messages about two regions list a
        vehicle, which crosses a border, the newer one counts."""
        found: dict[str, tuple[float, float]] = {}
        for fleet in sorted(self._newest.values(), key=lambda each: each.stamp_ns):
            east_m, south_m = np.frombuffer(fleet.east_m, "<f4"), np.frombuffer(fleet.south_m, "<f4")
            found |= zip(fleet.ids, zip(east_m.tolist(), south_m.tolist(), strict=True), strict=True)
        return found

    def columns(self) -> tuple[Floats, Floats]:
        """East and south of all vehicles in metres, float32 (vehicles,) each, in no particular order."""
        east_m, south_m = np.array([*self.places().values()], np.float32).reshape(-1, 2).T
        return east_m, south_m
