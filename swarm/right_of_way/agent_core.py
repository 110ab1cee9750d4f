"""One agent's part in right of way: its seats among the members of shards, and the cells that its own vehicles
hold.

Messages and time in, actions out. The shell performs actions in their order: a saved file must be on disk before
later messages are sent.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import msgspec
from msgspec.structs import replace

from swarm.clock import NS_PER_S
from swarm.config.scenario import agent_of
from swarm.errors import StoreError
from swarm.grid import REGION_CELLS
from swarm.right_of_way.holdings import CellRequest, SendState
from swarm.right_of_way.host import GENERATIONS_KEPT, AskKnown, Host
from swarm.right_of_way.shard_member import Member, MemberAction, Refused, RoundTrips
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Held, HostState, Known, KnownRequest, Left, Stored, Table

_ON_DISK = {"generations": "lives", "shard_cells": "plot_cells"}
"""Names of fields in files, which stay as they were."""


class OwnRecord(msgspec.Struct, frozen=True, kw_only=True, rename=_ON_DISK):
    """An agent's record about itself and the others' files.

    disk         names this file: a number drawn when it was made
    generations  the agent's generations that have run on it, the last ones
    noted        agent -> its file, the first that we received
    noted_by     the agents that have noted ours
    shard_cells  side of the shards of which this file holds promises, if it holds any
    """

    disk: int
    generations: list[int] = []
    noted: dict[str, int] = {}
    noted_by: list[str] = []
    shard_cells: int = REGION_CELLS


Action = MemberAction | SendState | Left | OwnRecord | Known | AskKnown


@dataclass
class RightOfWay:
    """Right of way of one agent.

    spawns    agent -> vehicle -> the cell where it stands when the run begins
    own       the agent's record about itself, from its file
    saved     shard -> (promised epoch, stored table), from the same file
    vehicles  only for an external vehicle, which is not in `spawns`: its vehicles, which enter one by one. It has
              no seat
    tick_ns   time between two ticks

    host    the agent's part as a host of vehicles
    trips   round trips to the other agents
    silent  whether the file cannot be written now: then the agent is no member of any shard, and notes no other
            agent's file. The held and granted cells of its vehicles do not depend on it

    Raises StoreError if the file holds promises for shards of another size: cells could be granted twice.
    """

    agent: str
    shards: Shards
    spawns: Mapping[str, Mapping[str, int]]
    own: OwnRecord
    saved: Mapping[int, tuple[int, Table]]
    vehicles: Collection[str] = ()
    tick_ns: int = NS_PER_S // 10
    trips: RoundTrips = field(default_factory=RoundTrips)
    silent: bool = False
    _members: dict[int, Member] = field(default_factory=dict)
    _revoked: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        own, side, self.saved = self.own, self.shards.side, dict(self.saved)
        if not (self.saved or own.noted or own.noted_by):  # no vehicle depends on it: it takes any size
            self.own = replace(own, shard_cells=side)
        elif own.shard_cells != side:
            raise StoreError(
                f"agent {self.agent} has on file promises of shards of {own.shard_cells} cells, the scenario has "
                f"{side}: set map.shard_regions to {own.shard_cells // REGION_CELLS}, or start another run"
            )
        self._is_external = self.agent not in self.spawns
        self.host = Host(self.shards, self.agent, self.vehicles if self._is_external else self.spawns[self.agent])

    # --- beginning a generation -----------------------------------------------------------------------------------

    @property
    def settled(self) -> bool:
        """True if no recovery query about us is pending: our generation knows every shard with cells of ours, all
        other agents have noted our file (an external vehicle's is not noted), and no later generation leaves it to
        us to state, wherever cells of ours are shut, that we have stopped.

        A generation may begin before others could answer, as beside a router that restarts. Without a later query
        it would never speak to the leaders of shards of which we are no member, and its vehicles there would have
        no place."""
        noted = self._is_external or len(self.own.noted_by) >= len(self.spawns) - 1
        return self.host.generation > 0 and self.host.informed and noted and not self.host.replaced

    def answer_known(self, request: KnownRequest) -> list[Action]:
        """Another agent has begun a generation. The last action is what to answer.

        Its file is noted once and for all: with another one it has no seat, because what it promised stands in the
        first. An external vehicle never has a seat: its file is not noted, and it receives the list of seats.
        """
        if request.layer != self.shards.layer or request.agent in self.shards.others:
            return []
        if request.agent == self.agent or self.silent or self._is_external:
            return []
        if request.agent not in self.spawns or not request.disk:
            own = self.shards.side, REGION_CELLS * self.shards.grid.parts  # an added agent knows its shards
            if not self._has_quorum or request.shard_cells not in own:
                return []
            known = self._known_of(request.agent, request.disk)
            return [
                replace(known, generations=self._generations_of(request.agent), agents=list(self.shards.agents))
            ]
        if request.shard_cells != self.shards.side:
            return []  # what it grants is nothing that we may help to make usable
        actions: list[Action] = []
        if request.agent not in self.own.noted:
            self.own = replace(self.own, noted={**self.own.noted, request.agent: request.disk})
            actions.append(self.own)
        return [*actions, self._known_of(request.agent, self.own.noted[request.agent])]

    def hear_known(self, known: Known) -> list[Action]:
        """An answer to our question."""
        if known.agent not in self.spawns or known.agent == self.agent or known.shard_cells != self.shards.side:
            return []
        self.host.hear_known(known)
        if self.silent or self._is_external or known.disk != self.own.disk or known.agent in self.own.noted_by:
            return []
        self.own = replace(self.own, noted_by=[*self.own.noted_by, known.agent])
        return [self.own]

    def begin(self, chance: int) -> list[Action]:
        """Begins a new generation, once those who could be asked have answered.

        chance  a random number
        """
        self.host.hear_known(self._known_of(self.agent, self.own.disk))
        generations = self.host.begin(self.own.generations, chance)
        self.host.watch(map(self.shards.of, self.spawns.get(self.agent, {}).values()))
        self.own = replace(self.own, generations=generations)
        return [self.own]

    @property
    def _has_quorum(self) -> bool:
        """Returns True once the run has confirmed this shard size."""
        return self.shards.has_quorum({self.agent, *self.own.noted_by})

    def _known_of(self, agent: str, disk: int) -> Known:
        """Content of stored tables about an agent: its greatest generation in any, and the shards that grant cells
        to its vehicles or keep some of an earlier generation shut."""
        stored = self._stored()
        shards = (
            shard
            for shard, table in stored.items()
            if any(agent_of(vehicle) == agent for vehicle in table.grants)
            or any(fence.agent == agent for fence in table.fences)
        )
        return Known(
            agent=self.agent,
            disk=disk,
            generation=max((table.hosts.get(agent, (0, 0))[0] for table in stored.values()), default=0),
            shards=sorted(shards),
            shard_cells=self.shards.side,
        )

    def _stored(self) -> dict[int, Table]:
        """Shard -> the newest table of it on our file."""
        stored = {shard: table for shard, (_, table) in self.saved.items()}
        stored.update((shard, member.stored) for shard, member in self._members.items())
        return stored

    def _generations_of(self, agent: str) -> list[int]:
        """Generations of an agent that stored tables name, the newest ones."""
        generations = {table.hosts[agent][0] for table in self._stored().values() if agent in table.hosts}
        generations.update(
            each.generation for table in self._stored().values() for each in table.fences if each.agent == agent
        )
        return sorted(generations)[-GENERATIONS_KEPT:]

    # --- what is heard --------------------------------------------------------------------------------------

    def revoke(self, names: Mapping[str, int], now_ns: int) -> None:
        """Certificates of these agents up to a number are revoked: what they said as members may be false."""
        self._revoked.update(names)
        for member in self._members.values():
            member.revoke(names, now_ns)

    def hear_host_state(self, state: HostState, now_ns: int) -> None:
        member = self._member(state.shard, now_ns)
        if member is not None:
            member.hear_host_state(state, now_ns)

    def hear_table(self, table: Table, now_ns: int) -> list[Action]:
        member = self._member(table.shard, now_ns)
        return [] if member is None else [*member.hear_table(table, now_ns)]

    def hear_stored(self, stored: Stored, now_ns: int) -> list[Action]:
        member = self._member(stored.shard, now_ns)
        return [] if member is None else [*member.hear_stored(stored, now_ns)]

    def hear_claim(self, shard: int, epoch: int, now_ns: int) -> list[Action]:
        """Another member asks for our promise: `Save`, then the table to answer with; or nothing."""
        member = self._member(shard, now_ns)
        return [] if member is None else [*member.hear_claim(epoch, now_ns)]

    def hear_promise(self, member: str, epoch: int, table: Table, now_ns: int) -> None:
        seat = self._members.get(table.shard)
        if seat is not None:
            seat.hear_promise(member, epoch, table, now_ns)

    # --- time passes ----------------------------------------------------------------------------------------

    def tick(self, requests: Mapping[str, CellRequest], now_ns: int) -> list[Action]:
        """Returns the messages of our members and our vehicles to send now."""
        actions: list[Action] = [Refused(text) for text in self.host.refused]
        self.host.refused.clear()
        for shard in self.saved if self._revoked else ():
            self._member(shard, now_ns)  # they have to agree again, even if no host speaks to them
        for member in () if self.silent else self._members.values():
            actions += member.tick(now_ns)
        if self.host.replaced:
            self.host.watch(self._known_of(self.agent, self.own.disk).shards)
        actions += self.host.lefts(now_ns)
        actions += self.host.host_states(requests, now_ns)
        if self.host.ended_alone(now_ns):
            actions.append(AskKnown())
        return actions

    def _member(self, shard: int, now_ns: int) -> Member | None:
        """Returns our seat in a shard. None if we have none, or the other members have not all noted our file: then
        it is not known to be the first, and promises in the first are not in it; or while agents of shards of
        another size could have seats."""
        if self.silent:
            return None
        known = self._members.get(shard)
        if known is not None or shard not in self.shards.all:
            return known
        members = self.shards.members(shard)
        noted = {self.agent, *self.own.noted_by}
        honest = {*members} - self._revoked.keys()
        if self.agent not in members or not noted.issuperset(honest) or not self._has_quorum:
            return None
        promised, stored = self.saved.get(shard) or (0, self._at_start(shard))
        made = self._members[shard] = Member(
            self.shards, self.agent, promised, stored, self.spawns, now_ns, self.trips, self.tick_ns
        )
        made.revoke(self._revoked, now_ns)
        return made

    def _at_start(self, shard: int) -> Table:
        """The table from before any leader: vehicles stand where the run begins."""
        grants = {
            vehicle: Held.of([(cell, 0, 1)])
            for fleet in self.spawns.values()
            for vehicle, cell in fleet.items()
            if self.shards.of(cell) == shard
        }
        return Table(shard=shard, agent=self.agent, epoch=0, seq=0, hosts={}, grants=grants)
