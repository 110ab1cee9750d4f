"""Rules of right of way, each taken out: functions which break one, and histories in which laws must notice it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from support.traffic_world import TrafficWorld

from swarm.right_of_way.cell_orders import BEFORE_ALL, HostEntries, Orders
from swarm.wire.messages.traffic import Entry

Broken = Callable[[pytest.MonkeyPatch], None]


def follows_without_a_word(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(HostEntries, "may_enter", lambda self, entry: True)


def follows_on_the_word_of_the_last_before_it(patch: pytest.MonkeyPatch) -> None:
    hear = HostEntries.hear_granted

    def hasty(self: HostEntries, shard, stamp, generation, grants):  # type: ignore[no-untyped-def]
        last = {id: [Entry(each.number, each.after[-1:]) for each in entries] for id, entries in grants.items()}
        return hear(self, shard, stamp, generation, last)

    patch.setattr(HostEntries, "hear_granted", hasty)


def takes_what_an_older_table_added(patch: pytest.MonkeyPatch) -> None:
    """A host takes again what it gave back, passed over, or never knew."""
    hear = HostEntries.hear_granted

    def greedy(self: HostEntries, shard, stamp, generation, grants):  # type: ignore[no-untyped-def]
        knows = self.knows.pop(shard, BEFORE_ALL)
        changed = hear(self, shard, stamp, generation, grants) if stamp > knows else set()
        self.knows[shard] = max(knows, self.knows.get(shard, knows))
        return changed

    patch.setattr(HostEntries, "hear_granted", greedy)


def believes_that_another_vehicle_of_the_cell_has_left(patch: pytest.MonkeyPatch) -> None:
    def careless(self: HostEntries, host: str, numbers) -> None:  # type: ignore[no-untyped-def]
        cells = {number[0] for number in numbers}
        for path in self.paths.values():
            path[:] = [Entry(each.number) if each.cell in cells else each for each in path]

    patch.setattr(HostEntries, "hear_left", careless)


def forgets_who_is_before(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Orders, "before", lambda self, number, vehicle: iter(()))


def forgets_where_an_older_generation_may_stand(patch: pytest.MonkeyPatch) -> None:
    take = Orders.take_host_state

    def trusting(self: Orders, host: str, *what):  # type: ignore[no-untyped-def]
        changed = take(self, host, *what)
        for generation in [generation for each, generation in self.fenced if each == host]:
            self.end(host, generation)
        return changed

    patch.setattr(Orders, "take_host_state", trusting)


def forgets_those_before_in_earlier_generations(patch: pytest.MonkeyPatch) -> None:
    before = Orders.before
    patch.setattr(
        Orders, "before", lambda self, *of: (each for each in before(self, *of) if each[0] not in self._fences)
    )


def frees_what_the_host_did_not_know_of(patch: pytest.MonkeyPatch) -> None:
    remove = Orders.remove
    patch.setattr(Orders, "remove", lambda self, host, holds, _: remove(self, host, holds, (1 << 60, 0)))


def forgets_where_bodies_are(patch: pytest.MonkeyPatch) -> None:
    take = Orders.take_host_state
    patch.setattr(Orders, "take_host_state", lambda self, *what: take(self, *what[:-2], {}, what[-1]))


def collides(first: int, worlds: tuple[Callable[[int], TrafficWorld], ...], seconds: float) -> bool:
    """True if two vehicles meet in one of 97 histories of these worlds, the first of which is named."""
    for seed in (first, *range(96)):
        world = worlds[seed % len(worlds)](seed // 2)
        world.run(seconds)
        if world.collisions:
            return True
    return False
