"""One mission on its way to a vehicle: MAVLink's mission protocol, our side of it."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from launch_scripts.gateways.mavlink.messages import ACCEPTED, MissionCount, MissionItem
from swarm.clock import NS_PER_S

RETRY_NS = NS_PER_S * 3 // 2
MOST_TRIES = 5
_MOST_ASKED = 8
"""A vehicle may ask so often for each item, on average: a broken one does not keep us at one mission for ever."""


class State(Enum):
    UNDER_WAY, ACCEPTED, FAILED = range(3)


class Upload:
    """MISSION_COUNT until the vehicle asks, then the items that it asks for, until it answers.

    What was said last is said again after 1.5 s without a word, five times in all, as the protocol demands.

    state  how it goes
    why    of a failed one: half a sentence
    """

    def __init__(self, items: Sequence[MissionItem]) -> None:
        self.items = items
        self.state = State.UNDER_WAY
        self.why = ""
        self._said: MissionCount | MissionItem = MissionCount(len(items))
        """What is said next, or was last."""
        self._due_ns: int | None = None
        """When it is said (again); None: at once."""
        self._tries = 0
        self._asked = 0

    def hear_asked(self, seq: int) -> None:
        """The vehicle asks for an item."""
        if self.state is not State.UNDER_WAY:
            return
        self._asked += 1
        if not 0 <= seq < len(self.items):
            return  # of a mission before; it asks again
        if self._asked > _MOST_ASKED * len(self.items):
            self.state, self.why = State.FAILED, f"asked {self._asked} times for {len(self.items)} items"
            return
        self._said, self._due_ns, self._tries = self.items[seq], None, 0

    def hear_answered(self, result: int) -> None:
        """The vehicle has it all, or refuses it."""
        if self.state is not State.UNDER_WAY:
            return
        if result == ACCEPTED:
            # One of a mission before, while nothing of this one was asked for, tells nothing of this one.
            if isinstance(self._said, MissionItem) and self._said.seq == len(self.items) - 1:
                self.state = State.ACCEPTED
        else:
            self.state, self.why = State.FAILED, f"refused it with MAV_MISSION_RESULT {result}"

    def tick(self, now_ns: int) -> MissionCount | MissionItem | None:
        """What is to be said now."""
        if self.state is not State.UNDER_WAY or (self._due_ns is not None and now_ns < self._due_ns):
            return None
        if self._tries == MOST_TRIES:
            self.state, self.why = State.FAILED, f"did not answer {MOST_TRIES} times"
            return None
        self._tries += 1
        self._due_ns = now_ns + RETRY_NS
        return self._said
