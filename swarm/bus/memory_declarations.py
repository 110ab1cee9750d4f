"""What nodes of the simulated network hear: their subscriptions and queryables, by topic and key."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from swarm.bus.bus import Event, Heard, HeardMany, Post
from swarm.errors import ProtocolError
from swarm.wire.topics import Topic

if TYPE_CHECKING:
    from swarm.bus.memory_bus import MemoryBus


@dataclass(eq=False, slots=True)
class Declaration:
    """One subscription or queryable of one bus. `narrow` holds the fields of its key that are no wildcard."""

    bus: MemoryBus
    narrow: dict[str, str]
    post: Post

    def meets(self, fields: Mapping[str, str]) -> bool:
        """Whether this and another key of the topic, either with wildcards, can name the same value."""
        for name, chunk in self.narrow.items():  # noqa: SIM110 (`all` with a generator costs a simulation time)
            if fields[name] not in (chunk, "*"):
                return False
        return True


def declare(bus: MemoryBus, topic: Topic, fields: Mapping[str, str | int], post: Post) -> Declaration:
    return Declaration(bus, narrowed(topic, fields), post)


def narrowed(topic: Topic, fields: Mapping[str, str | int]) -> dict[str, str]:
    """The fields of a key expression that are no wildcard. Raises TypeError and ValueError as `Topic.every`."""
    return {name: chunk for name, chunk in topic.every(fields).items() if chunk != "*"}


class Subscriptions:
    """The subscriptions of one topic.

    Those without wildcards are looked up by their key: a hundred vehicles each listen to one of their own.
    """

    def __init__(self) -> None:
        self._wide: list[Declaration] = []
        self._exact: dict[tuple[str, ...], list[Declaration]] = {}

    def add(self, declaration: Declaration, topic: Topic) -> None:
        if len(declaration.narrow) == len(topic.fields):
            self._exact.setdefault(tuple(declaration.narrow.values()), []).append(declaration)
        else:
            self._wide.append(declaration)

    def remove(self, bus: MemoryBus, narrow: Mapping[str, str] | None = None) -> None:
        """Forget the subscriptions of a bus: all, or those with exactly these fields."""

        def goes(declaration: Declaration) -> bool:
            return declaration.bus is bus and (narrow is None or declaration.narrow == narrow)

        self._wide = [declaration for declaration in self._wide if not goes(declaration)]
        for key, declarations in list(self._exact.items()):
            self._exact[key] = [declaration for declaration in declarations if not goes(declaration)]

    def find(self, fields: Mapping[str, str]) -> list[Declaration]:
        """Those that a value with these fields reaches: first the ones with wildcards, each kind in the order of
        its declaration. A replayed run depends on this order."""
        found = [declaration for declaration in self._wide if declaration.meets(fields)]
        return found + self._exact.get(tuple(fields.values()), [])


def checking_key(post: Post, counts: dict[str, int]) -> Post:
    """Drops and counts messages whose sender differs from their key."""

    def checked(event: Event) -> None:
        if isinstance(event, Heard):
            try:
                event.topic.check_key(event.fields, event.message)
            except ProtocolError:
                counts["payloads_dropped"] += 1
                return
        post(event)

    return checked


def as_batches(post: Post) -> Post:
    """Makes a `HeardMany` of each sample: in a simulation nothing waits, so each comes alone."""

    def batched(event: Event) -> None:
        if isinstance(event, Heard):
            event = HeardMany(event.topic, [(event.topic.key.format(**event.fields), event.message)])
        post(event)

    return batched
