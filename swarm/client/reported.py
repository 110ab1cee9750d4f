"""The reports of a program about a vehicle or target of its own: its place, repeated until it leaves."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from swarm.bus.bus import Event
from swarm.client.session import Session
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.wire.topics import Topic

R = TypeVar("R", bound="Reported")


class Reported:
    """One thing under an id of its own. Use it in a `with`, or `leave`.

    incarnation  when it joined, in ns: tells it from an earlier generation under the same id
    """

    def __init__(self, session: Session, topic: Topic, kind: str, id: str, lease_s: float, repeat_ns: int) -> None:
        """Does not take part before `_join`.

        kind       the noun for it in sentences
        repeat_ns  time from a word to its repetition; a fourth of the lease if that is shorter
        """
        self.id = id
        self.lease_s = lease_s
        self.incarnation = session.now_ns()
        self._session = session
        self._topic = topic
        self._kind = kind
        self._key: dict[str, Any] = {topic.fields[-1]: id}
        self._repeat_ns = min(repeat_ns, int(lease_s * NS_PER_S / 4))
        self._word: Any = None
        """The message that was said last; None before the first, and once it has left."""
        self._seq = 0
        self._repeat_due_ns = 0

    def _join(self) -> None:
        """Takes part from now on: the last step of its making, as events and ticks come on another thread.

        Raises ConfigError where the id is in use in this program.
        """
        self._session.add(self)
        self._session.bus.subscribe(self._topic, self._session.post, **self._key)

    def __enter__(self: R) -> R:
        return self

    def __exit__(self, *_: object) -> None:
        self.leave()

    def on_event(self, event: Event, now_ns: int) -> None:
        raise NotImplementedError

    def _cell_at(self, x_m: float, y_m: float) -> int:
        """The cell of a place. Raises ConfigError, counted, on a cell outside the terrain and on a value that is
        not a number."""
        try:
            return self._session.frame.cell(x_m, y_m)
        except ConfigError as error:
            raise self._session.refused(f"{self._kind} {self.id}: {error}") from None

    def _say(self, x_m: float, y_m: float, **fields: Any) -> None:
        """Publishes a word. Raises ConfigError, counted, on fields beyond their bounds: the word before stands."""
        now_ns = self._session.now_ns()
        word = self._topic.message(
            **self._key,
            **fields,
            incarnation=self.incarnation,
            seq=self._seq + 1,
            stamp_ns=now_ns,
            x_m=float(x_m),
            y_m=float(y_m),
            lease_s=self.lease_s,
        )
        self._word = self._session.publish(self._topic, word, **self._key)
        self._seq += 1
        self._repeat_due_ns = now_ns + self._repeat_ns

    def _repeat(self, now_ns: int, **changes: Any) -> None:
        self._repeat_due_ns = now_ns + self._repeat_ns
        self._seq += 1
        self._word = msgspec.structs.replace(self._word, seq=self._seq, stamp_ns=now_ns, **changes)
        self._session.bus.publish(self._topic, self._word, **self._key)

    def tick(self, now_ns: int) -> None:
        if self._word is not None and now_ns >= self._repeat_due_ns:
            self._repeat(now_ns)

    def leave(self) -> None:
        """Takes it away: others know at once. May be repeated."""
        session = self._session
        with session.lock:
            if self._word is not None and session.ended is None:
                self._repeat(session.now_ns(), lease_s=0.0)
            self._word = None
            session.bus.unsubscribe(self._topic, **self._key)
            session.remove(self)
