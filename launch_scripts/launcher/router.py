"""The router: a Zenoh session in router mode that passes on all messages.

Zenoh reads access control when a session opens, and closes no single link. When a name is revoked, the router
therefore reopens its session: all links end, and every admitted process is back within half a second, as after a
restart.
"""

from __future__ import annotations

import logging
import resource
import time
from collections.abc import Callable

import msgspec

from launch_scripts.launcher.router_door import HANDSHAKE_S, Door
from launch_scripts.ports import free_ports
from launch_scripts.process_table import admitting_all
from launch_scripts.web import LOOPBACK
from swarm.bus.bus import Bus, Event, Post
from swarm.bus.endpoints import host_port
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.clock import MonotonicClock
from swarm.config.revocations import with_revocations
from swarm.config.scenario import NetworkConfig
from swarm.errors import BusError, SwarmError
from swarm.peers import Peer
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import NO_RUN, Member, MemberService
from swarm.runtime.process import Process
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.run_secret import authenticator_of
from swarm.wire.messages import WIRE_VERSION
from swarm.wire.messages.processes import RunInfo

log = logging.getLogger(__name__)

_OPEN_WITHIN_S = 5.0
"""Ten times what it takes: links end and are back within half a second (docs/operate/access.md). A port that is
taken for longer belongs to another program."""


class RouterService(MemberService):
    """Belongs to no run, so it may be stopped, started again and replaced while runs go on around it.

    reopened  asked at each tick: the bus in place of the one before, which is closed; None: it stays
    restarts  how often its launcher started it again
    """

    def __init__(
        self,
        peer: Peer,
        bus: Bus,
        post: Post,
        reopened: Callable[[], Bus | None] = lambda: None,
        *,
        restarts: int = 0,
    ) -> None:
        info = RunInfo(
            run_id=NO_RUN, role=peer.role, id=peer.id, incarnation=peer.incarnation, scenario="", terrain="",
            rows=0, cols=0, resolution_m=0.0, started_ns=peer.incarnation, restarts=restarts,
            wire_version=WIRE_VERSION,
        )  # fmt: skip
        self._member = Member(info, bus, post)
        self._reopened = reopened

    def start(self, now_ns: int) -> None:
        self._member.join()

    def handle(self, event: Event, now_ns: int) -> None:
        self._member.on_member_event(event)

    def tick(self, now_ns: int) -> None:
        if (bus := self._reopened()) is not None:
            self._member.move_to(bus)
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._member.publish_stats(now_ns)


class Admission:
    """The router's session, behind a door at its `tls/` endpoints, and reopened whenever the list of revoked names
    changes. Raises BusError if it cannot listen."""

    def __init__(self, network: NetworkConfig) -> None:
        self._authenticator = authenticator_of(network, "")  # a router belongs to no run
        self._network, self._door = network, None
        if outside := [endpoint for endpoint in network.listen if endpoint.startswith("tls/")]:
            inner = LOOPBACK, free_ports(1)[0]
            self._door = Door([host_port(each) for each in outside], inner)
            within = f"tls/{inner[0]}:{inner[1]}#tls_handshake_timeout_ms={HANDSHAKE_S * 1000:.0f}"
            others = tuple(each for each in network.listen if each not in outside)
            self._network = msgspec.structs.replace(network, listen=(*others, within))
        self._admitting = with_revocations(self._network)
        self._failure = ""
        """Reason why the file of revoked names could not be read at the last look."""
        self.bus = self._opened(within_s=0.0)

    def close(self) -> None:
        """Leaves the network."""
        if self._door is not None:
            self._door.close()
        self.bus.close()

    def reopened(self) -> ZenohBus | None:
        """The new session, if one was opened. If the list cannot be read, the previous one stays in force."""
        try:
            admitting = with_revocations(self._network)
        except SwarmError as error:
            if str(error) != self._failure:
                log.error("%s; the names that were revoked before stay so", error)
            self._failure = str(error)
            return None
        self._failure = ""
        if admitting == self._admitting:
            return None
        log.warning("revoked names: %s; reopening the session", ", ".join(admitting.revoked) or "none")
        self._admitting = admitting
        self.bus.close()
        self.bus = self._opened(_OPEN_WITHIN_S)
        return self.bus

    def _opened(self, within_s: float) -> ZenohBus:
        until_s = time.monotonic() + within_s
        while True:
            try:
                return open_bus(self._admitting, mode="router", authenticator=self._authenticator)
            except BusError:  # the port is free only once the last link has ended
                if time.monotonic() > until_s:
                    raise
                time.sleep(0.05)


def run(setup: RoleSetup, built: Callable[[], None]) -> None:
    clock, inbox = MonotonicClock(), Inbox()
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # each connection, silent ones included, is a file
    admission = Admission(admitting_all(setup.scenario).network)
    try:
        peer = Peer(setup.role, setup.id, setup.incarnation)
        service = RouterService(peer, admission.bus, inbox.post, admission.reopened, restarts=setup.restarts)
        process = Process(service, inbox, clock, tick_hz=2.0, health=setup.health)
        process.stop_on_signals()
        built()
        process.run()
    finally:
        admission.close()
