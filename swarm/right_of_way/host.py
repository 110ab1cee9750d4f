"""One host of vehicles in right of way: its lives, and the cells that its vehicles hold
(docs/design/right-of-way.md, Lives)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.liveness import Peer, Roster
from swarm.right_of_way.holdings import Holdings, Tell, Wish
from swarm.right_of_way.incarnations import first_life, is_far_ahead
from swarm.right_of_way.lock_regions import Plots
from swarm.wire.messages.traffic import Granted, Left, Word

LIVES_KEPT = 32
"""Numbers of lives on file, as many as a `Standing` has room for."""
_ALONE_NS = NS_PER_S // 2
"""A life that has been replaced begins again once no other process of its host has been alive for so long."""
_UNLED_NS = 2 * NS_PER_S
"""A plot that is silent for so long has no warden; another one takes over within a second where it can."""


@dataclass(frozen=True, slots=True)
class AskKnown:
    """Ask all agents what they have on file about this host, then begin a life."""


class Host:
    """A host's part in right of way; whether it is also a member of plots is nothing to it.

    name  of the agent or guest

    holdings  which cells our vehicles hold: none before `begin`
    """

    def __init__(self, plots: Plots, name: str, vehicles: Collection[str] | None) -> None:
        self.name = name
        self.plots = plots
        self.holdings = Holdings(plots, name, vehicles)
        self._known_life = 0
        self._told_by: set[str] = set()
        """Agents that have sent us their knowledge of us."""
        self._twins = Roster()
        self._alone_since_ns: int | None = None
        self._led_ns: dict[int, int] = {}
        """Plot that concerns us -> when its warden was heard last."""

    def hear_known(self, agent: str, life: int, plots: Sequence[int]) -> None:
        """An agent has tables that name this life of ours, and plots which concern us."""
        self._told_by.add(agent)
        if not is_far_ahead(life, self._known_life):
            self._known_life = max(self._known_life, life)
        self.holdings.watch([plot for plot in plots if plot in self.plots.all])

    @property
    def informed(self) -> bool:
        """True if we know every plot in which cells are granted to us: of each plot enough members have replied
        that one of them has the newest usable table."""
        if self._told_by.issuperset(self.plots.agents):
            return True
        every = map(self.plots.members, self.plots.all)
        enough = self.plots.liars - self.plots.majority
        return all(len(self._told_by.intersection(of)) > len(of) + enough for of in every)

    def begin(self, dead: Sequence[int], chance: int) -> list[int]:
        """Begins a new life, once those who could be asked have answered. Returns the lives to keep on file;
        nothing may be said before they are.

        dead    our lives that are on the file which this process has locked: they have ended
        chance  a random number
        """
        life = first_life(max(self._known_life, *dead, 0), chance)
        self.holdings.begin(life, dead)
        return [*dead[1 - LIVES_KEPT :], life]

    def hear_granted(self, granted: Granted | Word, now_ns: int) -> list[str]:
        """A warden's grant, or a member's word on one. Returns the vehicles that have found their place."""
        if not self.holdings.life or granted.plot not in self.plots.all:
            return []
        if isinstance(granted, Word):
            return self.holdings.hear_word(granted)
        if granted.plot not in self.holdings.plots:
            return []
        placed = self.holdings.hear_granted(granted, now_ns)
        if self.holdings.heard_ns(granted.plot) == now_ns:
            self._led_ns[granted.plot] = now_ns
        return placed

    def hear_left(self, left: Left) -> list[str]:
        """Another host's word to us. Returns the vehicles that have found their place."""
        heard = left.host == self.name and self.holdings.life and not self.holdings.replaced
        return self.holdings.hear_left(left) if heard else []

    def have_left(self, vehicles: Iterable[str]) -> bool:
        """Returns True if these vehicles left in an earlier life: each plot which concerns us has answered this
        life, and none grants them a cell."""
        return self.informed and self.holdings.answered and not any(map(self.holdings.is_granted, vehicles))

    def hear_token(self, peer: Peer, *, up: bool) -> None:
        """The liveliness token of another process has risen or fallen."""
        if peer.id == self.name:
            (self._twins.appeared if up else self._twins.gone)(Peer("host", peer.id, peer.incarnation))

    def standings(self, wishes: Mapping[str, Wish], now_ns: int) -> list[Tell]:
        """Returns the statements of our vehicles to publish now."""
        return self.holdings.standings(wishes, now_ns) if self.holdings.life else []

    def lefts(self, now_ns: int) -> list[Left]:
        """Returns the words to publish now that vehicles of other hosts wait for."""
        return self.holdings.lefts(now_ns) if self.holdings.life and not self.holdings.replaced else []

    def ended_alone(self, now_ns: int) -> bool:
        """Returns True if a replaced life is to begin again, as its successor has ended. It holds and knows nothing
        then: send a recovery query, and `begin`."""
        if not self.holdings.replaced:
            return False
        if self._twins.is_alive("host", self.name) or self._alone_since_ns is None:
            self._alone_since_ns = now_ns
        if now_ns - self._alone_since_ns < _ALONE_NS:
            return False
        self._alone_since_ns = None
        self._known_life = max(self._known_life, self.holdings.newest)
        self.holdings.end()
        return True

    def unled(self, now_ns: int) -> dict[int, str]:
        """Reason why vehicles of ours wait: plot -> that no warden of it is heard."""
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
