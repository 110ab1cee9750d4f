"""The reports of a program about a vehicle or target of its own: its place, repeated until it leaves."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from swarm.bus.bus import Event, Heard, LinkChanged
from swarm.client.session import Session
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.runtime.tracker_ownership import Tracking, Verdict
from swarm.wire.fields import LONGEST_LEASE_S
from swarm.wire.messages.planning import TargetPose
from swarm.wire.topics import POSE, Topic

R = TypeVar("R", bound="Reported")


class Reported:
    """A vehicle or target of this program, under its own id. Use it in a `with`, or `leave`.

    incarnation  when it joined, in ns: tells it from an earlier generation under the same id
    """

    def __init__(self, session: Session, topic: Topic, kind: str, id: str, lease_s: float, repeat_ns: int) -> None:
        """The reports begin at `_join`.

        kind       its noun in sentences: vehicle or target
        repeat_ns  time from a report to its repetition; a quarter of the lease if that is shorter
        """
        self.id = id
        self.lease_s = lease_s
        self.incarnation = session.now_ns()
        self._session = session
        self._topic = topic
        self._kind = kind
        self._key: dict[str, Any] = {topic.fields[-1]: id}
        self._repeat_ns = min(repeat_ns, int(lease_s * NS_PER_S / 4))
        self._word: Any = None
        """The message that was said last; None before the first, and once it has left."""
        self._seq = 0
        self._repeat_due_ns = 0

    def _join(self) -> None:
        """Begins the reports. Call it last: from then on another thread delivers events and ticks.

        Raises ConfigError where the id is in use in this program.
        """
        self._session.add(self)
        self._session.bus.subscribe(self._topic, self._session.post, **self._key)

    def __enter__(self: R) -> R:
        return self

    def __exit__(self, *_: object) -> None:
        self.leave()

    def on_event(self, event: Event, now_ns: int) -> None:
        raise NotImplementedError

    def _cell_at(self, x_m: float, y_m: float) -> int:
        """The cell of a place. Raises ConfigError, counted, on a cell outside the terrain and on a value that is
        not a number."""
        try:
            return self._session.frame.cell(x_m, y_m)
        except ConfigError as error:
            raise self._session.refused(f"{self._kind} {self.id}: {error}") from None

    def _say(self, x_m: float, y_m: float, **fields: Any) -> None:
        """Publishes a word. Raises ConfigError, counted, on fields beyond their bounds: the word before stands."""
        now_ns = self._session.now_ns()
        word = self._topic.message(
            **self._key,
            **fields,
            incarnation=self.incarnation,
            seq=self._seq + 1,
            stamp_ns=now_ns,
            x_m=float(x_m),
            y_m=float(y_m),
            lease_s=self.lease_s,
        )
        self._word = self._session.publish(self._topic, word, **self._key)
        self._seq += 1
        self._repeat_due_ns = now_ns + self._repeat_ns

    def _repeat(self, now_ns: int, **changes: Any) -> None:
        self._repeat_due_ns = now_ns + self._repeat_ns
        self._seq += 1
        self._word = msgspec.structs.replace(self._word, seq=self._seq, stamp_ns=now_ns, **changes)
        self._session.bus.publish(self._topic, self._word, **self._key)

    def tick(self, now_ns: int) -> None:
        if self._word is not None and now_ns >= self._repeat_due_ns:
            self._repeat(now_ns)

    def leave(self) -> None:
        """Removes the vehicle or target; others receive this at once. May be repeated."""
        session = self._session
        with session.lock:
            if self._word is not None and session.ended is None:
                self._repeat(session.now_ns(), lease_s=0.0)
            self._word = None
            session.bus.unsubscribe(self._topic, **self._key)
            session.remove(self)


_REPEAT_NS = NS_PER_S * 2 // 5
"""Poses come twice a second at least."""


class Target(Reported):
    """A target of the scenario whose walk is `external`. Made by `Swarm.target`; use it in a `with`, or `leave`.

    Of several trackers the one that has tracked the target for the longest owns it, and its poses count. The next
    one takes over when its lease ends, or immediately when it leaves (docs/design/tracker-ownership.md).

    id           of the target, as in the scenario
    tracker      name of this tracker; a later start under the same name takes over at once. None: each start is a
                 tracker of its own
    lease_s      after this time without a pose the target counts as lost
    incarnation  when its tracking began, in ns
    """

    def __init__(self, session: Session, id: str, tracker: str | None, lease_s: float) -> None:
        session.check_ids(id=id, **({} if tracker is None else {"tracker": tracker}))
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
        """Hands the target over: the next tracker's poses count at once. May be repeated."""
        super().leave()
