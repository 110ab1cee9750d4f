"""With whom an agent comes to terms about cells: whoever shares a plot with it, and two witnesses.

An agent's ground are the plots (64 x 64 cells) in which its vehicles may claim cells. Before it claims anything in
a plot, it tells every live agent, and each must have answered. An answer carries the other's own ground. So of two
agents in one plot each knows of the other before it claims anything there: had B not been in the plot when it
answered A, it came later, knew of A by then, and cannot claim before A has answered, too. Whoever shares no plot
need not be waited for and is not listened to: what claims cost grows with the neighbours, not with the swarm.

Two witnesses, the next two live agents in the order of the run, are waited for like neighbours. So somebody knows
where the vehicles of an agent stand that drove alone and died. Who comes into a dead agent's plot first asks
everybody for its last words: until all who live have answered, and somebody knew them, the plot stays closed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Grounds

PLOT_CELLS = 64
"""Side of a plot. Smaller ones have fewer neighbours on them, and are entered more often."""
_ASK_AGAIN_NS = NS_PER_S // 5


@dataclass(frozen=True, slots=True)
class _Known:
    """An agent's ground as it last told; seq 0 while it has not put its vehicles anywhere."""

    incarnation: int
    seq: int
    plots: frozenset[int]


class SharedGround:
    """One agent's ground beside everybody else's.

    agents     all of the run, in the order by which witnesses are found
    witnesses  how many there are of each

    heard_from  whose claims concern us: neighbours, dead or alive, our witnesses, and those whose witness we are
    echoed_by   those who must have echoed a want of ours: neighbours and witnesses
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
        self._since: dict[int, int] = {}  # plot -> the question from which on it is ours
        self._others: dict[str, _Known] = {}
        self._agreed: dict[str, tuple[int, int]] = {}  # agent -> (its incarnation, our seq that it answered)
        self._alive: dict[str, int] = {}
        self._dead: frozenset[str] = frozenset()
        self._settled: frozenset[int] = frozenset()
        self._asked_ns: int | None = None

    # --- what changes ---------------------------------------------------------------------------------------

    def wish(self, plots: frozenset[int]) -> None:
        """Make these our ground. Give up a plot only when nothing there is held or wanted any more."""
        if plots == self.plots:
            return
        self._seq += 1
        self._since = {plot: self._since.get(plot, self._seq) for plot in plots}
        self.plots = plots
        self._asked_ns = None
        self._conclude()

    def set_alive(self, agents: Mapping[str, int]) -> None:
        """Which agents live, and in which incarnation."""
        alive = {agent: incarnation for agent, incarnation in agents.items() if agent != self.agent}
        if alive == self._alive:
            return
        self._alive = alive
        # Whoever was away may have missed what we told: it has to agree anew.
        self._agreed = {agent: each for agent, each in self._agreed.items() if alive.get(agent) == each[0]}
        self._mourn()
        self._asked_ns = None
        self._conclude()

    def ask_anew(self) -> None:
        """Our link was down: what others told meanwhile did not reach us."""
        self._agreed = {}
        self._asked_ns = None
        self._conclude()

    def told(self, grounds: Grounds) -> None:
        """Another agent's ground, in its question or its answer; of one agent the newest counts."""
        known = self._others.get(grounds.agent)
        if grounds.agent == self.agent or grounds.seq == 0:
            return
        if known is not None and (grounds.incarnation, grounds.seq) <= (known.incarnation, known.seq):
            return
        self._others[grounds.agent] = _Known(grounds.incarnation, grounds.seq, frozenset(grounds.plots))
        self._mourn()
        self._conclude()

    def answered(self, grounds: Grounds, seq: int) -> None:
        """An agent's answer to our question of this number."""
        if grounds.agent == self.agent or seq > self._seq:
            return
        self.told(grounds)
        incarnation, agreed = self._agreed.get(grounds.agent, (grounds.incarnation, -1))
        if grounds.incarnation >= incarnation:
            agreed = agreed if grounds.incarnation == incarnation else -1
            self._agreed[grounds.agent] = (grounds.incarnation, max(seq, agreed))
            self._conclude()

    def _mourn(self) -> None:
        """Of who has died on our ground we need the last words: nothing there is settled before all were asked."""
        dead = frozenset(id for id, known in self._others.items() if self._alive.get(id) != known.incarnation)
        lost = [id for id in sorted(dead - self._dead) if self._others[id].plots & self.plots]
        self._dead = dead
        if lost:
            self._seq += 1
            for id in lost:
                for plot in self._others[id].plots & self.plots:
                    self._since[plot] = self._seq
            self._asked_ns = None

    def _conclude(self) -> None:
        agreed = min(
            (self._agreed_seq(id, incarnation) for id, incarnation in self._alive.items()), default=1 << 62
        )
        self._settled = frozenset(plot for plot, since in self._since.items() if since <= agreed)
        neighbours = {id for id in self._alive if self._is_neighbour(id)}
        self.echoed_by = frozenset(neighbours.union(self._next_placed(1)))
        # Of those who are said to be dead: should one live all the same, we had better know where it drives.
        dead = (id for id in self._dead if self._others[id].plots & self.plots)
        self.heard_from = self.echoed_by.union(self._next_placed(-1), dead)

    def _agreed_seq(self, agent: str, incarnation: int) -> int:
        known, seq = self._agreed.get(agent, (incarnation, -1))
        return seq if known == incarnation else -1

    def _is_neighbour(self, agent: str) -> bool:
        """Whether a live agent shares ground with us, as far as we know: of whom we know nothing we take it."""
        known = self._others.get(agent)
        if known is None or known.incarnation != self._alive[agent]:
            return agent not in self._agreed  # it has answered and has no ground yet
        return bool(known.plots & self.plots)

    def _next_placed(self, step: int) -> list[str]:
        """Along the order of the run: our witnesses after us (1), those whose witness we are before us (-1)."""
        if self.agent not in self._agents:
            return []
        at = self._agents.index(self.agent)
        around = (self._agents[at + 1 :] + self._agents[:at])[::step]
        return [id for id in around if self._placed(id)][: self._witnesses]

    def _placed(self, agent: str) -> bool:
        known = self._others.get(agent)
        return known is not None and self._alive.get(agent) == known.incarnation

    # --- what one may ask -----------------------------------------------------------------------------------

    def plot_of(self, cell: int) -> int:
        """Plots are counted row by row, as regions are."""
        row, col = self._grid.row_col(cell)
        return row // PLOT_CELLS * -(-self._grid.cols // PLOT_CELLS) + col // PLOT_CELLS

    def settled(self, plot: int) -> bool:
        """Whether everybody who lives knows that this plot is ours."""
        return plot in self._settled

    def dead_in(self, plot: int) -> list[tuple[str, int]]:
        """(agent, incarnation) of those who died with this plot in their ground."""
        known = ((id, self._others[id]) for id in sorted(self._dead))
        return [(id, each.incarnation) for id, each in known if plot in each.plots]

    def is_far(self, agent: str) -> bool:
        """Whether a live agent has told its ground, and its claims are none of our concern."""
        return self._placed(agent) and agent not in self.heard_from

    def question(self, now_ns: int) -> Grounds | None:
        """What to ask everybody now; None if all who live have answered the newest question."""
        if all(self._agreed_seq(id, incarnation) >= self._seq for id, incarnation in self._alive.items()):
            return None
        if self._asked_ns is not None and now_ns - self._asked_ns < _ASK_AGAIN_NS:
            return None
        self._asked_ns = now_ns
        silent = [id for id in sorted(self._dead) if self._others[id].plots & self.plots]
        return self._ours(silent=silent)

    def answer(self) -> Grounds:
        """Our own ground, without anybody's last words."""
        return self._ours()

    def _ours(self, silent: Sequence[str] = ()) -> Grounds:
        return Grounds(
            agent=self.agent,
            incarnation=self.incarnation,
            seq=self._seq,
            plots=sorted(self.plots),
            silent=list(silent),
        )
