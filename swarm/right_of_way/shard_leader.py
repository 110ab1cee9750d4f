"""The leader of a shard: it appends vehicles to the orders of cells, and removes them only by their host's own
word.

An entry is never revoked, and no other is put before it (see docs/design/right-of-way.md for the proof). No vehicle
waits for one that stays: it follows only those that have an entry farther on their path, or give this one back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import InitVar, dataclass, field
from functools import lru_cache
from itertools import chain
from zlib import crc32

from swarm.clock import NS_PER_S
from swarm.config.scenario import agent_of
from swarm.right_of_way.cell_orders import Orders, cells_beside
from swarm.right_of_way.generations import HEARTBEAT_NS, is_far_ahead, keep_last, was_just_sent
from swarm.right_of_way.holdings import STATES_KEPT, TABLES_KEPT
from swarm.right_of_way.host import GENERATIONS_KEPT
from swarm.right_of_way.pibt import Mover, Round
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Granted, HostState, Number, Stamp, Stand, Table

SILENT_NS = NS_PER_S
"""Vehicles of a host that is silent for this time are obstacles: no vehicle waits for them or pushes them."""
_AGE_BITS = 12
"""Ages are compared in steps of 4 s: two leaders hear the same two at different times, and have to agree which is
the older most of the time, or each lets its own wait for the other (docs/design/right-of-way.md)."""
_GRANT_AGAIN_NS = 3 * HEARTBEAT_NS // 4
"""Interval at which an unchanged grant is repeated: somewhat less than a heartbeat, so that a heartbeat carries
it."""
MOST_EXTERNALS = 256
"""External vehicles that one shard has ever known: their generations stay in its table, as those of all hosts
(docs/design/external-vehicles.md)."""
MOST_CELLS_OF_EXTERNAL = 1024
"""Cells of one shard that one external vehicle holds (docs/design/external-vehicles.md)."""
MOST_CELLS_OF_EXTERNALS = 1 << 14
"""Cells of one shard that all external vehicles together hold: a quarter of one as large as a region
(docs/design/external-vehicles.md)."""
_MOST_BEFORE = 2
"""Entries that one may wait for: each more would hold up those behind it for longer."""
MOST_CELLS = 42
"""Limit for one vehicle. Entries on two of three files are at most 63 then, as many as a `Held` takes."""


def _turn(stand: Stand) -> tuple[int, int, str]:
    """Returns the sort key: the longest wait first. Ties are drawn by lot for each step of the age, because sorting
    by name would always favour the same agent, as all waits begin together at the start of a run."""
    step = stand.age_ms >> _AGE_BITS
    return -step, _lot(stand.vehicle, step), stand.vehicle


def is_entering(stand: Stand) -> bool:
    """Returns True if the vehicle holds no cell and requests its first."""
    return not stand.holds and stand.ahead[:1] == [stand.cell]


def exceeds_externals(table: Table, fleets: Mapping[str, Collection[str]]) -> bool:
    """Returns True if external vehicles have more of a table than leaders grant them."""
    counts = Counter[str]()
    for vehicle, entries in table.grants.items():
        if (host := agent_of(vehicle)) not in fleets:
            counts[host] += len(entries)
    return (
        counts.total() > MOST_CELLS_OF_EXTERNALS
        or any(count > MOST_CELLS_OF_EXTERNAL for count in counts.values())
        or len(table.hosts.keys() - fleets.keys()) > MOST_EXTERNALS
    )


@lru_cache(maxsize=1 << 14)
def _lot(vehicle: str, step: int) -> int:
    return crc32(f"{vehicle}/{step}".encode())


@dataclass(slots=True)
class _Host:
    """Known state of a host.

    state       the newest of its newest generation, and when it came; None if none counts
    stands      of that, vehicle -> its stand, for vehicles that the host may speak for
    asking      those of them that are at rest, or request more than they are granted; other vehicles under way
                request nothing now
    spoke_ns    time of the last message, of any of its generations: a replaced one is informed
    sent        the last grant to it; `sent_ns` is its time
    statements  (generation, seq) -> statement, the last ones, if changes of them are read
    changes     whether the newest was sent as changes: then so are grants
    """

    spoke_ns: int
    state: HostState | None = None
    stands: dict[str, Stand] = field(default_factory=dict)
    asking: Sequence[Stand] = ()
    heard_ns: int = 0
    sent: object = None
    sent_ns: int = 0
    statements: dict[Stamp, HostState] = field(default_factory=dict)
    changes: bool = False


@dataclass
class Leader:
    """Holds one shard's table in one epoch. Every `tick` may make a new one, which counts once a majority stored
    it.

    fleets   agent -> its vehicles, all of the scenario's. Any other host is an external vehicle
             (docs/design/external-vehicles.md): its vehicles are those that bear its name
    without  agent -> number of its newest revoked certificate, after which the table was agreed by the others
    """

    _shards: Shards
    _me: str
    epoch: int
    table: InitVar[Table]
    _fleets: Mapping[str, Collection[str]]
    without: InitVar[Mapping[str, int] | None] = None

    def __post_init__(self, table: Table, without: Mapping[str, int] | None) -> None:
        self.seq = 0
        self.refused: list[str] = []
        self._shard = table.shard
        self._without = dict(table.without)
        for name, number in (without or {}).items():
            self._without[name] = max(number, self._without.get(name, 0))
        self._orders = Orders(table)
        self._hosts: dict[str, _Host] = {}
        self._pushed: dict[str, int] = {}
        self._stands: dict[str, Stand] = {}
        """Vehicle -> its stand, by the hosts that have spoken lately."""
        self._granted = True  # since the last table: something that a host waits for
        self._changed = False  # or anything else
        self._table: Table | None = None
        self._table_ns = 0
        self._content: dict[Stamp, dict[str, tuple[Granted, object]]] = {}
        """Stamp of a table -> as `_content_of` it."""
        self._granted_stamp: Stamp | None = None
        self._granted_ns = 0

    @property
    def _next_stamp(self) -> Stamp:
        return self.epoch, self.seq + 1

    # --- what hosts say -------------------------------------------------------------------------------------

    def take_host_state(self, state: HostState, now_ns: int) -> None:
        host = state.agent
        if not self._is_welcome(host):
            self.refused.append(
                f"shard {self._shard} has known {MOST_EXTERNALS} external vehicles: {host} cannot enter"
            )
            return
        if host not in self._hosts:
            self._hosts[host] = _Host(now_ns)
            self._changed = True
        known = self._hosts[host]
        known.spoke_ns = now_ns
        generation, seq = self._orders.hosts.get(host, (0, 0))
        if state.ended:
            for ended in (*state.dead, state.generation):
                self._granted |= self._orders.end(host, ended)
            return
        if (state.generation, state.seq) <= (generation, seq):
            return
        known.changes = state.since > 0
        if (whole := state.whole(known.statements)) is None:
            return
        state = whole
        if is_far_ahead(state.generation, generation):
            self.refused.append(f"{host} names a generation that is implausibly far ahead: {state.generation}")
            return
        fenced = {each for name, each in self._orders.fenced if name == host}
        if state.generation != generation and len(fenced) >= GENERATIONS_KEPT and fenced.isdisjoint(state.dead):
            self.refused.append(f"{host} has {len(fenced)} generations here which are not known to have ended")
            return
        if state.generation != generation:
            known.sent = None
            self.seq += 1  # two generations of one tick are given different entries
        if not state.vehicles and (known.state is None or known.state.vehicles):
            self._changed = True  # it leaves the shard as soon as a table counts this
        stands = self._stands_of(state)
        holds = {id: stand.holds for id, stand in stands.items()}
        bodies = {id: stand.cell for id, stand in stands.items() if is_entering(stand)}
        before = self._orders.by_host_count(host)
        self._granted |= self._orders.take_host_state(
            host, state.generation, state.seq, holds, state.knows, state.dead, bodies, self._next_stamp
        )
        self._changed |= self._orders.by_host_count(host) != before
        self.seq = max(self.seq, self._orders.newest - 1)  # the next table is not older than its entries
        known.state, known.stands, known.heard_ns = state, stands, now_ns
        if self._shards.reads_changes(host):
            keep_last(known.statements, (state.generation, state.seq), state, STATES_KEPT)
        known.asking = [stand for stand in stands.values() if stand.ahead or stand.cell == stand.end]

    def _is_welcome(self, host: str) -> bool:
        """Returns True if there is room for this host: for each of the scenario, and for a number of external
        vehicles."""
        if host in self._fleets or host in self._orders.hosts or host in self._hosts:
            return True
        known = self._orders.hosts.keys() | self._hosts.keys()
        return len(known - self._fleets.keys()) < MOST_EXTERNALS

    def _stands_of(self, state: HostState) -> dict[str, Stand]:
        """Returns vehicle -> its stand, for vehicles that the host may speak for."""
        fleet = self._fleets.get(state.agent)
        if fleet is None:
            return {each.vehicle: each for each in state.vehicles if agent_of(each.vehicle) == state.agent}
        return {each.vehicle: each for each in state.vehicles if each.vehicle in fleet}

    # --- what is granted ------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> Table | None:
        """Grants all possible requests. Returns the table if a host waits for a change in it, or once in a
        heartbeat: the same as before if it is unchanged."""
        self._plan(now_ns)
        if not self._granted and now_ns - self._table_ns < HEARTBEAT_NS:
            return None
        if self._table is None or self._granted or self._changed:
            self.seq += 1
            stamp = self.epoch, self.seq
            self._table = self._orders.table(self._shard, self._me, stamp, self._pushed, self._without)
            keep_last(self._content, stamp, self._content_of(self._table), TABLES_KEPT)
        self._changed = self._granted = False
        self._table_ns = now_ns
        return self._table

    def granted(self, table: Table, now_ns: int) -> Iterator[Granted]:
        """Returns the table's content for each host that has spoken lately, if it is new or `_GRANT_AGAIN_NS` have
        passed since the last message."""
        if was_just_sent(table.stamp, self._granted_stamp, now_ns - self._granted_ns, _GRANT_AGAIN_NS):
            return
        self._granted_stamp, self._granted_ns = table.stamp, now_ns
        for name, (granted, news) in self._content.get(table.stamp, {}).items():
            host = self._hosts[name]
            silent = now_ns - host.spoke_ns > SILENT_NS
            if not silent and not was_just_sent(news, host.sent, now_ns - host.sent_ns, _GRANT_AGAIN_NS):
                host.sent, host.sent_ns = news, now_ns
                yield self._since_used(granted, host)

    def _since_used(self, granted: Granted, host: _Host) -> Granted:
        """Returns a grant, to a host that sends changes as changes since the one that it has used."""
        used = host.state.knows if host.changes and host.state is not None else (0, 0)
        base, _ = self._content.get(used, {}).get(granted.host, (None, None))
        return granted if base is None or base.generation != granted.generation else granted.changes(base)

    def _content_of(self, table: Table) -> dict[str, tuple[Granted, object]]:
        """Returns host -> its part of the table that has just been made, and what of that is news: not the number
        of the table nor, while the host has vehicles, which statement of it was heard."""
        orders, cols, followed = self._orders, self._shards.grid.cols, self._orders.followed()
        found: dict[str, tuple[Granted, object]] = {}
        for name, host in self._hosts.items():
            grants, waits = orders.granted(name)
            # Also around those under way: their requests once they come to rest depend on the cells around.
            stands = () if host.state is None else host.state.vehicles
            near = set[int]().union(*(cells_beside(stand.end, cols) for stand in stands))
            generation, heard = table.hosts.get(name, (0, 0))
            granted = Granted(
                shard=table.shard,
                host=name,
                agent=table.agent,
                epoch=table.epoch,
                seq=table.seq,
                generation=generation,
                heard=heard,
                grants=grants,
                waits=waits,
                followed=followed.get(name, {}),
                pushed={vehicle: age for vehicle, age in table.pushed.items() if vehicle in grants},
                occupied=orders.occupied(near, name),
            )
            news = grants, waits, granted.followed, granted.pushed, granted.occupied
            found[name] = granted, (generation, 0 if stands else heard, news)
        return found

    def _plan(self, now_ns: int) -> None:
        hosts = [
            host for host in self._hosts.values() if host.state is not None and now_ns - host.heard_ns <= SILENT_NS
        ]
        # The vehicle that has been on its way for longest goes first.
        asking = sorted(chain.from_iterable([host.asking for host in hosts]), key=_turn)
        movers: dict[str, Mover] = {}
        for stand in [each for each in asking if each.cell == each.end]:
            entries = self._orders.entries(stand.vehicle)
            if not entries and is_entering(stand):
                continue  # no vehicle makes way for it
            if not entries or (len(entries) == 1 and entries[0][0] == stand.cell):
                outside = not entries or stand.cell in stand.wants  # it waits to come to its first cell
                movers[stand.vehicle] = Mover(
                    stand.vehicle, stand.cell, stand.wants, stand.better, stand.age_ms, outside=outside
                )
        self._stands = dict(chain.from_iterable(host.stands.items() for host in hosts))
        round = Round(
            list(movers.values()),
            lambda cell: self._stays(cell, movers),
            lambda cell: self._shards.of(cell) == self._shard,
            self._orders.onward,
        )
        for stand in asking:
            mover = movers.get(stand.vehicle)
            if mover is not None:
                round.plan(mover, pushed=self._orders.is_followed(mover.cell, mover.id))
            elif (ahead := self._next_ahead(stand)) and not self._orders.waits(stand.vehicle):
                self._grant(stand, ahead, round.taken)
        # Vehicles that make way are granted first, so that others may follow them.
        still = {mover.cell: id for id, mover in movers.items() if not mover.outside}
        granted: set[str] = set()
        for stand in [each for each in asking if each.vehicle in round.to]:
            chain_of = [stand.vehicle]
            while (next := still.get(round.to.get(chain_of[-1], -1))) is not None and next not in chain_of:
                chain_of.append(next)
            for vehicle in reversed(chain_of):
                to = round.to.get(vehicle)
                if to is not None and vehicle not in granted:
                    granted.add(vehicle)
                    each = self._stands[vehicle]
                    if to != each.cell:
                        self._grant(each, each.ahead if each.ahead[:1] == [to] else [to], round.taken)
        if round.pushed != self._pushed:
            self._pushed = round.pushed
            self._granted = True

    def _stays(self, cell: int, movers: Mapping[str, Mover]) -> bool:
        """Returns True if the last in a cell's order stays there under any plan: it neither goes on nor may be
        pushed."""
        order = self._orders.order(cell)
        if not order:
            return False
        number = [*order][-1]
        mover = movers.get(order[number])
        if mover is not None and mover.cell == cell and not mover.outside:
            return self._orders.is_fenced(cell)
        return not self._goes_on(order[number], number)

    def _goes_on(self, vehicle: str, number: Number) -> bool:
        """Returns True if a vehicle of which the host has spoken lately has an entry farther on its path, or gives
        this one back as soon as it is followed."""
        stand, entries = self._stands.get(vehicle), self._orders.entries(vehicle)
        if stand is None or number not in entries or self._orders.is_fenced(number[0]):
            return False
        if entries.index(number) > stand.keeps:
            return True
        # Into a shard of a greater number only: no leader sees circles over two, and so there are none.
        return number != entries[-1] or (
            number[0] != stand.end and number in stand.holds and self._shards.of(stand.end) > self._shard
        )

    def _next_ahead(self, stand: Stand) -> Sequence[int]:
        """The cells ahead of one that is under way, from where all that it has been granted ends."""
        cells = [number[0] for number in self._orders.entries(stand.vehicle)] or [stand.end]
        ahead = [stand.end, *stand.ahead]
        follows = stand.end in cells and cells[-1] in ahead
        return ahead[ahead.index(cells[-1]) + 1 :] if follows else []

    def _grant(self, stand: Stand, ahead: Sequence[int], taken: dict[int, str]) -> None:
        """Append entries up to the first that is not possible, or that waits: none goes behind that. Further than
        the vehicle keeps them only where no other vehicle is near."""
        orders, vehicle = self._orders, stand.vehicle
        for cell in ahead:
            mine = taken.setdefault(cell, vehicle) == vehicle
            if not mine or self._shards.of(cell) != self._shard:
                return
            order = orders.order(cell)
            if order and not self._may_follow(stand, order):
                return
            held = len(orders.entries(vehicle))
            if held >= MOST_CELLS or not self._external_may_hold_more(vehicle):
                return
            if held > stand.keeps and self._is_near(cell, vehicle):
                return
            if not orders.append(vehicle, cell, self._next_stamp):
                return
            self._granted = True
            if len(order) > 1:
                return

    def _is_near(self, cell: int, vehicle: str) -> bool:
        """Returns True if another vehicle has an entry of a cell, or of one beside it."""
        held = self._orders.orders
        near = held.keys() & cells_beside(cell, self._shards.grid.cols)
        return any(other != vehicle for each in (cell, *near) for other in self._orders.order(each).values())

    def _may_follow(self, stand: Stand, order: Mapping[Number, str]) -> bool:
        """Returns True if a vehicle may be put behind those in an order."""
        number = [*order][-1]
        return (
            len(order) <= _MOST_BEFORE
            and not is_entering(stand)
            and self._goes_on(order[number], number)
            and not self._orders.would_circle(stand.vehicle, number[0])
        )

    def _external_may_hold_more(self, vehicle: str) -> bool:
        """Returns True if neither this external vehicle nor all together hold their share; true of vehicles of the
        scenario."""
        host = agent_of(vehicle)
        if host in self._fleets:
            return True
        fleets, count = self._fleets, self._orders.by_host_count
        if count(host) >= MOST_CELLS_OF_EXTERNAL:
            return False
        return (
            sum(count(external) for external in self._orders.by_host if external not in fleets)
            < MOST_CELLS_OF_EXTERNALS
        )
