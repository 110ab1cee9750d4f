"""Rules of right of way, each taken out: functions which break one, and histories in which laws must notice it."""

from collections.abc import Callable
from typing import Any

import pytest
from support.traffic_world import TrafficWorld

from swarm.right_of_way.cell_orders import Orders
from swarm.right_of_way.host_entries import BEFORE_ALL, HostEntries
from swarm.wire.messages.traffic import Entry

Broken = Callable[[pytest.MonkeyPatch], None]


def in_place_of(owner: Any, name: str) -> Callable[[Callable[..., Any]], Broken]:
    """A rule of a function that stands for a method while the rule is broken. It is given the true method first."""

    def broken(stands: Callable[..., Any]) -> Broken:
        def breaks(patch: pytest.MonkeyPatch) -> None:
            true = getattr(owner, name)
            patch.setattr(owner, name, lambda *given, **named: stands(true, *given, **named))

        breaks.__name__ = stands.__name__
        return breaks

    return broken


@in_place_of(HostEntries, "may_enter")
def follows_without_a_word(may, self, entry):
    return True


@in_place_of(HostEntries, "hear_granted")
def follows_on_the_word_of_the_last_before_it(hear, self, shard, stamp, generation, grants):
    last = {id: [Entry(each.number, each.after[-1:]) for each in entries] for id, entries in grants.items()}
    return hear(self, shard, stamp, generation, last)


@in_place_of(HostEntries, "hear_granted")
def takes_what_an_older_table_added(hear, self, shard, stamp, generation, grants):
    """A host takes again what it gave back, passed over, or never knew."""
    knows = self.knows.pop(shard, BEFORE_ALL)
    changed = hear(self, shard, stamp, generation, grants) if stamp > knows else set()
    self.knows[shard] = max(knows, self.knows.get(shard, knows))
    return changed


@in_place_of(HostEntries, "hear_left")
def believes_that_another_vehicle_of_the_cell_has_left(hear, self, host, numbers):
    cells = {number[0] for number in numbers}
    for path in self.paths.values():
        path[:] = [Entry(each.number) if each.cell in cells else each for each in path]


@in_place_of(Orders, "before")
def forgets_who_is_before(before, self, number, vehicle):
    return iter(())


@in_place_of(Orders, "take_host_state")
def forgets_where_an_older_generation_may_stand(take, self, host, *what):
    changed = take(self, host, *what)
    for generation in [generation for each, generation in self.fenced if each == host]:
        self.end(host, generation)
    return changed


@in_place_of(Orders, "before")
def forgets_those_before_in_earlier_generations(before, self, *of):
    return (each for each in before(self, *of) if each[0] not in self._fences)


@in_place_of(Orders, "remove")
def frees_what_the_host_did_not_know_of(remove, self, host, holds, knew):
    return remove(self, host, holds, (1 << 60, 0))


@in_place_of(Orders, "take_host_state")
def forgets_where_bodies_are(take, self, *what):
    return take(self, *what[:-2], {}, what[-1])


def collides(first: int, worlds: tuple[Callable[[int], TrafficWorld], ...], seconds: float) -> bool:
    """True if two vehicles meet in one of 97 histories of these worlds, the first of which is named: rare faults
    are found soon."""
    for seed in (first, *range(96)):
        world = worlds[seed % len(worlds)](seed // 2)
        world.run(seconds)
        if world.collisions:
            return True
    return False
