"""Places where a target was seen last and is not any more, as vehicles find that stand there. Pure.

A target that only vehicles see is where the newest sighting says, for as long as the sighting lasts. Captured, it
is somewhere else at once, and its planner leads to the old place until it finds, from where vehicles are, that
nobody sees it there, and searches. That costs whoever stands there nothing: without this they would stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Set

from swarm.clock import NS_PER_S
from swarm.runtime.tracking import Trackings

UNSEEN_NS = 2 * NS_PER_S
"""A target in sight is told of twice a second: one that is not told of for so long while a vehicle stands where it
was is not there."""


LEFT_NS = 5 * NS_PER_S
"""For so long nobody goes for a target that was found gone: then its planner searches, and it is as good as any."""


class EmptyPlaces:
    """The targets that are not where they were seen last.

    trackings  where all targets are, as this agent knows
    """

    def __init__(self, trackings: Trackings) -> None:
        self._trackings = trackings
        self._by_sight: set[str] = set()
        """Targets that were placed by a sighting last."""
        self._found_ns: dict[str, int] = {}
        """Target -> when it was found gone."""

    @property
    def of(self) -> set[str]:
        """The targets that were found gone lately."""
        return set(self._found_ns)

    def unseen(self, lost: Set[str]) -> Set[str]:
        """The targets that were placed by a sighting and may be anywhere now.

        lost  those of which nobody knows where they are
        """
        return (lost | self._found_ns.keys()) & self._by_sight

    def placed(self, target: str, *, by_sight: bool) -> None:
        """It is known anew where a target is: by a sighting, or by its tracker."""
        self._found_ns.pop(target, None)
        if by_sight:
            self._by_sight.add(target)
        else:
            self._by_sight.discard(target)

    def look(self, stood_at: Iterable[str], now_ns: int) -> bool:
        """Find which targets are gone; returns whether one is that was not before.

        stood_at  targets that a vehicle has within reach, by what is known
        """
        if not self._by_sight:
            return False
        self._found_ns = {each: at_ns for each, at_ns in self._found_ns.items() if now_ns - at_ns < LEFT_NS}
        before = len(self._found_ns)
        for target in self._by_sight.intersection(stood_at):
            tracking = self._trackings.of(target)
            age_ns = None if tracking is None else tracking.age_ns(now_ns)
            if age_ns is not None and age_ns >= UNSEEN_NS:
                self._found_ns.setdefault(target, now_ns)
        return len(self._found_ns) > before
