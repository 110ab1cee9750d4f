"""A process's part in who leads, on the bus: it tells how it is, and hears the other candidates."""

from __future__ import annotations

import logging

from swarm.bus.bus import Bus, Event, Heard, Post
from swarm.clock import NS_PER_S
from swarm.liveness import job_of, ranked_id
from swarm.runtime.leadership import BEAT_NS, Leadership
from swarm.runtime.membership import Member
from swarm.runtime.role import RoleSetup
from swarm.wire.messages.processes import Beat
from swarm.wire.topics import LEAD

log = logging.getLogger(__name__)


class Candidacy:
    """Beats for one process, and `Leadership` fed with those of the others of its job.

    standbys  how many others there are by the scenario; with none it leads and says nothing
    """

    def __init__(self, setup: RoleSetup, standbys: int, tick_hz: float, bus: Bus, post: Post) -> None:
        self._setup = setup
        self._standbys = standbys
        self._bus = bus
        self._post = post
        self._core = Leadership(setup.id, setup.incarnation, alone=standbys == 0, period_ns=int(NS_PER_S / tick_hz))
        self._due_ns = 0
        """When the next beat is to be told; at a change of who leads it is told at once."""

    @property
    def leads(self) -> bool:
        return self._core.leads

    def start(self) -> None:
        """Listen to all candidates of this job, other lives of this id among them."""
        for rank in range(self._standbys + 1 if self._standbys else 0):
            id = ranked_id(job_of(self._setup.id), rank)
            self._bus.subscribe(LEAD, self._post, role=self._setup.role, id=id)

    def handle(self, event: Event, now_ns: int) -> bool:
        """Whether the event was a beat, and is done with."""
        if isinstance(event, Heard) and isinstance(event.message, Beat):
            self._core.hear(event.message, now_ns)
            return True
        return False

    def tick(self, ready: bool, now_ns: int) -> bool:
        """Whether this process leads from now on."""
        before = self._core.leads
        leads = self._core.tick(ready, now_ns)
        if self._standbys and (leads != before or now_ns >= self._due_ns):
            self._due_ns = now_ns + BEAT_NS - BEAT_NS // 10  # ticks of the same period come a little early or late
            self._beat(ready, leads)
        return leads

    def tell(self, member: Member, now_ns: int) -> None:
        """Say to people that another leads from now on. Without standbys there is nothing to say."""
        if not self._standbys:
            return
        text = "leads from now on" if self.leads else "stands by from now on"
        log.info("%s", text)
        member.note(now_ns, "leader", text)

    def stop(self) -> None:
        """Let another take over at once."""
        if self._standbys:
            self._beat(False, False)

    def _beat(self, ready: bool, leads: bool) -> None:
        setup = self._setup
        beat = Beat(role=setup.role, id=setup.id, incarnation=setup.incarnation, ready=ready, leads=leads)
        self._bus.publish(LEAD, beat, role=setup.role, id=setup.id)
