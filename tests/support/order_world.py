"""A world in which the cores of right of way meet everything that may happen: two plots with three members each,
hosts with known and with made-up bodies, second lives beside the first, and a network that loses, repeats, delays
and reorders. No time passes: any party acts at any moment."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from swarm.right_of_way.entries import HostEntries
from swarm.wire.messages.traffic import Entry, Number, Stamp, Table
from vehicle_agent.traffic.cell_orders import Orders

SIDE, MEMBERS, PLOTS = 6, 3, 2
HOSTS = ("a", "b", "c", "guest")
EACH = 3
MADE_UP = ("b", "c")
"""Hosts that simulate their vehicles: a new life does not know where a body was."""


def plot_of(cell: int) -> int:
    return int(cell % SIDE >= SIDE // 2)


def beside(cell: int) -> list[int]:
    row, col = divmod(cell, SIDE)
    rows, cols = range(max(row - 1, 0), min(row + 2, SIDE)), range(max(col - 1, 0), min(col + 2, SIDE))
    return [r * SIDE + c for r in rows for c in cols if (r, c) != (row, col)]


def adjacent(one: int, other: int) -> bool:
    return other in beside(one)


def vehicles_of(host: str) -> list[str]:
    return [f"{host}-{n}" for n in range(EACH)]


@dataclass(eq=False)
class Seat:
    """A member of a plot: what is on its file, and its part as a warden."""

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
class Life:
    """One life of a host; `dead` are lives that it can prove to have ended. One that is cut off drives on."""

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
        self.counts = dict.fromkeys(("moves", "followed", "seams", "takeovers", "lives", "given_back"), 0)
        cells = self.chance.sample(range(SIDE * SIDE), EACH * (len(HOSTS) - 1))
        self.lives: list[Life] = []
        self.bodies: dict[tuple[str, int], int] = {}
        """(vehicle, life) -> the cell of its body; a body of a dead process stays."""
        first = [Table(plot=plot, agent="member", epoch=0, seq=0, hosts={}, grants={}) for plot in range(PLOTS)]
        spawns: dict[str, int] = {}
        for host in HOSTS[:-1]:
            for vehicle in vehicles_of(host):
                spawns[vehicle] = cell = cells.pop()
                first[plot_of(cell)].grants[vehicle] = [(cell, 0, 1)]
                self.bodies[vehicle, 0] = cell
        self.seats = [[Seat(first[plot]) for _ in range(MEMBERS)] for plot in range(PLOTS)]
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

    def hear_table(self, plot: int, member: int, sender: int, table: Table) -> None:
        seat = self.seats[plot][member]
        if not seat.up:
            return
        if (table.stamp[0] >= seat.promised or self.obliging) and table.stamp > seat.stored.stamp:
            seat.promised, seat.stored = max(seat.promised, table.stamp[0]), table
            if seat.orders is not None and seat.stamp[0] < table.stamp[0]:
                seat.orders = None
        if seat.stored.stamp == table.stamp:
            self.send(self.hear_stored, plot, sender, member, table.stamp)

    def hear_stored(self, plot: int, member: int, sender: int, stamp: Stamp) -> None:
        seat = self.seats[plot][member]
        if not seat.up or stamp not in seat.told:
            return
        acked = seat.acked.setdefault(stamp, set())
        acked.add(sender)
        if len(acked) >= self.majority:
            self.grant(plot, seat.told[stamp])

    def grant(self, plot: int, table: Table) -> None:
        orders = Orders(table)
        for life in self.lives:
            if not life.up:
                continue
            known = table.hosts.get(life.host, (0, 0))[0]
            grants = orders.granted(life.host)
            self.send(self.hear_granted, life, plot, table.stamp, known, grants)

    def hear_claim(self, plot: int, member: int, claimant: int, epoch: int) -> None:
        seat = self.seats[plot][member]
        if seat.up and epoch > seat.promised:
            seat.promised = epoch
            if claimant != member:
                seat.orders = None
            self.send(self.hear_promise, plot, claimant, member, epoch, seat.stored)

    def hear_promise(self, plot: int, member: int, sender: int, epoch: int, table: Table) -> None:
        seat = self.seats[plot][member]
        if not seat.up or seat.claimed != epoch:
            return
        seat.promises[sender] = table
        if len(seat.promises) >= self.promises_needed:
            newest = max(seat.promises.values(), key=lambda each: each.stamp)
            seat.orders, seat.stamp, seat.claimed = Orders(newest), (epoch, 0), 0
            self.counts["takeovers"] += 1

    def claim(self, plot: int, member: int) -> None:
        seat = self.seats[plot][member]
        if seat.up:
            seat.claimed = (seat.promised // MEMBERS + 1) * MEMBERS + member
            seat.promises = {}
            for other in range(MEMBERS):
                if other == member:
                    self.hear_claim(plot, other, member, seat.claimed)
                else:
                    self.send(self.hear_claim, plot, other, member, seat.claimed)

    def plan(self, plot: int, member: int) -> None:
        """A warden appends some entries, anywhere beside where paths end, and tells its table."""
        seat, chance = self.seats[plot][member], self.chance
        if not seat.up or seat.orders is None:
            return
        orders, fresh = seat.orders, (seat.stamp[0], seat.stamp[1] + 1)
        for host in chance.sample(HOSTS, 2):
            for vehicle in chance.sample(vehicles_of(host), 2):
                path = orders.of.get(vehicle)
                if path and len(path) < 4:
                    orders.append(
                        vehicle, chance.choice([c for c in beside(path[-1][0]) if plot_of(c) == plot]), fresh
                    )
                elif not path:  # it comes in over the seam, or from nowhere
                    near = [c for other in self.ends(vehicle) for c in beside(other) if plot_of(c) == plot]
                    cells = near or [c for c in range(SIDE * SIDE) if plot_of(c) == plot]
                    if near or chance.random() < 0.3:
                        orders.append(vehicle, chance.choice(cells), fresh)
        told = orders.table(plot, "member", fresh, {})
        seat.stamp = fresh
        seat.told = {stamp: table for stamp, table in seat.told.items() if stamp[0] == told.stamp[0]}
        seat.told[told.stamp] = told
        for other in range(MEMBERS):
            self.send(self.hear_table, plot, other, member, told)

    def ends(self, vehicle: str) -> list[int]:
        """Cells where paths of a vehicle end, as its hosts say."""
        paths = (life.entries.paths.get(vehicle) for life in self.lives if life.up)
        return [path[-1].cell for path in paths if path]

    # --- hosts ----------------------------------------------------------------------------------------------

    def boot(self, host: str, dead: list[int], bodies: dict[str, int]) -> None:
        number = 1 + max([life.entries.life for life in self.lives if life.host == host], default=0)
        entries = HostEntries(number, plot_of, adjacent, bodies)
        for key in [key for key in self.bodies if key[0].rpartition("-")[0] == host and key[1] in dead]:
            cell = self.bodies.pop(key)
            if key[0] in bodies:
                self.bodies[key[0], number] = cell
        self.lives.append(Life(host, entries, dead))
        self.counts["lives"] += 1

    def hear_granted(self, life: Life, plot: int, stamp: Stamp, known: int, grants: dict[str, list[Entry]]) -> None:
        if not life.up or life.cut:
            return
        if known > life.entries.life and not life.replaced:
            life.replaced = True  # it drives no more, and its made-up bodies vanish
            if life.host in MADE_UP:
                for vehicle in vehicles_of(life.host):
                    self.bodies.pop((vehicle, life.entries.life), None)
        if not life.replaced:
            life.entries.hear_granted(plot, stamp, known, grants)

    def tell(self, life: Life) -> None:
        life.seq += 1
        if life.cut:
            return
        for plot, seats in enumerate(self.seats):
            holds, knows = life.entries.holds(plot), life.entries.knows.get(plot, (0, 0))
            for member in range(len(seats)):
                self.send(self.hear_standing, plot, member, life, life.seq, holds, knows, life.replaced)
        for other in self.lives:
            over = frozenset(number for numbers in life.entries.over.values() for number in numbers)
            if other is not life and other.up and over:
                self.send(self.hear_left, other, life.host, over)

    def hear_left(self, life: Life, host: str, numbers: frozenset[Number]) -> None:
        if life.up:
            life.entries.hear_left(host, numbers)

    def hear_standing(
        self, plot: int, member: int, life: Life, seq: int, holds: dict[str, Any], knows: Stamp, ended: bool
    ) -> None:
        seat = self.seats[plot][member]
        if not seat.up or seat.orders is None:
            return
        number = life.entries.life
        if ended:
            seat.orders.end(life.host, number)
        else:
            bodies = {id: cell for id, cell in life.entries.bodies.items() if plot_of(cell) == plot}
            fresh = (seat.stamp[0], seat.stamp[1] + 1)
            known = seat.orders.hosts.get(life.host, (0, 0))[0]
            if number > known:  # a table is skipped, so that two lives begin with different entries
                seat.stamp = fresh
                fresh = (fresh[0], fresh[1] + 1)
            seat.orders.take_standing(life.host, number, seq, holds, knows, life.dead, bodies, fresh)

    def drive(self, life: Life) -> None:
        entries, chance = life.entries, self.chance
        if not entries.paths or life.replaced:
            return
        vehicle = chance.choice(sorted(entries.paths))
        path = entries.paths[vehicle]
        if life.host == HOSTS[-1] and vehicle in entries.placed and chance.random() < 0.01:
            entries.leave(vehicle)
            self.bodies.pop((vehicle, entries.life), None)
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
            self.counts["seams"] += plot_of(before.cell) != plot_of(cell)
            self.bodies[vehicle, entries.life] = cell
            for (other, number), there in self.bodies.items():
                if there == cell and other != vehicle and self.is_there(other, number):
                    self.collisions.append((vehicle, other))

    def is_there(self, vehicle: str, number: int) -> bool:
        """Returns True if a body exists: a simulated one does once a life of its host has placed it."""
        host = vehicle.rpartition("-")[0]
        lives = [life.entries for life in self.lives if life.host == host and life.entries.life == number]
        return host not in MADE_UP or any(vehicle in entries.placed for entries in lives)

    def disturb(self) -> None:
        """A member or a host dies or starts again; or a second life starts beside the first."""
        chance = self.chance
        if chance.random() < 0.2:
            for life in self.lives:
                life.cut = False
        if chance.random() < 0.4:
            plot, member = chance.randrange(PLOTS), chance.randrange(MEMBERS)
            seat = self.seats[plot][member]
            stored = self.first[plot] if self.forgetful and not seat.up else seat.stored
            promised = 0 if self.forgetful and not seat.up else seat.promised
            self.seats[plot][member] = Seat(stored, promised, not seat.up)
            return
        host = chance.choice(HOSTS)
        ours = [life for life in self.lives if life.host == host]
        life = ours[-1]
        if life.up and (host not in MADE_UP or chance.random() < 0.7):
            life.up = False
        elif life.up and not self.proves_too_much:
            life.cut = True
            self.boot(host, [], {})  # on another machine
        else:
            life.cut = life.up
            dead = [each.entries.life for each in ours if not each.up or self.proves_too_much]
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
                life = chance.choice([each for each in self.lives if each.up] or self.lives)
                if life.up:
                    self.drive(life)
                    self.tell(life)
            elif draw < 0.97:
                self.plan(chance.randrange(PLOTS), chance.randrange(MEMBERS))
            elif draw < 0.97 + self.claims or step < 6:
                self.claim(chance.randrange(PLOTS), chance.randrange(MEMBERS))
            elif chance.random() < 10 * self.crash:
                self.disturb()
            if self.collisions:
                break
        return self
