"""A target whose place a program outside the swarm reports."""

from __future__ import annotations

import msgspec

from swarm.bus.bus import Event, Heard, LinkChanged
from swarm.client.session import Session
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.runtime.tracking import Tracking, Verdict
from swarm.wire.fields import LONGEST_LEASE_S, check_id
from swarm.wire.messages.planning import TargetPose
from swarm.wire.topics import POSE

_REPEAT_NS = NS_PER_S * 2 // 5
"""Poses come twice a second at least."""


class Target:
    """A target of the scenario whose walk is `external`. Made by `Swarm.target`; use it in a `with`, or `leave`.

    Of several trackers the one that has tracked the target for the longest owns it, and its poses count; the next
    one takes over when its lease ends, or at once when it leaves (decision 42).

    id           of the target, as in the scenario
    tracker      name of this tracker; a later start under the same name takes over at once. None: each start is a
                 tracker of its own
    lease_s      the target counts as lost when nothing was heard of its trackers for so long
    incarnation  when its tracking began, in ns
    """

    def __init__(self, session: Session, id: str, tracker: str | None, lease_s: float) -> None:
        for name, value in (("target", id), ("tracker", tracker)):
            try:
                if value is not None:
                    check_id(name, value)
            except ValueError as error:
                raise session.refused(str(error)) from error
        lease_s = session.number("lease_s", lease_s)
        if not 0 < lease_s <= LONGEST_LEASE_S:
            raise session.refused(f"lease_s is {lease_s!r}, expected more than 0 and at most {LONGEST_LEASE_S:g}")
        self.id = id
        self.tracker = tracker
        self.lease_s = lease_s
        self.incarnation = session.now_ns()
        self._session = session
        self._tracking = Tracking(session.frame.grid)
        self._pose: TargetPose | None = None
        """What was said last; None before the first `at`."""
        self._seq = 0
        self._repeat_due_ns = 0
        session.add(self)
        session.bus.subscribe(POSE, session.post, target=id)

    def __enter__(self) -> Target:
        return self

    def __exit__(self, *_: object) -> None:
        self.leave()

    def at(self, x_m: float, y_m: float) -> None:
        """Say where the target is, in the terrain's frame. It is repeated until the next call or `leave`.

        Raises ConfigError on a place outside the terrain and on what is no number; what was said before stands.
        """
        session = self._session
        with session.lock:
            try:
                cell = session.frame.cell(x_m, y_m)
            except ConfigError as error:
                raise session.refused(f"target {self.id}: {error}") from None
            pose = TargetPose(
                target=self.id,
                tracker=self.tracker,
                incarnation=self.incarnation,
                seq=self._seq + 1,
                lease_s=float(self.lease_s),
                stamp_ns=session.now_ns(),
                cell=cell,
                x_m=float(x_m),
                y_m=float(y_m),
            )
            self._pose = session.publish(POSE, pose, target=self.id)
            self._seq += 1
            self._repeat_due_ns = pose.stamp_ns + self._repeat_ns

    @property
    def owned(self) -> bool:
        """Whether this tracker's poses count, as far as is heard: false until the first one has come back."""
        with self._session.lock:
            counts = self._tracking.pose
            lost = self._tracking.lost(self._session.now_ns())
            return counts is not None and not lost and self._is_ours(counts)

    def _is_ours(self, pose: TargetPose) -> bool:
        return (pose.tracker, pose.incarnation) == (self.tracker, self.incarnation)

    @property
    def _repeat_ns(self) -> int:
        return min(_REPEAT_NS, int(self.lease_s * NS_PER_S / 4))

    def handle(self, event: Event, now_ns: int) -> None:
        match event:
            case Heard(topic=topic, message=TargetPose() as pose) if topic is POSE and pose.target == self.id:
                verdict = self._tracking.hear(pose, now_ns)
                if not self._is_ours(pose):
                    self._hear_other(pose, verdict)
            case LinkChanged(up=True):
                self._repeat_due_ns = 0

    def _hear_other(self, pose: TargetPose, verdict: Verdict) -> None:
        who = f"tracker {pose.tracker}" if pose.tracker else "another tracker"
        if verdict is Verdict.COUNTS:
            self._session.problem("doubles_heard", f"{who} owns target {self.id}: its poses count, not ours")
        elif verdict is Verdict.REFUSED:
            self._session.problem("doubles_heard", f"{who} reports target {self.id} too: our poses count")

    def tick(self, now_ns: int) -> None:
        if self._pose is not None and now_ns >= self._repeat_due_ns:
            self._repeat_due_ns = now_ns + self._repeat_ns
            self._seq += 1
            self._pose = msgspec.structs.replace(self._pose, seq=self._seq, stamp_ns=now_ns)
            self._session.bus.publish(POSE, self._pose, target=self.id)

    def leave(self) -> None:
        """Hand it over: the next tracker's poses count at once. May be repeated."""
        session = self._session
        with session.lock:
            if self._pose is not None and session.ended is None:
                last = msgspec.structs.replace(
                    self._pose, seq=self._seq + 1, stamp_ns=session.now_ns(), lease_s=0.0
                )
                session.bus.publish(POSE, last, target=self.id)
            self._pose = None
            session.bus.unsubscribe(POSE, target=self.id)
            session.remove(self)
