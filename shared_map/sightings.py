"""Sightings: where vehicles saw targets. They expire, and change no pace.

Of each author's sightings of a target the newest counts, and of all authors' the newest that has not expired. So,
as with marks, merging depends on neither order, grouping nor repetition.
"""

from __future__ import annotations

from collections.abc import Mapping

from shared_map.replication.filter import MarkFilter
from swarm.wire.messages.targets import Sighted, TargetPose

_MOST = 10_000


class Sightings:
    """The newest sighting of each (target, author), 10,000 at most.

    filter  which authors count
    """

    def __init__(self, filter: MarkFilter) -> None:
        self._filter = filter
        self._newest: dict[tuple[str, str], Sighted] = {}

    def hear(self, sighted: Sighted) -> bool:
        """Take in a sighting, even an expired one. False if it is no news, filtered out or beyond the limit."""
        key = (sighted.target, sighted.author)
        known = self._newest.get(key)
        if known is not None and (sighted.stamp_ns, sighted.seq) <= (known.stamp_ns, known.seq):
            return False
        if not self._filter.accepts_author(sighted.author, sighted.group):
            return False
        if known is None and len(self._newest) >= _MOST:
            return False
        self._newest[key] = sighted
        return True

    def expire(self, now_ns: int) -> None:
        """Forget expired sightings."""
        self._newest = {key: each for key, each in self._newest.items() if each.until_ns > now_ns}

    def best(self, now_ns: int) -> Mapping[str, Sighted]:
        """Target -> its newest sighting; of two with one stamp the surer, then that of the larger author id."""
        best: dict[str, Sighted] = {}
        for (target, _), each in self._newest.items():
            if each.until_ns > now_ns and (target not in best or _rank(each) > _rank(best[target])):
                best[target] = each
        return best


def _rank(sighted: Sighted) -> tuple[int, float, str]:
    return sighted.stamp_ns, -sighted.uncertainty_m, sighted.author


def pose_of(sighted: Sighted) -> TargetPose:
    """A sighting in the form of a tracker's message, numbered by its stamp."""
    return TargetPose(
        target=sighted.target,
        incarnation=0,
        seq=sighted.stamp_ns,
        stamp_ns=sighted.stamp_ns,
        cell=sighted.cell,
        x_m=sighted.x_m,
        y_m=sighted.y_m,
    )
