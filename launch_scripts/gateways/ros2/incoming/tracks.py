"""Which robots there are, what the swarm is told of each, and when one is none any more. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from launch_scripts.gateways.ros2.incoming.places import FrameReader, Place, robot_place, with_speed
from swarm.clock import NS_PER_S


@dataclass
class Track:
    """One robot's messages, over time.

    lease_s  it is gone so long after its last good message
    hz       the swarm is told at most so often
    say      told each new reason why messages are refused; once until a good one comes
    place    where it was said to be last; None before the first message and once it is gone
    """

    reader: FrameReader
    lease_s: float
    hz: float
    say: Callable[[str], None]
    place: Place | None = None
    refused: int = 0
    _heard_ns: int = 0
    _told_ns: int | None = None
    _reason: str | None = field(default=None, repr=False)

    def due(self, now_ns: int) -> bool:
        """Whether the swarm may be told of another place: only then is a message worth reading."""
        return self._told_ns is None or now_ns - self._told_ns >= NS_PER_S / self.hz

    def hear(self, message: Any, now_ns: int) -> Place | None:
        """What to tell the swarm of a message; None where it says nothing that counts.

        Only the time of arrival counts: clocks of robots may be simulated, leap or stand still.
        """
        found = robot_place(self.reader, message)
        if isinstance(found, str):
            self.refused += 1
            kind = found.partition(" is ")[0]
            if kind != self._reason:
                self._reason = kind
                self.say(found)
            return None
        before = None if self.place is None else (self.place, self._heard_ns)
        if not hasattr(message, "twist"):
            found = with_speed(before, found, now_ns)
        self.place, self._heard_ns, self._told_ns, self._reason = found, now_ns, now_ns, None
        return found

    def gone(self, now_ns: int) -> bool:
        """Whether its lease has ended. Said once: it may come back."""
        if self.place is None or now_ns - self._heard_ns <= self.lease_s * NS_PER_S:
            return False
        self.place = None
        return True
