"""Targets in view of an agent's vehicles, and positions of targets that only vehicles see."""

from __future__ import annotations

from collections.abc import Iterable, Set

import numpy as np

from shared_map.replication.interest import MarkFilter
from shared_map.sightings import Sightings, pose_of
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.peers import POSE_SILENCE_NS, Newest
from swarm.runtime.tracker_ownership import Trackings
from swarm.wire.messages.planning import Sighted, TargetPose
from vehicle_agent.driving.driven_vehicle import Places

_REPORT_NS = NS_PER_S // 2
"""Period of the sightings of a target that stays in sight."""
_RANGE_SHARE = 0.02
"""The uncertainty of a sighting is half a cell and this share of the distance."""
SIGHTING_LASTS_NS = 30 * NS_PER_S
"""A sighting expires after this time: by then a target may be anywhere within some hundred metres."""
_IN_SIGHT_NS = 2 * _REPORT_NS
_REPORT_AGAIN_NS = NS_PER_S
"""A planner that appears hears sightings after this time."""


class TargetDetector:
    """The simulated sensor for targets: knows where all are, and reports those within its range. A target that no
    tracker reports is where the best sighting of it says.

    For each target it remembers the last sighting of all, if it was its own, for a planner that restarts and
    received none. A target that was captured in sight is somewhere else, and its sighting is forgotten.

    range_m    of the sensor
    reading    whose sightings count
    untracked  targets that no tracker reports
    """

    def __init__(
        self, grid: GridSpec, author: str, group: str, range_m: float, reading: MarkFilter, untracked: Set[str]
    ) -> None:
        self.untracked = untracked
        self._sightings = Sightings(reading)
        self._grid = grid
        self._author = author
        self._group = group
        self._range_m = range_m
        self._true: dict[str, TargetPose] = {}
        self._newest = Newest(silence_ns=POSE_SILENCE_NS)
        self._reported_ns: dict[str, int] = {}
        self._seq = 0
        self._last: dict[str, Sighted] = {}
        """Target -> its last sighting of all, if that is this author's."""
        self._retell_ns: dict[str, int] = {}
        """Target -> time of the next repetition of its last sighting."""

    def set_truth(self, pose: TargetPose, now_ns: int) -> None:
        """Sets the true position of a target. For each target the newest pose counts."""
        if self._newest.is_news(pose.target, (pose.incarnation, pose.seq), now_ns):
            before = self._true.get(pose.target)
            self._true[pose.target] = pose
            last = self._last.get(pose.target)
            jumped = before is not None and before.jumps != pose.jumps
            if jumped and last is not None and now_ns - last.stamp_ns <= _IN_SIGHT_NS:
                del self._last[pose.target]

    def lose(self, targets: Set[str], now_ns: int) -> None:
        """Forgets the positions of these targets, if they have trackers, and expired sightings. A vehicle goes on
        to where it last knew its target to be."""
        self._sightings.expire(now_ns)
        for target in targets - self.untracked:
            self._true.pop(target, None)

    def note_sighting(self, sighted: Sighted, now_ns: int) -> TargetPose | None:
        """A vehicle of any author saw a target. Returns the pose of the target if it has no tracker; None if that
        is no news."""
        last = self._last.get(sighted.target)
        if last is not None and sighted.author != self._author and sighted.stamp_ns > last.stamp_ns:
            del self._last[sighted.target]
        if sighted.target not in self.untracked or not self._sightings.receive(sighted, now_ns):
            return None
        best = self._sightings.best(now_ns).get(sighted.target)  # None if the sighting came after it expired
        return None if best is None else pose_of(best)

    def retell(self, target: str, now_ns: int) -> None:
        """Repeats the last sighting for a planner that has restarted."""
        if target in self._last:
            self._retell_ns[target] = now_ns + _REPORT_AGAIN_NS

    def retold(self, now_ns: int) -> list[Sighted]:
        """Returns the unchanged last sightings whose repetition (`retell`) is due; each is repeated once."""
        due = [target for target, at_ns in self._retell_ns.items() if now_ns >= at_ns]
        for target in due:
            del self._retell_ns[target]
        return [self._last[target] for target in due if target in self._last]

    def detect(self, places: Places, now_ns: int) -> list[Sighted]:
        """The sightings to publish now: of each target in sight one, by the nearest vehicle."""
        due = [id for id in self._true if now_ns - self._reported_ns.get(id, -_REPORT_NS) >= _REPORT_NS]
        if not due or not places.vehicles:
            return []
        seen = []
        for id in due:
            pose = self._true[id]
            east_m, south_m = pose.x_m - self._grid.west_m, self._grid.north_m - pose.y_m
            distance_m = float(np.hypot(places.east_m - east_m, places.south_m - south_m).min())
            if distance_m <= self._range_m:
                self._reported_ns[id] = now_ns
                seen.append(self._sighted(pose, distance_m, now_ns))
        return seen

    def _sighted(self, pose: TargetPose, distance_m: float, now_ns: int) -> Sighted:
        self._seq += 1
        self._last[pose.target] = Sighted(
            author=self._author,
            group=self._group,
            target=pose.target,
            seq=self._seq,
            stamp_ns=now_ns,
            until_ns=now_ns + SIGHTING_LASTS_NS,
            cell=pose.cell,
            x_m=pose.x_m,
            y_m=pose.y_m,
            uncertainty_m=0.5 * self._grid.resolution_m + _RANGE_SHARE * distance_m,
        )
        return self._last[pose.target]


# Places where a target was seen last and is not any more, as vehicles find that stand there. Pure.
#
# A target that only vehicles see is where the newest sighting says, for as long as the sighting lasts. A captured
# target is elsewhere immediately. Its planner leads to the old place until it finds, from the positions of
# vehicles, that it is not seen there, and searches. That costs vehicles there nothing: without this they would
# stay.

UNSEEN_NS = 2 * NS_PER_S
"""A target in sight is published twice a second: one that is not published for this time while a vehicle is at its
position is not there."""


LEFT_NS = 5 * NS_PER_S
"""Time for which no vehicle chases a target that was found absent: then its planner searches, and it is as good as
any."""


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

        lost  targets whose position is unknown
        """
        return (lost | self._found_ns.keys()) & self._by_sight

    def placed(self, target: str, *, by_sight: bool) -> None:
        """Notes a new position of a target: by a sighting, or by its tracker."""
        self._found_ns.pop(target, None)
        (self._by_sight.add if by_sight else self._by_sight.discard)(target)

    def find_gone(self, stood_at: Iterable[str], now_ns: int) -> bool:
        """Finds which targets are gone; returns whether one is that was not before.

        stood_at  targets that a vehicle has within reach, by their known positions
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
