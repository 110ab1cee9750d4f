"""A member of a shard: it promises, stores tables, and becomes the shard's leader when the last one is silent.

The rules are those of a Paxos acceptor (Lamport, 1998) with the whole table as the value. Promises and tables must
be on file before any message states them. Clocks decide only when a member tries to become leader.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import InitVar, dataclass, field

from swarm.clock import NS_PER_S
from swarm.right_of_way.generations import FURTHEST_EPOCH, HEARTBEAT_NS, keep_last
from swarm.right_of_way.holdings import TABLES_KEPT
from swarm.right_of_way.shard_leader import Leader
from swarm.right_of_way.shard_witness import Witness, agreed
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Granted, HostState, Stamp, Stored, Table, Word

LEASE_NS = 3 * HEARTBEAT_NS
"""A leader that is silent for this time may be replaced, later if answers take long. Until then its members refuse
every claim (docs/design/right-of-way.md)."""
_RANK_NS = NS_PER_S // 5
"""Time between the claims of two members on a fast link. Chosen, not measured."""
_START_NS = 3 * NS_PER_S // 10
"""Time on a fast link before a member claims a shard that was led before: its leader may still speak. Chosen, not
measured."""
_WANTED_NS = NS_PER_S
"""Time without a host's message after which no leader is needed."""
_TICK_NS = NS_PER_S // 10
"""Tick of an agent at the usual `vehicles.tick_hz`."""
_UNKNOWN_NS = NS_PER_S
"""Assumed before the first answer: a claim that comes too late costs once, one that comes too early each time."""
_LONGEST_NS = 4 * NS_PER_S
"""A process that was stopped answers late: then this counts, until later answers have outweighed it."""
SLOW_NS = 3 * NS_PER_S // 10
"""Above this round trip a link is reported as slow: an election then takes longer than on a fast link."""
_ASKED_KEPT = 16
"""Tables and claims of which it is kept when they were sent."""
_BASES_KEPT = 8
"""Tables on file from which changes can be sent: on links so slow that members are further behind, tables come
whole."""


@dataclass(frozen=True, slots=True)
class Save:
    """Write this to the file before the next messages are sent."""

    promised: int
    table: Table


@dataclass(frozen=True, slots=True)
class AskPromises:
    """Ask the other members of a shard to promise this epoch."""

    shard: int
    epoch: int
    members: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Refused:
    """A message states what cannot be true."""

    text: str


MemberAction = Save | AskPromises | Refused | Table | Stored | Granted | Word


class RoundTrips:
    """Bounds on the time until another agent's answer comes: the smoothed round trip and four times its deviation
    (Jacobson, 1988)."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[int, int]] = {}
        """Agent -> (smoothed round trip, deviation), ns."""

    def measure(self, agent: str, trip_ns: int) -> None:
        """An agent has answered after this time."""
        trip_ns = min(max(trip_ns, 0), _LONGEST_NS)
        mean, deviation = self._known.get(agent, (trip_ns, trip_ns // 4))
        error = trip_ns - mean
        self._known[agent] = mean + error // 8, deviation + (abs(error) - deviation) // 4

    def bound_ns(self, agents: Collection[str]) -> int:
        """Returns the time within which all of these agents answer, as far as is known."""
        bounds = (self._known.get(agent, (_UNKNOWN_NS, 0)) for agent in agents)
        return max((min(mean + 4 * deviation, _LONGEST_NS) for mean, deviation in bounds), default=0)

    def slow(self) -> dict[str, int]:
        """Returns the agents which answer slowly -> the round trip, ns."""
        return {agent: mean for agent, (mean, _) in self._known.items() if mean > SLOW_NS}


@dataclass
class Member:
    """One agent's seat among the members of one shard.

    promised  no table of a lower epoch is stored any more
    stored    the newest table on file; the table of the run's start until there is another
    leader    the leader itself, while this member is in charge

    fleets    agent -> its vehicles, all of the run
    trips     round trips to other agents, shared by all seats of this one
    tick_ns   between two ticks
    """

    _shards: Shards
    _me: str
    promised: int
    stored: Table
    _fleets: Mapping[str, Collection[str]]
    now_ns: InitVar[int]
    _trips: RoundTrips = field(default_factory=RoundTrips)
    _tick_ns: int = _TICK_NS

    def __post_init__(self, now_ns: int) -> None:
        shards, me = self._shards, self._me
        self.shard = self.stored.shard
        self._asked: dict[Stamp, int] = {}
        """Stamp of a table that was sent once -> when; of a claim the sequence is 0."""
        self.leader: Leader | None = None
        self._members = shards.members(self.shard)
        self._witness = Witness(me, shards, self._fleets) if shards.proven else None
        self._others = tuple(member for member in self._members if member != me)
        self._revoked: dict[str, int] = {}
        """Agent -> number of its newest revoked certificate."""
        self._rank = self._members.index(me)
        self._claimed = 0
        self._promises: dict[str, Table] = {}
        self._claim_above = 0
        self._leader = ""
        self._led_until_ns = now_ns  # the leader that we know of is in charge at least this time
        self._due_ns = now_ns
        self._wanted_ns = now_ns - _WANTED_NS - 1
        self._acked_ns = dict.fromkeys(self._others, now_ns)
        """Other member -> when it acknowledged our claim or table last."""
        self._published: list[Table] = []
        """Tables published as leader, the oldest first, from the newest one that is on file on."""
        self._confirmed = self._other_confirmed = (0, 0)
        """Stamps of the newest tables that we, and the third member, confirmed as stored."""
        self._confirmed_ns = now_ns
        self._has: dict[str, tuple[Stamp, int]] = {}
        """Other member -> the table that it confirmed last, and when."""
        self._bases = {self.stored.stamp: self.stored}
        """Stamp -> table, of those that were stored last."""

    # --- timeouts -------------------------------------------------------------------------------------------

    def _distrusts(self, table: Table) -> list[str]:
        """Returns the agent with a revoked name, if a table was not agreed without it. At most one lies at a time:
        of several the others have new certificates, and state what is on their files."""
        without = table.without
        names = [id for id, number in self._revoked.items() if number > without.get(id, 0) and id != self._me]
        return names[:0] if self._witness is None else names[-self._shards.liars :]

    @property
    def _trusted(self) -> set[str]:
        return {*self._others}.difference(self._distrusts(self.stored))

    @property
    def _lease_ns(self) -> int:
        """A leader speaks once a heartbeat; the table of a new one comes a round trip after our promise. A table
        that is lost is sent again after another."""
        return max(LEASE_NS, HEARTBEAT_NS + 2 * (self._trips.bound_ns(self._trusted) + self._tick_ns))

    def _turn_ns(self) -> int:
        """Returns the delay of this member's claim, by rank: the claim of a lower rank arrives before it is due."""
        return self._rank * max(_RANK_NS, self._trips.bound_ns(self._trusted) + self._tick_ns)

    def _ask(self, stamp: Stamp, now_ns: int) -> None:
        """Notes when a claim or a table is sent first. One that is repeated measures nothing: its answer does not
        tell which of the two it answers (Karn and Partridge, 1987)."""
        if stamp in self._asked:
            self._asked[stamp] = -1
            return
        keep_last(self._asked, stamp, now_ns, _ASKED_KEPT)

    def _answered(self, member: str, stamp: Stamp, now_ns: int) -> None:
        asked_ns = self._asked.get(stamp, -1)
        if asked_ns >= 0:
            self._trips.measure(member, now_ns - asked_ns)

    def _is_wanted(self, now_ns: int) -> bool:
        """Returns True if a leader is needed: a host has spoken lately, or members have to agree again, before
        another name is revoked."""
        return now_ns - self._wanted_ns <= _WANTED_NS or bool(self._distrusts(self.stored))

    def revoke(self, names: Mapping[str, int], now_ns: int) -> None:
        """Certificates of these agents up to a number are revoked: by what they said as a member or a host, others
        may have different tables on file."""
        self._revoked.update(names)
        if not self._distrusts(self.stored):
            return
        self.leader = None  # all begin again with what they have
        self._led_until_ns, self._due_ns = now_ns, now_ns + self._turn_ns()

    # --- what hosts say -------------------------------------------------------------------------------------

    def hear_host_state(self, state: HostState, now_ns: int) -> None:
        if now_ns - self._wanted_ns > _WANTED_NS:
            # A new shard cannot have another leader; and hosts receive no more from the previous one.
            led = self.promised and now_ns >= self._led_until_ns + self._lease_ns
            start_ns = max(_START_NS, self._trips.bound_ns(self._trusted) + self._tick_ns)
            self._due_ns = max(self._due_ns, now_ns + (start_ns if led else 0) + self._turn_ns())
            self._acked_ns = dict.fromkeys(self._others, now_ns)
        self._wanted_ns = now_ns
        if self._witness is not None:
            self._witness.hear_host_state(state, now_ns)
        if self.leader is not None:
            self.leader.take_host_state(state, now_ns)

    # --- what members say -----------------------------------------------------------------------------------

    @property
    def on_file(self) -> Stored:
        return Stored(shard=self.shard, agent=self._me, epoch=self.stored.epoch, seq=self.stored.seq)

    def hear_table(self, table: Table, now_ns: int) -> list[MemberAction]:
        if table.agent == self._me or table.agent != self._shards.leader(self.shard, table.epoch):
            return []
        if table.epoch < self.promised:
            # A claim of ours or of another came to nothing: let the leader claim again, so that we can follow it.
            return [Stored(shard=self.shard, agent=self._me, epoch=self.promised, seq=0)]
        if table.epoch > self.promised + FURTHEST_EPOCH:
            return [Refused(f"{table.agent} names an epoch that is implausibly far ahead: {table.epoch}")]
        if self.leader is not None and table.epoch > self.leader.epoch:
            self.leader = None
        self._led(now_ns, table.agent)
        actions: list[MemberAction] = []
        if table.stamp > self.stored.stamp:
            if (whole := table.whole(self._bases)) is None:
                return [self.on_file]  # by which the leader knows what we lack
            table = whole
            if not self._accepts(table):
                return self._words(now_ns)
            self.promised = table.epoch
            self._store(table)
            actions.append(Save(self.promised, self.stored))
            actions += self._words(now_ns)
        if table.stamp == self.stored.stamp:
            # A repeated table is acknowledged again.
            self._confirmed = min(self._confirmed, (table.epoch, table.seq - 1))
            if self._shards.leader(self.shard, table.epoch + 1) == self._me:
                actions.append(self._confirm(now_ns))
        return actions

    def _store(self, table: Table) -> None:
        self.stored = table
        keep_last(self._bases, table.stamp, table, _BASES_KEPT)

    def _confirm(self, now_ns: int) -> Stored:
        self._confirmed, self._confirmed_ns = self.stored.stamp, now_ns
        return self.on_file

    def _accepts(self, table: Table) -> bool:
        """Returns True if a leader's table may replace ours. At most one lies: once it is known, others are
        trusted, but for what a host has said to us itself."""
        before, without = self.stored.without, table.without
        if self._witness is None:
            return True
        if any(without.get(name, 0) < number for name, number in before.items()):
            return False
        new = [name for name, number in without.items() if number > before.get(name, 0)]
        if not new:
            return self._witness.accepts(self.stored, table)
        known = all(without[name] <= self._revoked.get(name, 0) for name in new)
        distrusted = self._distrusts(self.stored)
        return known and table.agent not in distrusted and not self._witness.contradicts(table, distrusted)

    def _words(self, now_ns: int) -> list[MemberAction]:
        """Returns our words to hosts, where these need more than the leader's."""
        return [] if self._witness is None else [*self._witness.words(self.stored, now_ns)]

    def _confirm_late(self, now_ns: int) -> list[MemberAction]:
        """Returns the reply of the member that is second after the leader about its file. With the leader the first
        one makes a majority, so the second says only what the first does not, and, as others may not hear the
        first, speaks at least once in a heartbeat."""
        stamp = self.stored.stamp
        if self.leader is not None or self._confirmed >= stamp:
            return []
        if self._other_confirmed >= stamp and now_ns - self._confirmed_ns < HEARTBEAT_NS:
            return []
        return [self._confirm(now_ns)]

    def hear_claim(self, epoch: int, now_ns: int) -> list[MemberAction]:
        """Promise, or say nothing. The last action is the table to answer with."""
        claimant = self._shards.leader(self.shard, epoch)
        led = now_ns < self._led_until_ns and claimant != self._leader
        if epoch <= self.promised or (self.leader is not None and self._is_wanted(now_ns)) or led:
            return []
        if epoch > self.promised + FURTHEST_EPOCH:
            return [Refused(f"a claim names an epoch that is implausibly far ahead: {epoch}")]
        self._promise(epoch)
        self._led(now_ns, claimant)  # time for the claimant to begin
        return [Save(self.promised, self.stored), self.stored]

    def hear_promise(self, member: str, epoch: int, table: Table, now_ns: int) -> None:
        if member not in self._others or table.since is not None:
            return
        self._answered(member, (epoch, 0), now_ns)
        if epoch == self._claimed and epoch == self.promised:
            self._promises[member] = table
            self._take_charge(now_ns)

    def hear_stored(self, stored: Stored, now_ns: int) -> list[MemberAction]:
        """Takes acknowledgements as leader, and grants by the tables that are on file now."""
        if stored.agent not in self._others:
            return []
        self._has[stored.agent] = (stored.epoch, stored.seq), now_ns
        self._other_confirmed = max(self._other_confirmed, (stored.epoch, stored.seq))
        if self.leader is None:
            return []
        if stored.epoch == self.leader.epoch:
            self._acked_ns[stored.agent] = now_ns
            if stored.seq and stored.agent == self._shards.leader(self.shard, stored.epoch + 1):  # replies at once
                self._answered(stored.agent, (stored.epoch, stored.seq), now_ns)
            return [] if self._witness is not None else self._on_file(self.leader, stored.seq, now_ns)
        if self.promised < stored.epoch <= self.promised + FURTHEST_EPOCH:
            self._claim_above = stored.epoch
        return []

    def _on_file(self, leader: Leader, seq: int, now_ns: int) -> list[MemberAction]:
        """Another member has stored the table of this number, or a later one: with ours that is a majority."""
        while len(self._published) > 1 and self._published[1].seq <= seq:
            del self._published[0]
        if not self._published or self._published[0].seq > seq:
            return []
        return [*leader.granted(self._published[0], now_ns)]

    # --- being leader ---------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[MemberAction]:
        wanted = self._is_wanted(now_ns)
        if wanted and self.leader is not None and self._claim_above <= self.leader.epoch:
            return self._lead(self.leader, now_ns)
        if not wanted or (self.leader is None and now_ns < self._due_ns):
            return [*self._confirm_late(now_ns), *self._words(now_ns)]
        return self._claim(now_ns)

    def _claim(self, now_ns: int) -> list[MemberAction]:
        members = len(self._members)
        self._promise((max(self.promised, self._claim_above) // members + 1) * members + self._rank)
        self._claimed = self.promised
        self._promises = {self._me: self.stored}
        self._due_ns = now_ns + self._lease_ns + self._turn_ns()
        self._ask((self._claimed, 0), now_ns)
        actions: list[MemberAction] = [Save(self.promised, self.stored)]
        if self._others:
            actions.append(AskPromises(self.shard, self._claimed, self._others))
        self._take_charge(now_ns)
        return actions

    def _lead(self, leader: Leader, now_ns: int) -> list[MemberAction]:
        acked_ns = sorted(self._acked_ns.values(), reverse=True)[: self._shards.majority - 1]
        if acked_ns and now_ns - acked_ns[-1] > self._lease_ns:
            self.leader = None  # no messages arrive in one direction: leave it to the others
            self._led(now_ns, self._me)
            return []
        actions: list[MemberAction] = [Refused(text) for text in leader.refused]
        leader.refused.clear()
        table = leader.tick(now_ns)
        if table is not None:
            self._ask(table.stamp, now_ns)
            if table is not self.stored:
                self._store(table)
                self._published = [*self._published[-TABLES_KEPT:], table]
                actions.append(Save(self.promised, table))
            base = self._base(now_ns)
            actions.append(table if base is None or base.epoch != table.epoch else table.changes(base))
            if self._witness is not None:
                actions += leader.granted(table, now_ns)  # the hosts count the members' words
            elif self._shards.majority == 1:
                actions += self._on_file(leader, table.seq, now_ns)
        return actions

    def _base(self, now_ns: int) -> Table | None:
        """Returns the newest table which all members that have spoken lately have on file, if we know it: they need
        no more than changes since that."""
        has = [stamp for stamp, said_ns in self._has.values() if now_ns - said_ns < 2 * HEARTBEAT_NS]
        return self._bases.get(min(has)) if has else None

    def _take_charge(self, now_ns: int) -> None:
        distrusted = self._distrusts(self.stored)
        promises = [table for member, table in self._promises.items() if member not in distrusted]
        if self.leader is not None or len(promises) < self._shards.majority:
            return
        known = sorted(promises, key=lambda table: table.stamp, reverse=True)
        found: Table | None = known[0]
        if distrusted:
            # If none has a later table than one that was agreed, others go on from that, and some have it on file.
            found = agreed(promises) if self._distrusts(known[0]) else known[0]
        elif self._witness is not None:
            # A table that a thief told one member comes last, but a host that lies must not rule out all. If none
            # is accepted, hosts are asked for what the first lacks.
            known.sort(key=self._witness.contradicts)
            found = next(filter(self._accepts, [*known, known[0]]), None)
        if found is not None:
            self.leader = Leader(
                self._shards, self._me, self._claimed, found, self._fleets, self._revoked if distrusted else None
            )
            self._published = []
            self._acked_ns = dict.fromkeys(self._others, now_ns)
            # Once in an epoch: a promise that is repeated after the leader has resigned must not restart it.
            self._claimed, self._promises = 0, {}

    def _promise(self, epoch: int) -> None:
        self.promised = epoch
        self._promises = {}
        self.leader = None

    def _led(self, now_ns: int, leader: str) -> None:
        self._leader = leader
        self._led_until_ns = now_ns + self._lease_ns
        self._due_ns = self._led_until_ns + self._turn_ns()
