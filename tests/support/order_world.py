"""A world in which the cores of right of way meet everything that may happen: two shards with three members each,
hosts with known and with made-up bodies, second generations beside the first, and a network that loses, repeats,
delays and reorders. No time passes: any party acts at any moment."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from swarm.right_of_way.entries import HostEntries
from swarm.wire.messages.traffic import Entry, Held, Number, Stamp, Table, entries_of
from vehicle_agent.traffic.cell_orders import Orders

SIDE, MEMBERS, SHARDS = 6, 3, 2
HOSTS = ("a", "b", "c", "guest")
EACH = 3
MADE_UP = ("b", "c")
"""Hosts that simulate their vehicles: a new generation does not know where a body was."""


def shard_of(cell: int) -> int:
    return int(cell % SIDE >= SIDE // 2)


def beside(cell: int) -> list[int]:
    row, col = divmod(cell, SIDE)
    rows, cols = range(max(row - 1, 0), min(row + 2, SIDE)), range(max(col - 1, 0), min(col + 2, SIDE))
    return [r * SIDE + c for r in rows for c in cols if (r, c) != (row, col)]


def adjacent(one: int, other: int) -> bool:
    return other in beside(one)


def vehicles_of(host: str) -> list[str]:
    return [f"{host}-{n}" for n in range(EACH)]


def held_in(entries: HostEntries, shard: int) -> dict[str, list[Number]]:
    """Returns vehicle -> its entries in a shard: all others that the newest table lists are over."""
    held = {vehicle: entries.of(vehicle).get(shard, []) for vehicle in entries.paths}
    return {vehicle: numbers for vehicle, numbers in held.items() if numbers}


@dataclass(eq=False)
class Seat:
    """A member of a shard: what is on its file, and its part as a leader."""

    stored: Table
    promised: int = 0
    up: bool = True
    claimed: int = 0
    promises: dict[int, Table] = field(default_factory=dict)
    orders: Orders | None = None
    stamp: Stamp = (0, 0)
    acked: dict[Stamp, set[int]] = field(default_factory=dict)
    told: dict[Stamp, Table] = field(default_factory=dict)


@dataclass(eq=False)
class Generation:
    """One generation of a host; `dead` are generations that it can prove to have ended. One that is cut off drives
    on."""

    host: str
    entries: HostEntries
    dead: list[int]
    seq: int = 0
    up: bool = True
    replaced: bool = False
    cut: bool = False


class OrderWorld:
    """One history.

    collisions  pairs of vehicles that were on one cell
    """

    def __init__(self, seed: int, mutate: Callable[[OrderWorld], None] | None = None) -> None:
        self.chance = random.Random(seed)
        self.drop = self.chance.choice((0.0, 0.1, 0.3))
        self.crash = self.chance.choice((0.0, 0.002, 0.01))
        self.claims = self.chance.choice((0.0005, 0.002, 0.01))
        self.majority, self.forgetful, self.obliging = 2, False, False
        self.promises_needed = 2
        self.proves_too_much = False
        self.net: list[tuple[Callable[..., None], tuple[Any, ...]]] = []
        self.collisions: list[tuple[str, str]] = []
        self.counts = dict.fromkeys(("moves", "followed", "seams", "takeovers", "generations", "given_back"), 0)
        cells = self.chance.sample(range(SIDE * SIDE), EACH * (len(HOSTS) - 1))
        self.generations: list[Generation] = []
        self.bodies: dict[tuple[str, int], int] = {}
        """(vehicle, generation) -> the cell of its body; a body of a dead process stays."""
        first = [Table(shard=shard, agent="member", epoch=0, seq=0, hosts={}, grants={}) for shard in range(SHARDS)]
        spawns: dict[str, int] = {}
        for host in HOSTS[:-1]:
            for vehicle in vehicles_of(host):
                spawns[vehicle] = cell = cells.pop()
                first[shard_of(cell)].grants[vehicle] = Held.of([(cell, 0, 1)])
                self.bodies[vehicle, 0] = cell
        self.seats = [[Seat(first[shard]) for _ in range(MEMBERS)] for shard in range(SHARDS)]
        self.first = first
        if mutate is not None:
            mutate(self)
        for host in HOSTS:
            self.boot(host, [0], {vehicle: spawns[vehicle] for vehicle in vehicles_of(host) if vehicle in spawns})

    # --- the network ----------------------------------------------------------------------------------------

    def send(self, to: Callable[..., None], *what: Any) -> None:
        if self.chance.random() >= self.drop:
            self.net += [(to, what)] * (2 if self.chance.random() < 0.05 else 1)

    def deliver(self) -> None:
        index = self.chance.randrange(len(self.net)) if self.chance.random() < 0.5 else 0
        to, what = self.net.pop(index)
        to(*what)
        if len(self.net) > 600:
            del self.net[:300]

    # --- members --------------------------------------------------------------------------------------------

    def hear_table(self, shard: int, member: int, sender: int, table: Table) -> None:
        seat = self.seats[shard][member]
        if not seat.up:
            return
        if (table.stamp[0] >= seat.promised or self.obliging) and table.stamp > seat.stored.stamp:
            seat.promised, seat.stored = max(seat.promised, table.stamp[0]), table
            if seat.orders is not None and seat.stamp[0] < table.stamp[0]:
                seat.orders = None
        if seat.stored.stamp == table.stamp:
            self.send(self.hear_stored, shard, sender, member, table.stamp)

    def hear_stored(self, shard: int, member: int, sender: int, stamp: Stamp) -> None:
        seat = self.seats[shard][member]
        if not seat.up or stamp not in seat.told:
            return
        acked = seat.acked.setdefault(stamp, set())
        acked.add(sender)
        if len(acked) >= self.majority:
            self.grant(shard, seat.told[stamp])

    def grant(self, shard: int, table: Table) -> None:
        orders = Orders(table)
        for generation in self.generations:
            if not generation.up:
                continue
            known = table.hosts.get(generation.host, (0, 0))[0]
            held, waits = orders.granted(generation.host)
            grants = {vehicle: entries_of(of, waits.get(vehicle, ())) for vehicle, of in held.items()}
            self.send(self.hear_granted, generation, shard, table.stamp, known, grants)

    def hear_claim(self, shard: int, member: int, claimant: int, epoch: int) -> None:
        seat = self.seats[shard][member]
        if seat.up and epoch > seat.promised:
            seat.promised = epoch
            if claimant != member:
                seat.orders = None
            self.send(self.hear_promise, shard, claimant, member, epoch, seat.stored)

    def hear_promise(self, shard: int, member: int, sender: int, epoch: int, table: Table) -> None:
        seat = self.seats[shard][member]
        if not seat.up or seat.claimed != epoch:
            return
        seat.promises[sender] = table
        if len(seat.promises) >= self.promises_needed:
            newest = max(seat.promises.values(), key=lambda each: each.stamp)
            seat.orders, seat.stamp, seat.claimed = Orders(newest), (epoch, 0), 0
            self.counts["takeovers"] += 1

    def claim(self, shard: int, member: int) -> None:
        seat = self.seats[shard][member]
        if seat.up:
            seat.claimed = (seat.promised // MEMBERS + 1) * MEMBERS + member
            seat.promises = {}
            for other in range(MEMBERS):
                if other == member:
                    self.hear_claim(shard, other, member, seat.claimed)
                else:
                    self.send(self.hear_claim, shard, other, member, seat.claimed)

    def plan(self, shard: int, member: int) -> None:
        """A leader appends some entries, anywhere beside where paths end, and tells its table."""
        seat, chance = self.seats[shard][member], self.chance
        if not seat.up or seat.orders is None:
            return
        orders, fresh = seat.orders, (seat.stamp[0], seat.stamp[1] + 1)
        for host in chance.sample(HOSTS, 2):
            for vehicle in chance.sample(vehicles_of(host), 2):
                path = orders.of.get(vehicle)
                if path and len(path) < 4:
                    orders.append(
                        vehicle, chance.choice([c for c in beside(path[-1][0]) if shard_of(c) == shard]), fresh
                    )
                elif not path:  # it comes in over the seam, or from nowhere
                    near = [c for other in self.ends(vehicle) for c in beside(other) if shard_of(c) == shard]
                    cells = near or [c for c in range(SIDE * SIDE) if shard_of(c) == shard]
                    if near or chance.random() < 0.3:
                        orders.append(vehicle, chance.choice(cells), fresh)
        told = orders.table(shard, "member", fresh, {}, {})
        seat.stamp = fresh
        seat.told = {stamp: table for stamp, table in seat.told.items() if stamp[0] == told.stamp[0]}
        seat.told[told.stamp] = told
        for other in range(MEMBERS):
            self.send(self.hear_table, shard, other, member, told)

    def ends(self, vehicle: str) -> list[int]:
        """Cells where paths of a vehicle end, as its hosts say."""
        paths = (generation.entries.paths.get(vehicle) for generation in self.generations if generation.up)
        return [path[-1].cell for path in paths if path]

    # --- hosts ----------------------------------------------------------------------------------------------

    def boot(self, host: str, dead: list[int], bodies: dict[str, int]) -> None:
        number = 1 + max(
            [generation.entries.generation for generation in self.generations if generation.host == host], default=0
        )
        entries = HostEntries(number, shard_of, adjacent, bodies)
        for key in [key for key in self.bodies if key[0].rpartition("-")[0] == host and key[1] in dead]:
            cell = self.bodies.pop(key)
            if key[0] in bodies:
                self.bodies[key[0], number] = cell
        self.generations.append(Generation(host, entries, dead))
        self.counts["generations"] += 1

    def hear_granted(
        self, generation: Generation, shard: int, stamp: Stamp, known: int, grants: dict[str, list[Entry]]
    ) -> None:
        if not generation.up or generation.cut:
            return
        if known > generation.entries.generation and not generation.replaced:
            generation.replaced = True  # it drives no more, and its made-up bodies vanish
            if generation.host in MADE_UP:
                for vehicle in vehicles_of(generation.host):
                    self.bodies.pop((vehicle, generation.entries.generation), None)
        if not generation.replaced:
            unlisted = {vehicle: [] for vehicle in generation.entries.listed.get(shard, ())}
            generation.entries.hear_granted(shard, stamp, known, {**unlisted, **grants})

    def tell(self, generation: Generation) -> None:
        generation.seq += 1
        if generation.cut:
            return
        for shard, seats in enumerate(self.seats):
            holds, knows = held_in(generation.entries, shard), generation.entries.knows.get(shard, (0, 0))
            for member in range(len(seats)):
                self.send(
                    self.hear_host_state,
                    shard,
                    member,
                    generation,
                    generation.seq,
                    holds,
                    knows,
                    generation.replaced,
                )
        for other in self.generations:
            over = frozenset(number for numbers in generation.entries.over.values() for number in numbers)
            if other is not generation and other.up and over:
                self.send(self.hear_left, other, generation.host, over)

    def hear_left(self, generation: Generation, host: str, numbers: frozenset[Number]) -> None:
        if generation.up:
            generation.entries.hear_left(host, numbers)

    def hear_host_state(
        self,
        shard: int,
        member: int,
        generation: Generation,
        seq: int,
        holds: dict[str, Any],
        knows: Stamp,
        ended: bool,
    ) -> None:
        seat = self.seats[shard][member]
        if not seat.up or seat.orders is None:
            return
        number = generation.entries.generation
        if ended:
            seat.orders.end(generation.host, number)
        else:
            bodies = {id: cell for id, cell in generation.entries.bodies.items() if shard_of(cell) == shard}
            fresh = (seat.stamp[0], seat.stamp[1] + 1)
            known = seat.orders.hosts.get(generation.host, (0, 0))[0]
            if number > known:  # a table is skipped, so that two generations begin with different entries
                seat.stamp = fresh
                fresh = (fresh[0], fresh[1] + 1)
            seat.orders.take_host_state(generation.host, number, seq, holds, knows, generation.dead, bodies, fresh)

    def drive(self, generation: Generation) -> None:
        entries, chance = generation.entries, self.chance
        if not entries.paths or generation.replaced:
            return
        vehicle = chance.choice(sorted(entries.paths))
        path = entries.paths[vehicle]
        if generation.host == HOSTS[-1] and vehicle in entries.placed and chance.random() < 0.01:
            entries.leave(vehicle)
            self.bodies.pop((vehicle, entries.generation), None)
            return
        if vehicle in entries.placed and len(path) > 1 and chance.random() < 0.08:
            entries.give_back(vehicle)
            self.counts["given_back"] += 1
            return
        before = path[0]
        follows = len(path) > 1 and bool(path[1].after)
        if entries.place(vehicle) or entries.enter_next(vehicle):
            cell = entries.paths[vehicle][0].cell
            self.counts["moves"] += 1
            self.counts["followed"] += follows
            self.counts["seams"] += shard_of(before.cell) != shard_of(cell)
            self.bodies[vehicle, entries.generation] = cell
            for (other, number), there in self.bodies.items():
                if there == cell and other != vehicle and self.is_there(other, number):
                    self.collisions.append((vehicle, other))

    def is_there(self, vehicle: str, number: int) -> bool:
        """Returns True if a body exists: a simulated one does once a generation of its host has placed it."""
        host = vehicle.rpartition("-")[0]
        generations = [
            generation.entries
            for generation in self.generations
            if generation.host == host and generation.entries.generation == number
        ]
        return host not in MADE_UP or any(vehicle in entries.placed for entries in generations)

    def disturb(self) -> None:
        """A member or a host dies or starts again; or a second generation starts beside the first."""
        chance = self.chance
        if chance.random() < 0.2:
            for generation in self.generations:
                generation.cut = False
        if chance.random() < 0.4:
            shard, member = chance.randrange(SHARDS), chance.randrange(MEMBERS)
            seat = self.seats[shard][member]
            stored = self.first[shard] if self.forgetful and not seat.up else seat.stored
            promised = 0 if self.forgetful and not seat.up else seat.promised
            self.seats[shard][member] = Seat(stored, promised, not seat.up)
            return
        host = chance.choice(HOSTS)
        ours = [generation for generation in self.generations if generation.host == host]
        generation = ours[-1]
        if generation.up and (host not in MADE_UP or chance.random() < 0.7):
            generation.up = False
        elif generation.up and not self.proves_too_much:
            generation.cut = True
            self.boot(host, [], {})  # on another machine
        else:
            generation.cut = generation.up
            dead = [each.entries.generation for each in ours if not each.up or self.proves_too_much]
            if len(dead) == len(ours):
                dead.append(0)
            known = {vehicle: cell for (vehicle, at), cell in self.bodies.items() if at in dead}
            mine = {vehicle: cell for vehicle, cell in known.items() if vehicle in vehicles_of(host)}
            self.boot(host, dead, {} if host in MADE_UP else mine)

    # --- a history ------------------------------------------------------------------------------------------

    def run(self, steps: int = 12000) -> OrderWorld:
        chance = self.chance
        for step in range(steps):
            draw = chance.random()
            if draw < 0.90 and self.net:
                self.deliver()
            elif draw < 0.94:
                generation = chance.choice([each for each in self.generations if each.up] or self.generations)
                if generation.up:
                    self.drive(generation)
                    self.tell(generation)
            elif draw < 0.97:
                self.plan(chance.randrange(SHARDS), chance.randrange(MEMBERS))
            elif draw < 0.97 + self.claims or step < 6:
                self.claim(chance.randrange(SHARDS), chance.randrange(MEMBERS))
            elif chance.random() < 10 * self.crash:
                self.disturb()
            if self.collisions:
                break
        return self
