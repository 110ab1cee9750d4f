"""A thief of one agent's name among honest agents: it goes by the rules, and lies in every message that the name
lets it write."""

from __future__ import annotations

import random
from collections.abc import Iterator

from msgspec.structs import replace
from support.traffic_world import Disk, Faults, Process, TrafficWorld

from swarm.config.agents import agent_of
from swarm.right_of_way.holdings import part_of
from swarm.wire.messages.traffic import Granted, Held, Number, Stored, Table, Word
from vehicle_agent.traffic.cell_orders import Orders
from vehicle_agent.traffic.member import AskPromises
from vehicle_agent.traffic.right_of_way_core import Action

_EPOCHS = (0, 1, 1, 2, 50)
"""Number of its own epochs by which a lie is ahead."""


class Thief(Process):
    """The process of the stolen name."""

    world: ThiefWorld

    def perform(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, Table) and self.chance.random() < 0.5:
                self.tell(self.stolen_from(action))
            elif isinstance(action, Stored) and self.chance.random() < 0.3:
                super().perform([replace(action, seq=action.seq + self.chance.choice((-1, 1, 100)))])
            elif isinstance(action, Word) and self.chance.random() < 0.3:
                super().perform([replace(action, seq=action.seq + 5, asks=True, lacks=self.any_of(action))])
            else:
                super().perform([action])

    @property
    def chance(self) -> random.Random:
        return self.world.chance

    def tick(self) -> None:
        super().tick()
        for shard, member in self.rights._members.items():
            if self.chance.random() < 0.5:
                epochs = range(member.promised + 1, member.promised + 1 + len(self.world.shards.members(shard)))
                ours = next(epoch for epoch in epochs if self.world.shards.leader(shard, epoch) == self.agent)
                epoch = ours + self.chance.choice(_EPOCHS) * len(epochs)
                seq = self.chance.choice((1, 2, 3, 1 << 20))
                lie = self.stolen_from(replace(member.stored, agent=self.agent, epoch=epoch, seq=seq))
                self.world.lies += 1
                self.tell(lie)
                if self.chance.random() < 0.2:
                    others = [each for each in self.world.shards.members(shard) if each != self.agent]
                    super().perform([AskPromises(shard, epoch, tuple(others))])

    def hear_claim(self, shard: int, epoch: int) -> list[Action]:
        """Votes for all, twice, and for a table of its own."""
        actions = super().hear_claim(shard, epoch)
        if self.chance.random() < 0.5:
            return actions
        stored = self.rights._members[shard].stored if shard in self.rights._members else None
        return actions if stored is None else [replace(self.stolen_from(stored), epoch=max(epoch - 4, 1), seq=9)]

    def stolen_from(self, table: Table) -> Table:
        """The table, in which a vehicle of one host is given a cell of another."""
        shards, free = self.world.shards, Orders(table)
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
        assert shards.of(stolen[0]) == table.shard
        return replace(table, grants={id: Held.of(path) for id, path in grants.items() if path}, hosts=hosts)

    def any_of(self, word: Word) -> list[Number]:
        """Entries of a host that it may not have heard of yet."""
        grants = self.rights._members[word.shard].stored.grants.items()
        return [[*path][-1] for vehicle, path in grants if agent_of(vehicle) == word.host]

    def tell(self, table: Table) -> None:
        """Different members and hosts are told different tables of one number, each with the words that go with
        it."""
        tables = [table, self.stolen_from(table), self.rights._members[table.shard].stored]
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
        stamp = {"epoch": table.epoch, "seq": table.seq}
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
    vehicles of the others."""

    def __init__(self, seed: int, agents: int, per_agent: int, size: int, side: int, faults: Faults) -> None:
        self.lies = 0
        self.stolen = f"a{seed % agents}"
        super().__init__(seed, agents, per_agent, size, side, faults, proven=True)

    def process_of(self, agent: str, disk: Disk) -> Process:
        return (Thief if agent == self.stolen else Process)(self, agent, disk)

    def revoke(self) -> None:
        for process in [each for each in self.processes if each.agent == self.stolen]:
            process.alive = False
            self.processes.remove(process)

    def restart(self, process: Process) -> None:
        if process.agent != self.stolen or not self.quiet:
            super().restart(process)
