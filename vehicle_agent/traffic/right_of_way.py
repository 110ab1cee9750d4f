"""One agent's part in right of way: its seats among the members of plots, and the cells that its own vehicles hold.

Messages and time in, actions out. The shell performs actions in their order: what is saved must be on file before
what follows is said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import msgspec
from msgspec.structs import replace

from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of
from swarm.liveness import Peer, Roster
from swarm.wire.messages.traffic import Grant, Granted, Known, KnownRequest, Standing, Stored, Table
from vehicle_agent.traffic.holdings import Holdings, Tell, Wish
from vehicle_agent.traffic.member import Member, MemberAction, Refused
from vehicle_agent.traffic.plots import Plots
from vehicle_agent.traffic.warden import first_life, is_far_ahead

Place = Callable[[str, Sequence[int]], int]

_LIVES_KEPT = 32
_ALONE_NS = NS_PER_S // 2
"""A life that has been replaced begins again once no other process of its agent has been alive for so long."""
_UNLED_NS = 2 * NS_PER_S
"""A plot that is silent for so long has no warden; another one takes over within a second where it can."""


def _first(vehicle: str, cells: Sequence[int]) -> int:
    return cells[0]


class OwnRecord(msgspec.Struct, frozen=True, kw_only=True):
    """What an agent keeps on file about itself and the others' files.

    disk      names this file: a number drawn when it was made
    lives     the agent's lives that have run on it, the last ones
    noted     agent -> its file, the first that we were told of
    noted_by  the agents that have noted ours
    """

    disk: int
    lives: list[int] = []
    noted: dict[str, int] = {}
    noted_by: list[str] = []


@dataclass(frozen=True, slots=True)
class AskKnown:
    """Ask the other agents what they have on file about this one, then `begin`."""


Action = MemberAction | Tell | OwnRecord | Known | AskKnown


class RightOfWay:
    """Right of way of one agent.

    spawns  agent -> vehicle -> the cell where it stands when the run begins
    own     what this agent's file holds: of itself,
    saved   and of plots: (promised epoch, stored table)
    place   tells on which of the cells that it was granted a vehicle of a new life stands

    holdings  which cells our vehicles hold: none before `begin`
    silent    whether our file takes nothing now: then we are no member of any plot, and note nobody's file. What
              our vehicles hold and are granted does not depend on it
    """

    def __init__(
        self,
        agent: str,
        plots: Plots,
        spawns: Mapping[str, Mapping[str, int]],
        own: OwnRecord,
        saved: Mapping[int, tuple[int, Table]],
        place: Place = _first,
    ) -> None:
        self.agent = agent
        self.plots = plots
        self.own = own
        self.holdings = Holdings(plots, agent, spawns[agent])
        self._spawns = spawns
        self._saved = dict(saved)
        self._place = place
        self._members: dict[int, Member] = {}
        self._known_life = 0
        self._twins = Roster()
        self._alone_since_ns: int | None = None
        self._led_ns: dict[int, int] = {}
        """Plot that concerns us -> when its warden was heard last."""
        self.silent = False

    # --- beginning a life -----------------------------------------------------------------------------------

    @property
    def settled(self) -> bool:
        """Whether nobody needs to be asked what is known of us: we live, all other agents have noted our file, and
        no later life leaves it to us to say, wherever cells of ours are shut, that we have stopped."""
        noted = len(self.own.noted_by) >= len(self._spawns) - 1
        return self.holdings.life > 0 and noted and not self.holdings.replaced

    def answer_known(self, request: KnownRequest) -> list[Action]:
        """Another agent has begun a life. The last action is what to answer.

        Its file is noted once and for all: with another one it has no seat, because what it promised stands in the
        first.
        """
        if request.agent not in self._spawns or request.agent == self.agent or self.silent:
            return []
        actions: list[Action] = []
        if request.agent not in self.own.noted:
            self.own = replace(self.own, noted={**self.own.noted, request.agent: request.disk})
            actions.append(self.own)
        life, plots = self._known(request.agent)
        disk = self.own.noted[request.agent]
        return [*actions, Known(agent=self.agent, disk=disk, life=life, plots=plots)]

    def hear_known(self, known: Known) -> list[Action]:
        """An answer to our question."""
        if known.agent not in self._spawns or known.agent == self.agent:
            return []
        if not is_far_ahead(known.life, self._known_life):
            self._known_life = max(self._known_life, known.life)
        self.holdings.watch([plot for plot in known.plots if plot < self.plots.count])
        if self.silent or known.disk != self.own.disk or known.agent in self.own.noted_by:
            return []
        self.own = replace(self.own, noted_by=[*self.own.noted_by, known.agent])
        return [self.own]

    def begin(self, chance: int) -> list[Action]:
        """Begin a new life, once those who could be asked have answered.

        chance  a random number
        """
        life, plots = self._known(self.agent)
        dead = self.own.lives  # they have ended: this life has the file
        life = first_life(max(self._known_life, life, *dead), chance)
        self.holdings.begin(life, dead)
        home = map(self.plots.of, self._spawns[self.agent].values())
        self.holdings.watch([plot for plot in (*plots, *home) if plot < self.plots.count])
        self.own = replace(self.own, lives=[*dead[1 - _LIVES_KEPT :], life])
        return [self.own]

    def hear_token(self, peer: Peer, *, up: bool) -> None:
        """The liveliness token of another process has risen or fallen."""
        if peer.id == self.agent:
            (self._twins.appeared if up else self._twins.gone)(peer)

    def _again(self, now_ns: int) -> list[Action]:
        """Begin another life after this one was replaced, once its successor is gone; nothing while it lives."""
        if self._twins.is_alive("agent", self.agent) or self._alone_since_ns is None:
            self._alone_since_ns = now_ns
        if now_ns - self._alone_since_ns < _ALONE_NS:
            return []
        self._alone_since_ns = None
        self._known_life = max(self._known_life, self.holdings.newest)
        self.holdings.end()
        return [AskKnown()]

    def _known(self, agent: str) -> tuple[int, list[int]]:
        """The greatest life of an agent in any stored table, and the plots that grant cells to its vehicles or keep
        some of an earlier life shut."""
        stored = {plot: table for plot, (_, table) in self._saved.items()}
        stored.update((plot, member.stored) for plot, member in self._members.items())
        life = max((table.hosts.get(agent, (0, 0))[0] for table in stored.values()), default=0)
        return life, sorted(
            plot
            for plot, table in stored.items()
            if any(agent_of(vehicle) == agent for vehicle in table.grants)
            or any(shut.agent == agent for shut in table.shut)
        )

    def leads(self, plot: int) -> bool:
        """Whether we are the plot's warden, as far as we know."""
        member = self._members.get(plot)
        return member is not None and member.warden is not None

    # --- what is heard --------------------------------------------------------------------------------------

    def hear_standing(self, standing: Standing, now_ns: int) -> None:
        member = self._member(standing.plot, now_ns)
        if member is not None and standing.agent in self._spawns:
            member.hear_standing(standing, now_ns)

    def hear_table(self, table: Table, now_ns: int) -> list[Action]:
        member = self._member(table.plot, now_ns)
        return [] if member is None else [*member.hear_table(table, now_ns)]

    def hear_stored(self, stored: Stored, now_ns: int) -> list[Action]:
        member = self._members.get(stored.plot)
        return [] if member is None else [*member.hear_stored(stored, now_ns)]

    def hear_granted(self, granted: Granted, now_ns: int) -> list[str]:
        """A warden's word to us. Returns the vehicles that have found their place."""
        if not self.holdings.life or granted.plot not in self.holdings.plots:
            return []
        placed = self.holdings.hear_granted(granted, self._place, now_ns)
        if self.holdings.heard_ns(granted.plot) == now_ns:
            self._led_ns[granted.plot] = now_ns
        return placed

    def hear_claim(self, plot: int, epoch: int, now_ns: int) -> list[Action]:
        """Another member asks for our promise: `Save`, then the table to answer with; or nothing."""
        member = self._member(plot, now_ns)
        return [] if member is None else [*member.hear_claim(epoch, now_ns)]

    def hear_promise(self, member: str, epoch: int, table: Table, now_ns: int) -> None:
        seat = self._members.get(table.plot)
        if seat is not None:
            seat.hear_promise(member, epoch, table, now_ns)

    # --- time passes ----------------------------------------------------------------------------------------

    def tick(self, wishes: Mapping[str, Wish], now_ns: int) -> list[Action]:
        """What our members and our vehicles have to say now."""
        actions: list[Action] = [Refused(text) for text in self.holdings.refused]
        self.holdings.refused.clear()
        for member in () if self.silent else self._members.values():
            actions += member.tick(now_ns)
        if self.holdings.replaced:
            self.holdings.watch(self._known(self.agent)[1])
        if self.holdings.life:
            actions += self.holdings.standings(wishes, now_ns)
        if self.holdings.replaced:
            actions += self._again(now_ns)
        return actions

    def unled(self, now_ns: int) -> dict[int, str]:
        """Why vehicles of ours wait: plot -> that no warden of it is heard."""
        plots = self.holdings.plots
        self._led_ns = {plot: self._led_ns.get(plot, now_ns) for plot in plots}
        found = {}
        for plot, heard_ns in self._led_ns.items():
            if now_ns - heard_ns > _UNLED_NS and (vehicles := self.holdings.waiting(plot)):
                members = self.plots.members(plot)
                found[plot] = (
                    f"plot {plot} has no warden: {len(vehicles)} of our vehicles there wait until "
                    f"{self.plots.majority} of its members {', '.join(members)} run and reach each other and us"
                )
        return found

    def _member(self, plot: int, now_ns: int) -> Member | None:
        """Our seat in a plot; None where we have none, or the other members have not all noted our file: then it is
        not known to be the first, and what was promised in the first is not in it."""
        if self.silent:
            return None
        known = self._members.get(plot)
        if known is not None or not 0 <= plot < self.plots.count:
            return known
        members = self.plots.members(plot)
        if self.agent not in members or not {self.agent, *self.own.noted_by}.issuperset(members):
            return None
        promised, stored = self._saved.get(plot) or (0, self._at_start(plot))
        made = self._members[plot] = Member(self.plots, self.agent, promised, stored, self._spawns, now_ns)
        return made

    def _at_start(self, plot: int) -> Table:
        """The table from before any warden: vehicles stand where the run begins."""
        grants = {
            vehicle: Grant([cell], (0, 0))
            for fleet in self._spawns.values()
            for vehicle, cell in fleet.items()
            if self.plots.of(cell) == plot
        }
        return Table(plot=plot, agent=self.agent, epoch=0, seq=0, hosts={}, grants=grants)
