"""A traffic world with external vehicles: robots that speak for themselves, agents that join while the swarm runs,
and operators who declare a robot absent. All under the same faults."""

from __future__ import annotations

import random
from functools import partial

from support.traffic_world import MS, NS_PER_S, TICK_NS, Disk, Faults, Process, TrafficWorld

from swarm.right_of_way.agent_core import Action, OwnRecord, RightOfWay
from swarm.right_of_way.external_vehicle import ExternalAction, ExternalVehicle, Removal
from swarm.right_of_way.holdings import SendState
from swarm.right_of_way.host import AskKnown
from swarm.wire.messages.traffic import Granted, Known, KnownRequest, Left

_ANOTHER_CELL_NS = 2 * NS_PER_S


class Guest(Process):
    """A process without the core of an agent: no one asks it what it knows."""

    world: ExternalWorld

    def make_rights(self) -> RightOfWay:
        self.begin_as_guest()
        return RightOfWay(self.agent, self.world.shards, self.world.spawns, OwnRecord(disk=0), {})  # never used

    def begin_as_guest(self) -> None: ...

    def ask_known(self, request: KnownRequest) -> list[Action]:
        return []


class ExternalProcess(Guest):
    """One generation of a robot. Its body is on `disk`: when the process dies, the body stays there until it is
    carried away."""

    def __init__(self, world: ExternalWorld, agent: str, disk: Disk) -> None:
        super().__init__(world, agent, disk)
        self.hear_token = self.external.host.hear_token

    def begin_as_guest(self) -> None:
        self.external = ExternalVehicle(self.world.shards, self.agent, self.disk.own.generations)
        self.asked_ns = 0
        self.leaving = False

    @property
    def settled(self) -> bool:
        return self.external.settled

    @property
    def body(self) -> int | None:
        return self.disk.bodies.get(self.external.vehicle)

    def hear_known(self, known: Known) -> None:
        self.external.host.hear_known(known)

    def begin(self) -> None:
        if not self.external.needs_generation:
            self.try_to_enter()
        if generations := self.external.begin(self.world.chance.getrandbits(32)):
            self.disk.own = OwnRecord(disk=self.disk.own.disk, generations=generations)

    def try_to_enter(self) -> None:
        """Tries the cell of the body; a body without a cell tries here and there."""
        self.asked_ns = self.world.now_ns
        self.external.enter(self.world.chance.choice(self.world.free) if self.body is None else self.body)

    def do(self, actions: list[ExternalAction]) -> None:
        for action in actions:
            match action:
                case AskKnown():
                    self.world.begin(self)
                case SendState() | Left():
                    self.perform([action])

    def hear_granted(self, granted: Granted) -> None:
        self.enter_if(self.external.host.hear_granted(granted, self.now_ns))

    def hear_left(self, left: Left) -> None:
        self.enter_if(self.external.host.hear_left(left))

    def enter_if(self, entered: list[str]) -> None:
        if entered:
            if self.body is None:
                self.world.entered += 1
            self.disk.bodies[self.external.vehicle] = self.external.cells[0]
            self.world.look()

    def tick(self) -> None:
        external, world = self.external, self.world
        self.see_tokens()
        held = external.cells
        if held:
            self.drive_on()
        elif self.leaving and external.gone:
            world.left += 1
            self.leaving = False
        elif not self.leaving and world.now_ns - self.asked_ns > _ANOTHER_CELL_NS:
            self.try_to_enter()
            if external.needs_generation:  # the last one ended while it was away
                world.begin(self)
        self.do(external.tick(self.now_ns))

    def drive_on(self) -> None:
        external, world, chance = self.external, self.world, self.world.chance
        held_before = external.cells[0]
        if not world.quiet and chance.random() < 0.01:
            del self.disk.bodies[external.vehicle]
            external.leave()
            self.leaving = chance.random() < 0.5
            if not self.leaving:
                external.enter(held_before)  # it has changed its mind, and stands beside the cell that it has left
            return
        while len(external.cells) > 1 and chance.random() < 0.7:
            before, cell = external.cells[:2]
            external.left(before)
            self.disk.bodies[external.vehicle] = cell
            world.moves[external.vehicle] = world.moves.get(external.vehicle, 0) + 1
            world.look()
        here = external.cells[0]
        goal = world.goals.setdefault(external.vehicle, chance.choice(world.free))
        if here == goal:
            goal = world.new_goal(external.vehicle)
        cost, path = world.costs(goal), [here]
        while cost[path[-1]] and len(path) < 6:
            path.append(min(world.next_to(path[-1]), key=cost.__getitem__))
        external.want(path, sorted(world.next_to(here), key=lambda cell: (cost[cell], cell)))


class AddedProcess(Process):
    """One generation of an agent that is not in the scenario. Its vehicles enter where there is place; a new
    incarnation finds its earlier vehicles in the tables, and lets the others enter again."""

    world: ExternalWorld

    def make_rights(self) -> RightOfWay:
        world, disk = self.world, self.disk
        vehicles = world.added[self.agent]
        self.asked_ns: dict[str, int] = {}
        rights = RightOfWay(self.agent, world.shards, world.spawns, disk.own, disk.saved, vehicles=vehicles)
        assert not rights._members
        return rights

    def tick(self) -> None:
        world, holdings = self.world, self.rights.host
        self.vehicles = world.added[self.agent]
        for vehicle in self.vehicles if holdings.generation and not holdings.replaced else ():
            asked_ns = self.asked_ns.setdefault(vehicle, world.now_ns)
            if holdings.path(vehicle):
                if not world.quiet and world.chance.random() < 0.005:
                    self.disk.bodies.pop(vehicle, None)
                    holdings.leave(vehicle)
                    world.left += 1
                self.asked_ns[vehicle] = world.now_ns
            elif world.now_ns - asked_ns > _ANOTHER_CELL_NS:
                self.asked_ns[vehicle] = world.now_ns
                self.disk.bodies.pop(vehicle, None)
                holdings.enter(vehicle, world.chance.choice(world.free))
        super().tick()


class OperatorProcess(Guest):
    """Declares a robot absent until leaders have freed its cells."""

    has_token = False

    def begin_as_guest(self) -> None:
        self.removal = Removal(self.world.shards, self.agent)

    @property
    def settled(self) -> bool:
        return self.removal.host.informed

    def hear_known(self, known: Known) -> None:
        self.removal.hear_known(known)

    def begin(self) -> None:
        self.removal.begin(self.world.chance.getrandbits(32))

    def hear_granted(self, granted: Granted) -> None:
        self.removal.host.hear_granted(granted, self.now_ns)

    def tick(self) -> None:
        self.perform([*self.removal.tick(self.now_ns)])
        if self.removal.done or self.removal.host.replaced:
            self.alive = False
            self.world.processes.remove(self)
            self.world.removed += self.removal.done


class ExternalWorld(TrafficWorld):
    """A traffic world with `robots` that come and go and `added` agents of two vehicles each.

    entered, left, removed  number of arrivals and departures of external vehicles, and of robots declared absent
    """

    def __init__(
        self, seed: int, agents: int, per_agent: int, size: int, side: int, faults: Faults, robots: int, added: int
    ) -> None:
        super().__init__(seed, agents, per_agent, size, side, faults)
        self.entered = self.left = self.removed = 0
        self.robots = [f"r{k}" for k in range(robots)]
        self.added = {f"g{k}": [f"g{k}-00", f"g{k}-01"] for k in range(added)}
        self.gone: set[str] = set()
        """Robots that are dead now, and"""
        self.never_back: set[str] = set()
        """those that will never be back."""
        self.external_chance = random.Random(f"guests/{seed}")
        for vehicles in self.added.values():
            for vehicle in vehicles:
                self.goals[vehicle] = self.external_chance.choice(self.free)
        for name in (*self.robots, *self.added):
            self.disks[name] = [self.new_disk()]
            self.at(
                self.external_chance.randrange(3 * NS_PER_S),
                lambda name=name: self.start(name, self.disks[name][0]),
            )
        self.at(NS_PER_S, self.disturb_externals)

    def process_of(self, agent: str, disk: Disk) -> Process:
        if agent in self.robots:
            return ExternalProcess(self, agent, disk)
        return AddedProcess(self, agent, disk) if agent in self.added else Process(self, agent, disk)

    def restart(self, process: Process) -> None:
        if process.agent not in self.gone | self.never_back and not isinstance(process, OperatorProcess):
            super().restart(process)

    def disturb_externals(self) -> None:
        """Now and then a robot dies for good, is carried away, and an operator says so; later it comes again."""
        if self.quiet:
            return
        self.at(NS_PER_S, self.disturb_externals)
        alive = [each for each in self.processes if isinstance(each, ExternalProcess)]
        if not alive or self.external_chance.random() > 0.3 or len(self.disks[alive[0].agent]) > 1:
            return
        process = alive[0]
        self.gone.add(process.agent)
        self.end_all(process.agent)
        self.at(self.external_chance.randrange(NS_PER_S), lambda: self.carry_away(process))

    def carry_away(self, process: ExternalProcess, back: bool = True) -> None:
        process.disk.bodies.clear()
        operator = OperatorProcess(self, process.agent, self.new_disk())
        self.processes.append(operator)
        self.begin(operator)

        def tick() -> None:
            if operator.alive:
                operator.tick()
                self.at(TICK_NS, tick)

        self.at(300 * MS, tick)
        if back:
            self.at(self.external_chance.randrange(4 * NS_PER_S), lambda: self.bring_back(process))

    def everybody(self) -> list[str]:
        added = [id for vehicles in self.added.values() for id in vehicles]
        return [*super().everybody(), *(f"{robot}-00" for robot in self.robots), *added]

    def end_robots(self) -> None:
        """All robots die for good. Once no word of theirs is under way any more, they are carried away."""
        self.never_back.update(self.robots)
        for name in self.robots:
            self.end_all(name)
            robot = ExternalProcess(self, name, self.disks[name][0])
            self.at(6 * NS_PER_S, partial(self.carry_away, robot, back=False))

    def bring_back(self, process: ExternalProcess) -> None:
        if process.agent in self.never_back:
            return
        self.gone.discard(process.agent)
        self.restart(process)
