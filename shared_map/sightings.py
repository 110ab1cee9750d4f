"""Sightings: where vehicles saw targets; and where the vehicles are. Both expire, and change no pace.

The newest sighting of each author of a target counts, and of all authors' the newest that has not expired. As with
marks, merging therefore depends on neither order, grouping nor repetition.

No author's clock is trusted further than the reader's own: what an author dates ahead counts as seen when it was
heard, and no sighting outlives `LONGEST_NS` from then. A vehicle with a fast clock therefore outweighs no other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from shared_map.array_files import Floats
from shared_map.replication.interest import MarkFilter
from swarm.clock import NS_PER_S
from swarm.peers import POSE_SILENCE_NS
from swarm.wire.fields import LONGEST_LEASE_S
from swarm.wire.messages.planning import Sighted, TargetPose
from swarm.wire.messages.vehicles import Fleet

LONGEST_NS = 120 * NS_PER_S
"""A tracker that was lost for two minutes says nothing any more about where its target is."""
_MOST = 10_000
"""Targets of whom a sighting is kept: what strangers may make up."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """A sighting by the reader's clock: when it was heard, the instant it counts as, and when it expires."""

    sighted: Sighted
    heard_ns: int
    stamp_ns: int
    until_ns: int

    @property
    def rank(self) -> tuple[int, float, str]:
        return self.stamp_ns, -self.sighted.uncertainty_m, self.sighted.author


class Sightings:
    """The newest sighting of each (target, author), 10,000 at most.

    filter  which authors count
    """

    def __init__(self, filter: MarkFilter) -> None:
        self._filter = filter
        self._newest: dict[tuple[str, str], _Seen] = {}

    def receive(self, sighted: Sighted, now_ns: int) -> bool:
        """Stores a sighting, even an expired one. Returns False if it is not stored: it is not newer than the
        author's last one, its author is filtered out, or there are too many.

        After a silence of the author any of its sightings counts as newer (as in `swarm.peers.Newest`).
        """
        key = (sighted.target, sighted.author)
        known = self._newest.get(key)
        if known is not None and now_ns - known.heard_ns < POSE_SILENCE_NS:
            before = known.sighted
            if (sighted.stamp_ns, sighted.seq) <= (before.stamp_ns, before.seq):
                return False
        if not self._filter.accepts_author(sighted.author, sighted.group):
            return False
        if known is None and len(self._newest) >= _MOST:
            return False
        until_ns = min(sighted.until_ns, now_ns + LONGEST_NS)
        self._newest[key] = _Seen(sighted, now_ns, min(sighted.stamp_ns, now_ns), until_ns)
        return True

    def expire(self, now_ns: int) -> None:
        """Forgets expired sightings."""
        self._newest = {key: each for key, each in self._newest.items() if each.until_ns > now_ns}

    def best(self, now_ns: int) -> Mapping[str, Sighted]:
        """Target -> its newest sighting; of two with one stamp the surer, then that of the larger author id."""
        best: dict[str, _Seen] = {}
        for (target, _), each in self._newest.items():
            if each.until_ns > now_ns and (target not in best or each.rank > best[target].rank):
                best[target] = each
        return {target: each.sighted for target, each in best.items()}


def pose_of(sighted: Sighted) -> TargetPose:
    """A sighting in the form of a tracker's message, numbered by its stamp; its lease is for how long it stands."""
    lasts_s = (sighted.until_ns - sighted.stamp_ns) / NS_PER_S
    return TargetPose(
        target=sighted.target,
        incarnation=0,
        seq=sighted.stamp_ns,
        stamp_ns=sighted.stamp_ns,
        lease_s=min(max(lasts_s, 0.0), LONGEST_LEASE_S),
        cell=sighted.cell,
        x_m=sighted.x_m,
        y_m=sighted.y_m,
    )


class Presence:
    """Positions of all vehicles: the newest message of each (author, region), until its lease ends. Not stored.

    A message lists an author's vehicles in one region, and replaces the author's last message of that region.
    Presence therefore needs no merging, and a lost message needs no repeat.

    lease_ns  a message is forgotten this time after it came
    filter    whose vehicles count; None: everybody's
    """

    def __init__(self, lease_ns: int, filter: MarkFilter | None = None) -> None:
        self._filter = filter
        self._lease_ns = lease_ns
        self._newest: dict[tuple[str, int], tuple[Fleet, int]] = {}
        """(author, region) -> its newest message, and when that came."""

    def receive(self, fleet: Fleet, now_ns: int) -> None:
        """Takes in a message; late and repeated ones change nothing."""
        if self._filter is not None and not self._filter.accepts_author(fleet.author, fleet.group):
            return
        key = fleet.author, fleet.region
        if key not in self._newest or fleet.seq > self._newest[key][0].seq:
            self._newest[key] = fleet, now_ns

    def expire(self, now_ns: int) -> None:
        """Forgets messages whose lease has ended."""
        self._newest = {key: each for key, each in self._newest.items() if now_ns - each[1] <= self._lease_ns}

    def places(self) -> dict[str, tuple[float, float]]:
        """Vehicle -> (east_m, south_m) from the grid's west and north border. If messages about two regions list a
        vehicle, which crosses a border, the newer one counts."""
        found: dict[str, tuple[float, float]] = {}
        for fleet, _ in sorted(self._newest.values(), key=lambda each: each[0].stamp_ns):
            east_m, south_m = np.frombuffer(fleet.east_m, "<f4"), np.frombuffer(fleet.south_m, "<f4")
            found |= zip(fleet.ids, zip(east_m.tolist(), south_m.tolist(), strict=True), strict=True)
        return found

    def columns(self) -> tuple[Floats, Floats]:
        """East and south of all vehicles in metres, float32 (vehicles,) each, in no particular order."""
        east_m, south_m = np.array([*self.places().values()], np.float32).reshape(-1, 2).T
        return east_m, south_m
