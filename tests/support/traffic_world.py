"""Agents, their members and leaders, and the bodies of their vehicles, on a network that may do anything."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

from swarm.bus.scheduler import Scheduler
from swarm.clock import NS_PER_S, ManualClock
from swarm.config.scenario import agent_of
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.right_of_way.agent_core import Action, OwnRecord, RightOfWay
from swarm.right_of_way.agent_on_bus import OwnTime
from swarm.right_of_way.holdings import CellRequest, SendState
from swarm.right_of_way.host import AskKnown
from swarm.right_of_way.shard_member import AskPromises, Refused, Save
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Entry, Granted, Known, KnownRequest, Left, Stored, Table, Word

MS = NS_PER_S // 1000
TICK_NS = 100 * MS
LOOK_AHEAD = 3
PATIENCE_NS = 8 * TICK_NS


@dataclass(frozen=True)
class Faults:
    """Faults until `quiet_s`: shares of messages, and events a second in the whole swarm.

    tick_ns  how often processes tick, all the time. If true, messages are heard at ticks only, and all go by their
             own time, like agents; otherwise by clocks that leap, which must do no harm either
    """

    loss: float = 0.0
    repeat: float = 0.0
    late: float = 0.0
    delay_ms: float = 5.0
    crashes: float = 0.0
    hangs: float = 0.0
    cuts: float = 0.0
    leaps: float = 0.0
    twins: float = 0.0
    quiet_s: float = 0.0
    tick_ns: int = TICK_NS


def random_faults(chance: random.Random, quiet_s: float) -> Faults:
    """Faults of every kind, or not."""
    return Faults(
        loss=chance.choice((0, 0.05, 0.3)),
        repeat=chance.choice((0, 0.1)),
        late=chance.choice((0, 0.02, 0.2)),
        delay_ms=chance.choice((1, 50, 300)),
        crashes=chance.choice((0, 0.5, 2)),
        hangs=chance.choice((0, 0.3, 1)),
        cuts=chance.choice((0, 0.3, 1)),
        leaps=chance.choice((0, 0.3, 2)),
        twins=chance.choice((0, 0.1, 0.3)),
        quiet_s=quiet_s,
    )


@dataclass
class Disk:
    """The state that survives a process: promises, tables, and the incarnations that ran on it."""

    own: OwnRecord
    saved: dict[int, tuple[int, Table]] = field(default_factory=dict)
    bodies: dict[str, int] = field(default_factory=dict)


class Process:
    """One generation of one agent. Its vehicles' bodies are on `disk`: they stand where they are when it dies."""

    has_token = True

    def __init__(self, world: TrafficWorld, agent: str, disk: Disk) -> None:
        self.world, self.agent, self.disk = world, agent, disk
        self.alive = True
        self.hung: list[Callable[[], None]] | None = None
        self.rights = self.make_rights()
        self.hear_token = self.rights.host.hear_token
        self.vehicles = list(world.spawns.get(agent, ()))
        # A clock of its own: it may be years off, and leaps.
        self.offset_ns = world.chance.randrange(60 * 60 * NS_PER_S)
        self.own_time = OwnTime(TICK_NS)
        self.ages: dict[str, int] = {}
        self.waits: dict[str, tuple[Entry | None, int]] = {}
        self.tokens: set[Peer] = set()

    def make_rights(self) -> RightOfWay:
        world, disk = self.world, self.disk
        return RightOfWay(self.agent, world.shards, world.spawns, disk.own, disk.saved)

    @property
    def now_ns(self) -> int:
        now_ns = self.world.now_ns + self.offset_ns
        return self.own_time.at(now_ns) if self.world.is_late else now_ns

    @property
    def settled(self) -> bool:
        return self.rights.settled

    def hear_known(self, known: Known) -> None:
        self.rights.trips.measure(known.agent, TICK_NS // 10)
        self.perform(self.rights.hear_known(known))

    def begin(self) -> None:
        for vehicle in list(self.disk.bodies):
            if self.world.driver[vehicle] is not self.disk:
                del self.disk.bodies[vehicle]  # it has been driven from elsewhere since
        self.perform(self.rights.begin(self.world.chance.getrandbits(32)))
        for vehicle, cell in self.disk.bodies.items():
            self.rights.host.enter(vehicle, cell)

    def perform(self, actions: list[Action]) -> None:
        for action in actions:
            match action:
                case AskKnown():
                    self.world.begin(self)
                case Save(promised, table):
                    self.disk.saved[table.shard] = (promised, table)
                case AskPromises():
                    for member in action.members:
                        self.world.claim(self, action, member)
                case SendState(members, state):
                    for member in members:
                        self.world.send(self, member, lambda to, s=state: to.rights.hear_host_state(s, to.now_ns))
                case Table():
                    for member in self.world.shards.members(action.shard):
                        self.world.send(self, member, lambda to, t=action: to.hear_table(t))
                case Stored():
                    for member in self.world.shards.members(action.shard):
                        self.world.send(self, member, lambda to, s=action: to.hear_stored(s))
                case Granted() | Word():
                    self.world.send(self, action.host, lambda to, g=action: to.hear_granted(g))
                case Left():
                    self.world.send(self, action.host, lambda to, left=action: to.hear_left(left))
                case OwnRecord():
                    self.disk.own = action
                case Refused():
                    self.world.refused.append(action.text)

    def hear_table(self, table: Table) -> None:
        self.perform(self.rights.hear_table(table, self.now_ns))

    def hear_stored(self, stored: Stored) -> None:
        self.perform(self.rights.hear_stored(stored, self.now_ns))

    def hear_claim(self, shard: int, epoch: int) -> list[Action]:
        return self.rights.hear_claim(shard, epoch, self.now_ns)

    def hear_granted(self, granted: Granted | Word) -> None:
        self.place(self.rights.host.hear_granted(granted, self.now_ns))

    def hear_left(self, left: Left) -> None:
        self.place(self.rights.host.hear_left(left))

    def place(self, placed: list[str]) -> None:
        for vehicle in placed:
            self.disk.bodies[vehicle] = self.rights.host.path(vehicle)[0]
            self.world.driver[vehicle] = self.disk
            self.world.unmoved.pop(vehicle, None)
            self.world.placed += 1
            self.world.look()

    def ask_known(self, request: KnownRequest) -> list[Action]:
        return self.rights.answer_known(request)

    def tick(self) -> None:
        holdings = self.rights.host
        self.own_time.tick(self.world.now_ns + self.offset_ns)
        self.see_tokens()
        requests = {}
        if holdings.generation and not holdings.replaced:
            for vehicle in self.vehicles:
                if holdings.path(vehicle):
                    self.drive(vehicle)
                    requests[vehicle] = self.request(vehicle)
        self.perform(self.rights.tick(requests, self.now_ns))
        if holdings.replaced:
            self.world.ended(self)

    def see_tokens(self) -> None:
        """Notice which other processes of this agent are up, and not cut off."""
        world = self.world
        twins = [
            each for each in world.processes if each.agent == self.agent and each is not self and each.has_token
        ]
        up = {Peer("agent", each.agent, id(each)) for each in twins if not world.is_cut(self, each)}
        for peer in up ^ self.tokens:
            self.hear_token(peer, up=peer in up)
        self.tokens = up

    def drive(self, vehicle: str) -> None:
        holdings, chance = self.rights.host, self.world.chance
        awaits = holdings.awaits(vehicle)
        entry, since_ns = self.waits.get(vehicle, (None, 0))
        if awaits != entry:
            self.waits[vehicle] = awaits, self.world.now_ns
        waits_long = awaits is not None and awaits == entry and self.world.now_ns - since_ns > PATIENCE_NS
        if waits_long or chance.random() < 0.05:
            holdings.give_back(vehicle)
        while len(holdings.path(vehicle)) > 1 and chance.random() < 0.7:
            cell = holdings.path(vehicle)[1]
            if not holdings.may_enter(vehicle, cell):
                return
            holdings.moved(vehicle, cell)
            self.disk.bodies[vehicle] = cell
            self.world.moves[vehicle] = self.world.moves.get(vehicle, 0) + 1
            self.world.look()

    def request(self, vehicle: str) -> CellRequest:
        world = self.world
        path = holdings_path = self.rights.host.path(vehicle)
        goal = world.goals[vehicle]
        if path[0] == goal:
            goal = world.new_goal(vehicle)
            self.ages[vehicle] = 0
        self.ages[vehicle] = self.ages.get(vehicle, 0) + 100
        cost = world.costs(goal)
        ahead, at = [], holdings_path[-1]
        while len(ahead) + len(path) <= LOOK_AHEAD and cost[at]:
            at = min(world.next_to(at), key=cost.__getitem__)
            ahead.append(at)
        here = path[0]
        held = self.rights.host.occupied()
        wants = sorted(world.next_to(here), key=lambda cell: (cost[cell] + 0.9 * (cell in held), cell))[:8]
        better = sum(cost[cell] < cost[here] for cell in wants)
        pushed = self.rights.host.pushed.get(vehicle, 0)
        if pushed:
            better = len(wants)
        # In steps, so that a statement of changes leaves out vehicles that wait.
        return CellRequest(ahead, wants, better, max(self.ages[vehicle] >> 10 << 10, pushed))


class TrafficWorld:
    """`collisions` are pairs of different vehicles that were on one cell, also of the dead and the replaced.

    stolen  an agent of which the vehicles do not count, as its name is used by a thief
    """

    stolen = ""

    def __init__(
        self,
        seed: int,
        agents: int,
        per_agent: int,
        size: int,
        side: int,
        faults: Faults,
        walls: float = 0.0,
        *,
        proven: bool = False,
    ) -> None:
        self.chance = random.Random(seed)
        self.faults = faults
        self.is_late = faults.tick_ns > TICK_NS
        self._scheduler = Scheduler(ManualClock(0))
        self.grid = GridSpec(size, size, 1.0)
        names = [f"a{k}" for k in range(agents)]
        self.shards = Shards(self.grid, names, side, proven=proven)
        # Pillars on every fourth cell at most, so that the rest hangs together.
        pillars = {
            row * size + col
            for row in range(1, size, 2)
            for col in range(1, size, 2)
            if self.chance.random() < walls
        }
        self.free = [cell for cell in range(self.grid.cells) if cell not in pillars]
        self._open = frozenset(self.free)
        homes = iter(self.chance.sample(self.free, agents * per_agent))
        self.spawns = {name: {f"{name}-{k:02d}": next(homes) for k in range(per_agent)} for name in names}
        self.goals = {vehicle: self.chance.choice(self.free) for each in self.spawns.values() for vehicle in each}
        self.reached: dict[str, int] = {}
        self.moves: dict[str, int] = {}
        self.collisions: list[tuple[int, str, str]] = []
        self.refused: list[str] = []
        self.driver: dict[str, Disk] = {}
        """Vehicle -> the disk of the process that placed it last."""
        self.placed = self.crashes = self.takeovers = self.twins = self.messages = 0
        self.cut: set[tuple[str, str]] = set()
        self.disks: dict[str, list[Disk]] = {name: [self.new_disk()] for name in names}
        self.unmoved = {vehicle: cell for each in self.spawns.values() for vehicle, cell in each.items()}
        self.processes: list[Process] = []
        for name in names:
            self.at(self.chance.randrange(300 * MS), lambda name=name: self.start(name, self.disks[name][0]))
        self.at(0, self.disturb)

    # --- the ground -----------------------------------------------------------------------------------------

    @cache  # noqa: B019
    def next_to(self, cell: int) -> tuple[int, ...]:
        return tuple(other for _, other in self.grid.neighbours(cell) if other in self._open)

    @cache  # noqa: B019
    def costs(self, goal: int) -> dict[int, int]:
        cost, queue = {goal: 0}, deque([goal])
        while queue:
            cell = queue.popleft()
            for other in self.next_to(cell):
                if other not in cost:
                    cost[other] = cost[cell] + 1
                    queue.append(other)
        return cost

    def new_goal(self, vehicle: str) -> int:
        self.reached[vehicle] = self.reached.get(vehicle, 0) + 1
        self.goals[vehicle] = self.chance.choice(self.free)
        return self.goals[vehicle]

    def look(self) -> None:
        """The law: different vehicles are on different cells, whatever their hosts."""
        on = {cell: vehicle for vehicle, cell in self.unmoved.items() if agent_of(vehicle) != self.stolen}
        for disks in (of for agent, of in self.disks.items() if agent != self.stolen):
            for disk in disks:
                for vehicle, cell in disk.bodies.items():
                    other = on.setdefault(cell, vehicle)
                    if other != vehicle:
                        self.collisions.append((self.now_ns // MS, other, vehicle))

    # --- time, and the network ------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        return self._scheduler.clock.now_ns()

    def at(self, delay_ns: int, action: Callable[[], None]) -> None:
        """Does something later, unless vehicles have met until then."""
        self._scheduler.after(delay_ns, lambda: None if self.collisions else action())

    def run(self, seconds: float) -> None:
        self._scheduler.run_until(self.now_ns + int(seconds * NS_PER_S))

    def unmoved_in(self, seconds: float) -> list[str]:
        """Vehicles that do not move in this time, in which no two meet."""
        before = dict(self.moves)
        self.run(seconds)
        assert self.collisions == []
        return [id for id in self.everybody() if self.moves.get(id, 0) == before.get(id, 0)]

    def everybody(self) -> list[str]:
        return [id for vehicles in self.spawns.values() for id in vehicles]

    @property
    def quiet(self) -> bool:
        return self.now_ns >= self.faults.quiet_s * NS_PER_S

    def send(self, source: Process, agent: str | None, deliver: Callable[[Process], None]) -> None:
        """To every generation of an agent, or of all."""
        for process in self.processes:
            if agent in (None, process.agent):
                self.carry(source, process, lambda to=process: deliver(to))

    def carry(self, source: Process, to: Process, deliver: Callable[[], None]) -> None:
        chance, faults = self.chance, self.faults
        self.messages += 1
        delay_ms = 0.0
        if source is not to:
            if (source.agent, to.agent) in self.cut or (source.disk is not to.disk and self.is_cut(source, to)):
                return
            if not self.quiet and chance.random() < faults.loss:
                return
            delay_ms = chance.random() * faults.delay_ms
            if not self.quiet and chance.random() < faults.late:
                delay_ms += chance.random() * 3000
            if not self.quiet and chance.random() < faults.repeat:
                self.at(int((delay_ms + chance.random() * 2000) * MS), lambda: self.arrive(to, deliver))
        self.at(int(delay_ms * MS), lambda: self.arrive(to, deliver))

    def is_cut(self, source: Process, to: Process) -> bool:
        return (f"{id(source.disk)}", "") in self.cut or (f"{id(to.disk)}", "") in self.cut

    def arrive(self, to: Process, deliver: Callable[[], None]) -> None:
        if to.hung is not None:
            to.hung.append(deliver)
        elif to.alive:
            deliver()

    def claim(self, source: Process, claim: AskPromises, member: str) -> None:
        def ask(to: Process) -> None:
            actions = to.hear_claim(claim.shard, claim.epoch)
            to.perform([action for action in actions if not isinstance(action, Table)])
            for table in actions:
                if isinstance(table, Table):
                    self.carry(to, source, lambda table=table: answer(table))

        def answer(table: Table) -> None:
            source.rights.hear_promise(member, claim.epoch, table, source.now_ns)
            self.takeovers += 1

        self.send(source, member, ask)

    def ask_known(self, source: Process, first: bool = False) -> None:
        """Asks everybody what they know of us, again and again as long as it is needed."""
        own = source.disk.own
        request = KnownRequest(agent=source.agent, disk=own.disk, shard_cells=source.rights.shards.side)

        def answer(to: Process) -> None:
            for action in to.ask_known(request):
                if isinstance(action, Known):
                    self.carry(to, source, lambda known=action: source.hear_known(known))
                else:
                    to.perform([action])

        if source.alive:
            for process in self.processes if first or not source.settled else ():
                if process.agent != source.agent:
                    self.carry(source, process, lambda to=process: answer(to))
            self.at(NS_PER_S, lambda: self.ask_known(source))

    def new_disk(self) -> Disk:
        return Disk(OwnRecord(disk=self.chance.getrandbits(60)))

    # --- what goes wrong ------------------------------------------------------------------------------------

    def process_of(self, agent: str, disk: Disk) -> Process:
        return Process(self, agent, disk)

    def start(self, agent: str, disk: Disk) -> None:
        """Starts a process, which begins a generation."""
        process = self.process_of(agent, disk)
        self.processes.append(process)
        self.begin(process)

        def tick() -> None:
            if process.alive:
                if self.is_late:
                    self.wake(process)
                if process.hung is None:
                    process.tick()
                if self.is_late:
                    process.hung = []
                self.at(self.faults.tick_ns, tick)

        self.at(self.chance.randrange(TICK_NS), tick)

    def begin(self, process: Process) -> None:
        """Asks everybody, then begins a generation."""
        self.ask_known(process, first=True)
        self.at(200 * MS, lambda: process.begin() if process.alive else None)

    def crash(self, process: Process) -> None:
        process.alive = False
        self.processes.remove(process)
        self.crashes += 1
        self.at(int(self.chance.random() * 2 * NS_PER_S), lambda: self.restart(process))

    def end_all(self, agent: str) -> None:
        """Ends the processes under a name."""
        for process in [each for each in self.processes if each.agent == agent]:
            process.alive = False
            self.processes.remove(process)

    def restart(self, process: Process) -> None:
        if not any(other.disk is process.disk for other in self.processes):
            self.start(process.agent, process.disk)

    def ended(self, process: Process) -> None:
        """A generation that has been replaced drives no more, and its bodies are gone. It goes on as a member."""
        process.disk.bodies.clear()

    def twin(self, process: Process) -> None:
        """Cut a process off, alone or one way, and start another generation of its agent on another machine."""
        replaced = {name for name, disks in self.disks.items() if len(disks) > 1} | {process.agent}
        if len(self.spawns) < 3 or len(self.disks[process.agent]) > 2:
            return
        if any(replaced.issuperset(self.shards.members(shard)) for shard in range(self.shards.count)):
            return  # docs/design/right-of-way.md: of the three files of a shard's members one at least is the first
        self.twins += 1
        cut = (f"{id(process.disk)}", "")
        self.cut.add(cut)
        disk = self.new_disk()
        self.disks[process.agent].append(disk)
        self.at(int(self.chance.random() * NS_PER_S), lambda: self.start(process.agent, disk))
        self.at(int(self.chance.uniform(1, 5) * NS_PER_S), lambda: self.cut.discard(cut))

    def disturb(self) -> None:
        """Applies the faults of this moment, ten times a second."""
        if self.quiet:
            self.cut.clear()
            return
        chance, faults = self.chance, self.faults
        self.at(TICK_NS, self.disturb)
        if not self.processes:
            return
        somebody = chance.choice(self.processes)
        if chance.random() < faults.crashes / 10:
            self.crash(somebody)
        elif chance.random() < faults.hangs / 10 and somebody.hung is None:
            somebody.hung = []
            self.at(int(chance.random() * 4 * NS_PER_S), lambda: self.wake(somebody))
        elif chance.random() < faults.twins / 10:
            self.twin(somebody)
        if chance.random() < faults.leaps / 10:
            # One machine's clock leaps, or all but one: then they take a leader for silent that is not.
            alone = chance.random() < 0.5
            for process in self.processes:
                if (process is somebody) == alone:
                    process.offset_ns += chance.randrange(5 * NS_PER_S)
        if chance.random() < faults.cuts / 10:
            names = list(self.disks)
            side = set(chance.sample(names, chance.randint(1, -(-len(names) // 2))))
            one_way = chance.random() < 0.4
            pairs = {
                (a, b)
                for a in names
                for b in names
                if a != b and ((a in side) != (b in side)) and (not one_way or a in side)
            }
            self.cut |= pairs
            self.at(int(chance.random() * 4 * NS_PER_S), lambda: self.cut.difference_update(pairs))

    def wake(self, process: Process) -> None:
        waiting, process.hung = process.hung or [], None
        for deliver in waiting:
            if process.alive:
                deliver()
