"""Membership of a process: it shows that it is alive, names its run, and publishes its counters."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

import msgspec

from swarm.bus.bus import Appeared, Asked, AskEnded, Bus, Disappeared, Event, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.errors import RunMismatchError
from swarm.peers import Peer
from swarm.runtime.stats import MESSAGES_PER_S, READY, RESTARTS, Counters, carried
from swarm.wire.fields import MOST_TEXT
from swarm.wire.messages import Message, Nothing
from swarm.wire.messages.processes import Alarm, Note, RunInfo, Stats
from swarm.wire.topics import NOTE, RUN, STATS, Topic, asker_of
from swarm.wire.versions import are_neighbours

_MOST_STANDING, _MOST_OVER = 40, 20
"""Alarms in a `Stats`, which has to stay a small message: it is sent each second."""


class Alarms:
    """The alarms of one process: those that last, 40 at most, and the newest 20 that are over.

    They are repeated with each `Stats`, so that a late subscriber knows them.
    """

    def __init__(self, before: Iterable[Alarm] = ()) -> None:
        self._standing: dict[tuple[str, str], Alarm] = {}
        """(kind, about) -> what lasts. An alarm of an earlier generation has ended: this generation raises it
        again."""
        self._over: deque[Alarm] = deque((each for each in before if each.over_ns is not None), maxlen=_MOST_OVER)

    def happened(self, kind: str, about: str, text: str, now_ns: int, cell: int | None = None) -> None:
        """Reports an event that is over at once, such as a collision."""
        text = text[:MOST_TEXT]
        self._over.append(
            Alarm(kind=kind, about=about[:100], text=text, since_ns=now_ns, over_ns=now_ns, cell=cell)
        )

    def begin(
        self, kind: str, about: str, text: str, now_ns: int, cell: int | None = None, target: str | None = None
    ) -> None:
        """Something lasts from now on; a repeated call changes only its text and its place."""
        known = self._standing.get((kind, about))
        if known is None and len(self._standing) >= _MOST_STANDING:
            return
        since_ns = now_ns if known is None else known.since_ns
        self._standing[kind, about] = Alarm(
            kind=kind, about=about[:100], text=text[:MOST_TEXT], since_ns=since_ns, cell=cell, target=target
        )

    def end(self, kind: str, about: str, now_ns: int) -> None:
        """It is over; nothing happens if it did not last."""
        known = self._standing.pop((kind, about), None)
        if known is not None:
            self._over.append(msgspec.structs.replace(known, over_ns=max(now_ns, known.since_ns)))

    def last_of(self, kind: str, abouts: Collection[str], now_ns: int) -> None:
        """Keeps only these alarms of this kind open, and closes all others."""
        for standing, about in list(self._standing):
            if standing == kind and about not in abouts:
                self.end(kind, about, now_ns)

    def current(self) -> list[Alarm]:
        """Returns open alarms, then closed ones, each in order of time."""
        return [*sorted(self._standing.values(), key=lambda alarm: alarm.since_ns), *self._over]


log = logging.getLogger(__name__)

ROUTER = "router"
NO_RUN = ""
"""The run id of what belongs to no run: a router passes on all messages."""
_TAG = "run-check"
_MOST_STRANGERS = 256
"""Foreign processes that are counted and named: any process that may put on the namespace can make up any
number."""
_RATE_LEAST_S = 0.5
"""Over a shorter time no rate is measured, as at the end."""
_BEHIND_TICKS = 5
"""Skipped ticks in a second from which on a process is behind."""


class Member:
    """One process's membership in a run.

    A process asks all others for their run when it starts, whenever a link comes back and whenever a router
    appears, as behind it there may be others. Two processes belong together when run id, terrain digest, the side
    of shards and the classes of vehicles, in their order, are the same, and their builds speak neighbouring wire
    versions; each is then confirmed. An unconfirmed process exits, with RunMismatchError, if every answer differs.
    A confirmed one never exits because of an answer; it reports the sender as a stranger: counts it, and names it
    once.
    """

    def __init__(self, info: RunInfo, bus: Bus, post: Post, before: Stats | None = None) -> None:
        self.info = info
        self._before = before
        """Counts of earlier generations of this process, which late subscribers receive, too."""
        self.alarms = Alarms(() if before is None else before.alarms)
        """Alarms for people that watch the run."""
        self.counters = Counters()
        """All counters of this process; never reset. Counters of faults start at 0, so that a watcher sees the
        first one."""
        for name in ("strangers", "plugin_failed"):
            self.counters.count(name, 0)
        self.web_port = 0
        """Port of this process's web page. Published each second, for late subscribers."""
        self._bus = bus
        self._post = post
        self._stats_due_ns = 0
        self._rate_ns, self._rate_of = 0, 0
        """Time when the rate of messages was measured last, and how many there had been."""
        self._dropped = 0
        """Ticks that had been dropped when that was looked at last."""
        self.counters.gauge(RESTARTS, float(info.restarts))
        self._now_ns = 0  # of the last tick
        # Whether another process of this run has ever answered: from then on no answer ends this one.
        self._confirmed = info.run_id == NO_RUN
        self._linked = True
        """True if the router is reached; a bus opens with its link."""
        self._asked_all = self._confirmed
        """True if a round of replies has ended in which not all of them named other runs."""
        self._needs: list[tuple[str, Callable[[], bool]]] = []
        self._router_appeared = False
        """True if a router's token has risen since others were asked for their run."""
        self._ask_due_ns, self._ask_wait_ns = 0, NS_PER_S
        """Time when all may be asked again, and the wait before it. A token costs its sender nothing: while tokens
        rise without a pause, each wait is twice the one before, up to 16 s."""
        # The first differing reply of the current round, in words.
        self._differs: RunMismatchError | None = None
        # Processes which were named already, and sentences that the next tick publishes.
        self._strangers: set[Peer] = set()
        self._to_name: list[str] = []

    @property
    def peer(self) -> Peer:
        return Peer(self.info.role, self.info.id, self.info.incarnation)

    def needs(self, what: str, met: Callable[[], bool]) -> None:
        """Names a need of the process, and how to test whether it is met."""
        self._needs.append((what, met))

    def lacks(self) -> list[str]:
        """Returns the missing needs of the process: link, run, and the names in `needs`. Changes nothing."""
        own = [("its router", self._linked), ("word of its run", self._asked_all)]
        return [what for what, met in own if not met] + [what for what, met in self._needs if not met()]

    def join(self) -> None:
        """Serves our run, then asks for those of others, in this order: of two processes that start at once at
        least one hears the other. Called once for each bus."""
        self._bus.serve(RUN, self._post, role=self.info.role, id=self.info.id)
        self._bus.watch_links(self._post)
        self._bus.watch_alive(self._post, role=ROUTER)
        self._bus.declare_alive(self.peer)
        self._ask()

    def move_to(self, bus: Bus) -> None:
        """Continues on another bus, and joins there; the previous one is closed."""
        self._bus = bus
        self.join()

    def on_member_event(self, event: Event) -> bool:
        """Returns True if the event was about membership only, and needs no other handler. Raises
        RunMismatchError."""
        match event:
            case Asked(topic=topic) if topic is RUN:
                event.answer(msgspec.structs.replace(self.info, now_ns=self._now_ns))
                event.end()
                return True
            case Replied(tag=tag, message=RunInfo() as other) if tag == _TAG:
                self._compare(other)
                return True
            case AskEnded(tag=tag) if tag == _TAG:
                differs, self._differs = self._differs, None
                if differs is not None and not self._confirmed:
                    raise differs
                self._asked_all = True
                return True
            case Appeared(peer=Peer(role=role)) | Disappeared(peer=Peer(role=role)) if role == ROUTER:
                self._router_appeared |= isinstance(event, Appeared)
                return True
            case LinkChanged(up=False, beyond=False) if self.info.role != ROUTER:
                self._linked = False
                return False
            case LinkChanged(up=True, beyond=beyond):
                self._linked = self._linked or not beyond
                self._ask()
                return False  # replicas compare what they hold when a link comes back
        return False

    def tick(self, now_ns: int) -> None:
        """Performs all work that is due: reports a restart at the first tick, reports a link after another router
        appeared, names new strangers, and publishes the counters once a second."""
        if not self._now_ns and self.info.restarts:
            text = f"{self._name} was started again, restart {self.info.restarts}"
            self.alarms.happened("restarted", self._name, text, now_ns)
        self._now_ns = now_ns
        if self._router_appeared and now_ns >= self._ask_due_ns:
            waited_ns = 2 * self._ask_wait_ns + self._ask_due_ns - now_ns
            self._ask_wait_ns = min(max(waited_ns, NS_PER_S), 16 * NS_PER_S)
            self._router_appeared, self._ask_due_ns = False, now_ns + self._ask_wait_ns
            self._post(LinkChanged(up=True, beyond=True))
        for sentence in self._to_name:
            self.note(now_ns, "stranger", sentence)
        self._to_name.clear()
        if now_ns >= self._stats_due_ns:
            self._stats_due_ns = now_ns + NS_PER_S
            self.publish_stats(now_ns)

    def publish_stats(self, now_ns: int) -> None:
        """Publishes the counters now: the last time when the service stops."""
        counts = {**self.counters.counts, **self._bus.counts}
        self._measure(counts, now_ns)
        self.counters.gauge(READY, float(not self.lacks()))
        stats = Stats(
            role=self.info.role,
            id=self.info.id,
            incarnation=self.info.incarnation,
            stamp_ns=now_ns,
            counts=dict(sorted(counts.items())),  # when a figure was counted first must not show in the bytes
            gauges=dict(sorted(self.counters.gauges.items())),
            histograms={name: h.buckets for name, h in sorted(self.counters.histograms.items())},
            counts_by=self.counters.counts_by,
            histograms_by={
                name: {id: h.buckets for id, h in each.items()}
                for name, each in self.counters.histograms_by.items()
            },
            alarms=self.alarms.current(),
            web_port=self.web_port,
        )
        if self._before is not None:
            stats = carried(self._before, stats)
        self._bus.publish(STATS, stats, role=self.info.role, id=self.info.id)

    def _measure(self, counts: Mapping[str, int], now_ns: int) -> None:
        """Measures what only this process can: all observers then have the same rate, whenever they joined."""
        passed_s = (now_ns - self._rate_ns) / NS_PER_S
        if passed_s < _RATE_LEAST_S:
            return
        sent, dropped = counts.get("messages_out", 0), counts.get("ticks_dropped", 0)
        if self._rate_ns:
            self.counters.gauge(MESSAGES_PER_S, (sent - self._rate_of) / passed_s)
            skipped = dropped - self._dropped
            if skipped >= _BEHIND_TICKS:
                text = f"{self._name} skipped {skipped} ticks in {passed_s:.1f} s"
                self.alarms.begin("behind", self._name, text, now_ns)
            elif not skipped:
                self.alarms.end("behind", self._name, now_ns)
        self._rate_ns, self._rate_of, self._dropped = now_ns, sent, dropped

    def ask_by_name(self, topic: Topic, request: Message, *, tag: str, timeout_s: float = 2.0, **of: str) -> None:
        """Sends a query under our name, so that our queries have a turn of their own.

        of  fields of the key, beside the asker
        """
        asker = asker_of(self.info.role, self.info.id)
        self._bus.ask(topic, request, self._post, tag=tag, timeout_s=timeout_s, asker=asker, **of)

    @property
    def _name(self) -> str:
        return f"{self.info.role}-{self.info.id}"

    def note(
        self, now_ns: int, kind: str, text: str, cell: int | None = None, *, target: str | None = None
    ) -> None:
        """Publishes a sentence for people who watch the run, as a `Note`.

        kind    word by which programs tell events apart
        cell    place of the event, if it has one
        target  target which the event is about, if any
        """
        info = self.info
        note = Note(
            role=info.role, id=info.id, stamp_ns=now_ns, kind=kind, text=text[:MOST_TEXT], cell=cell, target=target
        )
        self._bus.publish(NOTE, note, role=info.role, id=info.id)

    def warn(self, now_ns: int, kind: str, text: str) -> None:
        """States what went wrong in the log and to people who watch the run, and counts it as `kind`."""
        log.warning("%s: %s", kind, text)
        self.counters.count(kind)
        self.note(now_ns, kind, text)

    def note_faults(self, faults: list[str], now_ns: int) -> None:
        """States what plug-ins did wrong, and clears the list."""
        for fault in faults:
            self.warn(now_ns, "plugin_failed", fault)
        faults.clear()

    def _compare(self, other: RunInfo) -> None:
        peer = Peer(other.role, other.id, other.incarnation)
        if NO_RUN in (self.info.run_id, other.run_id) or peer == self.peer:
            return
        try:
            check_same_run(self.info, other)
        except RunMismatchError as error:
            self._differs = self._differs or error
            if peer not in self._strangers and len(self._strangers) < _MOST_STRANGERS:
                self._strangers.add(peer)
                self.counters.count("strangers")
                if self._confirmed:
                    log.warning("%s", error)
                    self._to_name.append(str(error))
        else:
            self._confirmed = True

    def _ask(self) -> None:
        self._bus.ask(RUN, Nothing(), self._post, tag=_TAG, timeout_s=2.0)


class MemberService:
    """Base of services that take part in a run: what they count and what they lack, their member says."""

    _member: Member

    @property
    def counters(self) -> Counters:
        return self._member.counters

    def lacks(self) -> list[str]:
        return self._member.lacks()


def check_belongs(mine: RunInfo, others: Iterable[RunInfo]) -> None:
    """Raises RunMismatchError, in words, where others answer and none belongs to the same run."""
    differs: RunMismatchError | None = None
    for other in others:
        if other.run_id == NO_RUN:
            continue
        try:
            check_same_run(mine, other)
            return
        except RunMismatchError as error:
            differs = differs or error
    if differs is not None:
        raise differs


def check_same_run(mine: RunInfo, other: RunInfo) -> None:
    """Raises RunMismatchError, with a sentence on the difference, if two processes must not share a namespace.

    They may if run id, terrain, sizes of shards and of cells of right of way, and vehicle classes are equal, and
    their wire versions neighbours.
    """
    who = f"{other.role} {other.id}"
    if other.run_id != mine.run_id:
        raise RunMismatchError(
            f"{mine.role} {mine.id} belongs to run {mine.run_id}, but {who} in the same namespace belongs to run "
            f"{other.run_id} (scenario {other.scenario}): choose another network.namespace or join that run"
        )
    if not are_neighbours(mine.wire_version, other.wire_version):
        raise RunMismatchError(
            f"{mine.role} {mine.id} speaks wire version {mine.wire_version}, but {who} speaks "
            f"{other.wire_version}: only neighbouring versions share a run, so upgrade by one at a time"
        )
    if other.terrain != mine.terrain:
        raise RunMismatchError(
            f"{mine.role} {mine.id} has terrain {mine.terrain} ({mine.rows} x {mine.cols}), but {who} has "
            f"{other.terrain} ({other.rows} x {other.cols}): terrain files or cost rules differ"
        )
    if other.shard_cells != mine.shard_cells:
        raise RunMismatchError(
            f"{mine.role} {mine.id} has shards of right of way of {mine.shard_cells} cells a side, but {who} has "
            f"{other.shard_cells}: map.shard_regions differs, or was set by a version that does not know it"
        )
    if other.traffic_parts != mine.traffic_parts:
        raise RunMismatchError(
            f"{mine.role} {mine.id} has {mine.traffic_parts or 1} cells of right of way across a cell of the"
            f" terrain, but {who} has {other.traffic_parts or 1}: map.traffic_cell_m differs"
        )
    if other.classes != mine.classes:
        raise RunMismatchError(
            f"{mine.role} {mine.id} has the classes of vehicles {_listed(mine.classes)}, but {who} has "
            f"{_listed(other.classes)}: marks name classes by their place in [[classes]], which differs"
        )


def _listed(classes: Sequence[str]) -> str:
    return ", ".join(classes) if classes else "none"
