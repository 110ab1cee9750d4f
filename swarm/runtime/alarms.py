"""What a process wants people to know. It says so again with each `Stats`, so that whoever comes late knows it.

Pure: time is an argument.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable

import msgspec

from swarm.wire.fields import MOST_TEXT
from swarm.wire.messages.processes import Alarm

_MOST_STANDING, _MOST_OVER = 40, 20


class Alarms:
    """The alarms of one process: those that last, 40 at most, and the newest 20 that are over."""

    def __init__(self, before: Iterable[Alarm] = ()) -> None:
        self._standing: dict[tuple[str, str], Alarm] = {}
        """(kind, about) -> what lasts. What lasted in an earlier life lasts no longer: this one says it anew."""
        self._over: deque[Alarm] = deque((each for each in before if each.over_ns is not None), maxlen=_MOST_OVER)

    def happened(
        self, kind: str, about: str, text: str, now_ns: int, cell: int | None = None, target: str | None = None
    ) -> None:
        """Something happened that is over at once, as a collision."""
        self._over.append(
            Alarm(
                kind=kind, about=about[:100], text=text[:MOST_TEXT], since_ns=now_ns, over_ns=now_ns,
                cell=cell, target=target,
            )
        )  # fmt: skip

    def begin(
        self, kind: str, about: str, text: str, now_ns: int, cell: int | None = None, target: str | None = None
    ) -> None:
        """Something lasts from now on; said again, only its words and its place change."""
        known = self._standing.get((kind, about))
        if known is None and len(self._standing) >= _MOST_STANDING:
            return
        since_ns = now_ns if known is None else known.since_ns
        self._standing[kind, about] = Alarm(
            kind=kind, about=about[:100], text=text[:MOST_TEXT], since_ns=since_ns, cell=cell, target=target
        )

    def end(self, kind: str, about: str, now_ns: int) -> None:
        """It is over; nothing happens if it did not last."""
        known = self._standing.pop((kind, about), None)
        if known is not None:
            self._over.append(msgspec.structs.replace(known, over_ns=max(now_ns, known.since_ns)))

    def last_of(self, kind: str, abouts: Collection[str], now_ns: int) -> None:
        """Of this kind only these last: all others are over."""
        for standing, about in list(self._standing):
            if standing == kind and about not in abouts:
                self.end(kind, about, now_ns)

    def told(self) -> list[Alarm]:
        """What lasts, then what is over, each in order of time."""
        return [*sorted(self._standing.values(), key=lambda alarm: alarm.since_ns), *self._over]
