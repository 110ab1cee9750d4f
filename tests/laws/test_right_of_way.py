"""Right of way: never two vehicles on one cell, and everybody moves again once all is quiet, whatever the network,
the processes and the clocks do. Each rule that docs/design/right-of-way.md needs is taken out in turn, and the law
must notice.

Vehicles drive the same distance in a number of ticks, however long these take. Ground and air vehicles never ask,
hold or wait for each other.

More histories: `pytest tests/laws/test_right_of_way.py -m seeds --seeds 0:2000`.
"""

import random
from collections import Counter
from functools import cache
from itertools import chain, pairwise

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import broken_rules as rules
from support.broken_rules import in_place_of
from support.effort import few
from support.shard_tables import AGENTS, MEMBERS, SHARDS, host_state, table_of
from support.traffic_world import TICK_NS, Faults, Process, TrafficWorld, random_faults

from swarm.grid import GridSpec
from swarm.right_of_way import host_entries
from swarm.right_of_way.agent_core import OwnRecord, RightOfWay
from swarm.right_of_way.agent_on_bus import OwnTime
from swarm.right_of_way.cell_orders import Orders
from swarm.right_of_way.holdings import Holdings
from swarm.right_of_way.shard_leader import Leader
from swarm.right_of_way.shard_member import Member
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Fence, Granted, Held, HostState, KnownRequest, Table

QUIET_S = 12.0
SHAPES = ((3, 4, 9, 9), (4, 3, 10, 5), (8, 3, 14, 7), (2, 5, 8, 4), (5, 4, 12, 4), (1, 5, 7, 4))
"""(agents, vehicles each, side of the map, side of a shard): one to nine shards, a sixth to a third of the cells
taken."""


def world_of(seed: int) -> TrafficWorld:
    chance = random.Random(f"world/{seed}")
    shape, faults = chance.choice(SHAPES), random_faults(chance, QUIET_S)
    return TrafficWorld(seed, *shape, faults, walls=chance.choice((0, 0.5)))


def duel_of(seed: int) -> TrafficWorld:
    """One shard, and members that take a busy leader for silent again and again, over a slow network."""
    return TrafficWorld(seed, 3, 6, 7, 7, Faults(late=0.3, delay_ms=400, leaps=8, quiet_s=QUIET_S))


def borders_of(seed: int) -> TrafficWorld:
    """Nine shards of three by three cells, and a network that repeats half of all and delays much for seconds."""
    return TrafficWorld(seed, 4, 6, 9, 3, Faults(repeat=0.5, late=0.3, delay_ms=50, quiet_s=QUIET_S))


def check(world: TrafficWorld, settle_s: float = 8.0, move_s: float = 10.0) -> None:
    """Runs through the faults, and then until everybody must have moved again."""
    world.run(QUIET_S + settle_s)
    assert world.unmoved_in(move_s) == []
    for process in world.processes:
        assert_remembers_what_is_not_over(process)


def assert_remembers_what_is_not_over(process: Process) -> None:
    """A host remembers entries which are over while a table lists them, and a bounded number of words of others; a
    leader remembers what its table says."""
    entries = process.rights.host._entries
    for shard, over in entries.over.items():
        assert over <= {*chain(*entries.listed.get(shard, {}).values())}
    assert len(entries.heard) <= host_entries._MOST_HEARD
    for leader in (member.leader for member in process.rights._members.values() if member.leader is not None):
        kept = leader._orders
        anew = Orders(kept.table(0, "a0", (0, 0), {}, {}))
        assert (kept.orders, kept.fenced, kept._fences) == (anew.orders, anew.fenced, anew._fences)
        assert kept._waits.keys() | kept._held.keys() <= kept.of.keys()


@pytest.mark.seeds(24)
def test_no_two_meet_and_all_move_again_when_it_is_quiet(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where hosts remember few words of others: these are told again."""
    monkeypatch.setattr(host_entries, "_MOST_HEARD", 40)
    check(world_of(seed))


@pytest.mark.seeds(3)
def test_no_two_meet_when_leaders_replace_each_other_all_the_time(seed: int) -> None:
    world = duel_of(seed)
    check(world, move_s=20.0)
    assert world.takeovers > 3


@pytest.mark.seeds(4)
def test_no_two_meet_where_borders_are_crossed_all_the_time(seed: int) -> None:
    check(borders_of(seed), move_s=20.0)


@pytest.mark.thorough
def test_forty_agents_in_a_crowd() -> None:
    faults = Faults(
        loss=0.05, repeat=0.02, late=0.02, delay_ms=50, crashes=3, hangs=1, cuts=0.5, leaps=1, twins=0.5, quiet_s=8
    )
    world = TrafficWorld(1, 40, 5, 28, 14, faults)
    world.run(8.0)
    assert world.crashes > 10
    assert len(world.unmoved_in(14.0)) <= 10  # they wait their turn


@pytest.mark.seeds(3)
def test_changes_are_read_as_what_was_said(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever messages are lost, late or repeated: nothing is read from a wrong base."""
    said: dict[object, object] = {}
    read = Counter[type]()

    def content(message: HostState | Granted) -> object:
        if isinstance(message, HostState):
            return {stand.vehicle: stand for stand in message.vehicles}
        return message.grants

    def key(message: HostState | Granted) -> object:
        host, epoch = getattr(message, "host", message.agent), getattr(message, "epoch", 0)
        return host, message.shard, message.generation, epoch, message.seq

    for kind in (HostState, Granted):

        def changes(self, base, made=kind.changes):  # type: ignore[no-untyped-def]
            said[key(self)] = content(self)
            return made(self, base)

        def whole(self, known, made=kind.whole):  # type: ignore[no-untyped-def]
            found = made(self, known)
            if self.since and found is not None:
                assert content(found) == said[key(self)]
                read[type(self)] += content(self) != content(found)
            return found

        monkeypatch.setattr(kind, "changes", changes)
        monkeypatch.setattr(kind, "whole", whole)
    for of in (world_of, borders_of):
        of(seed).run(QUIET_S)
    assert read[HostState] > 20 < read[Granted]


def test_without_faults_everybody_gets_where_it_wants() -> None:
    world = TrafficWorld(2, 8, 4, 14, 7, Faults())
    world.run(15.0)
    assert len(world.reached) == 32
    assert sum(world.reached.values()) > 150


def test_a_leader_that_dies_is_replaced_within_a_second_and_the_vehicles_go_on() -> None:
    world = TrafficWorld(3, 4, 3, 10, 10, Faults())
    world.run(4.0)
    (leader,) = (one for one in world.processes if 0 in one.rights._members and one.rights._members[0].leader)
    world.processes.remove(leader)
    leader.alive = False
    others = [vehicle for vehicle in world.moves if not vehicle.startswith(leader.agent)]
    world.run(1.2)
    # Not all: one may want the very cell on which a vehicle of the dead agent stands.
    assert len({*others} - {*world.unmoved_in(2.0)}) >= 6


def test_a_vehicle_does_not_wait_for_its_own_entry_of_an_earlier_generation() -> None:
    first, second, third = ((5, 1, seq) for seq in (1, 2, 3))
    orders = Orders(
        Table(
            shard=0, agent="a0", epoch=1, seq=3, hosts={"a0": (2, 1), "a1": (1, 1)},
            grants={"a0-00": Held.of([second]), "a1-00": Held.of([third])},
            fences=[Fence("a0", 1, {"a0-00": Held.of([first])})],
        )
    )  # fmt: skip
    assert [*orders.before(second, "a0-00")] == []
    assert [*orders.before(third, "a1-00")] == [(first, "a0-00"), (second, "a0-00")]


def test_a_statement_that_is_heard_again_says_nothing_of_a_host_that_is_silent() -> None:
    leader = Leader(SHARDS, MEMBERS[0], 1, table_of(1, 1, a1=[5]), {name: [f"{name}-00"] for name in AGENTS})
    for now_ns in (3, 9):
        leader.take_host_state(host_state("a1", [(5, 1, 1)], 2, (1, 1)), now_ns)
    assert leader._hosts["a1"].heard_ns == 3


# --- late ticks; ground and air -----------------------------------------------------------------------------

TICKS = 120


@cache
def drive(seed: int, times_as_long: int) -> TrafficWorld:
    world = TrafficWorld(seed, 5, 4, 16, 8, Faults(tick_ns=times_as_long * TICK_NS))
    world.run(TICKS * times_as_long * TICK_NS / 1e9)
    return world


@pytest.mark.parametrize("times_as_long", [4, 12, 40])
def test_late_ticks_do_not_cost_vehicles_more_than_the_time_they_take(times_as_long: int) -> None:
    for seed in range(few(3)):
        on_time, late = drive(seed, 1), drive(seed, times_as_long)
        assert not late.collisions
        # A message is received a tick later, so a step takes longer; by wall time it would be a tenth.
        assert sum(late.moves.values()) > 0.5 * sum(on_time.moves.values())
        assert late.takeovers <= 2 * on_time.takeovers
        assert late.messages < 1.1 * on_time.messages


@given(
    period_ns=st.integers(1, 10**9),
    start_ns=st.integers(0, 10**18),
    steps=st.lists(st.tuples(st.integers(-(10**9), 10**11), st.booleans()), max_size=50),
)
def test_own_time_never_goes_back_and_counts_a_period_for_a_tick_at_most(
    period_ns: int, start_ns: int, steps: list[tuple[int, bool]]
) -> None:
    own, now_ns = OwnTime(period_ns), start_ns
    told = [own.tick(now_ns)]
    ticks = [told[0]]
    for step_ns, is_tick in steps:
        now_ns += step_ns
        told.append(own.at(now_ns))
        if is_tick:
            ticks.append(own.tick(now_ns))
            assert ticks[-1] == told[-1]
    assert all(0 <= later - earlier <= period_ns for earlier, later in pairwise(ticks))
    if all(step_ns >= 0 for step_ns, _ in steps):
        assert told == sorted(told)
        assert told[-1] <= now_ns


def test_on_time_it_is_the_time_of_the_wall() -> None:
    own = OwnTime(100)
    told = [own.at(7), own.tick(7), own.at(50), own.tick(107), own.at(207), own.tick(200)]
    assert told == [7, 7, 50, 107, 207, 200]


names = st.lists(st.sampled_from([f"a{n}" for n in range(12)]), min_size=1, max_size=12, unique=True)


@settings(max_examples=few(60))
@given(st.integers(1, 300), st.integers(1, 300), names, st.data())
def test_no_shard_and_no_member_is_in_two_layers(
    rows: int, cols: int, agents: list[str], data: st.DataObject
) -> None:
    grid = GridSpec(rows, cols, 10.0)
    driving = data.draw(st.lists(st.sampled_from(agents), unique=True))
    flying = [agent for agent in agents if agent not in driving]
    layers = [Shards(grid, driving, layer=0), Shards(grid, flying, layer=1)]
    cell = data.draw(st.integers(0, grid.cells - 1))
    for shards, own in zip(layers, (driving, flying), strict=True):
        assert shards.of(cell) in shards.all
        assert shards.of(grid.cells) == shards.of(-1) == -1
        if own:
            assert set(shards.members(shards.of(cell))) <= set(own)
    ground, air = layers
    assert not set(ground.all) & set(air.all)
    assert air.of(cell) - ground.of(cell) == ground.count


@given(st.integers(0, 1), st.integers(0, 1), st.sampled_from(["a1", "a2", "stranger"]), st.integers(0, 3))
def test_only_those_of_its_layer_answer_a_new_generation(layer: int, asked: int, who: str, disk: int) -> None:
    """No process answers an external vehicle that bears the name of an agent of the other layer, a2."""
    spawns = {"a0": {"a0-00": 1}, "a1": {"a1-00": 5}}
    shards = Shards(GridSpec(20, 20, 10.0), list(spawns), layer=layer, others=["a2"])
    rights = RightOfWay("a0", shards, spawns, OwnRecord(disk=7), {})
    rights.begin(3)
    answers = rights.answer_known(KnownRequest(agent=who, disk=disk, layer=asked))
    assert bool(answers) is (layer == asked and who != "a2")


# --- the rules, each taken out ------------------------------------------------------------------------------


@in_place_of(Member, "_lead")
def usable_without_majority(lead, self, leader, now_ns):
    return [*lead(self, leader, now_ns), *self._on_file(leader, leader.seq, now_ns)]


@in_place_of(TrafficWorld, "crash")
def restart_without_file(crash, self, process):
    process.disk.saved.clear()
    crash(self, process)


@in_place_of(Member, "hear_table")
def stores_after_a_promise(hear, self, table, now_ns):
    promised, self.promised = self.promised, min(self.promised, table.epoch)
    actions = hear(self, table, now_ns)
    self.promised = max(promised, self.promised)
    return actions


@in_place_of(Member, "_take_charge")
def one_promise_is_enough(take, self, now_ns):
    majority, self._shards.majority = self._shards.majority, 1
    take(self, now_ns)
    self._shards.majority = majority


@in_place_of(Leader, "tick")
def frees_what_nobody_reported(tick, self, now_ns):
    orders = self._orders
    for host, vehicles in orders.by_host.items():
        orders.remove(host, {vehicle: orders.of[vehicle][-1:] for vehicle in vehicles}, (1 << 60, 0))
    return tick(self, now_ns)


@in_place_of(Holdings, "hear_granted")
def an_older_generation_goes_on(hear, self, granted, now_ns):
    self.generation = self._entries.generation = max(self.generation, granted.generation)
    return hear(self, granted, now_ns)


@in_place_of(Holdings, "lefts")
def says_that_it_has_left_when_it_sets_out(lefts, self, now_ns):
    entries = self._entries
    entries._end([path[0] for path in entries.paths.values() if len(path) > 1])
    return lefts(self, now_ns)


@in_place_of(Orders, "_fence")
def a_new_generation_takes_what_the_last_one_held(fence, self, host, generation):
    pass


@in_place_of(RightOfWay, "begin")
def seats_a_file_that_is_not_the_first(begin, self, chance):
    actions = begin(self, chance)
    self.own = msgspec.structs.replace(self.own, noted_by=[name for name in self.spawns if name != self.agent])
    return actions


@in_place_of(Holdings, "host_states")
def acts_on_a_table_that_is_not_the_newest(host_states, self, requests, now_ns):
    said = host_states(self, requests, now_ns)
    for known in (self._views, self._entries.knows, self._entries.over):
        for shard in [shard for shard in known if shard not in self.watched]:
            del known[shard]
    return said


RULES: dict[rules.Broken, int] = {
    usable_without_majority: 7,
    restart_without_file: 86,
    stores_after_a_promise: 7,
    one_promise_is_enough: 3,
    frees_what_nobody_reported: 1,
    an_older_generation_goes_on: 14,
    rules.forgets_where_an_older_generation_may_stand: 14,
    rules.follows_without_a_word: 1,
    rules.follows_on_the_word_of_the_last_before_it: 41,
    says_that_it_has_left_when_it_sets_out: 1,
    rules.takes_what_an_older_table_added: 1,
    rules.believes_that_another_vehicle_of_the_cell_has_left: 5,
    rules.forgets_who_is_before: 1,
    a_new_generation_takes_what_the_last_one_held: 18,
    seats_a_file_that_is_not_the_first: 26,
    acts_on_a_table_that_is_not_the_newest: 21,
}
"""A rule -> the history that is tried before the others, because it collided last."""


@pytest.mark.parametrize("broken", RULES, ids=lambda rule: rule.__name__)
def test_each_rule_is_needed(broken: rules.Broken, monkeypatch: pytest.MonkeyPatch) -> None:
    broken(monkeypatch)
    assert rules.collides(RULES[broken], (world_of, borders_of, world_of, duel_of), QUIET_S)
