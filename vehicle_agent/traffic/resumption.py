"""What a starting agent gathers before it places its vehicles."""

from __future__ import annotations

from collections.abc import Mapping

from swarm.wire.messages.vehicles import Claims
from vehicle_agent.traffic.right_of_way import _stamp


class Resumption:
    """What a starting agent gathers before it puts its vehicles anywhere: everybody's claims, its own last ones
    among them."""

    def __init__(self, agent: str) -> None:
        self._agent = agent
        self._newest: dict[str, Claims] = {}
        self._answered: dict[str, Claims] = {}

    def heard(self, claims: Claims) -> None:
        known = self._newest.get(claims.agent)
        if claims.seq and (known is None or _stamp(claims) > _stamp(known)):
            self._newest[claims.agent] = claims

    def answered(self, claims: Claims) -> None:
        """As `heard`, of what came in reply to our question."""
        self.heard(claims)
        answered = self._answered.get(claims.agent)
        if answered is None or _stamp(claims) >= _stamp(answered):
            self._answered[claims.agent] = claims

    def complete(self, alive: Mapping[str, int]) -> bool:
        """Whether each live agent has answered, and the last words that any of them has heard have come through."""
        for agent, incarnation in alive.items():
            if agent == self._agent:
                continue
            claims = self._answered.get(agent)
            if claims is None or claims.incarnation != incarnation:
                return False
            for other, stamp in claims.seen.items():
                silent = other == self._agent or alive.get(other) != stamp[0]
                if silent and (other not in self._newest or _stamp(self._newest[other]) < tuple(stamp)):
                    return False
        return True

    @property
    def last_words(self) -> Claims | None:
        """The claims of our earlier incarnation, if anybody heard it."""
        return self._newest.get(self._agent)

    @property
    def others(self) -> list[Claims]:
        return [claims for agent, claims in self._newest.items() if agent != self._agent]
