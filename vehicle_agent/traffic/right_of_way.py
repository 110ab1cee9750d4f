"""Who may enter which cell now: right of way among agents that hear only each other's newest claims.

The rule is Ricart and Agrawala's (1981) on messages that each carry their sender's whole state, so that loss,
repetition and reordering do no harm. A vehicle may enter a cell when every other live agent has echoed the message
in which the want first stood, and in nobody's newest claims the cell is held, or wanted with a lower
(ticket, agent, vehicle). With `SharedGround` only those neighbours and witnesses are waited for and heard whom it
names, and a cell is wanted only in a plot that it calls settled.

Why no two get the same cell: A goes by a message of B that echoes A's want, B by one of A that echoes B's. Had B
got the cell before it sent that message, the message would say so. So B got it later, when it knew A's want, and
found its own the lower; and A got it when it knew B's, and found its own the lower. Both cannot be. Tickets only
decide who goes first: they are Lamport's clock, so that a want made after hearing of another queues behind it.

What a dead agent held or wanted stays forbidden until a newer incarnation of it speaks: each cell that it may
stand on was wanted in a message that all who lived then had echoed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from swarm.clock import NS_PER_S
from swarm.wire.messages.vehicles import Claims, Want
from vehicle_agent.traffic.territory import SharedGround

_CLOCK_LIMIT = 1 << 61
_IDLE_NS = NS_PER_S // 2
_NOBODY: Mapping[str, _Other] = MappingProxyType({})

Rank = tuple[int, str, str]
"""(ticket, agent, vehicle): the lower goes first."""


@dataclass(slots=True)
class _Wanted:
    """A want of ours. `seq` is that of the first message in which it stands."""

    cell: int
    ticket: int
    seq: int


@dataclass(slots=True)
class _Mine:
    """One of our vehicles: the cells that it holds, its own first, and those that it wants after them."""

    holds: list[int] = field(default_factory=list)
    wants: list[_Wanted] = field(default_factory=list)


class _Other:
    """Another agent's newest claims, by cell."""

    def __init__(self, claims: Claims) -> None:
        self.claims = claims
        self.held: dict[int, str] = {}
        for vehicle, cells in claims.holds.items():
            for cell in cells:
                self.held[cell] = vehicle
        self.wanted: dict[int, Rank] = {}
        self.wanting: dict[int, list[str]] = {}
        for want in claims.wants:
            self.wanting.setdefault(want.cell, []).append(want.vehicle)
            rank = (want.ticket, claims.agent, want.vehicle)
            if want.cell not in self.wanted or rank < self.wanted[want.cell]:
                self.wanted[want.cell] = rank
        self.cells = self.held.keys() | self.wanted.keys()


@dataclass(frozen=True, slots=True)
class Wanter:
    """Who wants a cell: `stands_on` is None of a vehicle that stands nowhere yet."""

    vehicle: str
    stands_on: int | None


class RightOfWay:
    """The claims of one agent's vehicles beside everybody else's.

    spawns  agent -> vehicle -> cell where each agent of the run puts its vehicles when it first starts: held for
            those that have not spoken yet
    ground  who shares ground with us; None where everybody does
    """

    def __init__(
        self,
        agent: str,
        incarnation: int,
        spawns: Mapping[str, Mapping[str, int]],
        ground: SharedGround | None = None,
    ) -> None:
        self.agent = agent
        self.incarnation = incarnation
        self._seq = 0
        self._clock = 0
        self._mine: dict[str, _Mine] = {}
        self._held_by: dict[int, str] = {}
        self._wanting: dict[int, list[str]] | None = None
        self._ground = ground
        self._others: dict[str, _Other] = {}
        self._by_cell: dict[int, dict[str, _Other]] = {}  # who of the others holds or wants a cell
        self._alive: dict[str, int] = {}
        self._changed = True
        """Whether we hold, want or have heard anything that our last published claims do not tell."""
        self._idle_until_ns = 0
        for other, vehicles in spawns.items():
            if other != agent:
                holds = {vehicle: [cell] for vehicle, cell in vehicles.items()}
                claims = Claims(agent=other, incarnation=0, seq=0, clock=0, holds=holds, wants=[], seen={})
                self._take(other, _Other(claims))

    # --- what the others say --------------------------------------------------------------------------------

    def heard(self, claims: Claims) -> None:
        """Take in another agent's claims; only the newest of an agent count. Sequence 0 says "not placed yet"."""
        if claims.agent == self.agent:
            if claims.incarnation < self.incarnation and claims.clock < _CLOCK_LIMIT:
                self._clock = max(self._clock, claims.clock)
            return
        if claims.seq == 0:
            return
        known = self._others.get(claims.agent)
        if known is not None and (claims.incarnation, claims.seq) <= stamp_of(known.claims):
            return
        if self._ground is not None and self._ground.is_far(claims.agent):
            return  # it was a neighbour when it said this
        self._take(claims.agent, _Other(claims))
        if claims.clock < _CLOCK_LIMIT:  # an honest one never gets there; ours must stay within what fits the wire
            self._clock = max(self._clock, claims.clock)
        self._changed = self._changed or bool(claims.wants)

    def set_alive(self, agents: Mapping[str, int]) -> None:
        """Which agents live, and in which incarnation. A dead one is not waited for; its claims stand."""
        self._alive = {agent: incarnation for agent, incarnation in agents.items() if agent != self.agent}

    def forget_the_far(self) -> None:
        """Drop the claims of those who live and share no ground with us any more: we hear no newer ones."""
        if self._ground is not None:
            for agent in [agent for agent in self._others if self._ground.is_far(agent)]:
                self._take(agent, None)

    def _take(self, agent: str, other: _Other | None) -> None:
        """Put another agent's claims in the place of its earlier ones."""
        known = self._others.pop(agent, None)
        if known is not None:
            for cell in known.cells:
                there = self._by_cell[cell]
                del there[agent]
                if not there:
                    del self._by_cell[cell]
        if other is not None:
            self._others[agent] = other
            for cell in other.cells:
                self._by_cell.setdefault(cell, {})[agent] = other

    def words_of(self, agents: Sequence[str]) -> list[Claims]:
        """The newest claims that we have heard of these agents."""
        heard = (self._others.get(agent) for agent in agents)
        return [other.claims for other in heard if other is not None and other.claims.seq]

    # --- what our vehicles do -------------------------------------------------------------------------------

    def place(self, vehicle: str, cell: int) -> None:
        """Put a vehicle where nobody else can be: its spawn cell, or where it last stood."""
        if cell in self._held_by:
            raise ValueError(f"{vehicle} and {self._held_by[cell]} are both placed on cell {cell}")
        self._mine[vehicle] = _Mine(holds=[cell])
        self._held_by[cell] = vehicle
        self._changed = True

    def ask(self, vehicle: str, ahead: Sequence[int]) -> None:
        """Want exactly these cells, in this order; what was held or wanted besides is given up at once."""
        mine = self._mine.setdefault(vehicle, _Mine())
        ahead = self._settled_part(mine, ahead)
        base = 1 if mine.holds else 0
        kept = 0
        while kept < len(ahead) and base + kept < len(mine.holds) and mine.holds[base + kept] == ahead[kept]:
            kept += 1
        if base + kept < len(mine.holds) and base:
            for cell in mine.holds[base + kept :]:
                del self._held_by[cell]
            del mine.holds[base + kept :]
            self._changed = True
        wanted = ahead[kept:]
        if [want.cell for want in mine.wants] == list(wanted):
            return
        old = {want.cell: want for want in mine.wants}
        if any(cell not in old for cell in wanted):
            self._clock += 1
        self._wanting = None
        mine.wants = [old.get(cell) or _Wanted(cell, self._clock, self._seq + 1) for cell in wanted]
        self._changed = True

    def _settled_part(self, mine: _Mine, ahead: Sequence[int]) -> Sequence[int]:
        """The cells up to the first in a plot that not everybody knows to be ours."""
        if self._ground is not None:
            for index, cell in enumerate(ahead):
                if cell not in mine.holds and not self._is_settled(cell):
                    return ahead[:index]
        return ahead

    def _is_settled(self, cell: int) -> bool:
        ground = self._ground
        if ground is None:
            return True
        plot = ground.plot_of(cell)
        if not ground.settled(plot):
            return False
        for agent, incarnation in ground.dead_in(plot):
            other = self._others.get(agent)
            if other is None or other.claims.incarnation < incarnation:
                return False  # nobody who lives can tell where its vehicles stand
        return True

    def moved(self, vehicle: str, cell: int) -> None:
        """The vehicle stands on a cell that it holds: those before it are free."""
        mine = self._mine[vehicle]
        index = mine.holds.index(cell)
        for passed in mine.holds[:index]:
            del self._held_by[passed]
        del mine.holds[:index]
        self._changed = True

    def grant(self) -> bool:
        """Turn wants into holds wherever the rule allows; True if any was. A vehicle gets its cells in order."""
        echoed = self._echoed()
        firsts: dict[int, Rank] = {}
        for vehicle, mine in self._mine.items():
            for want in mine.wants:
                rank = (want.ticket, self.agent, vehicle)
                if want.cell not in firsts or rank < firsts[want.cell]:
                    firsts[want.cell] = rank
        any_granted = False
        for vehicle, mine in self._mine.items():
            while mine.wants:
                want = mine.wants[0]
                rank = (want.ticket, self.agent, vehicle)
                if want.seq > echoed or want.cell in self._held_by or firsts[want.cell] < rank:
                    break
                if not self._is_settled(want.cell) or self._others_forbid(want.cell, rank):
                    break
                mine.holds.append(want.cell)
                self._held_by[want.cell] = vehicle
                del mine.wants[0]
                self._wanting = None
                any_granted = self._changed = True
        return any_granted

    def speaks(self, now_ns: int) -> bool:
        """Whether to publish our claims now: they changed, another agent waits for our echo, a want of ours is
        open, or nothing was published for half a second."""
        due = now_ns >= self._idle_until_ns or self._changed or any(mine.wants for mine in self._mine.values())
        if due:
            self._idle_until_ns = now_ns + _IDLE_NS
        return due

    def speak(self) -> Claims:
        """Our whole state, under the next sequence number. Publish it: a want counts from here on."""
        self._seq += 1
        self._changed = False
        return Claims(
            agent=self.agent,
            incarnation=self.incarnation,
            seq=self._seq,
            clock=self._clock,
            holds={vehicle: list(mine.holds) for vehicle, mine in self._mine.items() if mine.holds},
            wants=[
                Want(vehicle=vehicle, cell=want.cell, ticket=want.ticket)
                for vehicle, mine in self._mine.items()
                for want in mine.wants
            ],
            seen={agent: stamp_of(other.claims) for agent, other in self._others.items() if other.claims.seq},
        )

    # --- what one may ask -----------------------------------------------------------------------------------

    def holds(self, vehicle: str) -> list[int]:
        """The cells of a vehicle, the one that it stands on first; empty of one that stands nowhere yet."""
        mine = self._mine.get(vehicle)
        return mine.holds if mine else []

    def wants(self, vehicle: str) -> list[int]:
        mine = self._mine.get(vehicle)
        return [want.cell for want in mine.wants] if mine else []

    def holder(self, cell: int) -> str | None:
        """Who holds a cell, as far as we know; of a dead agent also who wanted it."""
        if cell in self._held_by:
            return self._held_by[cell]
        for agent, other in self._by_cell.get(cell, _NOBODY).items():
            if cell in other.held:
                return other.held[cell]
            if cell in other.wanted and self._dead(agent, other):
                return other.wanted[cell][2]
        return None

    def wanters(self, cell: int, besides: str) -> list[Wanter]:
        """Who wants a cell, the vehicle `besides` and the dead not among them."""
        if self._wanting is None:
            self._wanting = {}
            for vehicle, mine in self._mine.items():
                for want in mine.wants:
                    self._wanting.setdefault(want.cell, []).append(vehicle)
        found = []
        for vehicle in self._wanting.get(cell, ()):
            if vehicle != besides:
                holds = self._mine[vehicle].holds
                found.append(Wanter(vehicle, holds[0] if holds else None))
        for agent, other in self._by_cell.get(cell, _NOBODY).items():
            if cell in other.wanting and not self._dead(agent, other):
                for vehicle in other.wanting[cell]:
                    stands = other.claims.holds.get(vehicle)
                    found.append(Wanter(vehicle, stands[0] if stands else None))
        return found

    def unplaced(self) -> Claims:
        """What a starting agent is told while our own vehicles are not placed: seq 0 replaces nobody's claims."""
        return Claims(agent=self.agent, incarnation=self.incarnation, seq=0, clock=0, holds={}, wants=[], seen={})

    def answers(self) -> list[Claims]:
        """What a starting agent is told: where we are now, and the last words of all who cannot tell it."""
        last_words = [
            other.claims for agent, other in self._others.items() if other.claims.seq and self._dead(agent, other)
        ]
        changed = self._changed
        mine = self.speak()
        self._changed = changed  # the others have not heard it
        return [*last_words, mine]

    def _dead(self, agent: str, other: _Other) -> bool:
        return self._alive.get(agent) != other.claims.incarnation

    def _echoed(self) -> int:
        """The newest sequence number of ours that every live agent has seen."""
        echoed = self._seq
        for agent, incarnation in self._alive.items():
            if self._ground is not None and agent not in self._ground.echoed_by:
                continue
            other = self._others.get(agent)
            if other is None or other.claims.incarnation != incarnation:
                return -1
            seen = other.claims.seen.get(self.agent)
            if seen is None or seen[0] != self.incarnation:
                return -1
            echoed = min(echoed, seen[1])
        return echoed

    def _others_forbid(self, cell: int, rank: Rank) -> bool:
        for agent, other in self._by_cell.get(cell, _NOBODY).items():
            if cell in other.held:
                return True
            wanted = other.wanted.get(cell)
            if wanted is not None and (wanted < rank or self._dead(agent, other)):
                return True
        return False


def stamp_of(claims: Claims) -> tuple[int, int]:
    """Orders the claims of one agent: the larger is the newer."""
    return claims.incarnation, claims.seq
