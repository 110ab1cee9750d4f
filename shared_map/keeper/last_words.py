"""What processes that are gone had counted last: for whoever comes later, and would not know of them. Pure."""

from __future__ import annotations

from swarm.liveness import Peer, Roster
from swarm.wire.messages.processes import Stats

_MOST = 4096
"""Processes that are remembered."""


class LastWords:
    """The newest `Stats` of every process, of which those of the gone are asked for."""

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], Stats] = {}
        self._roster = Roster()

    def hear(self, stats: Stats) -> None:
        """A process has said what it counted."""
        key = (stats.role, stats.id)
        known = self._newest.get(key)
        if known is None and len(self._newest) >= _MOST:
            return
        if known is None or (stats.incarnation, stats.stamp_ns) >= (known.incarnation, known.stamp_ns):
            self._newest[key] = stats

    def alive(self, peer: Peer, up: bool) -> None:
        """A liveliness token rose or fell."""
        if up:
            self._roster.appeared(peer)
        else:
            self._roster.gone(peer)

    def of_the_gone(self) -> list[Stats]:
        """What processes said last which are not alive, in order."""
        return [stats for key, stats in sorted(self._newest.items()) if not self._roster.is_alive(*key)]
