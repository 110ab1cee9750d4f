"""The position of a target as its planner believes it, and the oddities of its trackers. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.runtime.stats import Counters
from swarm.runtime.tracker_ownership import Tracking, Verdict
from swarm.wire.messages.planning import CELL_OF_PLACE, TargetPose

COUNTS = ("poses_refused", "poses_outside", "trackers_lost")
_REFUSED_OFTEN = 3
"""Poses of a tracker that are refused before it is named: the last of one that was replaced may come late."""
_MOST_NAMED = 256
"""Trackers: names cost a stranger nothing."""


@dataclass(frozen=True, slots=True)
class Notice:
    """A sentence for people who watch the run; `cell` is where, if anywhere."""

    kind: str
    text: str
    cell: int | None = None


class TargetWatch:
    """The position of one target, as its planners of all classes believe it.

    Each oddity of a tracker is counted every time, and reported once in a sentence for operators.

    leads  false for a standby, which neither counts nor reports: the leader does
    """

    def __init__(self, target: str, grid: GridSpec, counters: Counters, leads: bool = True) -> None:
        self.target = target
        self.leads = leads
        self._grid = grid
        self._counters = counters
        self._tracking = Tracking(grid)
        self._lost = False
        self._lost_since_ns = 0
        self._handed_over = False
        self._tracker = ""
        """The name of the last owner, in words; empty before the first."""
        self._refused: dict[str | int, int] = {}
        """Tracker, or incarnation of one without a name -> its poses that were refused."""
        self._named: set[tuple[str, str | int]] = set()
        """(kind of oddity, tracker), reported before."""
        self._pending: list[Notice] = []
        for name in COUNTS:
            counters.count(name, 0)

    @property
    def pose(self) -> TargetPose | None:
        """Last position of the target; None before the first pose."""
        return self._tracking.pose

    def age_s(self, now_ns: int) -> float | None:
        """Time since that pose arrived; None before the first."""
        age_ns = self._tracking.age_ns(now_ns)
        return None if age_ns is None else age_ns / NS_PER_S

    def lost(self, now_ns: int) -> bool:
        """Returns True if no tracker publishes the target now."""
        return self._tracking.lost(now_ns)

    def on_pose(self, pose: TargetPose, now_ns: int) -> None:
        """A tracker tells a pose of the target."""
        if pose.target != self.target:
            return
        verdict = self._tracking.judge(pose, now_ns)
        if verdict is Verdict.COUNTS:
            self._owned_by(pose, now_ns)
        elif verdict is Verdict.REFUSED:
            self._refuse(pose)
        elif verdict is Verdict.OUTSIDE:
            self._count("poses_outside")
            shape = f"{self._grid.rows} x {self._grid.cols} cells"
            cell = f"cell {pose.cell}" if pose.cell != CELL_OF_PLACE else f"{pose.x_m:.0f}, {pose.y_m:.0f} m"
            text = f"{_name(pose)} puts it into {cell}, outside of the terrain of {shape}: not used"
            self._name_once("pose-outside", pose, text)

    def on_sighting(self, pose: TargetPose, now_ns: int) -> None:
        """The best sighting of a target that has no tracker."""
        before = self._tracking.pose
        self._tracking.place(pose, now_ns)
        if self._tracking.pose is not before:
            self._found("a vehicle sees it", now_ns)

    def drain(self, now_ns: int) -> list[Notice]:
        """Returns the sentences for operators that are new, none on a standby."""
        if not self._lost and self._tracking.lost(now_ns):
            self._lose(now_ns)
        notes, self._pending = self._pending, []
        return notes if self.leads else []

    def _owned_by(self, pose: TargetPose, now_ns: int) -> None:
        tracker, before = _name(pose), self._tracker
        self._tracker = tracker
        self._handed_over = pose.lease_s == 0
        self._found(f"{tracker} tracks it", now_ns)
        if before not in ("", tracker):
            self._note("tracker-changed", f"{tracker} tracks it now, before that {before} did")

    def _found(self, how: str, now_ns: int) -> None:
        if self._lost:
            self._lost = False
            lost_s = (now_ns - self._lost_since_ns) / NS_PER_S
            self._note("tracker-back", f"{how} again, after {lost_s:.1f} s without a known position")

    def _lose(self, now_ns: int) -> None:
        pose = self._tracking.pose
        assert pose is not None
        self._lost, self._lost_since_ns = True, self._tracking.heard_ns
        self._count("trackers_lost")
        then = "routes lead to where it was, and after 30 s it is searched for"
        if not self._tracker:
            then = "it is searched for"
            why = f"no vehicle has seen it for {(now_ns - self._tracking.heard_ns) / NS_PER_S:.1f} s"
        elif self._handed_over:
            why = f"{self._tracker} has handed it over, and there is no other tracker"
        else:
            why = f"{self._tracker} has been silent for longer than its lease of {pose.lease_s:g} s"
        self._note("tracker-lost", f"{why}; {then}", pose.cell)

    def _refuse(self, pose: TargetPose) -> None:
        self._count("poses_refused")
        tracker, owner = _key(pose), self._tracking.pose
        if tracker not in self._refused and len(self._refused) >= _MOST_NAMED:
            return
        self._refused[tracker] = self._refused.get(tracker, 0) + 1
        if self._refused[tracker] < _REFUSED_OFTEN or owner is None:
            return
        if pose.tracker is not None and pose.tracker == owner.tracker:
            why = f"two trackers call themselves {pose.tracker}; only that of the later incarnation counts"
        else:
            why = f"poses of {_name(pose)} are refused, as {_name(owner)} owns it"
        self._name_once("tracker-refused", pose, why)

    def _count(self, name: str) -> None:
        if self.leads:
            self._counters.count(name)

    def _name_once(self, kind: str, pose: TargetPose, text: str) -> None:
        key = (kind, _key(pose))
        if key not in self._named and len(self._named) < _MOST_NAMED:
            self._named.add(key)
            self._note(kind, text)

    def _note(self, kind: str, text: str, cell: int | None = None) -> None:
        self._pending.append(Notice(kind, f"target {self.target}: {text}", cell))


def _key(pose: TargetPose) -> str | int:
    return pose.incarnation if pose.tracker is None else pose.tracker


def _name(pose: TargetPose) -> str:
    if pose.tracker is None:
        return f"a tracker without a name, of incarnation {pose.incarnation},"
    return f"tracker {pose.tracker}"
