"""A traffic world with guests: robots that speak for themselves, agents that join while the swarm runs, and
operators who declare a robot absent. All under the same faults."""

from __future__ import annotations

import random
from functools import partial

from support.traffic_world import MS, NS_PER_S, TICK_NS, Disk, Faults, Process, TrafficWorld

from swarm.liveness import Peer
from swarm.right_of_way.guest import Guest, GuestAction, Removal, SaveLives
from swarm.right_of_way.holdings import Tell
from swarm.right_of_way.host import AskKnown
from swarm.wire.messages.traffic import Granted, Known, KnownRequest, Left
from vehicle_agent.traffic.right_of_way_core import Action, OwnRecord, RightOfWay

_ANOTHER_CELL_NS = 2 * NS_PER_S


class GuestProcess(Process):
    """One life of a robot. Its body is on `disk`: when the process dies, the body stays there until it is carried
    away."""

    world: GuestWorld

    def make_rights(self) -> RightOfWay:
        self.guest = Guest(self.world.plots, self.agent, self.disk.own.lives)
        self.asked_ns = 0
        self.leaving = False
        return RightOfWay(self.agent, self.world.plots, self.world.spawns, OwnRecord(disk=0), {})  # never used

    @property
    def settled(self) -> bool:
        return self.guest.settled

    @property
    def body(self) -> int | None:
        return self.disk.bodies.get(self.guest.vehicle)

    def ask_known(self, request: KnownRequest) -> list[Action]:
        return []

    def hear_known(self, known: Known) -> None:
        self.guest.hear_known(known)

    def begin(self) -> None:
        if not self.guest.needs_life:
            self.try_to_enter()
        self.do(self.guest.begin(self.world.chance.getrandbits(32)))

    def try_to_enter(self) -> None:
        """Tries the cell of the body; a body without a cell tries here and there."""
        self.asked_ns = self.world.now_ns
        self.guest.enter(self.world.chance.choice(self.world.free) if self.body is None else self.body)

    def do(self, actions: list[GuestAction]) -> None:
        for action in actions:
            match action:
                case SaveLives(lives):
                    self.disk.own = OwnRecord(disk=self.disk.own.disk, lives=lives)
                case AskKnown():
                    self.world.begin(self)
                case Tell() | Left():
                    self.perform([action])

    def hear_granted(self, granted: Granted) -> None:
        self.enter_if(self.guest.hear_granted(granted, self.now_ns))

    def hear_left(self, left: Left) -> None:
        self.enter_if(self.guest.hear_left(left))

    def enter_if(self, entered: bool) -> None:
        if entered:
            if self.body is None:
                self.world.entered += 1
            self.disk.bodies[self.guest.vehicle] = self.guest.cells[0]
            self.world.look()

    def tick(self) -> None:
        guest, world = self.guest, self.world
        self.see_tokens()
        held = guest.cells
        if held:
            self.drive_on()
        elif self.leaving and guest.gone:
            world.left += 1
            self.leaving = False
        elif not self.leaving and world.now_ns - self.asked_ns > _ANOTHER_CELL_NS:
            self.try_to_enter()
            if guest.needs_life:  # the last one ended while it was away
                world.begin(self)
        self.do(guest.tick(self.now_ns))

    def drive_on(self) -> None:
        guest, world, chance = self.guest, self.world, self.world.chance
        held_before = guest.cells[0]
        if not world.quiet and chance.random() < 0.01:
            del self.disk.bodies[guest.vehicle]
            guest.leave()
            self.leaving = chance.random() < 0.5
            if not self.leaving:
                guest.enter(held_before)  # it has changed its mind, and stands beside the cell that it has left
            return
        while len(guest.cells) > 1 and chance.random() < 0.7:
            before, cell = guest.cells[:2]
            guest.left(before)
            self.disk.bodies[guest.vehicle] = cell
            world.moves[guest.vehicle] = world.moves.get(guest.vehicle, 0) + 1
            world.look()
        here = guest.cells[0]
        goal = world.goals.setdefault(guest.vehicle, chance.choice(world.free))
        if here == goal:
            goal = world.new_goal(guest.vehicle)
        cost, path = world.costs(goal), [here]
        while cost[path[-1]] and len(path) < 6:
            path.append(min(world.next_to(path[-1]), key=cost.__getitem__))
        guest.want(path, sorted(world.next_to(here), key=lambda cell: (cost[cell], cell)))

    def see_tokens(self) -> None:
        up = {Peer("agent", each.agent, id(each)) for each in self.world.twins_of(self)}
        for peer in up ^ self.tokens:
            self.guest.hear_token(peer, up=peer in up)
        self.tokens = up


class AddedProcess(Process):
    """One life of an agent that is not in the scenario. Its vehicles enter where there is place; a new incarnation
    finds its earlier vehicles in the tables, and lets the others enter again."""

    world: GuestWorld

    def make_rights(self) -> RightOfWay:
        world, disk = self.world, self.disk
        vehicles = world.added[self.agent]
        self.asked_ns: dict[str, int] = {}
        rights = RightOfWay(self.agent, world.plots, world.spawns, disk.own, disk.saved, vehicles=vehicles)
        assert not rights._members
        return rights

    def tick(self) -> None:
        world, holdings = self.world, self.rights.holdings
        self.vehicles = world.added[self.agent]
        for vehicle in self.vehicles if holdings.life and not holdings.replaced else ():
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


class OperatorProcess(Process):
    """Declares a robot absent until wardens have freed its cells."""

    world: GuestWorld

    def make_rights(self) -> RightOfWay:
        self.removal = Removal(self.world.plots, self.agent)
        return RightOfWay(self.agent, self.world.plots, self.world.spawns, OwnRecord(disk=0), {})  # never used

    @property
    def settled(self) -> bool:
        return self.removal.settled

    def ask_known(self, request: KnownRequest) -> list[Action]:
        return []

    def hear_known(self, known: Known) -> None:
        self.removal.hear_known(known)

    def begin(self) -> None:
        self.removal.begin(self.world.chance.getrandbits(32))

    def hear_granted(self, granted: Granted) -> None:
        self.removal.hear_granted(granted, self.now_ns)

    def tick(self) -> None:
        self.perform([*self.removal.tick(self.now_ns)])
        if self.removal.done or self.removal.replaced:
            self.alive = False
            self.world.processes.remove(self)
            self.world.removed += self.removal.done


class GuestWorld(TrafficWorld):
    """A traffic world with `robots` that come and go and `added` agents of two vehicles each.

    entered, left, removed  number of arrivals and departures of guests, and of robots declared absent
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
        self.guest_chance = random.Random(f"guests/{seed}")
        for vehicles in self.added.values():
            for vehicle in vehicles:
                self.goals[vehicle] = self.guest_chance.choice(self.free)
        for name in (*self.robots, *self.added):
            self.disks[name] = [self.new_disk()]
            self.at(
                self.guest_chance.randrange(3 * NS_PER_S), lambda name=name: self.start(name, self.disks[name][0])
            )
        self.at(NS_PER_S, self.disturb_guests)

    def process_of(self, agent: str, disk: Disk) -> Process:
        if agent in self.robots:
            return GuestProcess(self, agent, disk)
        return AddedProcess(self, agent, disk) if agent in self.added else Process(self, agent, disk)

    def twins_of(self, process: Process) -> list[Process]:
        """Other processes of the same guest that it sees."""
        return [
            each
            for each in self.processes
            if each.agent == process.agent
            and each is not process
            and not isinstance(each, OperatorProcess)
            and not self.is_cut(process, each)
        ]

    def restart(self, process: Process) -> None:
        if process.agent not in self.gone | self.never_back and not isinstance(process, OperatorProcess):
            super().restart(process)

    def disturb_guests(self) -> None:
        """Now and then a robot dies for good, is carried away, and an operator says so; later it comes again."""
        if self.quiet:
            return
        self.at(NS_PER_S, self.disturb_guests)
        alive = [each for each in self.processes if isinstance(each, GuestProcess)]
        if not alive or self.guest_chance.random() > 0.3 or len(self.disks[alive[0].agent]) > 1:
            return
        process = alive[0]
        self.gone.add(process.agent)
        for each in [each for each in self.processes if each.agent == process.agent]:
            each.alive = False
            self.processes.remove(each)
        self.at(self.guest_chance.randrange(NS_PER_S), lambda: self.carry_away(process))

    def carry_away(self, process: GuestProcess, back: bool = True) -> None:
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
            self.at(self.guest_chance.randrange(4 * NS_PER_S), lambda: self.bring_back(process))

    def end_robots(self) -> None:
        """All robots die for good. Once no word of theirs is under way any more, they are carried away."""
        self.never_back.update(self.robots)
        for robot in [each for each in self.processes if isinstance(each, GuestProcess)]:
            robot.alive = False
            self.processes.remove(robot)
        for name in self.robots:
            robot = GuestProcess(self, name, self.disks[name][0])
            self.at(6 * NS_PER_S, partial(self.carry_away, robot, back=False))

    def bring_back(self, process: GuestProcess) -> None:
        if process.agent in self.never_back:
            return
        self.gone.discard(process.agent)
        self.restart(process)
