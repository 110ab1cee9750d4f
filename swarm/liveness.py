"""Who is alive, whose lease ran out. Pure: time is an argument."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, order=True)
class Peer:
    """One incarnation of one process. A later incarnation of the same (role, id) replaces the earlier."""

    role: str
    id: str
    incarnation: int


class Roster:
    """The peers whose tokens are up. The order of tokens coming and going does not matter."""

    def __init__(self) -> None:
        self._alive: dict[tuple[str, str], list[int]] = {}

    def appeared(self, peer: Peer) -> None:
        incarnations = self._alive.setdefault((peer.role, peer.id), [])
        if peer.incarnation not in incarnations:
            incarnations.append(peer.incarnation)
            incarnations.sort()

    def gone(self, peer: Peer) -> None:
        incarnations = self._alive.get((peer.role, peer.id), [])
        if peer.incarnation in incarnations:
            incarnations.remove(peer.incarnation)
        if not incarnations:
            self._alive.pop((peer.role, peer.id), None)

    def alive(self, role: str) -> dict[str, int]:
        """Id -> newest incarnation of the live processes of a role, in order of id."""
        return {id: incarnations[-1] for (r, id), incarnations in sorted(self._alive.items()) if r == role}

    def is_alive(self, role: str, id: str) -> bool:
        return (role, id) in self._alive


class Leases:
    """When each key was last heard of; `expired` names and forgets those silent for longer than the lease."""

    def __init__(self, lease_ns: int) -> None:
        self._lease_ns = lease_ns
        self._seen_ns: dict[str, int] = {}

    def heard(self, key: str, now_ns: int) -> None:
        self._seen_ns[key] = now_ns

    def holds(self, key: str, now_ns: int) -> bool:
        seen_ns = self._seen_ns.get(key)
        return seen_ns is not None and now_ns - seen_ns <= self._lease_ns

    def expired(self, now_ns: int) -> list[str]:
        late = [key for key, seen_ns in self._seen_ns.items() if now_ns - seen_ns > self._lease_ns]
        for key in late:
            del self._seen_ns[key]
        return late
