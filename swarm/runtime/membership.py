"""What every process does besides its work: shows that it is alive, which run it belongs to, and what it
counted."""

from __future__ import annotations

from swarm.bus.bus import Appeared, Asked, AskEnded, Bus, Disappeared, Event, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.errors import RunMismatchError
from swarm.liveness import Peer
from swarm.runtime.stats import Counters
from swarm.wire.messages.base import Nothing
from swarm.wire.messages.processes import Note, RunInfo, Stats
from swarm.wire.topics import NOTE, RUN, STATS

ROUTER = "router"
_TAG = "run-check"


class Member:
    """One process's membership in a run.

    A process asks all others which run they belong to when it starts, when a link comes back and when a router
    appears, as processes may be behind it. It ends with RunMismatchError if the run or terrain of any differs
    from its own.
    """

    def __init__(self, info: RunInfo, bus: Bus, post: Post) -> None:
        self.info = info
        self.counters = Counters()
        """All that this process counts; never reset."""
        self._bus = bus
        self._post = post
        self._stats_due_ns = 0
        """When `tick` publishes the counters next."""

    @property
    def peer(self) -> Peer:
        return Peer(self.info.role, self.info.id, self.info.incarnation)

    def join(self) -> None:
        """Serve our run, then ask for those of others, in this order: of two processes that start at once at least
        one hears the other. Called once."""
        self._bus.serve(RUN, self._post, role=self.info.role, id=self.info.id)
        self._bus.watch_links(self._post)
        self._bus.watch_alive(self._post, role=ROUTER)
        self._bus.declare_alive(self.peer)
        self._ask()

    def handle(self, event: Event) -> bool:
        """Whether the event was about membership only and is done with. Raises RunMismatchError."""
        match event:
            case Asked(topic=topic) if topic is RUN:
                event.answer(self.info)
                event.end()
                return True
            case Replied(tag=tag, message=RunInfo() as other) if tag == _TAG:
                check_same_run(self.info, other)
                return True
            case AskEnded(tag=tag) if tag == _TAG:
                return True
            case Appeared(peer=Peer(role=role)) if role == ROUTER:
                self._post(LinkChanged(up=True, beyond=True))
                return True
            case Disappeared(peer=Peer(role=role)) if role == ROUTER:
                return True
            case LinkChanged(up=True):
                self._ask()
                return False  # replicas compare what they hold when a link comes back
        return False

    def tick(self, now_ns: int) -> None:
        """Publish the counters once a second."""
        if now_ns >= self._stats_due_ns:
            self._stats_due_ns = now_ns + NS_PER_S
            self.publish_stats(now_ns)

    def publish_stats(self, now_ns: int) -> None:
        """Publish the counters now: the last time when the service stops."""
        counts = {**self.counters.counts, **self._bus.counts}
        stats = Stats(
            role=self.info.role,
            id=self.info.id,
            incarnation=self.info.incarnation,
            stamp_ns=now_ns,
            counts=counts,
            gauges=dict(self.counters.gauges),
            histograms={name: h.buckets for name, h in self.counters.histograms.items()},
        )
        self._bus.publish(STATS, stats, role=self.info.role, id=self.info.id)

    def note(self, now_ns: int, kind: str, text: str, cell: int | None = None) -> None:
        """Publish a sentence for people who watch the run."""
        info = self.info
        note = Note(role=info.role, id=info.id, stamp_ns=now_ns, kind=kind, text=text, cell=cell)
        self._bus.publish(NOTE, note, role=info.role, id=info.id)

    def _ask(self) -> None:
        self._bus.ask(RUN, Nothing(), self._post, tag=_TAG, timeout_s=2.0)


def check_same_run(mine: RunInfo, other: RunInfo) -> None:
    """Raise RunMismatchError, with a sentence on the difference, where two processes must not share a namespace."""
    who = f"{other.role} {other.id}"
    if other.run_id != mine.run_id:
        raise RunMismatchError(
            f"{mine.role} {mine.id} belongs to run {mine.run_id}, but {who} in the same namespace belongs to run "
            f"{other.run_id} (scenario {other.scenario}): choose another network.namespace or join that run"
        )
    if other.terrain != mine.terrain:
        raise RunMismatchError(
            f"{mine.role} {mine.id} has terrain {mine.terrain} ({mine.rows} x {mine.cols}), but {who} has "
            f"{other.terrain} ({other.rows} x {other.cols}): terrain files or cost rules differ"
        )
