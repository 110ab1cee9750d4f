"""One host of vehicles in right of way: its generations (docs/design/right-of-way.md, Generations)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.peers import Peer, Roster
from swarm.right_of_way.generations import first_generation, is_far_ahead
from swarm.right_of_way.holdings import Holdings
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Known

GENERATIONS_KEPT = 32
"""Numbers of generations on file, as many as a `HostState` has room for."""
_ALONE_NS = NS_PER_S // 2
"""A replaced generation begins again once no other process of its host has been alive for this time."""
_UNLED_NS = 2 * NS_PER_S
"""A shard that is silent for this time has no leader; another one takes over within a second where it can."""


@dataclass(frozen=True, slots=True)
class AskKnown:
    """Ask all agents what they have on file about this host, then begin a generation."""


class Host(Holdings):
    """A host's part in right of way: which of its generations this is, and the cells that its vehicles hold, none
    before `begin`. Whether it is also a member of shards is nothing to it."""

    def __init__(self, shards: Shards, name: str, vehicles: Collection[str] | None) -> None:
        super().__init__(shards, name, vehicles)
        self._known_generation = 0
        self._informants: set[str] = set()
        """Agents that have sent us their knowledge of us."""
        self._twins = Roster()
        """Other processes of this host, as a second start of it: of these one generation counts."""
        self._alone_since_ns: int | None = None
        self._leader_heard_ns: dict[int, int] = {}
        """Shard that concerns us -> when its leader was heard last."""

    def hear_known(self, known: Known) -> None:
        """An agent has tables that name this generation of ours, and shards which concern us."""
        self._informants.add(known.agent)
        if not is_far_ahead(known.generation, self._known_generation):
            self._known_generation = max(self._known_generation, known.generation)
        self.watch(known.shards)

    @property
    def informed(self) -> bool:
        """True if we know every shard in which cells are granted to us: of each shard enough members have replied
        that one of them has the newest usable table."""
        if self._informants.issuperset(self.shards.agents):
            return True
        every = map(self.shards.members, self.shards.all)
        enough = self.shards.liars - self.shards.majority
        return all(len(self._informants.intersection(of)) > len(of) + enough for of in every)

    def begin(self, dead: Sequence[int], chance: int) -> list[int]:
        """Begins a new generation, once those who could be asked have answered. Returns the generations to keep
        on file; nothing may be said before they are there.

        dead    our generations that are on the file which this process has locked: they have ended
        chance  a random number
        """
        self.begin_as(first_generation(max(self._known_generation, *dead, 0), chance), dead)
        return [*dead[1 - GENERATIONS_KEPT :], self.generation]

    def have_left(self, vehicles: Iterable[str]) -> bool:
        """Returns True if these vehicles left in an earlier generation: each shard which concerns us has answered
        this generation, and none grants them a cell."""
        speaks = self.informed and self.generation > 0 and not self.replaced
        answered = speaks and all(self._views[shard].heard for shard in self.watched)
        return answered and not any(map(self.is_granted, vehicles))

    def hear_token(self, peer: Peer, *, up: bool) -> None:
        """The liveliness token of another process has risen or fallen."""
        if peer.id == self.name:
            (self._twins.appeared if up else self._twins.gone)(Peer("host", peer.id, peer.incarnation))

    def ended_alone(self, now_ns: int) -> bool:
        """Returns True if a replaced generation is to begin again, as its successor has ended. It holds and knows
        nothing then: send a recovery query, and `begin`."""
        if not self.replaced:
            return False
        if self._twins.is_alive("host", self.name) or self._alone_since_ns is None:
            self._alone_since_ns = now_ns
        if now_ns - self._alone_since_ns < _ALONE_NS:
            return False
        self._alone_since_ns = None
        self._informants.clear()  # the successor may have driven into other shards
        self._known_generation = max(self._known_generation, self.newest)
        self.end()
        return True

    def unled(self, now_ns: int) -> dict[int, str]:
        """Reason why vehicles of ours wait: shard -> that no leader of it is heard."""
        views = self._views
        self._leader_heard_ns = {
            shard: max(self._leader_heard_ns.get(shard, now_ns), views[shard].heard_ns) for shard in self.watched
        }
        reasons = {}
        for shard, heard_ns in self._leader_heard_ns.items():
            if now_ns - heard_ns > _UNLED_NS and (vehicles := views[shard].seen):
                members = self.shards.members(shard)
                reasons[shard] = (
                    f"vehicles of this agent wait ({len(vehicles)}): the agents which grant the next cells "
                    f"({', '.join(members)}) do not answer, or too late; {self.shards.majority} of them must"
                )
        return reasons
