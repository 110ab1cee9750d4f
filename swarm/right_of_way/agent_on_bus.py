"""Connects the core of right of way to the bus and the file: messages become calls, decisions become messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from hashlib import blake2s

from msgspec.structs import replace

from swarm.bus.bus import Appeared, Asked, AskEnded, Bus, Disappeared, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import plan_agents
from swarm.peers import Peer
from swarm.right_of_way.agent_core import Action, OwnRecord, RightOfWay
from swarm.right_of_way.holdings import CellRequest, SendState
from swarm.right_of_way.host import AskKnown
from swarm.right_of_way.promise_store import PromiseStore
from swarm.right_of_way.shard_member import SLOW_NS, AskPromises, Refused, Save
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages import Message, traffic
from swarm.wire.topics import GRANTED, HOST_STATE, KNOWN, LEFT, STORED, TABLE, WORD, Topic


class OwnTime:
    """A clock that counts at most one period between two ticks.

    A process that comes late to its ticks has not heard the others meanwhile, so it cannot say that they were
    silent; and if one process is late for lack of CPU, all are. By wall time, on a machine on which ticks
    come seconds apart, every lease had expired at each tick: leaders were replaced before they could grant, for
    ever. With punctual ticks it equals wall time. Safety does not depend on it.

    period_ns  of ticks
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ticked_ns: int | None = None
        self._own_ns = 0

    def at(self, now_ns: int) -> int:
        """The own time, ns, between this tick and the next."""
        if self._ticked_ns is None:
            return now_ns
        return self._own_ns + min(max(now_ns - self._ticked_ns, 0), self._period_ns)

    def tick(self, now_ns: int) -> int:
        """A tick begins. Returns the own time, ns."""
        self._own_ns = self.at(now_ns)
        self._ticked_ns = now_ns
        return self._own_ns


_FIRST_ANSWERS_NS = 3 * NS_PER_S // 10
"""A new generation waits this time for the others' answers before it begins. Later answers count, too."""
_LATE_ANSWERS_S = 10.0
"""Time within which answers after the first wait still count. Chosen, not measured."""
_ASK_AGAIN_NS = NS_PER_S
_ASK_RARELY_NS = 30 * NS_PER_S
"""Interval of recovery queries to agents: a second, then twice as long each time, up to this."""
_PROMISE_TIMEOUT_S = 10.0
"""A late member replies late, and its promise counts until we claim again: by epoch, so it does no harm."""
_MOST_REFUSALS = 100
"""Liars may say as many different things as they like."""
_MOST_DIGITS = 9
"""Digits of a shard's number in a key, and of a certificate's."""
_RESERVE_NS = NS_PER_S
"""Space for promises is looked for at this interval: a check costs a system call."""
_SILENT_AGAIN_NS = 60 * NS_PER_S
"""Interval of repeated events about silent agents and slow links: the log stays readable. Chosen, not measured."""
_SLOW_FOR_NS = 5 * NS_PER_S
"""A link is reported once it has been slow for this time: at a start all are, for a moment."""
_WAITING_AGAIN_NS = 30 * NS_PER_S
"""Interval of repeated events of a shard, also if it was led meanwhile, as on a busy machine. Late watchers receive
them, and the log stays readable."""


@dataclass
class RightOfWaySync:
    """Carries an agent's right of way.

    acts    whether messages are posted as they come, not kept for the next tick
    warn    called with a kind and a sentence: "refused", for what cannot be true; "waiting", for why vehicles wait;
            "slow_link", for agents that answer late; "promises", for the file of promises
    """

    core: RightOfWay
    setup: RoleSetup
    store: PromiseStore
    bus: Bus
    post: Post
    warn: Callable[[str, str], None]
    acts: bool = False
    _asked_ns: int | None = None
    """Time of the last recovery query of this generation."""
    _known_tag: str = ""
    """Tag of this generation's recovery queries: what answers an earlier one is older than the shards into which
    its successor drove."""
    _ask_due_ns: int = 0
    _ask_wait_ns: int = _ASK_AGAIN_NS
    _unasked: bool = False
    """True if an agent has appeared that has not received our recovery query."""
    _revoked: dict[str, int] = field(default_factory=dict)
    """Agent -> number of its newest revoked certificate."""
    _refused: set[str] = field(default_factory=set)
    _unled_due_ns: dict[int, int] = field(default_factory=dict)
    """Shard which had no leader -> from when on the warning is repeated."""
    _reserve_due_ns: int = 0
    _slow_due_ns: int = 0
    _warned_ns: int | None = None
    """Time of the last warning that our seats are silent; None while they are not."""

    def __post_init__(self) -> None:
        setup = self.setup
        self._id = setup.id
        seed = f"{self.store.own.disk}/{setup.incarnation}".encode()
        self._chance = int.from_bytes(blake2s(seed, digest_size=4).digest(), "little")
        self._own_time = OwnTime(int(NS_PER_S / setup.scenario.vehicles.tick_hz))
        """Time for the core. When to ask, and when to tell people, goes by the time of the wall."""
        self._names = {f"agent.{plan.group.name}.{plan.id}": plan.id for plan in plan_agents(setup.scenario)}
        """Name in its certificate -> agent."""

    def start(self, now_ns: int) -> None:
        self.bus.watch_alive(self.post, role="agent")
        self.bus.serve(KNOWN, self.post, agent=self._id)
        self.bus.serve(TABLE, self.post, agent=self._id)
        # Not one by one for each seat: every subscription has a thread of its own, and of a large map's shards few
        # agents have hundreds of seats.
        keep = partial(self.bus.subscribe, post=self.post) if self.acts else self.bus.collect
        keep(HOST_STATE, member=self._id)
        self.bus.subscribe(TABLE, self.post, member=self._id)
        self.bus.subscribe(STORED, self.post, member=self._id)
        keep(GRANTED, host=self._id)
        if self.core.shards.proven:
            keep(WORD, host=self._id)
        keep(LEFT, host=self._id)
        self._ask_known(now_ns)

    def on_cells_event(self, event: Event, now_ns: int) -> bool:
        """True if the event was about right of way."""
        core, own_ns = self.core, self._own_time.at(now_ns)
        core.silent = not self.store.ready
        match event:
            case Heard(message=traffic.Table() as table):
                self._take_standings(now_ns)  # by which it is judged
                self._perform(core.hear_table(table, own_ns))
            case Heard(message=traffic.Stored() as stored):
                self._perform(core.hear_stored(stored, own_ns))
            case Asked(topic=topic, request=traffic.Claim() as claim) if topic is TABLE:
                self._hear_claim(event, claim.epoch, own_ns)
                event.end()
            case Asked(topic=topic, request=traffic.KnownRequest() as request) if topic is KNOWN:
                self._answer(event, core.answer_known(request))
                event.end()
            case Replied(topic=topic, fields=fields, tag=tag, message=traffic.Table() as table) if topic is TABLE:
                core.hear_promise(fields["agent"], int(tag.rpartition("-")[2]), table, own_ns)
            case Replied(message=traffic.Known() as known, took_s=took_s, tag=tag):
                if known.agent in core.shards.agents:
                    core.trips.measure(known.agent, int(took_s * NS_PER_S))
                if tag == self._known_tag:
                    self._perform(core.hear_known(known))
            case Appeared(peer=Peer(role="agent") as peer):
                core.host.hear_token(peer, up=True)
                self._unasked = True
            case Disappeared(peer=Peer(role="agent") as peer):
                core.host.hear_token(peer, up=False)
            case AskEnded(topic=topic, tag=tag) if topic is KNOWN or topic is TABLE:
                if tag == self._known_tag:
                    self._begin()
            case _:
                return False
        return True

    def take_granted(self, now_ns: int) -> Iterator[list[str]]:
        """Takes in what leaders have granted, and other hosts have left, since the last time, before vehicles
        drive. Yields the vehicles that have found their places by each message; they are to be placed before the
        next."""
        for topic in (LEFT, GRANTED, WORD):
            for heard in self.bus.collected(topic):
                yield self.hear(heard.message, now_ns)

    def is_awaited(self, message: Message) -> bool:
        """Returns True if a vehicle may be waiting for this message."""
        holdings = self.core.host
        match message:
            case traffic.Left():
                return holdings.waits
            case traffic.Granted(grants=grants):
                return any(len(entries) > 1 and len(holdings.path(id)) < 2 for id, entries in grants.items())
            case traffic.Word(shard=shard):
                return holdings.is_pending(shard)
            case traffic.HostState(vehicles=stands):
                return any(stand.better for stand in stands)
        return False

    def hear(self, message: Message, now_ns: int) -> list[str]:
        """Handles a message of a host or of a shard's leader. Returns the vehicles whose places it settles."""
        match message:
            case traffic.Left():
                return self.core.host.hear_left(message)
            case traffic.Granted() | traffic.Word():
                return self.core.host.hear_granted(message, self._own_time.at(now_ns))
            case traffic.HostState():
                self.core.hear_host_state(message, self._own_time.at(now_ns))
        return []

    def tick(self, requests: Mapping[str, CellRequest], now_ns: int) -> None:
        own_ns = self._own_time.tick(now_ns)
        asked_ns = self._asked_ns
        waited = asked_ns is None or not 0 <= now_ns - asked_ns < _FIRST_ANSWERS_NS
        if waited and not self.core.settled and (self._unasked or now_ns >= self._ask_due_ns):
            self._ask_known(now_ns)
        self._check_store(now_ns)
        if waited and asked_ns is not None:
            self._begin()
        self._take_standings(now_ns)
        self._perform(self.core.tick(requests, own_ns))
        self._warn_slow(now_ns)
        for shard, text in self.core.host.unled(own_ns).items():
            if now_ns >= self._unled_due_ns.get(shard, now_ns):
                self._unled_due_ns[shard] = now_ns + _WAITING_AGAIN_NS
                self.warn("waiting", text)

    def _take_standings(self, now_ns: int) -> None:
        for heard in self.bus.collected(HOST_STATE):
            self.hear(heard.message, now_ns)

    def _warn_slow(self, now_ns: int) -> None:
        """States which agents answer so late, for some seconds on end, that vehicles wait longer for cells."""
        slow = self.core.trips.slow()
        if not slow:
            self._slow_due_ns = max(self._slow_due_ns, now_ns + _SLOW_FOR_NS)
        elif now_ns >= self._slow_due_ns:
            self._slow_due_ns = now_ns + _SILENT_AGAIN_NS
            agent = max(slow, key=slow.__getitem__)
            self.warn(
                "slow_link",
                f"agent {agent} answers slowly, after {slow[agent] / NS_PER_S:.1f} s (expected: below "
                f"{SLOW_NS / NS_PER_S:g} s){f', and {len(slow) - 1} more' * (len(slow) > 1)}: vehicles wait longer "
                "for cells, and a failed agent is replaced later",
            )

    def _check_store(self, now_ns: int) -> None:
        """Stops a member that cannot file promises, notes it, and lets it act again when there is space."""
        if now_ns >= self._reserve_due_ns:
            self._reserve_due_ns = now_ns + _RESERVE_NS
            self._take_revoked(now_ns)
            why = self.store.reserve()
            warned_ns = self._warned_ns
            if self.store.ready:
                if warned_ns is not None:
                    self._warned_ns = None
                    self.warn("promises", "promises can be written again: this agent votes on right of way again")
            elif warned_ns is None or now_ns - warned_ns >= _SILENT_AGAIN_NS:
                self._warned_ns = now_ns
                self.warn("promises", f"{why}; this agent does not vote on right of way until there is space")
        self.core.silent = not self.store.ready

    def _take_revoked(self, now_ns: int) -> None:
        """Tells members which agents' certificates were revoked since the last look."""
        revoked: dict[str, int] = {}
        for name in self.store.revoked():
            base, _, number = name.partition("~")  # a0~2 is the second certificate of a0
            agent, number = self._names.get(base), number or "1"
            if agent is not None and number.isdecimal() and len(number) <= _MOST_DIGITS:
                revoked[agent] = max(int(number), revoked.get(agent, 0))
        if revoked != self._revoked:
            self._revoked = revoked
            self.core.revoke(revoked, self._own_time.at(now_ns))

    def _ask_known(self, now_ns: int) -> None:
        """Asks all agents what they know of us, and schedules the next query: each after twice the delay, up to a
        limit."""
        shards = self.core.shards
        request = traffic.KnownRequest(
            agent=self._id, disk=self.store.own.disk, layer=shards.layer, shard_cells=shards.side
        )
        self._known_tag = self._known_tag or f"known-{now_ns}"
        self._asked_ns, self._unasked = now_ns, False
        self._ask_due_ns = now_ns + self._ask_wait_ns
        self._ask_wait_ns = min(2 * self._ask_wait_ns, _ASK_RARELY_NS)
        self.bus.ask(KNOWN, request, self.post, tag=self._known_tag, timeout_s=_LATE_ANSWERS_S)

    def _begin(self) -> None:
        """Begins a generation if there is none and the promise file can be written. Called once the other agents
        have had time to answer."""
        self.core.silent = not self.store.ready
        if self._asked_ns is not None and not self.core.host.generation and not self.core.silent:
            self._perform(self.core.begin(self._chance))

    def _hear_claim(self, asked: Asked, epoch: int, own_ns: int) -> None:
        """Answers a claim only if the asking member leads that epoch."""
        if not asked.fields["shard"].isdecimal() or len(asked.fields["shard"]) > _MOST_DIGITS:
            return
        shard, shards = int(asked.fields["shard"]), self.core.shards
        if shard in shards.all and asked.fields["member"] == shards.leader(shard, epoch):
            self._answer(asked, self.core.hear_claim(shard, epoch, own_ns))

    def _answer(self, asked: Asked, actions: Sequence[Action]) -> None:
        """Performs the actions that come first, and replies with the last."""
        for action in actions:
            match action:
                case traffic.Table():
                    member = asked.fields["member"]
                    asked.answer(replace(action, agent=self._id), shard=action.shard, member=member, agent=self._id)
                case traffic.Known():
                    asked.answer(action, agent=self._id)
                case _:
                    self._perform([action])

    def _send_to_members(self, topic: Topic, message: traffic.Table | traffic.Stored) -> None:
        """Sends a message to each other member of the shard."""
        for member in self.core.shards.members(message.shard):
            if member != self._id:
                self.bus.publish(topic, message, shard=message.shard, member=member, agent=self._id)

    def _perform(self, actions: Sequence[Action]) -> None:
        """Performs the actions of one event or tick: writes first, with one sync for all."""
        filed = [action for action in actions if isinstance(action, Save | OwnRecord)]
        for each in filed:
            if isinstance(each, Save):
                self.store.save(each.promised, each.table)
            else:
                self.store.save_own(each)
        if filed:
            self.store.sync()
        for action in actions:
            match action:
                case AskKnown():
                    self._asked_ns, self._unasked, self._known_tag = None, True, ""  # at the next tick
                case SendState(members, state):
                    for member in members:
                        self.bus.publish(HOST_STATE, state, shard=state.shard, member=member, agent=self._id)
                case traffic.Left():
                    self.bus.publish(LEFT, action, host=action.host, agent=self._id)
                case traffic.Granted():
                    self.bus.publish(GRANTED, action, shard=action.shard, host=action.host, agent=self._id)
                case traffic.Word():
                    self.bus.publish(WORD, action, shard=action.shard, host=action.host, agent=self._id)
                case traffic.Table():
                    self._send_to_members(TABLE, action)
                case traffic.Stored():
                    self._send_to_members(STORED, action)
                case AskPromises(shard, epoch, members):
                    for member in members:
                        tag = f"promise-{shard}-{epoch}"
                        claim = traffic.Claim(epoch=epoch)
                        seats: dict[str, str | int] = {"shard": shard, "member": self._id, "agent": member}
                        self.bus.ask(TABLE, claim, self.post, tag=tag, timeout_s=_PROMISE_TIMEOUT_S, **seats)
                case Refused(text):
                    if text not in self._refused and len(self._refused) < _MOST_REFUSALS:
                        self._refused.add(text)
                        self.warn("refused", text)
