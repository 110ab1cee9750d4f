"""A member's witness, where certificates prove names: it tells hosts what its file grants them, and stores no table
that takes an entry from a host which did not give it back, or adds one for a host which has not spoken.

With both, one liar among four members makes no two vehicles of others meet. Members which it left with different
tables agree again once its name is revoked (docs/design/right-of-way.md).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain

from msgspec.structs import replace

from swarm.config.scenario import agent_of
from swarm.right_of_way.cell_orders import Orders
from swarm.right_of_way.generations import was_just_sent
from swarm.right_of_way.holdings import part_of
from swarm.right_of_way.host import GENERATIONS_KEPT
from swarm.right_of_way.host_entries import BEFORE_ALL
from swarm.right_of_way.shard_leader import MOST_CELLS, SILENT_NS, exceeds_externals, is_entering
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Fence, Held, HostState, Number, Stamp, Table, Word

_Entries = dict[Number, tuple[str, int]]
_MOST_LACKED = 64
"""Entries that one word asks for; the next asks for more."""


def _listed(table: Table) -> _Entries | None:
    """Returns number -> its vehicle, and the generation of its host. None if no leader makes such a table: a number
    is there twice, a vehicle has two entries of one cell, or a fence is not of an earlier generation of the host of
    its vehicles, or not the only one of it."""
    counted = {host: generation for host, (generation, _) in table.hosts.items()}
    fences = {(fence.agent, fence.generation): fence.entries for fence in table.fences}
    each = [(id, counted.get(agent_of(id), 0), of) for id, of in table.grants.items()]
    each += [(id, generation, of) for (_, generation), entries in fences.items() for id, of in entries.items()]
    found = {number: (id, generation) for id, generation, of in each for number in of}
    places = {(*of, number[0]) for number, of in found.items()}
    is_made = (
        len(places) == len(found) == sum(len(of) for *_, of in each)
        and len(fences) == len(table.fences)
        and all(0 < generation < counted.get(host, 0) for host, generation in fences)
        and all(agent_of(id) == host for (host, _), entries in fences.items() for id in entries)
    )
    return found if is_made else None


def agreed(tables: Collection[Table]) -> Table:
    """Returns the entries on at least two of three honest members' tables. The newest statements
    count. An entry that a majority had on file is on two of them, or over by its host's word, or its vehicle began
    in the cell again by a later one."""
    newest_first = sorted(tables, key=lambda table: table.stamp, reverse=True)
    lists = [_listed(table) or {} for table in newest_first]
    counts = Counter((number, vehicle) for each in lists for number, (vehicle, _) in each.items())
    in_cell = Counter(chain.from_iterable({(number[0], each[0]) for number, each in of.items()} for of in lists))
    agreed_on: dict[Number, str] = {}
    cells: set[tuple[int, str]] = set()
    for number, vehicle in sorted(counts, key=lambda each: (counts[each] > 1, each[0][1:]), reverse=True):
        place = number[0], vehicle
        if counts[number, vehicle] > 1 or (in_cell[place] > 1 and place not in cells and number not in agreed_on):
            agreed_on[number] = vehicle
            cells.add(place)
    hosts: dict[str, tuple[int, int]] = {}
    for table in newest_first:
        hosts.update((name, max(newest, hosts.get(name, newest))) for name, newest in table.hosts.items())
    entries: dict[tuple[str, int], dict[str, list[Number]]] = {}
    for number, vehicle in (each for each in counts if agreed_on.get(each[0]) == each[1]):
        host = agent_of(vehicle)
        of = [each[number][1] for each in lists if each.get(number, ("", 0))[0] == vehicle]
        # The latest has it by an honest member's word that those before have ended: to fence it for an earlier one
        # would free the cell under the vehicle. Generation 0 is the run's start.
        generation = max(of) or hosts.get(host, BEFORE_ALL)[0]
        entries.setdefault((host, generation), {}).setdefault(vehicle, []).append(number)
    grants: dict[str, Held] = {}
    fences: list[Fence] = []
    for (host, generation), of_vehicles in entries.items():
        ordered = {
            id: Held.of(sorted(numbers, key=lambda number: number[1:])) for id, numbers in of_vehicles.items()
        }
        if generation == hosts.get(host, BEFORE_ALL)[0]:
            grants.update(ordered)
        else:
            fences.append(Fence(host, generation, ordered))
    return replace(newest_first[0], hosts=hosts, grants=grants, fences=fences, pushed={})


@dataclass(slots=True)
class _Host:
    """Statements of one host.

    spoke_ns     time of the last one
    newest       (generation, sequence) of the newest
    generations  generation -> the newest table that it knows, the entries that it holds, and those that it never
                 takes
    there        (vehicle, cell) that its newest generation holds, or states a vehicle to be on -> whether it holds
                 an entry there
    ended        generations that have ended, the newest ones
    sent         the last word to it; `sent_ns` is its time
    """

    spoke_ns: int
    newest: Stamp = BEFORE_ALL
    generations: dict[int, tuple[Stamp, frozenset[Number], list[Number]]] = field(default_factory=dict)
    there: dict[tuple[str, int], bool] = field(default_factory=dict)
    ended: set[int] = field(default_factory=set)
    sent: object = None
    sent_ns: int = 0

    def hear(self, state: HostState, now_ns: int) -> None:
        self.spoke_ns = now_ns
        self.ended.update(state.dead)
        if state.ended:
            self.ended.add(state.generation)
        self.ended.intersection_update(sorted(self.ended)[-2 * GENERATIONS_KEPT :])
        if (state.generation, state.seq) > self.newest:
            self.newest = state.generation, state.seq
            held = frozenset(number for stand in state.vehicles for number in stand.holds)
            self.generations[state.generation] = state.knows, held, state.never
            self.there = {(stand.vehicle, stand.cell): False for stand in state.vehicles if is_entering(stand)}
            held_cells = ((each.vehicle, cell) for each in state.vehicles for cell in each.holds.cells)
            self.there.update(dict.fromkeys(held_cells, True))
            for old in sorted(self.generations)[:-GENERATIONS_KEPT]:
                del self.generations[old]

    @property
    def held(self) -> frozenset[Number]:
        """The entries that its newest generation holds."""
        return self.generations[self.newest[0]][1] if self.generations else frozenset()

    def is_over(self, number: Number, vehicle: str, generation: int, *, begins: bool) -> bool:
        """Returns True if this host said that an entry of a generation of it is over. Generation 0 is the run's
        start, of which the entries belong to the first generation that a table counts.

        An entry of an ended generation passes to the newest if that states the vehicle to be on the cell: only its
        word ends it then, once it holds an entry there. Otherwise it is over once the vehicle is elsewhere, or
        begins again.

        begins  whether the vehicle has entries in the table that omits this one
        """
        is_ended, holds = generation in self.ended, self.there.get((vehicle, number[0]))
        begins = begins or self.newest[0] in self.ended or any(vehicle == of for of, _ in self.there)
        if is_ended and begins and holds is None:
            return True
        own = {generation, self.newest[0]} if is_ended else {generation}
        return any(
            (number[1:] <= knows and number not in held) or number in never
            for of, (knows, held, never) in self.generations.items()
            if (of in own or not generation) and not (self.ended and holds is False and of == self.newest[0])
        )


class Witness:
    """Knowledge of one member about a shard.

    fleets  agent -> its vehicles, all of the scenario's
    """

    def __init__(self, me: str, shards: Shards, fleets: Mapping[str, Collection[str]]) -> None:
        self._me = me
        self._shards = shards
        self._fleets = fleets
        self._hosts: dict[str, _Host] = {}
        self._of: Table | None = None
        self._orders: Orders | None = None
        self._lacks: dict[str, list[Number]] = {}
        """Host of which a statement is missed -> entries that it may have left."""

    def hear_host_state(self, state: HostState, now_ns: int) -> None:
        self._hosts.setdefault(state.agent, _Host(now_ns)).hear(state, now_ns)

    def accepts(self, old: Table, new: Table) -> bool:
        """Returns True if a table may replace the one on file: what it omits is over by the word of its own host,
        what it adds is for a host that has spoken and comes after all that remains in its cell, and it counts no
        statement that was not made. Hosts of which a statement is missed are asked for it by the next words."""
        old_entries, new_entries = _listed(old), _listed(new)
        if old_entries is None or new_entries is None:
            return False
        added = [(number, each) for number, each in new_entries.items() if old_entries.get(number) != each]
        if not self._may_follow(old, new) or (added and not self._may_have(added, new_entries, new)):
            return False
        self._lacks = {
            host: []
            for host, newest in new.hosts.items()
            if newest != old.hosts.get(host) and (host not in self._hosts or newest > self._hosts[host].newest)
        }
        # A vehicle of which all generations have ended before a table counted one begins in its cell again.
        begins = {(number[0], each[0]) for number, each in added if number not in old_entries}
        last: dict[int, Number] = {}
        for number, (vehicle, generation) in old_entries.items():
            new_entry, host = new_entries.get(number), agent_of(vehicle)
            known = self._hosts.get(host)
            anew = not generation and known is not None and known.ended and (number[0], vehicle) in begins
            if anew or new_entry == (vehicle, generation) or self._passes((vehicle, generation), new_entry, number):
                last[number[0]] = max(number, last.get(number[0], number))
            elif known is None or not known.is_over(number, vehicle, generation, begins=vehicle in new.grants):
                self._lacks.setdefault(host, []).append(number)
        for _, (vehicle, generation) in added:
            host = agent_of(vehicle)
            known = self._hosts.get(host)
            counted = old.hosts.get(host, BEFORE_ALL)[0], new.hosts.get(host, BEFORE_ALL)[0]
            if not known or not known.generations or generation not in {*counted, *known.ended, *known.generations}:
                self._lacks.setdefault(host, [])  # not which cells it requested: it gives others back by itself
        # An earlier number that is new here was left, and its host has told others so, unless it still holds it.
        return not self._lacks and all(
            (
                number not in old_entries
                and number > last.get(number[0], ())
                and number[1:] <= new.stamp
                and (old.stamp < number[1:] or number in self._hosts[agent_of(each[0])].held)
            )
            or self._passes(old_entries.get(number), each, number)
            for number, each in added
        )

    def _may_follow(self, old: Table, new: Table) -> bool:
        """Returns True if a table counts no earlier generations than the one before it, and where it counts another
        one, has no fence of a generation which that says to have ended: such entries pass, or are over."""
        before = {host: generation for host, (generation, _) in old.hosts.items()}
        after = {host: generation for host, (generation, _) in new.hosts.items()}
        return all(generation <= after.get(host, 0) for host, generation in before.items()) and not any(
            before.get(fence.agent) != after[fence.agent]
            and fence.agent in self._hosts
            and fence.generation in self._hosts[fence.agent].ended
            for fence in new.fences
        )

    def _may_have(self, added: Iterable[tuple[Number, tuple[str, int]]], new_entries: _Entries, new: Table) -> bool:
        """Returns True if additions are cells of the shard, for vehicles that there are, and no more than leaders
        grant."""
        counts = Counter(new_entries.values())
        return not exceeds_externals(new, self._fleets) and all(
            self._shards.of(number[0]) == new.shard
            and each[0] in self._fleets.get(agent_of(each[0]), each)
            and counts[each] <= MOST_CELLS
            for number, each in added
        )

    def _passes(self, before: tuple[str, int] | None, after: tuple[str, int] | None, number: Number) -> bool:
        """Returns True if an entry may pass to a newer generation of its host at its place in the order: the run's
        first, or one of an ended generation where the newest states the vehicle to be on the cell. All others may
        have been left."""
        if before is None or after is None or before[0] != after[0]:
            return False
        host = self._hosts.get(agent_of(before[0]))
        is_there = host is not None and before[1] in host.ended and (before[0], number[0]) in host.there
        return is_there or not before[1]

    def contradicts(self, table: Table, distrusted: Collection[str] = ()) -> bool:
        """Returns True if a trusted host held an entry which a table omits, by a statement no older than the one
        that the table counts: no majority has it on file."""
        lists = _listed(table) or {}
        return any(
            not host.held <= lists.keys()
            for name, host in self._hosts.items()
            if name not in distrusted and table.hosts.get(name, BEFORE_ALL) <= host.newest
        )

    def words(self, stored: Table, now_ns: int) -> Iterator[Word]:
        """Returns our words to the hosts that have spoken lately, and to those of which a statement is missed, if
        they are new or a heartbeat old."""
        if self._of is not stored or self._orders is None:
            self._of, self._orders = stored, Orders(stored)
        for name in [
            name for name, host in self._hosts.items() if host.newest == BEFORE_ALL and name not in self._lacks
        ]:
            del self._hosts[name]  # a liar may name as many as it likes
        for name in self._lacks:
            self._hosts.setdefault(name, _Host(now_ns - SILENT_NS - 1))
        for name, host in self._hosts.items():
            lacks = self._lacks.get(name)
            if now_ns - host.spoke_ns > SILENT_NS and lacks is None:
                continue
            generation, _ = stored.hosts.get(name, BEFORE_ALL)
            part = part_of(generation, *self._orders.granted(name))
            news = stored.epoch, part, lacks
            if was_just_sent(news, host.sent, now_ns - host.sent_ns):
                continue
            host.sent, host.sent_ns = news, now_ns
            yield Word(
                shard=stored.shard,
                host=name,
                agent=self._me,
                epoch=stored.epoch,
                seq=stored.seq,
                part=part,
                asks=lacks is not None,
                lacks=(lacks or [])[:_MOST_LACKED],
            )
