"""Things that are done again and again, each at its own pace. Pure: time is an argument."""

from __future__ import annotations

from collections.abc import Mapping

from swarm.clock import NS_PER_S


class Due:
    """When each of several things is done next.

    every_s  name -> seconds from one time to the next
    """

    def __init__(self, every_s: Mapping[str, float]) -> None:
        self._every_ns = {name: int(seconds * NS_PER_S) for name, seconds in every_s.items()}
        self._next_ns = dict.fromkeys(every_s, 0)

    def now(self, name: str, now_ns: int, slower: int = 1) -> bool:
        """Whether it is time; if so, the next time is counted from now, and comes so many times as late."""
        if now_ns < self._next_ns[name]:
            return False
        self._next_ns[name] = now_ns + slower * self._every_ns[name]
        return True
