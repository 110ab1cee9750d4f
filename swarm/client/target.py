"""A target whose place a program outside the swarm reports."""

from __future__ import annotations

from swarm.bus.bus import Event, Heard, LinkChanged
from swarm.client.reported import Reported
from swarm.client.session import Session
from swarm.clock import NS_PER_S
from swarm.runtime.tracking import Tracking, Verdict
from swarm.wire.fields import LONGEST_LEASE_S
from swarm.wire.messages.planning import TargetPose
from swarm.wire.topics import POSE

_REPEAT_NS = NS_PER_S * 2 // 5
"""Poses come twice a second at least."""


class Target(Reported):
    """A target of the scenario whose walk is `external`. Made by `Swarm.target`; use it in a `with`, or `leave`.

    Of several trackers the one that has tracked the target for the longest owns it, and its poses count. The next
    one takes over when its lease ends, or immediately when it leaves (docs/design/tracker-ownership.md).

    id           of the target, as in the scenario
    tracker      name of this tracker; a later start under the same name takes over at once. None: each start is a
                 tracker of its own
    lease_s      the target counts as lost when nothing was heard of its trackers for so long
    incarnation  when its tracking began, in ns
    """

    def __init__(self, session: Session, id: str, tracker: str | None, lease_s: float) -> None:
        session.check_ids(target=id, tracker=tracker)
        lease_s = session.number("lease_s", lease_s, 0, LONGEST_LEASE_S, more=True)
        self.tracker = tracker
        self._tracking = Tracking(session.frame.grid)
        super().__init__(session, POSE, "target", id, lease_s, _REPEAT_NS)
        self._join()

    def at(self, x_m: float, y_m: float) -> None:
        """States where the target is, in the terrain's frame. It is repeated until the next call or `leave`.

        Raises ConfigError on a location outside the terrain and on a value that is not a number; the previous pose
        is kept.
        """
        with self._session.lock:
            self._say(x_m, y_m, cell=self._cell_at(x_m, y_m), tracker=self.tracker)

    @property
    def owned(self) -> bool:
        """True if this tracker's poses count, as far as is known: false until the first one has been received
        back."""
        with self._session.lock:
            counts = self._tracking.pose
            lost = self._tracking.lost(self._session.now_ns())
            return counts is not None and not lost and self._is_ours(counts)

    def _is_ours(self, pose: TargetPose) -> bool:
        return (pose.tracker, pose.incarnation) == (self.tracker, self.incarnation)

    def on_event(self, event: Event, now_ns: int) -> None:
        match event:
            case Heard(topic=topic, message=TargetPose() as pose) if topic is POSE and pose.target == self.id:
                verdict = self._tracking.judge(pose, now_ns)
                if not self._is_ours(pose):
                    self._on_other(pose, verdict)
            case LinkChanged(up=True):
                self._repeat_due_ns = 0

    def _on_other(self, pose: TargetPose, verdict: Verdict) -> None:
        who = f"tracker {pose.tracker}" if pose.tracker else "another tracker"
        if verdict is Verdict.COUNTS:
            self._session.problem("doubles_heard", f"{who} owns target {self.id}: its poses count, not ours")
        elif verdict is Verdict.REFUSED:
            self._session.problem("doubles_heard", f"{who} reports target {self.id} too: our poses count")

    def leave(self) -> None:
        """Hand it over: the next tracker's poses count at once. May be repeated."""
        super().leave()
