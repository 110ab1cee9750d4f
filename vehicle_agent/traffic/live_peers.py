"""Which agents and planners live, and whether we can know it at all."""

from __future__ import annotations

from swarm.clock import NS_PER_S
from swarm.liveness import Peer, Roster

_GRACE_NS = NS_PER_S // 2
"""An agent whose token fell counts as alive for so long: if our own link is cut, its tokens fall first and word of
the link comes later."""


class LivePeers:
    """The peers whose liveliness tokens are up, with a grace period for agents.

    lease_ns  after a change of our link, tokens tell nothing for so long
    """

    def __init__(self, lease_ns: int) -> None:
        self._lease_ns = lease_ns
        self._roster = Roster()
        self._grace_ends_ns: dict[str, int] = {}
        """Agent -> until when it counts as alive though its token fell."""
        self._link_up = True
        self._trusted_from_ns = 0

    def appeared(self, peer: Peer) -> None:
        self._roster.appeared(peer)
        if peer.role == "agent":
            self._grace_ends_ns.pop(peer.id, None)

    def disappeared(self, peer: Peer, now_ns: int) -> None:
        self._roster.gone(peer)
        if peer.role == "agent" and not self._roster.is_alive("agent", peer.id):
            self._grace_ends_ns[peer.id] = now_ns + _GRACE_NS

    def link_changed(self, up: bool, beyond: bool, now_ns: int) -> None:
        """Our link, or with `beyond` one between routers, came up or went down.

        A link beyond does not bring our own back: word of it may be read after our own has gone.
        """
        self._link_up = self._link_up if beyond else up
        self._trusted_from_ns = now_ns + self._lease_ns

    def expire(self, now_ns: int) -> bool:
        """End the grace periods that are over; True if any was."""
        over = [agent for agent, ends_ns in self._grace_ends_ns.items() if ends_ns <= now_ns]
        for agent in over:
            del self._grace_ends_ns[agent]
        return bool(over)

    def trusted(self, now_ns: int) -> bool:
        """Whether tokens tell who lives. If not, no vehicle may enter a new cell: we may not hear of rivals."""
        return self._link_up and now_ns >= self._trusted_from_ns

    @property
    def planners(self) -> dict[str, int]:
        """Target -> incarnation of its planner."""
        return self._roster.alive("planner")

    @property
    def agents_up(self) -> dict[str, int]:
        """Agent -> incarnation, of those whose token is up."""
        return self._roster.alive("agent")

    @property
    def agents(self) -> dict[str, int]:
        """Agent -> incarnation, of those to wait for; 0 of one in its grace period, so that nothing it says counts
        as a reply."""
        agents = self._roster.alive("agent")
        for agent in self._grace_ends_ns:
            agents.setdefault(agent, 0)
        return agents
