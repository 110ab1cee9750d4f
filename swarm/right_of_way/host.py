"""One host of vehicles in right of way: its generations, and the cells that its vehicles hold
(docs/design/right-of-way.md, Generations)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.liveness import Peer, Roster
from swarm.right_of_way.generations import first_generation, is_far_ahead
from swarm.right_of_way.holdings import Holdings, Tell, Wish
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Granted, Left, Word

GENERATIONS_KEPT = 32
"""Numbers of generations on file, as many as a `HostState` has room for."""
_ALONE_NS = NS_PER_S // 2
"""A replaced generation begins again once no other process of its host has been alive for this time."""
_UNLED_NS = 2 * NS_PER_S
"""A shard that is silent for this time has no leader; another one takes over within a second where it can."""


@dataclass(frozen=True, slots=True)
class AskKnown:
    """Ask all agents what they have on file about this host, then begin a generation."""


class Host:
    """A host's part in right of way; whether it is also a member of shards is nothing to it.

    name  of the agent or external vehicle

    holdings  which cells our vehicles hold: none before `begin`
    """

    def __init__(self, shards: Shards, name: str, vehicles: Collection[str] | None) -> None:
        self.name = name
        self.shards = shards
        self.holdings = Holdings(shards, name, vehicles)
        self._known_generation = 0
        self._told_by: set[str] = set()
        """Agents that have sent us their knowledge of us."""
        self._twins = Roster()
        self._alone_since_ns: int | None = None
        self._led_ns: dict[int, int] = {}
        """Shard that concerns us -> when its leader was heard last."""

    def hear_known(self, agent: str, generation: int, shards: Sequence[int]) -> None:
        """An agent has tables that name this generation of ours, and shards which concern us."""
        self._told_by.add(agent)
        if not is_far_ahead(generation, self._known_generation):
            self._known_generation = max(self._known_generation, generation)
        self.holdings.watch([shard for shard in shards if shard in self.shards.all])

    @property
    def informed(self) -> bool:
        """True if we know every shard in which cells are granted to us: of each shard enough members have replied
        that one of them has the newest usable table."""
        if self._told_by.issuperset(self.shards.agents):
            return True
        every = map(self.shards.members, self.shards.all)
        enough = self.shards.liars - self.shards.majority
        return all(len(self._told_by.intersection(of)) > len(of) + enough for of in every)

    def begin(self, dead: Sequence[int], chance: int) -> list[int]:
        """Begins a new generation, once those who could be asked have answered. Returns the generations to keep
        on file; nothing may be said before they are there.

        dead    our generations that are on the file which this process has locked: they have ended
        chance  a random number
        """
        generation = first_generation(max(self._known_generation, *dead, 0), chance)
        self.holdings.begin(generation, dead)
        return [*dead[1 - GENERATIONS_KEPT :], generation]

    def hear_granted(self, granted: Granted | Word, now_ns: int) -> list[str]:
        """A leader's grant, or a member's word on one. Returns the vehicles that have found their place."""
        if not self.holdings.generation or granted.shard not in self.shards.all:
            return []
        if isinstance(granted, Word):
            return self.holdings.hear_word(granted)
        if granted.shard not in self.holdings.shards:
            return []
        placed = self.holdings.hear_granted(granted, now_ns)
        if self.holdings.heard_ns(granted.shard) == now_ns:
            self._led_ns[granted.shard] = now_ns
        return placed

    def hear_left(self, left: Left) -> list[str]:
        """Another host's word to us. Returns the vehicles that have found their place."""
        heard = left.host == self.name and self.holdings.generation and not self.holdings.replaced
        return self.holdings.hear_left(left) if heard else []

    def have_left(self, vehicles: Iterable[str]) -> bool:
        """Returns True if these vehicles left in an earlier generation: each shard which concerns us has answered
        this generation, and none grants them a cell."""
        return self.informed and self.holdings.answered and not any(map(self.holdings.is_granted, vehicles))

    def hear_token(self, peer: Peer, *, up: bool) -> None:
        """The liveliness token of another process has risen or fallen."""
        if peer.id == self.name:
            (self._twins.appeared if up else self._twins.gone)(Peer("host", peer.id, peer.incarnation))

    def standings(self, wishes: Mapping[str, Wish], now_ns: int) -> list[Tell]:
        """Returns the statements of our vehicles to publish now."""
        return self.holdings.standings(wishes, now_ns) if self.holdings.generation else []

    def lefts(self, now_ns: int) -> list[Left]:
        """Returns the words to publish now that vehicles of other hosts wait for."""
        return self.holdings.lefts(now_ns) if self.holdings.generation and not self.holdings.replaced else []

    def ended_alone(self, now_ns: int) -> bool:
        """Returns True if a replaced generation is to begin again, as its successor has ended. It holds and knows
        nothing then: send a recovery query, and `begin`."""
        if not self.holdings.replaced:
            return False
        if self._twins.is_alive("host", self.name) or self._alone_since_ns is None:
            self._alone_since_ns = now_ns
        if now_ns - self._alone_since_ns < _ALONE_NS:
            return False
        self._alone_since_ns = None
        self._told_by.clear()  # the successor may have driven into other shards
        self._known_generation = max(self._known_generation, self.holdings.newest)
        self.holdings.end()
        return True

    def unled(self, now_ns: int) -> dict[int, str]:
        """Reason why vehicles of ours wait: shard -> that no leader of it is heard."""
        shards = self.holdings.shards
        self._led_ns = {shard: self._led_ns.get(shard, now_ns) for shard in shards}
        found = {}
        for shard, heard_ns in self._led_ns.items():
            if now_ns - heard_ns > _UNLED_NS and (vehicles := self.holdings.waiting(shard)):
                members = self.shards.members(shard)
                found[shard] = (
                    f"{len(vehicles)} of our vehicles wait to enter cells: no agent leads the right of way there "
                    f"(shard {shard}) until {self.shards.majority} of {', '.join(members)} reach each other and us"
                )
        return found
