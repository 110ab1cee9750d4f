"""In which plots an agent may reserve cells, and which other agents that concerns.

The territory of an agent is the set of plots (64 x 64 cells) in which its vehicles may reserve cells. Before it
reserves anything in a new plot, it tells all live agents and waits until each has answered; an answer carries the
territory of the agent that answers. So of two agents with a plot in common each knows of the other before it
reserves anything there. Proof: suppose that B did not have the plot when it answered A. Then B took it later,
knew by then that A has it, and reserves nothing there before A has answered in turn.

Agents without a common plot neither wait for each other nor hear each other's reservations. So the cost of
reservations grows with the number of neighbours and not with the number of agents.

An agent that has a plot to itself has no neighbour that knows where its vehicles stand when it dies. So each agent
has two witnesses: the next two live agents in the order of the run, which hear its reservations and are waited for
as neighbours are. An agent that takes a plot of a dead agent asks all live agents for the dead one's newest
reservations. The plot stays closed until all have answered and one of them knew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Reservations, TerritoryReply, TerritoryRequest

PLOT_CELLS = 64
"""Side of a plot. In smaller plots an agent has fewer neighbours, and it enters them more often."""
_ASK_AGAIN_NS = NS_PER_S // 5


@dataclass(frozen=True, slots=True)
class _Known:
    """Another agent's territory, as it last told."""

    incarnation: int
    seq: int
    plots: frozenset[int]


class Territory:
    """One agent's territory beside those of all other agents.

    agents      all agents of the run, in the order by which witnesses are found
    witnesses   how many witnesses each agent has

    plots       our territory
    heard_from  agents whose reservations concern us: neighbours alive or dead, our witnesses, and the agents whose
                witness we are
    echoed_by   live agents that must echo our requests: neighbours and witnesses
    """

    def __init__(
        self, agent: str, incarnation: int, grid: GridSpec, agents: Sequence[str], witnesses: int = 2
    ) -> None:
        self.agent = agent
        self.incarnation = incarnation
        self.plots: frozenset[int] = frozenset()
        self.heard_from: frozenset[str] = frozenset()
        self.echoed_by: frozenset[str] = frozenset()
        self._grid = grid
        self._agents = list(agents)
        self._witnesses = witnesses
        self._seq = 0
        """Number of our newest question; it grows with each change of our territory."""
        self._since: dict[int, int] = {}
        """Plot -> the first question that names it."""
        self._others: dict[str, _Known] = {}
        self._answered_by: dict[str, tuple[int, int]] = {}
        """Agent -> (its incarnation, the newest question of ours that it answered)."""
        self._alive: dict[str, int] = {}
        self._dead: frozenset[str] = frozenset()
        """Agents whose territory is known and whose incarnation then is not alive."""
        self._agreed: frozenset[int] = frozenset()
        """The plots in which we may reserve cells."""
        self._asked_ns: int | None = None
        """When the newest question was sent; None to send it at once."""

    # --- what changes ---------------------------------------------------------------------------------------

    def set_plots(self, plots: frozenset[int]) -> None:
        """Make these our territory. Drop a plot only when nothing in it is held or requested any more."""
        if plots == self.plots:
            return
        self._seq += 1
        self._since = {plot: self._since.get(plot, self._seq) for plot in plots}
        self.plots = plots
        self._asked_ns = None
        self._update()

    def set_alive(self, agents: Mapping[str, int]) -> None:
        """Which agents live: agent -> incarnation."""
        alive = {agent: incarnation for agent, incarnation in agents.items() if agent != self.agent}
        if alive == self._alive:
            return
        self._alive = alive
        # An agent that was away may have missed what we told: it has to answer again.
        self._answered_by = {
            agent: each for agent, each in self._answered_by.items() if alive.get(agent) == each[0]
        }
        self._find_dead()
        self._asked_ns = None
        self._update()

    def ask_anew(self) -> None:
        """Our link was down: what others told meanwhile did not reach us, so all have to answer again."""
        self._answered_by = {}
        self._asked_ns = None
        self._update()

    def hear(self, told: TerritoryRequest | TerritoryReply) -> None:
        """Take in another agent's territory, from its question or its answer, if it is the newest of that agent."""
        if told.agent == self.agent or told.seq == 0:
            return
        known = self._others.get(told.agent)
        if known is not None and (told.incarnation, told.seq) <= (known.incarnation, known.seq):
            return
        self._others[told.agent] = _Known(told.incarnation, told.seq, frozenset(told.plots))
        self._find_dead()
        self._update()

    def answered(self, reply: TerritoryReply, seq: int) -> None:
        """Take in an agent's answer to our question number `seq`."""
        if reply.agent == self.agent or seq > self._seq:
            return
        self.hear(reply)
        incarnation, newest = self._answered_by.get(reply.agent, (reply.incarnation, -1))
        if reply.incarnation >= incarnation:
            newest = newest if reply.incarnation == incarnation else -1
            self._answered_by[reply.agent] = (reply.incarnation, max(seq, newest))
            self._update()

    def _find_dead(self) -> None:
        """Close the plots in which an agent has died: all have to be asked for its newest reservations first."""
        dead = frozenset(id for id, known in self._others.items() if self._alive.get(id) != known.incarnation)
        lost = [id for id in sorted(dead - self._dead) if self._others[id].plots & self.plots]
        self._dead = dead
        if lost:
            self._seq += 1
            for id in lost:
                for plot in self._others[id].plots & self.plots:
                    self._since[plot] = self._seq
            self._asked_ns = None

    def _update(self) -> None:
        """Derive what one may ask from what is known."""
        answered = min(
            (self._answered_seq(id, incarnation) for id, incarnation in self._alive.items()), default=1 << 62
        )
        self._agreed = frozenset(plot for plot, since in self._since.items() if since <= answered)
        neighbours = {id for id in self._alive if self._is_neighbour(id)}
        self.echoed_by = frozenset(neighbours.union(self._next_placed(1)))
        # An agent that is said to be dead may live all the same: its reservations are heard.
        dead = (id for id in self._dead if self._others[id].plots & self.plots)
        self.heard_from = self.echoed_by.union(self._next_placed(-1), dead)

    def _answered_seq(self, agent: str, incarnation: int) -> int:
        known, seq = self._answered_by.get(agent, (incarnation, -1))
        return seq if known == incarnation else -1

    def _is_neighbour(self, agent: str) -> bool:
        """Whether a live agent may have a plot in common with us; one of which nothing is known may."""
        known = self._others.get(agent)
        if known is None or known.incarnation != self._alive[agent]:
            return agent not in self._answered_by  # it has answered and has no territory yet
        return bool(known.plots & self.plots)

    def _next_placed(self, step: int) -> list[str]:
        """Our witnesses, which come after us in the order of the run (1), or the agents before us, whose witness we
        are (-1)."""
        if self.agent not in self._agents:
            return []
        at = self._agents.index(self.agent)
        around = (self._agents[at + 1 :] + self._agents[:at])[::step]
        return [id for id in around if self._is_placed(id)][: self._witnesses]

    def _is_placed(self, agent: str) -> bool:
        """Whether an agent is alive and has told its territory, so that its vehicles are placed."""
        known = self._others.get(agent)
        return known is not None and self._alive.get(agent) == known.incarnation

    # --- queries --------------------------------------------------------------------------------------------

    def plot_of(self, cell: int) -> int:
        """The plot of a cell. Plots are numbered row by row, as regions are."""
        row, col = self._grid.row_col(cell)
        return row // PLOT_CELLS * -(-self._grid.cols // PLOT_CELLS) + col // PLOT_CELLS

    def agreed(self, plot: int) -> bool:
        """Whether every live agent knows that this plot is in our territory."""
        return plot in self._agreed

    def dead_in(self, plot: int) -> list[tuple[str, int]]:
        """(agent, incarnation) of those that died with this plot in their territory."""
        known = ((id, self._others[id]) for id in sorted(self._dead))
        return [(id, each.incarnation) for id, each in known if plot in each.plots]

    def is_far(self, agent: str) -> bool:
        """Whether a live agent has told its territory, and its reservations are none of our concern."""
        return self._is_placed(agent) and agent not in self.heard_from

    def question(self, now_ns: int) -> TerritoryRequest | None:
        """What to ask all agents now; None if all have answered, or were asked a moment ago."""
        if all(self._answered_seq(id, incarnation) >= self._seq for id, incarnation in self._alive.items()):
            return None
        if self._asked_ns is not None and now_ns - self._asked_ns < _ASK_AGAIN_NS:
            return None
        self._asked_ns = now_ns
        silent = [id for id in sorted(self._dead) if self._others[id].plots & self.plots]
        return TerritoryRequest(
            agent=self.agent, incarnation=self.incarnation, seq=self._seq, plots=sorted(self.plots), silent=silent
        )

    def answer(self, of_the_dead: Sequence[Reservations] = ()) -> TerritoryReply:
        """Our territory, with the newest reservations that we have heard of the agents asked for."""
        return TerritoryReply(
            agent=self.agent,
            incarnation=self.incarnation,
            seq=self._seq,
            plots=sorted(self.plots),
            reservations=list(of_the_dead),
        )
