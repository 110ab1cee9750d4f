"""What is known of a run, message by message. Pure: whoever hears the swarm passes it what comes on `HEARD`."""

from __future__ import annotations

from launch_scripts.observe.latest_state import Observed
from launch_scripts.observe.plan import RunPlan
from launch_scripts.observe.state import RunState, state_of
from launch_scripts.observe.tracked_targets import TrackedTargets
from swarm.grid import GridSpec
from swarm.liveness import Peer
from swarm.runtime.order_book import OrderBook
from swarm.wire.messages import Message
from swarm.wire.messages.orders import Orders
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.vehicles import Fleet
from swarm.wire.topics import FLEET, LEAD, ORDERS, POSE, STATS, STATUS, Topic

HEARD: dict[Topic, float] = {STATS: 0.0, STATUS: 0.0, POSE: 0.0, LEAD: 0.5, ORDERS: 0.5, FLEET: 0.4}
"""What a state is made of, and how often the newest of each key is needed, in seconds; 0 for all that comes.
Places are sampled every 0.5 s, and each must find newer ones: else all vehicles seem to stand now and then."""


class RunModel:
    """All that is shown of a run at an instant is made of this.

    book  what operators have ordered
    """

    def __init__(self, plan: RunPlan, grid: GridSpec) -> None:
        self.plan = plan
        self.observed = Observed(grid)
        self.tracked = TrackedTargets(grid, self.observed.status)
        self.book = OrderBook()
        self.first_ns: int | None = None
        """When the first was heard; None before."""

    def heard(self, message: Message, now_ns: int) -> Message | None:
        """Take in a message; returns it, a pose with its cell, and None for a pose that does not count."""
        self._touch(now_ns)
        match message:
            case TargetPose():
                counts = self.tracked.hear(message, now_ns)
                if counts is None:
                    return None
                message = counts
            case Fleet():
                self.tracked.something_moved(now_ns)
            case Orders():
                self.book.merge(message.orders, now_ns)
        self.observed.heard(message, now_ns)
        return message

    def alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        """A liveliness token rose or fell."""
        self._touch(now_ns)
        self.observed.alive(peer, up, now_ns)

    @property
    def began_ns(self) -> int | None:
        """When the run began; None before the first message of one whose beginning is not known."""
        return self.first_ns if self.plan.started_ns is None else self.plan.started_ns

    def missing(self) -> list[str]:
        """Processes that the run needs which are not alive, as `role id`."""
        crew = self.plan.crew_now(self.plan.targets_now(self.book))
        return [f"{role} {id}" for role, id in crew if not self.observed.fills(role, id)]

    def state(self, now_ns: int) -> RunState:
        """What the run is at a time."""
        return state_of(self.observed, self.tracked, self.plan, self.book, now_ns, self.began_ns)

    def _touch(self, now_ns: int) -> None:
        if self.first_ns is None:
            self.first_ns = now_ns
