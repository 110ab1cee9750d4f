"""Places where a target was seen last and is not any more, as vehicles find that stand there. Pure.

A target that only vehicles see is where the newest sighting says, for as long as the sighting lasts. Captured, it
is somewhere else at once, and until somebody sees it again its planner leads to the old place, which costs whoever
stands there nothing: without this they would stay.
"""

from __future__ import annotations

from collections.abc import Iterable

from swarm.clock import NS_PER_S
from swarm.runtime.tracking import Trackings

UNSEEN_NS = 2 * NS_PER_S
"""A target in sight is told of twice a second: one that is not told of for so long while a vehicle stands where it
was is not there."""


class EmptyPlaces:
    """The targets that are not where they were seen last.

    trackings  where all targets are, as this agent knows
    """

    def __init__(self, trackings: Trackings) -> None:
        self._trackings = trackings
        self._by_sight: set[str] = set()
        """Targets that were placed by a sighting last."""
        self.of: set[str] = set()

    def placed(self, target: str, *, by_sight: bool) -> None:
        """It is known anew where a target is: by a sighting, or by its tracker."""
        self.of.discard(target)
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
        before = len(self.of)
        for target in self._by_sight.intersection(stood_at):
            tracking = self._trackings.of(target)
            age_ns = None if tracking is None else tracking.age_ns(now_ns)
            if age_ns is not None and age_ns >= UNSEEN_NS:
                self.of.add(target)
        return len(self.of) > before
