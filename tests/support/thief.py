"""A thief of one agent's name among honest agents: it goes by the rules, and lies in every message that the name
lets it write."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

from msgspec.structs import replace
from support.traffic_world import Disk, Faults, Process, TrafficWorld

from swarm.clock import NS_PER_S
from swarm.config.scenario import agent_of
from swarm.right_of_way.agent_core import Action
from swarm.right_of_way.cell_orders import Orders
from swarm.right_of_way.holdings import SendState, part_of
from swarm.right_of_way.shard_member import AskPromises
from swarm.wire.messages.traffic import Fence, Granted, Held, HostState, Left, Number, Stored, Table, Word

_EPOCHS = (0, 1, 1, 2, 50)
"""Number of its own epochs by which a lie is ahead."""


class Thief(Process):
    """The process of the stolen name."""

    world: ThiefWorld
    past: list[Table]
    """Tables of its own."""

    def __init__(self, world: ThiefWorld, agent: str, disk: Disk) -> None:
        self.past = []
        self.lies_often = world.chance.choice((0.1, 0.4, 1.0))
        super().__init__(world, agent, disk)

    def perform(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, Table):
                self.past = [*self.past[-20:], action]
            if not self.lies(0.4):
                super().perform([action])
            elif isinstance(action, Table):
                self.tell(self.lied_about(action))
            elif isinstance(action, SendState):
                super().perform([SendState((member,), self.misstated(action.state)) for member in action.members])
            elif isinstance(action, Left):
                super().perform([replace(action, entries=[*action.entries, *self.world.entries()][:16])])
            elif isinstance(action, Stored):
                super().perform([replace(action, seq=action.seq + self.chance.choice((-1, 1, 100)))])
            elif isinstance(action, Word):
                super().perform([replace(action, seq=action.seq + 5, asks=True, lacks=self.any_of(action))])
            else:
                super().perform([action])

    @property
    def chance(self) -> random.Random:
        return self.world.chance

    def lies(self, share: float) -> bool:
        return self.chance.random() < share * self.lies_often

    def tick(self) -> None:
        super().tick()
        for shard, member in self.rights._members.items():
            if self.lies(0.5):
                epochs = range(member.promised + 1, member.promised + 1 + len(self.world.shards.members(shard)))
                ours = next(epoch for epoch in epochs if self.world.shards.leader(shard, epoch) == self.agent)
                epoch = ours + self.chance.choice(_EPOCHS) * len(epochs)
                seq = self.chance.choice((1, 2, 3, 1 << 20))
                lie = self.lied_about(replace(member.stored, agent=self.agent, epoch=epoch, seq=seq))
                self.world.lies += 1
                self.tell(lie)
                if self.chance.random() < 0.2:
                    others = [each for each in self.world.shards.members(shard) if each != self.agent]
                    super().perform([AskPromises(shard, epoch, tuple(others))])

    def hear_claim(self, shard: int, epoch: int) -> list[Action]:
        """Votes for all, twice, and for a table of its own."""
        actions = super().hear_claim(shard, epoch)
        if not self.lies(0.5):
            return actions
        stored = self.rights._members[shard].stored if shard in self.rights._members else None
        return actions if stored is None else [replace(self.lied_about(stored), epoch=max(epoch - 4, 1), seq=9)]

    def lied_about(self, table: Table) -> Table:
        """The table with a lie of any kind, whole or as changes since an earlier one."""
        member = self.rights._members.get(table.shard)
        if table.since is not None and member is not None:
            table = member.stored
        lies = (self.stolen_from, self.stolen_from, self.added_to, self.dropped_from, self.reordered, self.replayed)
        lie = self.chance.choice((*lies, self.fenced, self.renamed))
        told, bases = lie(table), [] if member is None else [*member._bases.values()]
        bases = [base for base in bases if base.epoch == told.epoch]
        return told.changes(self.chance.choice(bases)) if bases and self.chance.random() < 0.5 else told

    def added_to(self, table: Table) -> Table:
        """Cells are given to a vehicle of its own, of another, or to one that does not exist: free ones, any, those
        that it has already, or entries that it has left; after those that it has, or before."""
        taken = {number[0] for path in table.grants.values() for number in path}
        cells = range(self.world.grid.cells)
        free = [cell for cell in cells if self.world.shards.of(cell) == table.shard and cell not in taken]
        vehicle = self.chance.choice((f"{self.agent}-00", f"{self.agent}-77", "ghost-00", *table.grants))
        path = [*table.grants.get(vehicle, ())]
        left = [number for old in self.past for number in old.grants.get(vehicle, ())]
        fresh = [(cell, table.epoch, table.seq) for cell in self.chance.choice((free, cells, [*taken]))]
        fresh = self.chance.choice((fresh, fresh, fresh, left))
        more = self.chance.sample(fresh, min(self.chance.choice((1, 2, 20)), len(fresh)))
        path = self.chance.choice(([*path, *more], [*more, *path]))[:64]
        return replace(table, grants={**table.grants, vehicle: Held.of(path)}) if path else table

    def fenced(self, table: Table) -> Table:
        """Entries of a vehicle are those of an earlier generation of a host, which may be another's, or never
        was."""
        if not table.grants or not table.hosts:
            return table
        vehicle = self.chance.choice(sorted(table.grants))
        host = self.chance.choice((agent_of(vehicle), agent_of(vehicle), *sorted(table.hosts)))
        generation = max(table.hosts.get(host, (1, 1))[0] - self.chance.choice((0, 1, 1 << 32)), 0)
        dead = [*(process.disk.own.generations for process in self.world.processes if process.agent == host), []][0]
        fence = Fence(host, self.chance.choice((generation, *dead)), {vehicle: table.grants[vehicle]})
        kept = {id: path for id, path in table.grants.items() if id != vehicle}
        return replace(table, grants=kept, fences=[*table.fences, fence])

    def renamed(self, table: Table) -> Table:
        """Other statements count, or none; or it was agreed after a certificate which is not revoked."""
        if self.chance.random() < 0.5:
            hosts = {name: (generation, 1) for name, (generation, _) in table.hosts.items()}
            return replace(table, hosts=self.chance.choice((hosts, {})))
        return replace(table, without={self.chance.choice([*self.world.spawns]): self.chance.choice((0, 1))})

    def dropped_from(self, table: Table) -> Table:
        """Some vehicles have no entry."""
        kept = {vehicle: path for vehicle, path in table.grants.items() if self.chance.random() < 0.8}
        return replace(table, grants=kept)

    def reordered(self, table: Table) -> Table:
        """Two vehicles change places in the orders of cells, or have entries of other tables."""
        if len(table.grants) < 2:
            return table
        one, other = self.chance.sample(sorted(table.grants), 2)
        if self.chance.random() < 0.5:
            return replace(table, grants={**table.grants, one: table.grants[other], other: table.grants[one]})
        early = [(cell, epoch, max(seq - 1, 0)) for cell, epoch, seq in table.grants[one]]
        return replace(table, grants={**table.grants, one: Held.of(early)})

    def replayed(self, table: Table) -> Table:
        """An earlier table of its own, under a new number."""
        old = self.chance.choice([*self.past, table])
        return table if old.shard != table.shard else replace(old, epoch=table.epoch, seq=table.seq)

    def misstated(self, state: HostState) -> HostState:
        """Another start of it, of which others have ended; or vehicles that hold what others do."""
        if self.chance.random() < 0.3:
            return replace(state, generation=state.generation + self.chance.choice((-1, 1, 1 << 32)))
        if self.chance.random() < 0.3:
            return replace(state, dead=[state.generation, 1], ended=self.chance.random() < 0.5)
        stolen = [number for number in self.world.entries() if self.world.shards.of(number[0]) == state.shard]
        stands = [replace(stand, holds=Held.of([*stand.holds, *stolen][:16])) for stand in state.vehicles]
        return replace(state, vehicles=stands, never=stolen[:8], knows=(1 << 20, 1))

    def stolen_from(self, table: Table) -> Table:
        """The table, in which a vehicle of one host is given a cell of another."""
        free = Orders(table)
        thefts: list[tuple[str, Number]] = []
        for vehicle, path in table.grants.items():
            for cell in self.world.next_to([*path.cells][-1]):
                order = list(free.order(cell).items())
                thefts += [
                    (vehicle, number)
                    for number, of in order
                    if {agent_of(of), self.agent}.isdisjoint({agent_of(vehicle)}) and agent_of(of) != self.agent
                ]
        if not thefts:
            return table
        vehicle, stolen = self.chance.choice(thefts)
        owner = free.order(stolen[0])[stolen]
        grants = {id: list(path) for id, path in table.grants.items()}
        hosts = dict(table.hosts)
        how = self.chance.randrange(4)
        if how and stolen in grants.get(owner, ()):
            grants[owner].remove(stolen)  # as if its host had left it
        if how == 2 and agent_of(owner) in hosts:
            hosts[agent_of(owner)] = hosts[agent_of(owner)][0], 1 << 40
        first = (stolen[0], 0, 0) if how == 0 else (stolen[0], table.epoch, table.seq)  # before it, or after it
        grants[vehicle] = [*grants[vehicle], first]
        return replace(table, grants={id: Held.of(path) for id, path in grants.items() if path}, hosts=hosts)

    def any_of(self, word: Word) -> list[Number]:
        """Entries of a host that it may not have heard of yet."""
        grants = self.rights._members[word.shard].stored.grants.items()
        return [[*path][-1] for vehicle, path in grants if agent_of(vehicle) == word.host]

    def tell(self, table: Table) -> None:
        """Different members and hosts are told different tables of one number, each with the words that go with
        it."""
        tables = [table, self.lied_about(table), self.rights._members[table.shard].stored]
        tables[2] = replace(tables[2], agent=self.agent, epoch=table.epoch, seq=table.seq)
        for member in self.world.shards.members(table.shard):
            said = self.chance.choice(tables)
            if member != self.agent:
                self.world.send(self, member, lambda to, said=said: to.hear_table(said))
        for host in self.world.spawns:
            said = self.chance.choice(tables)
            if host != self.agent:
                for word in self.words(said, host):
                    self.world.send(self, host, lambda to, word=word: to.hear_granted(word))

    def words(self, table: Table, host: str) -> Iterator[Granted | Word]:
        """A grant by a table, sometimes without those before; and the word for it."""
        (grants, waits), generation = Orders(table).granted(host), table.hosts.get(host, (0, 0))[0]
        if self.chance.random() < 0.2:
            waits = {}
        stamp = {"epoch": table.epoch, "seq": max(table.seq + self.chance.choice((0, 0, 0, -1, -5, 100)), 1)}
        yield Granted(
            shard=table.shard,
            host=host,
            agent=self.agent,
            generation=generation,
            heard=1 << 30,
            grants=grants,
            waits=waits,
            **stamp,
        )
        part = part_of(generation, grants, waits)
        yield Word(shard=table.shard, host=host, agent=self.agent, part=part, **stamp)


class ThiefWorld(TrafficWorld):
    """Names are proven, and one of them is stolen until `faults.quiet_s`; then it is revoked. `collisions` are of
    vehicles of the others.

    revoked  number of the newest certificate of the name that is revoked; the next one may be stolen, too
    """

    def __init__(self, seed: int, agents: int, per_agent: int, size: int, side: int, faults: Faults) -> None:
        self.lies = 0
        self.revoked = 0
        self.thief: type[Process] = Thief
        """Kind of process that starts under the stolen name."""
        self.stolen = f"a{seed % agents}"
        super().__init__(seed, agents, per_agent, size, side, faults, proven=True)

    def process_of(self, agent: str, disk: Disk) -> Process:
        process = (self.thief if agent == self.stolen else Process)(self, agent, disk)
        if self.revoked:
            self.tell_revoked(process)
        return process

    def revoke(self) -> None:
        """The thief is silent from now on, and the others notice within two seconds."""
        self.end_all(self.stolen)
        self.revoked += 1
        for process in self.processes:
            self.at(self.chance.randrange(2 * NS_PER_S), lambda to=process: self.tell_revoked(to))

    def begin_again(self, kind: type[Process]) -> None:
        """The name has its next certificate, in the hands of its owner or a thief."""
        self.end_all(self.stolen)
        self.thief = kind
        self.start(self.stolen, self.disks[self.stolen][0])

    def carry(self, source: Process, to: Process, deliver: Callable[[], None]) -> None:
        """Carries nothing more that a process which has ended said under the name."""
        super().carry(source, to, lambda: deliver() if source.alive or source.agent != self.stolen else None)

    def tell_revoked(self, process: Process) -> None:
        process.rights.revoke({self.stolen: self.revoked}, process.now_ns)

    def entries(self) -> list[Number]:
        """Some entries that members have on file."""
        paths = [path for table in self.files() for path in table.grants.values()]
        return [self.chance.choice([*path]) for path in self.chance.sample(paths, min(4, len(paths)))]

    def files(self) -> list[Table]:
        """The tables on files of members."""
        return [member.stored for process in self.processes for member in process.rights._members.values()]

    def is_of_one_mind(self, shard: int) -> bool:
        """True if all honest members of a shard had one table on file lately, and all honest hosts with vehicles
        there know one of its epoch: they have the words of a majority."""
        seats = [seats[shard] for process in self.processes if shard in (seats := process.rights._members)]
        hosts = [process.rights.host for process in self.processes]
        epochs = {host._entries.knows.get(shard, (0, 0))[0] for host in hosts if shard in host.watched}
        same = [base for stamp, base in seats[0]._bases.items() if all(s._bases.get(stamp) == base for s in seats)]
        return any(epochs <= {table.epoch} for table in same)

    def restart(self, process: Process) -> None:
        if process.agent != self.stolen or not self.quiet:
            super().restart(process)
