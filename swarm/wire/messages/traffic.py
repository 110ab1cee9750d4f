"""Messages about right of way: what hosts say of their vehicles, and what leaders grant
(docs/design/right-of-way.md)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate, chain, groupby, pairwise, repeat
from typing import Annotated

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from swarm.grid import MOST_SHARD_REGIONS, REGION_CELLS
from swarm.wire import fields
from swarm.wire.messages import Message, schema_of

Stamp = tuple[fields.Natural, fields.Natural]
"""(epoch, seq): which table of a shard. Later ones compare greater."""
Number = tuple[fields.Cell, fields.Natural, fields.Natural]
"""(cell, epoch, seq): an entry in the order of vehicles for a cell, by the table that added it."""
Before = tuple[fields.Natural, fields.Natural, fields.VehicleId]
"""(epoch, seq, vehicle) of another entry of the same cell."""
_MOST_CELLS = 1 << 32
"""Cells of the largest grid; as those of a `Cell`, the cells of an entry may lie outside the grid."""
_LEAST_CELL = -_MOST_CELLS // 2
_Turn = Annotated[int, Meta(gt=-2 * _MOST_CELLS, lt=2 * _MOST_CELLS)]
_Run = Annotated[int, Meta(ge=1, le=64)]
Milliseconds = Annotated[int, Meta(ge=0, lt=1 << 32)]
ShardSide = Annotated[int, Meta(ge=REGION_CELLS, le=MOST_SHARD_REGIONS * REGION_CELLS, multiple_of=REGION_CELLS)]
"""In cells."""


class Held(msgspec.Struct, frozen=True, array_like=True):
    """Entries of one vehicle in driving order.

    first   cell of the first entry; 0 if there is none
    turns   the first step from cell to cell, then differences between successive steps: zeros on a straight path
    stamps  (epoch, seq, count): the tables which added the entries, each with the number of entries in turn
    """

    first: fields.Cell = 0
    turns: Annotated[list[_Turn], Meta(max_length=63)] = []
    stamps: Annotated[list[tuple[fields.Natural, fields.Natural, _Run]], Meta(max_length=64)] = []

    @classmethod
    def of(cls, numbers: Sequence[Number]) -> Held:
        if not numbers:
            return _NONE_HELD
        cells = [number[0] for number in numbers]
        steps = [after - cell for cell, after in pairwise(cells)]
        turns = [*steps[:1], *(after - step for step, after in pairwise(steps))]
        runs = groupby(numbers, key=lambda number: number[1:])
        return cls(cells[0], turns, [(*stamp, len([*run])) for stamp, run in runs])

    def __post_init__(self) -> None:
        stamps, turns = self.stamps, self.turns
        count = stamps[0][2] if len(stamps) == 1 else sum([run[2] for run in stamps])
        if count != (len(turns) + 1 if stamps else 0):
            raise ValueError("expected as many stamps as cells")
        # No cell is further from the first than this, and most are near: that is known without computing each.
        reach = count * sum(map(abs, turns)) if turns else 0
        if not _LEAST_CELL + reach <= self.first < _MOST_CELLS - reach and not all(
            _LEAST_CELL <= cell < _MOST_CELLS for cell in self.cells
        ):
            raise ValueError("expected cells of 32 bits")

    def __len__(self) -> int:
        return len(self.turns) + 1 if self.stamps else 0

    @property
    def cells(self) -> Iterator[int]:
        """The cells of the entries."""
        return accumulate(accumulate(self.turns), initial=self.first) if self.stamps else iter(())

    def __iter__(self) -> Iterator[Number]:
        stamps = chain.from_iterable(repeat((epoch, seq), count) for epoch, seq, count in self.stamps)
        return ((cell, *stamp) for cell, stamp in zip(self.cells, stamps, strict=True))


_NONE_HELD = Held()


def _differing(grants: dict[str, Held], base: dict[str, Held]) -> dict[str, Held]:
    """Returns the grants that differ from those before, an empty one for a vehicle that has none any more."""
    changed = {vehicle: held for vehicle, held in grants.items() if base.get(vehicle) != held}
    return changed | {vehicle: _NONE_HELD for vehicle in base if vehicle not in grants}


def _merged(base: dict[str, Held], changes: dict[str, Held]) -> dict[str, Held]:
    """Returns the grants of which `changes` differ from a base."""
    return {vehicle: held for vehicle, held in (base | changes).items() if held.stamps}


class Stand(msgspec.Struct, frozen=True, array_like=True):
    """One vehicle, as its host tells it to the members of one shard.

    cell    where it stands, perhaps in another shard
    end     where what it holds ends, perhaps in another shard
    holds   its entries of this shard
    ahead   its next cells after `end`
    wants   other cells to which it could go, the best first; only while it stands
    better  number of those which are better than to stay; the others serve to make way
    age_ms  time on its way: the vehicle with the longest goes first
    keeps   number of cells ahead which it keeps: its host gives back others once a vehicle waits for them
    """

    vehicle: fields.VehicleId
    cell: fields.Cell
    end: fields.Cell
    holds: Held
    ahead: Annotated[list[fields.Cell], Meta(max_length=16)]
    wants: Annotated[list[fields.Cell], Meta(max_length=8)]
    better: Annotated[int, Meta(ge=0, le=8)]
    age_ms: Milliseconds
    keeps: Annotated[int, Meta(ge=0, le=16)] = 16


class HostState(Message, frozen=True, kw_only=True, tag=schema_of("host-state", 9)):
    """All vehicles of a host that hold or request a cell of one shard, sent to one of its members. The newest
    replaces the older.

    generation  of the host; a later one is greater
    knows       stamp of the newest table that the host has used. It has left or given back every entry which that
                table, or an older one, added and which is not listed in `vehicles`
    dead        earlier generations that have certainly ended: they had locked the host's file, which this one has
                locked now
    ended       this generation has stopped driving, for good
    never       entries later than `knows` that this generation does not hold, and never takes: members asked for
                them
    since       seq of an earlier host state: `vehicles` has only the stands that differ from its. 0 if `vehicles`
                has all
    gone        vehicles of that earlier host state which are not here any more
    """

    shard: fields.Shard
    agent: fields.Id
    generation: fields.Natural
    seq: fields.Natural
    knows: Stamp
    vehicles: Annotated[list[Stand], fields.SMALL]
    dead: Annotated[list[fields.Natural], Meta(max_length=32)] = []
    ended: bool = False
    never: Annotated[list[Number], fields.SMALL] = []
    since: fields.Natural = 0
    gone: Annotated[list[fields.VehicleId], fields.SMALL] = []

    def changes(self, base: HostState) -> HostState:
        """Returns the same host state for a leader that has an earlier one of this generation."""
        before = {stand.vehicle: stand for stand in base.vehicles}
        vehicles = [stand for stand in self.vehicles if before.pop(stand.vehicle, None) != stand]
        return replace(self, vehicles=vehicles, since=base.seq, gone=[*before])

    def whole(self, known: Mapping[Stamp, HostState]) -> HostState | None:
        """Returns the host state with all stands; None if its base is not among those known, by generation and
        seq, or it is too large to be true."""
        if not self.since:
            return self
        base = known.get((self.generation, self.since))
        if base is None:
            return None
        stands = {stand.vehicle: stand for stand in chain(base.vehicles, self.vehicles)}
        for vehicle in self.gone:
            stands.pop(vehicle, None)
        fits = len(stands) <= fields.MOST_VEHICLES
        return replace(self, vehicles=[*stands.values()], since=0, gone=[]) if fits else None


class Entry(msgspec.Struct, frozen=True, array_like=True):
    """A vehicle's place in the order of vehicles for one cell.

    number  (cell, epoch, seq)
    after   (epoch, seq, vehicle) of the entries before it which the table still lists: the vehicle waits for each
    """

    number: Number
    after: Annotated[list[Before], Meta(max_length=64)] = []

    @property
    def cell(self) -> int:
        return self.number[0]


def entries_of(held: Iterable[Number], waits: Iterable[Entry]) -> list[Entry]:
    """Returns the entries of a vehicle, of which these wait."""
    waiting = {entry.number: entry for entry in waits}
    return [waiting.get(number) or Entry(number) for number in held]


class Fence(msgspec.Struct, frozen=True, array_like=True):
    """The entries of an earlier generation of a host, on which its vehicles may still be."""

    agent: fields.Id
    generation: fields.Natural
    entries: Annotated[dict[fields.VehicleId, Held], fields.LARGE]


class Table(Message, frozen=True, kw_only=True, tag=schema_of("table", 9)):
    """All entries (cells granted or waited for) of one shard, from its leader to the members; in a reply, what a
    member has on file. The entries of a cell are in the order of their numbers.

    hosts    agent -> [generation, seq] of the newest host state that counts in this table
    grants   vehicle -> its entries
    fences   entries of earlier generations, whose vehicles may still drive
    pushed   vehicle -> the age with which it is to make way into another shard
    without  agent -> number of its newest revoked certificate (a0~2 is the second of a0). A leader began without
             that member, with what two of the three others had on file
    since    stamp of an earlier table of the same epoch, from which this one has the differences only: changed
             `hosts` and `grants`, which are empty for a vehicle without entries now. None if the table is whole
    """

    shard: fields.Shard
    agent: fields.Id
    epoch: fields.Natural
    seq: fields.Natural
    hosts: Annotated[dict[fields.Id, tuple[fields.Natural, fields.Natural]], fields.IDS]
    grants: Annotated[dict[fields.VehicleId, Held], fields.LARGE]
    fences: Annotated[list[Fence], fields.IDS] = []
    pushed: Annotated[dict[fields.VehicleId, Milliseconds], fields.LARGE] = {}
    without: Annotated[dict[fields.Id, fields.Natural], fields.IDS] = {}
    since: Stamp | None = None

    @property
    def stamp(self) -> Stamp:
        return self.epoch, self.seq

    def changes(self, base: Table) -> Table:
        """Returns this table as its differences from `base`, for members that have that one on file."""
        if not base.hosts.keys() <= self.hosts.keys():
            return self
        hosts = {host: said for host, said in self.hosts.items() if base.hosts.get(host) != said}
        return replace(self, hosts=hosts, grants=_differing(self.grants, base.grants), since=base.stamp)

    def whole(self, known: Mapping[Stamp, Table]) -> Table | None:
        """Returns the table with all entries; None if its base is not among those known, or it is too large to be
        true."""
        if self.since is None:
            return self
        base = known.get(self.since) if self.since[0] == self.epoch else None
        if base is None:
            return None
        hosts, grants = base.hosts | self.hosts, _merged(base.grants, self.grants)
        fits = len(hosts) <= fields.MOST_IDS and len(grants) <= fields.MOST_LARGE
        return replace(self, hosts=hosts, grants=grants, since=None) if fits else None


class Stored(Message, frozen=True, kw_only=True, tag=schema_of("stored")):
    """A member of a shard has the table of this stamp on file."""

    shard: fields.Shard
    agent: fields.Id
    epoch: fields.Natural
    seq: fields.Natural


class Granted(Message, frozen=True, kw_only=True, tag=schema_of("granted", 9)):
    """Content of a shard's table for one host, once a majority of the shard's members has it on file.

    agent              the leader
    epoch, seq         stamp of the table
    generation, heard  generation and seq of the host's newest host state in the table; 0 if there is none
    grants             as in `Table`
    waits              vehicle -> those of its entries that wait for others
    followed           host -> entries of this host behind which its vehicles wait
    pushed             as in `Table`
    occupied           cells held by others near the ends of this host's paths
    since              stamp of an earlier table, which the host has used: `grants` has only what differs from it,
                       an empty one for a vehicle that has no entry any more. None if it has all. Sent to hosts
                       which send changes, too
    """

    shard: fields.Shard
    host: fields.Id
    agent: fields.Id
    epoch: fields.Natural
    seq: fields.Natural
    generation: fields.Natural
    heard: fields.Natural
    grants: Annotated[dict[fields.VehicleId, Held], fields.SMALL] = {}
    waits: Annotated[dict[fields.VehicleId, Annotated[list[Entry], Meta(max_length=64)]], fields.SMALL] = {}
    followed: Annotated[dict[fields.Id, Annotated[list[Number], fields.SMALL]], fields.IDS] = {}
    pushed: Annotated[dict[fields.VehicleId, Milliseconds], fields.SMALL] = {}
    occupied: Annotated[list[fields.Cell], fields.LARGE] = []
    since: Stamp | None = None

    @property
    def stamp(self) -> Stamp:
        return self.epoch, self.seq

    def changes(self, base: Granted) -> Granted:
        """Returns the same grant for a host that has used an earlier one."""
        return replace(self, grants=_differing(self.grants, base.grants), since=base.stamp)

    def whole(self, known: Mapping[Stamp, Granted]) -> Granted | None:
        """Returns the grant with all entries; None if its base is not among those known, or it is too large to be
        true."""
        base = self if self.since is None else known.get(self.since)
        grants = {} if base is None else _merged(base.grants, self.grants)
        fits = base is not None and len(grants) <= fields.MOST_VEHICLES
        return replace(self, grants=grants, since=None) if fits else None


class Word(Message, frozen=True, kw_only=True, tag=schema_of("word")):
    """A member of a shard has on file what the leader grants to one host. Sent where certificates prove names:
    there a grant counts with the words of a majority.

    agent       the member
    epoch, seq  stamp of its newest table on file
    part        digest of what the table grants to the host
    asks        the member lacks a statement of the host, without which it stores no later table
    lacks       entries of the host that such a table omits: the host disclaims those that it does not hold
    """

    shard: fields.Shard
    host: fields.Id
    agent: fields.Id
    epoch: fields.Natural
    seq: fields.Natural
    part: fields.Natural
    asks: bool = False
    lacks: Annotated[list[Number], Meta(max_length=64)] = []


class Left(Message, frozen=True, kw_only=True, tag=schema_of("left")):
    """Entries that vehicles of a host have left or given back for good, for a host whose vehicles wait behind them.
    Order, loss and repetition do not matter."""

    agent: fields.Id
    host: fields.Id
    entries: Annotated[list[Number], fields.SMALL]


class Claim(Message, frozen=True, kw_only=True, tag=schema_of("claim")):
    """Claim of a member to be leader in this epoch. A member which replies promises to store no table of a lower
    epoch."""

    epoch: fields.Natural


class KnownRequest(Message, frozen=True, kw_only=True, tag=schema_of("known-request")):
    """A new generation of an agent or an external vehicle asks all agents what they know of it. Agents with shards
    or cells of another size do not answer.

    disk         its file; 0 of an external vehicle
    layer        0 ground, 1 air: only agents of this layer answer
    shard_cells  of an external vehicle the cells of right of way across a region: 256 for each across a cell of the
                 terrain
    """

    agent: fields.Id
    disk: fields.Natural
    layer: Annotated[int, Meta(ge=0, le=1)] = 0
    shard_cells: ShardSide = REGION_CELLS


class Known(Message, frozen=True, kw_only=True, tag=schema_of("known")):
    """One agent's record of another.

    agent        which replies
    disk         the other's file: the first that it received
    generation   the other's greatest one in any table
    shards       those whose tables grant cells to the other's vehicles, or keep cells of its earlier generations
                 shut
    agents       for an external vehicle, which may not know the scenario: the agents of which some are members of
                 each shard
    generations  for an external vehicle: all of its own in tables, so that an operator can say that they have ended
    """

    agent: fields.Id
    disk: fields.Natural
    generation: fields.Natural
    shards: Annotated[list[fields.Shard], fields.LARGE]
    agents: Annotated[list[fields.Id], fields.IDS] = []
    generations: Annotated[list[fields.Natural], Meta(max_length=32)] = []
    shard_cells: ShardSide = REGION_CELLS
