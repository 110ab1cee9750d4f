"""Digests of others that still have to be compared with what is held. Pure: time is an argument."""

from __future__ import annotations

from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.liveness import Newest
from swarm.wire.messages.map_data import Digest

_GRACE_NS = NS_PER_S // 10
"""A digest may overtake the sets that it names: what is missing is asked for only this long after it came."""
_RETRY_NS = NS_PER_S * 15 // 100
_MAX_TRIES = 10
_MAX_SENDERS = 4096
_MAX_BYTES = 64 << 20
"""A digest that would exceed this is dropped: its sender repeats it within seconds."""


@dataclass(slots=True)
class PendingDigest:
    """
    due_ns  compare it then
    tries   how often it was compared
    """

    digest: Digest
    due_ns: int
    tries: int = 0

    @property
    def size(self) -> int:
        """Bytes in memory, about."""
        return 1000 + sum(map(len, self.digest.held.values())) + 100 * len(self.digest.held)


class PendingDigests:
    """The newest digest of each sender until nothing that it names is missing. Bounded in senders and bytes."""

    def __init__(self) -> None:
        # A sender here is (author, whole): a digest of late changes does not replace the last whole one.
        self._pending: dict[tuple[str, bool], PendingDigest] = {}
        self._bytes = 0  # sum of `size` of what is pending
        self._newest = Newest(_MAX_SENDERS)  # of the digests whose senders count them

    def add(self, digest: Digest, now_ns: int) -> bool:
        """Take in a digest; false if a newer one of the same sender overtook it."""
        sender = (digest.author, digest.whole)
        if digest.seq and not self._newest.is_news(sender, (0, digest.seq), now_ns):
            return False
        due_ns = now_ns + _GRACE_NS
        replaced = self._pending.get(sender)
        if replaced is not None:
            due_ns = min(replaced.due_ns, due_ns)
            self._drop(replaced)
        new = PendingDigest(digest, due_ns)
        if self._bytes + new.size <= _MAX_BYTES and len(self._pending) < _MAX_SENDERS:
            self._pending[sender] = new
            self._bytes += new.size
        return True

    def due(self, now_ns: int) -> list[PendingDigest]:
        """Those to compare now."""
        return [each for each in self._pending.values() if now_ns >= each.due_ns]

    def compared(self, pending: PendingDigest, complete: bool, now_ns: int) -> None:
        """It was compared: done if all that it names is held, else due again soon, ten times at most."""
        pending.tries += 1
        if complete or pending.tries > _MAX_TRIES:
            self._drop(pending)
        else:
            pending.due_ns = now_ns + _RETRY_NS

    def hasten(self, now_ns: int) -> None:
        """Compare all of them at once: a link has come back."""
        for pending in self._pending.values():
            pending.due_ns = now_ns

    def _drop(self, pending: PendingDigest) -> None:
        del self._pending[pending.digest.author, pending.digest.whole]
        self._bytes -= pending.size
