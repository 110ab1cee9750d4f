"""A target whose place a program outside the swarm reports."""

from __future__ import annotations

import msgspec

from swarm.bus.bus import Event, Heard, LinkChanged
from swarm.client.session import Session
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.wire.fields import check_id
from swarm.wire.messages.targets import TargetPose
from swarm.wire.topics import POSE

_REPEAT_NS = NS_PER_S * 2 // 5
"""Planners follow another tracker after two seconds without news; poses come twice a second at least."""


class Target:
    """A target of the scenario whose walk is `external`. Made by `Swarm.target`; use it in a `with`, or `leave`.

    id           of the target, as in the scenario
    incarnation  when its tracker started, in ns
    """

    def __init__(self, session: Session, id: str) -> None:
        try:
            check_id("target", id)
        except ValueError as error:
            raise session.refused(str(error)) from error
        self.id = id
        self.incarnation = session.now_ns()
        self._session = session
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
                incarnation=self.incarnation,
                seq=self._seq + 1,
                stamp_ns=session.now_ns(),
                cell=cell,
                x_m=float(x_m),
                y_m=float(y_m),
            )
            self._pose = session.publish(POSE, pose, target=self.id)
            self._seq += 1
            self._repeat_due_ns = pose.stamp_ns + _REPEAT_NS

    def handle(self, event: Event, now_ns: int) -> None:
        match event:
            case Heard(message=TargetPose() as pose) if pose.target == self.id:
                if pose.incarnation != self.incarnation:
                    later = (
                        "later, so it counts and we do not"
                        if (pose.incarnation > self.incarnation)
                        else "earlier, so we count and it does not"
                    )
                    self._session.problem("doubles_heard", f"another process tracks {self.id}; it started {later}")
            case LinkChanged(up=True):
                self._repeat_due_ns = 0

    def tick(self, now_ns: int) -> None:
        if self._pose is not None and now_ns >= self._repeat_due_ns:
            self._repeat_due_ns = now_ns + _REPEAT_NS
            self._seq += 1
            self._pose = msgspec.structs.replace(self._pose, seq=self._seq, stamp_ns=now_ns)
            self._session.bus.publish(POSE, self._pose, target=self.id)

    def leave(self) -> None:
        """Report it no more. May be repeated."""
        session = self._session
        with session.lock:
            self._pose = None
            session.bus.unsubscribe(POSE, target=self.id)
            session.remove(self)
