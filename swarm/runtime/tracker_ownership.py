"""Ownership of a target by one of its trackers. Pure: time is an argument.

Every receiver of poses decides by this rule alone, from the poses that it has heard:

1. A tracker lives from the arrival of a pose until the lease in it has passed. A pose with a lease of 0 hands the
   target over: its tracker lives no longer.
2. Of the generations of one tracker, which have one name, the latest incarnation that lives counts.
3. Of the living trackers, the one which has tracked the target for the longest time owns it. Trackers which began
   within `SAME_NS` of each other are ordered by name.

The owner's poses count; those of others are refused. Leases are counted from the arrival, by the receiver's
clock, and how long a tracker has tracked is the difference of two times of its own clock: no clock is compared with
another.

Only living trackers count. Receivers which have received different messages, or the same in another
order, agree again once each has received a pose of every living tracker. This is seniority as in the oldest member
of a process group (Birman, Joseph 1987), not the first that each happened to receive. Cost: a tracker that was
silent for longer than its lease gets its target back when it returns with the same incarnation.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from enum import Enum

import msgspec

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.peers import POSE_SILENCE_NS
from swarm.wire.messages.planning import CELL_OF_PLACE, TargetPose

SAME_NS = 3 * NS_PER_S // 4
"""Receivers measure when a tracker began as exactly as they look, which is at their ticks."""
LONGEST_AGE_NS = 366 * 86_400 * NS_PER_S
"""A tracker that has tracked for longer has no clock, or gives no time as its incarnation: others come first."""
MOST_GENERATIONS = 16
"""Limit for the remembered trackers of one target. Of more living trackers the youngest are refused."""
_MOST_TARGETS = 4096
"""Limit for the targets that are remembered: any process that may put poses can make up any number."""


class Verdict(Enum):
    """Result of checking a pose."""

    COUNTS = "counts"
    """It is the owner's, and news."""
    LATE = "late"
    """Its tracker has published a newer one before."""
    REFUSED = "refused"
    """Another tracker owns the target."""
    OUTSIDE = "outside"
    """Its cell is not on the map. The lease of its tracker is not renewed by it."""


@dataclass(slots=True, eq=False)
class _Generation:
    """One incarnation of a tracker, as of its newest pose.

    began_ns  when it began to track, by the receiver's clock; None if it does not tell
    """

    name: str | None
    incarnation: int
    seq: int
    heard_ns: int
    until_ns: int
    began_ns: int | None

    @property
    def order(self) -> tuple[bool, str, int]:
        """The nameless come last."""
        return self.name is None, self.name or "", self.incarnation


class Tracking:
    """Trackers of one target, as one receiver knows them."""

    def __init__(self, grid: GridSpec) -> None:
        self.pose: TargetPose | None = None
        """The newest that counts, with its cell: where the target was last."""
        self.heard_ns = 0
        """Time when that arrived."""
        self._grid = grid
        self._until_ns = 0
        """Time when the last lease ends."""
        self._generations: dict[tuple[str | None, int], _Generation] = {}
        """Includes ended generations, so that late poses are recognised."""

    def lost(self, now_ns: int) -> bool:
        """True if no tracker lives: `pose` is the last known position."""
        return self.pose is not None and now_ns >= self._until_ns

    def age_ns(self, now_ns: int) -> int | None:
        """Time since the newest pose that counts arrived; None before the first."""
        return None if self.pose is None else max(now_ns - self.heard_ns, 0)

    def judge(self, pose: TargetPose, now_ns: int) -> Verdict:
        """Takes in a pose of this target. Only if it counts has `pose` changed."""
        if pose.cell == CELL_OF_PLACE:
            pose = msgspec.structs.replace(pose, cell=self._grid.cell_at(pose.x_m, pose.y_m))
        if not 0 <= pose.cell < self._grid.cells:
            return Verdict.OUTSIDE
        key = (pose.tracker, pose.incarnation)
        generation = self._generations.get(key)
        if generation is not None and _is_late(pose.seq, generation, now_ns):
            return Verdict.LATE
        began_ns = _began_ns(pose, now_ns)
        if (
            generation is not None
            and generation.began_ns is not None
            and began_ns is not None
            and now_ns < generation.until_ns
        ):
            began_ns = min(began_ns, generation.began_ns)  # the one that came quickest tells best
        hands_over = pose.lease_s == 0
        until_ns = now_ns + (1 if hands_over else int(pose.lease_s * NS_PER_S))
        self._generations[key] = _Generation(pose.tracker, pose.incarnation, pose.seq, now_ns, until_ns, began_ns)
        if len(self._generations) > MOST_GENERATIONS:
            self._forget_one(now_ns)
        owner = self._owner(now_ns)
        counts = owner is not None and owner is self._generations.get(key)
        if hands_over and key in self._generations:
            self._generations[key].until_ns = now_ns
        self._until_ns = max(generation.until_ns for generation in self._generations.values())
        if not counts:
            return Verdict.REFUSED
        self.pose, self.heard_ns = pose, now_ns
        return Verdict.COUNTS

    def place(self, pose: TargetPose, now_ns: int) -> None:
        """Uses a pose as the place of a target without a tracker, until its lease ends. The same pose again changes
        nothing."""
        if pose != self.pose and 0 <= pose.cell < self._grid.cells:
            self.pose, self.heard_ns = pose, now_ns
            self._until_ns = now_ns + int(pose.lease_s * NS_PER_S)

    def _owner(self, now_ns: int) -> _Generation | None:
        return _oldest([generation for generation in self._generations.values() if now_ns < generation.until_ns])

    def _forget_one(self, now_ns: int) -> None:
        """The one that ended first, else the youngest."""
        known = self._generations
        ended = [key for key, generation in known.items() if now_ns >= generation.until_ns]
        first = min(ended, key=lambda key: known[key].until_ns, default=None)
        del known[max(known, key=lambda key: _age_order(known[key])) if first is None else first]


class Trackings:
    """The trackers of many targets, 4096 at most. A further target takes the place of one whose trackers are lost;
    as long as there is none, its poses are refused."""

    def __init__(self, grid: GridSpec) -> None:
        self._grid = grid
        self._of: dict[str, Tracking] = {}

    def counted(self, pose: TargetPose, now_ns: int) -> TargetPose | None:
        """Takes in a pose of any target; returns it, with its cell, if it counts."""
        tracking = self._of.get(pose.target)
        if tracking is None:
            if len(self._of) >= _MOST_TARGETS and not self._forget_one(now_ns):
                return None
            tracking = Tracking(self._grid)
        verdict = tracking.judge(pose, now_ns)
        if tracking.pose is not None:
            self._of[pose.target] = tracking
        return tracking.pose if verdict is Verdict.COUNTS else None

    def place(self, pose: TargetPose, now_ns: int) -> None:
        """Like `Tracking.place`, for any target."""
        if pose.target not in self._of and len(self._of) < _MOST_TARGETS and 0 <= pose.cell < self._grid.cells:
            self._of[pose.target] = Tracking(self._grid)
        if (tracking := self._of.get(pose.target)) is not None:
            tracking.place(pose, now_ns)

    def _forget_one(self, now_ns: int) -> bool:
        """Forgets the first target if its trackers are lost; else the next call looks at another one, so that each
        takes the same time."""
        id = next(iter(self._of))
        first = self._of.pop(id)
        if not first.lost(now_ns):
            self._of[id] = first
        return id not in self._of

    def poses(self) -> dict[str, TargetPose]:
        """Returns the newest pose that counts of each target."""
        return {id: tracking.pose for id, tracking in self._of.items() if tracking.pose is not None}

    def of(self, target: str) -> Tracking | None:
        """Returns the state of a target's trackers; None before its first pose."""
        return self._of.get(target)

    def lost(self, now_ns: int) -> set[str]:
        """The targets whose trackers are lost."""
        return {id for id, tracking in self._of.items() if tracking.lost(now_ns)}


def _is_late(seq: int, generation: _Generation, now_ns: int) -> bool:
    """Same rule as in `swarm.peers.Newest`: after a silence any other number counts as new, so that no pose
    outweighs all later ones."""
    return seq == generation.seq or (seq < generation.seq and now_ns - generation.heard_ns < POSE_SILENCE_NS)


def _began_ns(pose: TargetPose, now_ns: int) -> int | None:
    age_ns = pose.stamp_ns - pose.incarnation
    return now_ns - age_ns if 0 <= age_ns <= LONGEST_AGE_NS else None


def _oldest(living: list[_Generation]) -> _Generation | None:
    """The owner among those who live."""
    speakers: dict[Hashable, _Generation] = {}
    for generation in living:
        name = generation.incarnation if generation.name is None else generation.name
        known = speakers.get(name)
        if known is None or generation.incarnation > known.incarnation:
            speakers[name] = generation
    if len(speakers) < 2:
        return next(iter(speakers.values()), None)
    begins_ns = [generation.began_ns for generation in speakers.values() if generation.began_ns is not None]
    first_ns = min(begins_ns, default=None)
    elders = [generation for generation in speakers.values() if _is_elder(generation, first_ns)]
    return min(elders, key=lambda generation: generation.order)


def _is_elder(generation: _Generation, first_ns: int | None) -> bool:
    """Returns True if no tracker began clearly before it."""
    if first_ns is None:
        return True  # of none is it known when it began
    return generation.began_ns is not None and generation.began_ns - first_ns < SAME_NS


def _age_order(generation: _Generation) -> tuple[bool, int, tuple[bool, str, int]]:
    return generation.began_ns is None, generation.began_ns or 0, generation.order
