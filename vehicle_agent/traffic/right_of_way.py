"""Which vehicle may enter which cell: distributed mutual exclusion per cell.

The algorithm is Ricart and Agrawala's (CACM 24(1), 1981) with whole-state messages instead of a request and a
reply per entry. An agent publishes its reservations: the cells that its vehicles hold, the cells that they
request, and for every other agent the number of the newest reservations it has seen. Of each agent only the
newest reservations count, so loss, repetition and reordering cost time and never safety. `Territory` limits the
other agents to those that may reserve cells in a common plot.

Rule. A vehicle may hold a requested cell when
 1. every other live agent has echoed a message that contains the request, and
 2. in the newest reservations of every other agent the cell is neither held, nor requested with a lower rank.
A rank is (ticket, agent, vehicle). A ticket is a Lamport time (CACM 21(7), 1978): a request made after another
one was heard of ranks behind it.

Why two vehicles never hold one cell. Suppose that A and B both come to hold cell c. A relied on a message m of B
that echoes A's request. If B held c when it sent m, then m says so, and A was refused. So B got c after m, when
it knew A's request, and found its own rank lower. By symmetry A got c when it knew B's request, and found its own
rank lower. Ranks are totally ordered, so this is a contradiction.

Crashes. What a dead agent held or requested stays closed until a newer incarnation of it publishes reservations.
The dead agent stands only on cells that it requested in a message that all agents of its time had echoed, so
every agent that was alive then knows them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from swarm.clock import NS_PER_S
from swarm.wire.messages.vehicles import RequestedCell, Reservations
from vehicle_agent.traffic.territory import Territory

_CLOCK_LIMIT = 1 << 61
"""No honest clock gets there. Larger ones are ignored, so that ours stays within what fits the wire."""
_IDLE_NS = NS_PER_S // 2
_NO_AGENTS: Mapping[str, _Other] = MappingProxyType({})

Rank = tuple[int, str, str]
"""(ticket, agent, vehicle) of a request: the lower goes first."""


@dataclass(slots=True)
class _Request:
    """A requested cell of ours. `seq` is the number of the first message that contains it."""

    cell: int
    ticket: int
    seq: int


@dataclass(slots=True)
class _Mine:
    """One of our vehicles: the cells that it holds, the one on which it stands first, and those it requests
    next."""

    held: list[int] = field(default_factory=list)
    requests: list[_Request] = field(default_factory=list)


class _Other:
    """Another agent's newest reservations, by cell.

    held        cell -> vehicle
    rank        cell -> lowest rank of the requests for it
    requesting  cell -> vehicles that request it
    heard       False if these are spawn cells, of which the agent has said nothing
    """

    def __init__(self, reservations: Reservations) -> None:
        self.reservations = reservations
        self.held: dict[int, str] = {}
        for vehicle, cells in reservations.held.items():
            for cell in cells:
                self.held[cell] = vehicle
        self.rank: dict[int, Rank] = {}
        self.requesting: dict[int, list[str]] = {}
        for request in reservations.requested:
            self.requesting.setdefault(request.cell, []).append(request.vehicle)
            rank = (request.ticket, reservations.agent, request.vehicle)
            if request.cell not in self.rank or rank < self.rank[request.cell]:
                self.rank[request.cell] = rank
        self.cells = self.held.keys() | self.rank.keys()
        self.heard = reservations.seq > 0


@dataclass(frozen=True, slots=True)
class Requester:
    """A vehicle that requests a cell. `stands_on` is None for a vehicle that is not placed yet."""

    vehicle: str
    stands_on: int | None


class RightOfWay:
    """The reservations of one agent's vehicles beside those of all other agents.

    spawns     agent -> vehicle -> cell where each agent of the run first places its vehicles: these cells count as
               held by agents that we have not heard of yet
    territory  which agents reserve cells in a common plot; None if all do
    """

    def __init__(
        self,
        agent: str,
        incarnation: int,
        spawns: Mapping[str, Mapping[str, int]],
        territory: Territory | None = None,
    ) -> None:
        self.agent = agent
        self.incarnation = incarnation
        self._seq = 0
        """Number of our newest message."""
        self._clock = 0
        """Lamport clock: the largest ticket that we know of."""
        self._mine: dict[str, _Mine] = {}
        self._held_by: dict[int, str] = {}
        """Cell -> our vehicle that holds it."""
        self._requesting: dict[int, list[str]] | None = None
        """Cell -> our vehicles that request it; None after a change, made anew when asked for."""
        self._territory = territory
        self._others: dict[str, _Other] = {}
        self._by_cell: dict[int, dict[str, _Other]] = {}
        """Cell -> the other agents that hold or request it."""
        self._alive: dict[str, int] = {}
        self._changed = True
        """Whether we hold, request or have heard anything that our newest message does not tell."""
        self._idle_until_ns = 0
        for other, vehicles in spawns.items():
            if other != agent:
                holds = {vehicle: [cell] for vehicle, cell in vehicles.items()}
                unheard = Reservations(
                    agent=other, incarnation=0, seq=0, clock=0, held=holds, requested=[], seen={}
                )
                self._replace(other, _Other(unheard))

    # --- what other agents publish --------------------------------------------------------------------------

    def hear(self, reservations: Reservations) -> None:
        """Take in an agent's reservations, if they are the newest of that agent. Those with seq 0 tell nothing: the
        agent has not placed its vehicles."""
        agent, clock = reservations.agent, reservations.clock
        if agent == self.agent:
            if reservations.incarnation < self.incarnation and clock < _CLOCK_LIMIT:
                self._clock = max(self._clock, clock)
            return
        if reservations.seq == 0:
            return
        known = self._others.get(agent)
        if known is not None and stamp_of(reservations) <= stamp_of(known.reservations):
            return
        if self._territory is not None and self._territory.is_far(agent):
            return  # it was a neighbour when it published this
        self._replace(agent, _Other(reservations))
        if clock < _CLOCK_LIMIT:
            self._clock = max(self._clock, clock)
        self._changed = self._changed or bool(reservations.requested)

    def set_alive(self, agents: Mapping[str, int]) -> None:
        """Which agents live: agent -> incarnation. A dead agent is not waited for; its reservations stand."""
        self._alive = {agent: incarnation for agent, incarnation in agents.items() if agent != self.agent}

    def forget_far(self) -> None:
        """Drop the reservations of live agents with no plot in common any more: we hear no newer ones."""
        if self._territory is not None:
            for agent in [agent for agent in self._others if self._territory.is_far(agent)]:
                self._replace(agent, None)

    def _replace(self, agent: str, other: _Other | None) -> None:
        """Put another agent's reservations in the place of its earlier ones."""
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

    # --- what our vehicles do -------------------------------------------------------------------------------

    def place(self, vehicle: str, cell: int) -> None:
        """Put a vehicle on a cell on which no other can be. Raises ValueError if another of ours holds it."""
        if cell in self._held_by:
            raise ValueError(f"{vehicle} and {self._held_by[cell]} are both placed on cell {cell}")
        self._mine[vehicle] = _Mine(held=[cell])
        self._held_by[cell] = vehicle
        self._changed = True

    def request(self, vehicle: str, ahead: Sequence[int]) -> None:
        """Request exactly these cells, in this order. All others that the vehicle held or requested are given up at
        once, except the one on which it stands."""
        mine = self._mine.setdefault(vehicle, _Mine())
        ahead = self._allowed(mine, ahead)
        base = 1 if mine.held else 0
        kept = 0
        while kept < len(ahead) and base + kept < len(mine.held) and mine.held[base + kept] == ahead[kept]:
            kept += 1
        if base + kept < len(mine.held) and base:
            for cell in mine.held[base + kept :]:
                del self._held_by[cell]
            del mine.held[base + kept :]
            self._changed = True
        wanted = ahead[kept:]
        if [request.cell for request in mine.requests] == list(wanted):
            return
        old = {request.cell: request for request in mine.requests}
        if any(cell not in old for cell in wanted):
            self._clock += 1
        self._requesting = None
        mine.requests = [old.get(cell) or _Request(cell, self._clock, self._seq + 1) for cell in wanted]
        self._changed = True

    def _allowed(self, mine: _Mine, ahead: Sequence[int]) -> Sequence[int]:
        """The cells before the first one in a plot that some live agent does not know to be ours."""
        if self._territory is not None:
            for index, cell in enumerate(ahead):
                if cell not in mine.held and not self._is_ours(cell):
                    return ahead[:index]
        return ahead

    def _is_ours(self, cell: int) -> bool:
        """Whether every live agent knows that we reserve cells in this plot, and we know where its dead stand."""
        territory = self._territory
        if territory is None:
            return True
        plot = territory.plot_of(cell)
        if not territory.agreed(plot):
            return False
        for agent, incarnation in territory.dead_in(plot):
            other = self._others.get(agent)
            if other is None or other.reservations.incarnation < incarnation:
                return False
        return True

    def moved(self, vehicle: str, cell: int) -> None:
        """The vehicle stands on another cell that it holds: those before it are free."""
        mine = self._mine[vehicle]
        index = mine.held.index(cell)
        for passed in mine.held[:index]:
            del self._held_by[passed]
        del mine.held[:index]
        self._changed = True

    def grant(self) -> bool:
        """Let our vehicles hold what the rule allows; True if any cell was granted. Each vehicle gets its cells in
        the order in which it enters them."""
        echoed = self._echoed()
        firsts: dict[int, Rank] = {}
        for vehicle, mine in self._mine.items():
            for request in mine.requests:
                rank = (request.ticket, self.agent, vehicle)
                if request.cell not in firsts or rank < firsts[request.cell]:
                    firsts[request.cell] = rank
        any_granted = False
        for vehicle, mine in self._mine.items():
            while mine.requests:
                request = mine.requests[0]
                rank = (request.ticket, self.agent, vehicle)
                if request.seq > echoed or request.cell in self._held_by or firsts[request.cell] < rank:
                    break
                if not self._is_ours(request.cell) or self._forbidden(request.cell, rank):
                    break
                mine.held.append(request.cell)
                self._held_by[request.cell] = vehicle
                del mine.requests[0]
                self._requesting = None
                any_granted = self._changed = True
        return any_granted

    def _echoed(self) -> int:
        """The number of our newest message that every live agent has seen; -1 if one has seen none."""
        echoed = self._seq
        for agent, incarnation in self._alive.items():
            if self._territory is not None and agent not in self._territory.echoed_by:
                continue
            other = self._others.get(agent)
            if other is None or other.reservations.incarnation != incarnation:
                return -1
            seen = other.reservations.seen.get(self.agent)
            if seen is None or seen[0] != self.incarnation:
                return -1
            echoed = min(echoed, seen[1])
        return echoed

    def _forbidden(self, cell: int, rank: Rank) -> bool:
        """Whether another agent holds the cell, requests it with a lower rank, or requested it and died."""
        for agent, other in self._by_cell.get(cell, _NO_AGENTS).items():
            if cell in other.held:
                return True
            other_rank = other.rank.get(cell)
            if other_rank is not None and (other_rank < rank or self._is_dead(agent, other)):
                return True
        return False

    # --- what we publish ------------------------------------------------------------------------------------

    def message_due(self, now_ns: int) -> bool:
        """Whether to publish our reservations now: they changed, another agent waits for our echo, a request of
        ours is open, or nothing was published for half a second."""
        due = now_ns >= self._idle_until_ns or self._changed or any(mine.requests for mine in self._mine.values())
        if due:
            self._idle_until_ns = now_ns + _IDLE_NS
        return due

    def next_message(self) -> Reservations:
        """Our reservations under the next number. Publish them: a request counts from here on."""
        self._seq += 1
        self._changed = False
        return Reservations(
            agent=self.agent,
            incarnation=self.incarnation,
            seq=self._seq,
            clock=self._clock,
            held={vehicle: list(mine.held) for vehicle, mine in self._mine.items() if mine.held},
            requested=[
                RequestedCell(vehicle=vehicle, cell=request.cell, ticket=request.ticket)
                for vehicle, mine in self._mine.items()
                for request in mine.requests
            ],
            seen={agent: stamp_of(other.reservations) for agent, other in self._others.items() if other.heard},
        )

    def answers(self) -> list[Reservations]:
        """What a starting agent is told: the newest reservations of the dead, and ours."""
        of_the_dead = [
            other.reservations
            for agent, other in self._others.items()
            if other.heard and self._is_dead(agent, other)
        ]
        changed = self._changed
        mine = self.next_message()
        self._changed = changed  # the other agents have not heard it
        return [*of_the_dead, mine]

    def unplaced(self) -> Reservations:
        """What a starting agent is told while our vehicles are not placed: seq 0 replaces no reservations."""
        return Reservations(
            agent=self.agent, incarnation=self.incarnation, seq=0, clock=0, held={}, requested=[], seen={}
        )

    def heard_of(self, agents: Sequence[str]) -> list[Reservations]:
        """The newest reservations that we have heard of these agents."""
        others = (self._others.get(agent) for agent in agents)
        return [other.reservations for other in others if other is not None and other.heard]

    # --- queries --------------------------------------------------------------------------------------------

    def held(self, vehicle: str) -> list[int]:
        """The cells of a vehicle, the one on which it stands first; empty if it is not placed."""
        mine = self._mine.get(vehicle)
        return mine.held if mine else []

    def requested(self, vehicle: str) -> list[int]:
        """The cells that a vehicle requests, in the order in which it enters them."""
        mine = self._mine.get(vehicle)
        return [request.cell for request in mine.requests] if mine else []

    def holder(self, cell: int) -> str | None:
        """The vehicle that holds a cell, or requested it when its agent died; None if there is none."""
        if cell in self._held_by:
            return self._held_by[cell]
        for agent, other in self._by_cell.get(cell, _NO_AGENTS).items():
            if cell in other.held:
                return other.held[cell]
            if cell in other.rank and self._is_dead(agent, other):
                return other.rank[cell][2]
        return None

    def requesters(self, cell: int, besides: str) -> list[Requester]:
        """The vehicles of live agents that request a cell, without the vehicle `besides`."""
        if self._requesting is None:
            self._requesting = {}
            for vehicle, mine in self._mine.items():
                for request in mine.requests:
                    self._requesting.setdefault(request.cell, []).append(vehicle)
        found = []
        for vehicle in self._requesting.get(cell, ()):
            if vehicle != besides:
                held = self._mine[vehicle].held
                found.append(Requester(vehicle, held[0] if held else None))
        for agent, other in self._by_cell.get(cell, _NO_AGENTS).items():
            if cell in other.requesting and not self._is_dead(agent, other):
                for vehicle in other.requesting[cell]:
                    stands = other.reservations.held.get(vehicle)
                    found.append(Requester(vehicle, stands[0] if stands else None))
        return found

    def _is_dead(self, agent: str, other: _Other) -> bool:
        return self._alive.get(agent) != other.reservations.incarnation


def stamp_of(reservations: Reservations) -> tuple[int, int]:
    """Orders the reservations of one agent: the larger is the newer."""
    return reservations.incarnation, reservations.seq
