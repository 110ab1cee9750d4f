"""What nodes of the simulated network hear: their subscriptions and queryables, by topic and key."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING

from swarm.bus.bus import Event, Heard, Post
from swarm.wire.topics import Topic

if TYPE_CHECKING:
    from swarm.bus.memory_bus import MemoryBus


@dataclass(eq=False, slots=True)
class Declaration:
    """One subscription or queryable of one bus.

    narrow    the fields of its key that are no wildcard
    post      a subscription without one keeps its samples until they are collected
    together  it posts a `HeardMany` of each sample: in a simulation nothing waits, so each comes alone
    """

    bus: MemoryBus
    narrow: dict[str, str]
    post: Post | None
    together: bool = False

    def meets(self, fields: Mapping[str, str]) -> bool:
        """Whether this and another key of the topic, either with wildcards, can name the same value."""
        for name, chunk in self.narrow.items():  # noqa: SIM110 (`all` with a generator costs a simulation time)
            if fields[name] not in (chunk, "*"):
                return False
        return True


def narrowed(topic: Topic, fields: Mapping[str, str | int]) -> dict[str, str]:
    """The fields of a key expression that are no wildcard. Raises TypeError and ValueError as `Topic.every`."""
    return {name: chunk for name, chunk in topic.every(fields).items() if chunk != "*"}


class Subscriptions:
    """The subscriptions of one topic, looked up by the values of the fields that they name.

    A topic has few such sets of fields, and hundreds of subscriptions: a hundred vehicles each listen to a key of
    their own, agents to each plot near them.
    """

    def __init__(self) -> None:
        self._count = 0
        self._found: dict[tuple[str, ...], list[Declaration]] = {}
        """Values of all fields of a key -> `find` of it, until a subscription comes or goes."""
        self._by_names: dict[tuple[str, ...], dict[tuple[str, ...], list[tuple[int, Declaration]]]] = {}
        """Names of the fields that are no wildcard -> their values -> (number of the declaration, subscription)."""

    def add(self, declaration: Declaration) -> None:
        self._found.clear()
        names, values = tuple(declaration.narrow), tuple(declaration.narrow.values())
        self._by_names.setdefault(names, {}).setdefault(values, []).append((self._count, declaration))
        self._count += 1

    def remove(self, bus: MemoryBus, narrow: Mapping[str, str] | None = None) -> None:
        """Forget the subscriptions of a bus: all, or those with exactly these fields."""
        self._found.clear()
        for names, by_values in self._by_names.items():
            if narrow is not None and names != tuple(narrow):
                continue
            for values in list(by_values) if narrow is None else [tuple(narrow.values())]:
                kept = [each for each in by_values.pop(values, ()) if each[1].bus is not bus]
                if kept:
                    by_values[values] = kept

    def find(self, fields: Mapping[str, str]) -> list[Declaration]:
        """Those that a value with these fields reaches: first the ones with wildcards, each kind in the order of
        its declaration. A replayed run depends on this order. The list is kept: nobody may change it."""
        key = tuple(fields.values())
        found = self._found.get(key)
        if found is None:
            found = self._found[key] = self._look_up(fields)
        return found

    def _look_up(self, fields: Mapping[str, str]) -> list[Declaration]:
        wide: list[tuple[int, Declaration]] = []
        exact: list[tuple[int, Declaration]] = []
        for names, by_values in self._by_names.items():
            found = by_values.get(tuple([fields[name] for name in names]), ())
            (exact if len(names) == len(fields) else wide).extend(found)
        return [declaration for _, declaration in sorted(wide, key=itemgetter(0)) + exact]


def sampled(bus: MemoryBus, post: Post, every_ns: int) -> Post:
    """Posts the newest sample of each key, `every_ns` after the first that came."""
    newest: dict[str, Heard] = {}

    def flush() -> None:
        waiting = list(newest.values())
        newest.clear()
        if not bus.closed:
            for event in waiting:
                post(event)

    def arrive(event: Event) -> None:
        if isinstance(event, Heard):
            if not newest:
                bus.network.scheduler.after(every_ns, flush)
            newest[event.topic.below(event.fields)] = event

    return arrive
