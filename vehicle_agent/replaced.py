"""A life that has stopped because a younger one was named: whether there is one. Pure."""

from __future__ import annotations

from swarm.clock import NS_PER_S
from swarm.wire.messages.processes import RunInfo

_FIRST_NS = NS_PER_S // 2
_AGAIN_NS = 5 * NS_PER_S


class Replaced:
    """Asks, as long as this life stands still, whether another process answers for its agent.

    To stop takes no proof, as two lives must never both drive; to stay stopped does, as one damaged message would
    stop the vehicles for good. If no other process answers, a new life begins here. It is younger than what was
    named, so another that could not answer just then stops when it hears of it.
    """

    def __init__(self) -> None:
        self._due_ns: int | None = None
        """When to ask; None while this life drives, or an answer is awaited."""
        self._awaits = False
        self._other = False

    def ask_due(self, now_ns: int) -> bool:
        """Whether to ask now. Called as long as a younger life is said to drive."""
        if self._awaits:
            return False
        if self._due_ns is None:
            self._due_ns = now_ns + _FIRST_NS
        self._awaits = now_ns >= self._due_ns
        return self._awaits

    def heard(self, answer: RunInfo, own: RunInfo) -> None:
        """An answer from a process of our id, which may be ourselves."""
        same_run = (answer.run_id, answer.terrain) == (own.run_id, own.terrain)
        self._other = self._other or (same_run and answer.incarnation != own.incarnation)

    def ended(self, now_ns: int) -> bool:
        """All who could answer have. Whether no other process answers for our agent."""
        alone, self._other, self._awaits = not self._other, False, False
        self._due_ns = None if alone else now_ns + _AGAIN_NS
        return alone
