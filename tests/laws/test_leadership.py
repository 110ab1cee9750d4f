"""Leadership: at most one leader among those who hear each other, soon one after every fault, no change without
cause."""

import random
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from support.effort import few

from swarm.bus.scheduler import Scheduler
from swarm.clock import NS_PER_S, ManualClock
from swarm.peers import job_of, ranked_id, split_rank
from swarm.runtime.election import HEARTBEAT_NS, LEASE_NS, SETTLED_NS, Leadership
from swarm.wire.messages.processes import Heartbeat

MS = NS_PER_S // 1000
DELAY_NS = 30 * MS
SOON_NS = LEASE_NS + 2 * HEARTBEAT_NS + DELAY_NS
"""A lease, a period of the sender and one of the receiver, and the transit time between them."""
HANDOVER_NS = 2 * HEARTBEAT_NS + DELAY_NS
"""Two lead for no longer than it takes until the worse one hears the better one. Much less than a lease."""
STEADY_NS = SETTLED_NS + 2 * LEASE_NS + 4 * HEARTBEAT_NS


@dataclass(eq=False)
class Candidate:
    """A process: its core, and its faults."""

    rank: int
    skew_ns: int
    phase_ns: int
    generation: int = 0
    seq: int = 0
    core: Leadership | None = None
    ready_ns: int = 0
    hung_until_ns: int = 0
    waiting: list[Heartbeat] = field(default_factory=list)
    """Unread heartbeats."""


class World:
    """Candidates on a network that loses, delays and cuts, disturbed at times that a seed decides."""

    def __init__(self, seed: int, count: int, lossy: float) -> None:
        self.chance = random.Random(seed)
        self.lossy = lossy
        self.scheduler = Scheduler(ManualClock(0))
        self.look: Callable[[], None] = lambda: None
        self.far: set[int] = set()
        self.disturbed_ns = 0
        """Time of the last fault, or of its end."""
        self.several_since_ns: dict[bool, int] = {}
        """Since when several lead who hear each other, by side of a cut."""
        self.changes: list[tuple[int, tuple[int, ...]]] = []
        """Time of each change of leaders, and their ranks."""
        self.all = [
            Candidate(n, self.chance.randrange(NS_PER_S), self.chance.randrange(HEARTBEAT_NS), 1000 * n)
            for n in range(count)
        ]
        for each in self.all:
            self.boot(each)

    @property
    def now_ns(self) -> int:
        return self.scheduler.clock.now_ns()

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        def happen() -> None:
            action()
            self.look()

        self.scheduler.at(when_ns, happen)

    def run(self, until_ns: int, look: Callable[[], None] = lambda: None) -> None:
        self.look = look
        self.scheduler.run_until(until_ns)

    # --- what happens to candidates -------------------------------------------------------------------------

    def boot(self, who: Candidate) -> None:
        self.disturbed()
        who.generation += 1
        id = ranked_id("t0", who.rank)
        who.core = Leadership(id, who.generation, alone=False, period_ns=HEARTBEAT_NS)
        who.ready_ns = self.now_ns + self.chance.randrange(NS_PER_S)
        self.at(who.ready_ns, self.disturbed)
        core = who.core
        self.at(self.now_ns + who.phase_ns, lambda: self.tick(who, core))

    def kill(self, who: Candidate) -> None:
        self.disturbed()
        who.core = None

    def hang(self, who: Candidate, for_ns: int) -> None:
        self.disturbed()
        who.hung_until_ns = max(who.hung_until_ns, self.now_ns + for_ns)
        self.at(who.hung_until_ns, self.disturbed)

    def cut(self, far: set[int]) -> None:
        self.disturbed()
        self.far = far

    def disturbed(self) -> None:
        self.disturbed_ns = self.now_ns
        self.several_since_ns = {}

    def disturb(self) -> None:
        who = self.chance.choice(self.all)
        match self.chance.randrange(4):
            case 0 if who.core is None:
                self.boot(who)
            case 0:
                self.kill(who)
            case 1:
                self.hang(who, self.chance.randrange(3 * NS_PER_S))
            case 2:
                self.cut({each.rank for each in self.all if self.chance.random() < 0.5})
            case 3:
                self.cut(set())

    # --- what candidates do ---------------------------------------------------------------------------------

    def tick(self, who: Candidate, core: Leadership) -> None:
        if who.core is not core:
            return
        if self.now_ns < who.hung_until_ns:
            self.at(who.hung_until_ns, lambda: self.tick(who, core))
            return
        now_ns = self.now_ns + who.skew_ns
        if self.chance.random() < 0.5:  # a tick may come before or after the waiting events
            self.read(who, core, now_ns)
        before = core.leads
        ready = self.now_ns >= who.ready_ns
        core.tick(ready, now_ns)
        if core.leads != before:
            self.note()
        id = ranked_id("t0", who.rank)
        who.seq += 1
        heartbeat = Heartbeat(
            role="planner", id=id, incarnation=who.generation, ready=ready, leads=core.leads, seq=who.seq,
            heard=list(core.heard),
        )  # fmt: skip
        for other in self.all:
            if (other.rank in self.far) == (who.rank in self.far) and self.chance.random() >= self.lossy:
                delay_ns = self.chance.randrange(DELAY_NS)
                self.at(self.now_ns + delay_ns, lambda to=other: self.arrive(to, heartbeat))  # type: ignore[misc]
        self.read(who, core, now_ns)
        self.at(self.now_ns + HEARTBEAT_NS, lambda: self.tick(who, core))

    def read(self, who: Candidate, core: Leadership, now_ns: int) -> None:
        for heartbeat in who.waiting:
            core.on_heartbeat(heartbeat, now_ns)
        who.waiting.clear()

    def arrive(self, who: Candidate, heartbeat: Heartbeat) -> None:
        if who.core is None:
            return
        who.waiting.append(heartbeat)
        if self.now_ns >= who.hung_until_ns:
            self.read(who, who.core, self.now_ns + who.skew_ns)

    # --- the view from above ------------------------------------------------------------------------------------

    def well(self) -> list[Candidate]:
        return [each for each in self.all if each.core is not None and self.now_ns >= each.hung_until_ns]

    def leaders(self) -> list[Candidate]:
        return [each for each in self.well() if each.core is not None and each.core.leads]

    def note(self) -> None:
        self.changes.append((self.now_ns, tuple(each.rank for each in self.leaders())))

    def check(self) -> None:
        """The laws, of candidates that hear each other and with which nothing has happened for long enough."""
        for side in (True, False):
            side_of = [each for each in self.well() if (each.rank in self.far) is side]
            leaders = [each for each in side_of if each.core is not None and each.core.leads]
            if len(leaders) < 2:
                self.several_since_ns.pop(side, None)
            else:
                several_ns = self.now_ns - self.several_since_ns.setdefault(side, self.now_ns)
                assert several_ns <= HANDOVER_NS, (self.now_ns, self.changes[-5:])
            soon = self.now_ns - self.disturbed_ns > SOON_NS
            assert leaders or not side_of or not soon, (self.now_ns, self.changes[-5:])


@pytest.mark.parametrize("count", [2, 3, 5])
def test_one_leads_soon_after_every_fault_and_never_two_who_hear_each_other(count: int) -> None:
    changes = 0
    for seed in range(few(40)):
        world = World(seed, count, lossy=0.0)
        for _ in range(30):
            world.run(world.now_ns + world.chance.randrange(10 * MS, 4 * NS_PER_S), world.check)
            world.disturb()
        world.run(world.now_ns + 2 * SOON_NS, world.check)
        changes += len(world.changes)
    assert changes > 5 * few(40)


@pytest.mark.parametrize("count", [2, 4])
def test_once_all_is_well_the_best_leads_and_nothing_changes_any_more(count: int) -> None:
    for seed in range(few(15)):
        world = World(seed, count, lossy=0.1)
        for _ in range(12):
            world.run(world.now_ns + world.chance.randrange(10 * MS, 2 * NS_PER_S))
            world.disturb()
        world.lossy = 0.0
        world.cut(set())
        world.run(max(world.now_ns, *(each.hung_until_ns for each in world.all)))
        world.run(world.now_ns + STEADY_NS + NS_PER_S)
        alive = [each for each in world.all if each.core is not None]
        assert world.leaders() == alive[:1]
        before = list(world.changes)
        world.run(world.now_ns + 30 * NS_PER_S, world.check)
        assert world.changes == before


def test_of_several_standbys_the_best_takes_over_and_no_other_even_begins() -> None:
    for seed in range(few(20)):
        world = World(seed, 4, lossy=0.0)
        world.run(8 * NS_PER_S)
        for dead in (0, 1):
            began = len(world.changes)
            world.kill(world.all[dead])
            world.run(world.now_ns + SOON_NS, world.check)
            assert [ranks for _, ranks in world.changes[began:]] == [(dead + 1,)]
            world.run(world.now_ns + 4 * NS_PER_S)


def test_a_tenth_of_all_messages_lost_changes_no_leader() -> None:
    world = World(3, 3, lossy=0.1)
    world.run(10 * NS_PER_S)
    before = list(world.changes)
    world.run(300 * NS_PER_S)
    assert world.changes == before
    assert [each.rank for each in world.leaders()] == [0]


def test_a_leader_that_keeps_stalling_leads_only_once_it_has_been_well_for_a_while() -> None:
    world = World(5, 2, lossy=0.0)
    world.run(8 * NS_PER_S)
    assert [each.rank for each in world.leaders()] == [0]
    began = len(world.changes)
    for _ in range(30):
        world.hang(world.all[0], NS_PER_S)
        world.run(world.now_ns + 2 * NS_PER_S)
        assert [each.rank for each in world.leaders()] == [1]
    assert len(world.changes) - began <= 2
    world.run(world.now_ns + STEADY_NS)
    assert [each.rank for each in world.leaders()] == [0]


def test_who_stalls_takes_no_one_for_dead_because_of_that() -> None:
    world = World(9, 3, lossy=0.0)
    world.run(8 * NS_PER_S)
    before = list(world.changes)
    for _ in range(20):
        world.hang(world.all[1], world.chance.randrange(5 * NS_PER_S))
        world.run(world.now_ns + 6 * NS_PER_S)
    assert world.changes == before


def heartbeat(generation: int, leads: bool, n: int) -> Heartbeat:
    return Heartbeat(role="planner", id="t0", incarnation=generation, ready=True, leads=leads, seq=n, heard=[1, 2])


def test_of_two_generations_of_one_process_the_younger_leads() -> None:
    older, younger = (Leadership("t0", generation, alone=False, period_ns=HEARTBEAT_NS) for generation in (1, 2))
    for n in range(60):
        now_ns = n * HEARTBEAT_NS
        older.tick(True, now_ns)
        if n >= 10:
            younger.tick(True, now_ns)
            older.on_heartbeat(heartbeat(2, younger.leads, n), now_ns)
            younger.on_heartbeat(heartbeat(1, older.leads, n), now_ns)
        elif n == 9:
            assert older.leads
    assert (younger.leads, older.leads) == (True, False)


def test_strangers_without_end_take_no_memory_and_one_lie_holds_for_a_lease_only() -> None:
    core = Leadership("t0.r1", 1, alone=False, period_ns=HEARTBEAT_NS)
    assert [core.tick(True, n * HEARTBEAT_NS) for n in range(20)][-1]
    for generation in range(1000):
        core.on_heartbeat(heartbeat(generation, True, 1), 19 * HEARTBEAT_NS)
    assert max(len(core._others), len(core.heard)) <= 64
    assert not core.tick(True, 20 * HEARTBEAT_NS)
    assert [core.tick(True, n * HEARTBEAT_NS) for n in range(21, 30)][-1]
    assert core._others == {}


def test_copied_heartbeats_of_the_dead_hold_no_one_back() -> None:
    core, chance, last = Leadership("t0.r1", 1, alone=False, period_ns=HEARTBEAT_NS), random.Random(1), 80
    for n in range(1, 1000):
        now_ns = n * HEARTBEAT_NS
        core.tick(True, now_ns)
        copied = heartbeat(1, True, n if n <= last else chance.randint(1, last))
        for _ in range(2):
            core.on_heartbeat(copied, now_ns)
        assert core.leads == (n > last) or last < n < last + SOON_NS // HEARTBEAT_NS


def test_heartbeats_copied_before_its_start_hold_a_candidate_back_only_while_it_starts() -> None:
    core = Leadership("t0.r1", 3, alone=False, period_ns=HEARTBEAT_NS)
    for n in range(100):
        core.on_heartbeat(heartbeat(1, True, n), n * HEARTBEAT_NS)
        assert core.tick(True, n * HEARTBEAT_NS) == (n * HEARTBEAT_NS > SETTLED_NS + LEASE_NS)


def test_a_process_without_standbys_leads_from_its_start() -> None:
    core = Leadership("t0", 1, alone=True, period_ns=HEARTBEAT_NS)
    assert [core.leads, core.tick(False, 0), core.tick(False, 10 * NS_PER_S)] == [True, True, True]


def test_an_id_tells_job_and_rank() -> None:
    assert [ranked_id("t3", rank) for rank in (0, 1, 9)] == ["t3", "t3.r1", "t3.r9"]
    for job in ("t3", "a.b", "0", "x.r0", "x.r10"):
        assert split_rank(job) == (job, 0)
        for rank in range(10):
            assert split_rank(ranked_id(job, rank)) == (job, rank)
            assert job_of(ranked_id(job, rank)) == job
