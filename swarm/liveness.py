"""Which processes are alive and which leases have run out. Pure: time is an argument."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, order=True)
class Peer:
    """One incarnation of one process. A later incarnation of the same (role, id) replaces the earlier."""

    role: str
    id: str
    incarnation: int


class Roster:
    """The peers whose liveliness tokens are up.

    A token of a new incarnation may appear before that of the old one falls, so all incarnations of a process are
    kept, and the order in which tokens come and go does not matter. Repeated and unknown ones change nothing.
    """

    def __init__(self) -> None:
        self._alive: dict[tuple[str, str], list[int]] = {}
        """(role, id) -> incarnations whose token is up, rising; without processes that have none."""

    def appeared(self, peer: Peer) -> None:
        """A token is up."""
        incarnations = self._alive.setdefault((peer.role, peer.id), [])
        if peer.incarnation not in incarnations:
            incarnations.append(peer.incarnation)
            incarnations.sort()

    def gone(self, peer: Peer) -> None:
        """A token has fallen."""
        incarnations = self._alive.get((peer.role, peer.id), [])
        if peer.incarnation in incarnations:
            incarnations.remove(peer.incarnation)
        if not incarnations:
            self._alive.pop((peer.role, peer.id), None)

    def alive(self, role: str) -> dict[str, int]:
        """Id -> newest incarnation of the live processes of a role, in order of id."""
        return {id: incarnations[-1] for (r, id), incarnations in sorted(self._alive.items()) if r == role}

    def is_alive(self, role: str, id: str) -> bool:
        """Whether any incarnation of the process is alive."""
        return (role, id) in self._alive


class Leases:
    """When each key was last heard of. `expired` forgets keys that have been silent for longer than the lease."""

    def __init__(self, lease_ns: int) -> None:
        self._lease_ns = lease_ns
        self._heard_ns: dict[str, int] = {}

    def heard(self, key: str, now_ns: int) -> None:
        """Renew the lease of a key."""
        self._heard_ns[key] = now_ns

    def expired(self, now_ns: int) -> list[str]:
        """The keys whose lease has run out since the last call, in the order in which they were first heard."""
        late = [key for key, heard_ns in self._heard_ns.items() if now_ns - heard_ns > self._lease_ns]
        for key in late:
            del self._heard_ns[key]
        return late


SUCCESSION_LEASE_NS = 1_000_000_000


class Succession:
    """Which of the numbered values that are heard under a key counts, whatever the clocks of its senders.

    A value counts if its (life, seq) is higher than that of the last which counted, or if none has counted for the
    lease. So a sender that restarts with an earlier clock is followed after the lease, and no single value with a
    huge number outweighs those that follow it.
    """

    def __init__(self, lease_ns: int = SUCCESSION_LEASE_NS) -> None:
        self._lease_ns = lease_ns
        # Key -> (life, seq) of the last value that counted, and when it was heard.
        self._last: dict[str, tuple[tuple[int, int], int]] = {}

    def accepts(self, key: str, life: int, seq: int, now_ns: int) -> bool:
        """Whether a value counts. If so it is the last one from now on."""
        known = self._last.get(key)
        if known is not None and (life, seq) <= known[0] and now_ns - known[1] <= self._lease_ns:
            return False
        self._last[key] = ((life, seq), now_ns)
        return True
