"""Election of a leader among the processes with one job: by rank, heartbeats and a lease.

Leader election as in Garcia-Molina's bully algorithm, without its messages: ranks are fixed, and each candidate
regularly publishes whether it is ready and whether it leads. `Leadership` decides and is pure; `Candidacy` is its
side on the bus.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from swarm.bus.bus import Bus, Event, Heard, Post
from swarm.clock import NS_PER_S
from swarm.peers import FOR_GOOD_NS, Newest, job_of, ranked_id, split_rank
from swarm.runtime.membership import Member
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.processes import Heartbeat
from swarm.wire.topics import LEAD

HEARTBEAT_NS = NS_PER_S // 10
"""Time between two heartbeats of a candidate: one message of some 50 bytes, ten times a second
(docs/design/leader-and-standby.md)."""
LEASE_NS = 6 * HEARTBEAT_NS
"""A leader that has been silent for this time is replaced."""
SETTLED_NS = 2 * NS_PER_S
"""A better process takes over from a ready leader once it has been alive and ready for this time. A process that
was just started has the whole map by then, and one that keeps stalling never comes so far."""
_MOST_OTHERS = 64
"""Incarnations of other candidates that are remembered."""

_Order = tuple[bool, int, int]
"""(not ready, rank, -incarnation): the lowest is best, so of one rank the younger incarnation."""


@dataclass(slots=True)
class _Other:
    """The last heartbeat of another candidate, and when it was heard."""

    order: _Order
    leads: bool
    heard_ns: int


class Leadership:
    """One candidate's view of who leads.

    - A leader stops when it receives heartbeats of a better-ranked leader. Better is: ready, then of lower rank,
      then the younger incarnation.
    - A candidate that receives no leader's heartbeat for one lease takes over, unless a better-ranked candidate is
      alive, which does so itself.
    - A candidate that is better than the leader takes over once it has been so for `SETTLED_NS`, or for a lease if
      the leader is not ready.
    - A leader that stalls for a lease stops if another was ready to replace it.
    - A heartbeat counts once, and from `SETTLED_NS` after the first of its sender only if it names this candidate
      as heard. Copies, which are repeated with their codes, therefore hold no candidate back, and one that starts
      later only for that time.

    All periods are measured on a clock that counts at most half a lease between two ticks. While this process
    stalls, heartbeats of others wait unread, and no process is considered dead because of that.

    alone      there is no other candidate: this one leads, always
    period_ns  time between two ticks
    """

    def __init__(self, id: str, incarnation: int, *, alone: bool, period_ns: int) -> None:
        self.leads = alone
        """True if this process leads. Changed by `tick` only."""
        self.lease_ns = max(LEASE_NS, 4 * period_ns)
        self._alone = alone
        self._rank = split_rank(id)[1]
        self._incarnation = incarnation
        self._awake_ns = 0
        """The clock, at the last tick."""
        self._ticked_ns: int | None = None
        """Time when that was, on the caller's clock."""
        self._led_ns = 0
        """Time when a leader was last heard; at first, when this began to listen."""
        self._better_since_ns: int | None = None
        """Time since when this candidate has been better than the leader; None if it is not."""
        self._others: dict[tuple[int, int], _Other] = {}
        """(rank, incarnation) -> its last heartbeat. Forgotten after a lease."""
        self._newest = Newest(silence_ns=FOR_GOOD_NS)
        self.heard: dict[int, int] = {}
        """Incarnation of another candidate -> when its first heartbeat came; those of the last 64 that were heard.
        Our heartbeats name them."""

    def on_heartbeat(self, heartbeat: Heartbeat, now_ns: int) -> None:
        """Takes the heartbeat of another candidate."""
        rank = split_rank(heartbeat.id)[1]
        key = (rank, heartbeat.incarnation)
        if key == (self._rank, self._incarnation):
            return
        first_ns = self.heard.pop(heartbeat.incarnation, self._awake_ns)
        self.heard[heartbeat.incarnation] = first_ns
        if len(self.heard) > _MOST_OTHERS:
            del self.heard[next(iter(self.heard))]
        if self._incarnation not in heartbeat.heard and self._awake_ns - first_ns > SETTLED_NS:
            return
        if key not in self._others and len(self._others) >= _MOST_OTHERS:
            return
        if not self._newest.is_news(key, (0, heartbeat.seq), now_ns):
            return
        heard_ns = self._awake_ns + self._counted(now_ns)
        before = self._others.get(key)
        self._others[key] = _Other(_order(heartbeat.ready, rank, heartbeat.incarnation), heartbeat.leads, heard_ns)
        if heartbeat.leads:
            self._led_ns = heard_ns
        elif before is not None and before.leads:
            self._led_ns = heard_ns - self.lease_ns  # it has stopped: there is nothing to wait for

    def tick(self, ready: bool, now_ns: int) -> bool:
        """Decides whether this process leads from now on. `ready`: whether it can do its job."""
        if self._alone:
            return True
        stalled = self._ticked_ns is not None and now_ns - self._ticked_ns >= self.lease_ns
        if stalled:
            self._better_since_ns = None
            if any(not other.order[0] for other in self._others.values()):
                self.leads = False
        self._awake_ns += self._counted(now_ns)
        self._ticked_ns = now_ns
        earliest_ns = self._awake_ns - self.lease_ns
        self._others = {key: other for key, other in self._others.items() if other.heard_ns > earliest_ns}
        order = _order(ready, self._rank, self._incarnation)
        leader = min((other.order for other in self._others.values() if other.leads), default=None)
        self.leads = self._still(order, leader) if self.leads else self._begins(order, leader)
        if self.leads:
            self._led_ns = self._awake_ns
        return self.leads

    def _still(self, order: _Order, leader: _Order | None) -> bool:
        self._better_since_ns = None
        return leader is None or order < leader

    def _begins(self, order: _Order, leader: _Order | None) -> bool:
        if leader is None:
            self._better_since_ns = None
            silent_ns = self._awake_ns - self._led_ns
            better = any(other.order < order for other in self._others.values())
            return silent_ns >= self.lease_ns and not better
        if leader < order:
            self._better_since_ns = None
            return False
        if self._better_since_ns is None:
            self._better_since_ns = self._awake_ns
        return self._awake_ns - self._better_since_ns >= (self.lease_ns if leader[0] else SETTLED_NS)

    def _counted(self, now_ns: int) -> int:
        """Returns the time since the last tick, as it counts."""
        if self._ticked_ns is None:
            return 0
        return min(max(now_ns - self._ticked_ns, 0), self.lease_ns // 2)


def _order(ready: bool, rank: int, incarnation: int) -> _Order:
    return (not ready, rank, -incarnation)


log = logging.getLogger(__name__)


class Candidacy:
    """Heartbeats for one process, and `Leadership` fed with those of the others of its job.

    standbys  number of standbys in the scenario; if 0, this process leads without heartbeats
    """

    def __init__(self, setup: RoleSetup, standbys: int, tick_hz: float, bus: Bus, post: Post) -> None:
        self._setup = setup
        self._standbys = standbys
        self._bus = bus
        self._post = post
        self._core = Leadership(setup.id, setup.incarnation, alone=standbys == 0, period_ns=int(NS_PER_S / tick_hz))
        self._due_ns = 0
        """Time of the next heartbeat; a change of the leader is published immediately."""
        self._seq = 0

    @property
    def leads(self) -> bool:
        return self._core.leads

    def start(self) -> None:
        """Subscribes to all candidates of this job, other incarnations of this id among them."""
        for rank in range(self._standbys + 1 if self._standbys else 0):
            id = ranked_id(job_of(self._setup.id), rank)
            self._bus.subscribe(LEAD, self._post, role=self._setup.role, id=id)

    def on_election_event(self, event: Event, now_ns: int) -> bool:
        """Returns True if the event was a heartbeat, which needs no other handler."""
        if isinstance(event, Heard) and isinstance(event.message, Heartbeat):
            self._core.on_heartbeat(event.message, now_ns)
            return True
        return False

    def tick(self, ready: bool, now_ns: int) -> bool:
        """Returns True if this process leads from now on."""
        before = self._core.leads
        leads = self._core.tick(ready, now_ns)
        if self._standbys and (leads != before or now_ns >= self._due_ns):
            # Ticks of the same period come a little early or late.
            self._due_ns = now_ns + HEARTBEAT_NS - HEARTBEAT_NS // 10
            self._heartbeat(ready, leads)
        return leads

    def note_lead(self, member: Member, now_ns: int) -> None:
        """Notes for people whether this process leads from now on. Without standbys there is nothing to note."""
        if not self._standbys:
            return
        text = "leads from now on" if self.leads else "is a standby from now on"
        log.info("%s", text)
        member.note(now_ns, "leader", text)

    def stop(self) -> None:
        """Makes another take over immediately."""
        if self._standbys:
            self._heartbeat(False, False)

    def _heartbeat(self, ready: bool, leads: bool) -> None:
        setup = self._setup
        self._seq += 1
        heartbeat = Heartbeat(
            role=setup.role, id=setup.id, incarnation=setup.incarnation, ready=ready, leads=leads, seq=self._seq,
            heard=list(self._core.heard),
        )  # fmt: skip
        self._bus.publish(LEAD, heartbeat, role=setup.role, id=setup.id)
