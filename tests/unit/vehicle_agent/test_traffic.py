"""The parts of right of way, one by one: plots, planning, wardens, members, what hosts hold and ask for."""

from __future__ import annotations

import random
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec
from swarm.right_of_way.holdings import Holdings, Tell, Wish
from swarm.right_of_way.incarnations import BEAT_NS, first_life, is_far_ahead
from swarm.right_of_way.lock_regions import Plots
from swarm.wire.messages.traffic import Grant, Granted, Known, KnownRequest, Shut, Stand, Standing, Stored, Table
from swarm.wire.topics import STANDING
from vehicle_agent.bodies import Bodies
from vehicle_agent.traffic.member import Member, Refused, Save
from vehicle_agent.traffic.pibt import Mover, Round
from vehicle_agent.traffic.right_of_way_core import OwnRecord, RightOfWay
from vehicle_agent.traffic.steering import Steering
from vehicle_agent.traffic.warden import Warden

GRID = GridSpec(8, 8, 1.0)
AGENTS = [f"a{n}" for n in range(5)]
PLOTS = Plots(GRID, AGENTS)
MEMBERS = PLOTS.members(0)
S = NS_PER_S


def table_of(epoch: int, seq: int, **grants: list[int]) -> Table:
    """Vehicles are named by their host: a0=[5] is the vehicle a0-00 on cell 5."""
    held = {f"{host}-00": Grant(cells, (epoch, seq)) for host, cells in grants.items()}
    hosts = dict.fromkeys(grants, (1, seq))
    return Table(plot=0, agent=PLOTS.warden(0, epoch), epoch=epoch, seq=seq, hosts=hosts, grants=held)


def standing(host: str, cells: list[int], seq: int, knows: tuple[int, int] = (0, 0), **more: object) -> Standing:
    stand = Stand(f"{host}-00", cells[0], cells[-1], cells, [], [], 0, 0)
    fields = {"life": 1, "vehicles": [stand], **more}
    return Standing(plot=0, agent=host, seq=seq, knows=knows, **fields)  # type: ignore[arg-type]


# --- plots --------------------------------------------------------------------------------------------------


def test_members_are_the_same_in_every_process_and_spread_over_the_agents() -> None:
    grid = GridSpec(1000, 1000, 1.0)
    plots, others = Plots(grid, AGENTS), Plots(grid, AGENTS[::-1])
    counts = dict.fromkeys(AGENTS, 0)
    for plot in range(plots.count):
        assert plots.members(plot) == others.members(plot)
        assert len(set(plots.members(plot))) == 3
        for member in plots.members(plot):
            counts[member] += 1
    assert min(counts.values()) > plots.count // 3
    assert Plots(grid, ["a0", "a1"]).members(7) in (("a0",), ("a1",))
    assert plots.of(-1) == plots.of(grid.cells) == -1


# --- planning -----------------------------------------------------------------------------------------------


@given(st.integers(0, 10_000), st.integers(1, 30))
def test_a_round_of_planning_sends_no_two_to_one_cell_and_lets_the_oldest_through(seed: int, count: int) -> None:
    chance = random.Random(seed)
    cells = chance.sample(range(GRID.cells), count)
    movers = []
    for n, cell in enumerate(cells):
        near = [other for _, other in GRID.neighbours(cell)]
        chance.shuffle(near)
        movers.append(Mover(f"v{n}", cell, near, chance.randint(0, len(near)), age=count - n))
    round = Round(movers, closed=lambda cell: False, inside=lambda cell: True)
    for mover in movers:
        round.plan(mover)
    assert len(set(round.to.values())) == count
    at = {mover.cell: mover.id for mover in movers}
    for mover in movers:
        to = round.to[mover.id]
        assert to == mover.cell or to in mover.wants
        if to != mover.cell and to in at:
            assert round.to[at[to]] != mover.cell  # nobody exchanges places
    # Where there is a cell free somewhere, the oldest gets its first wish: all others can be pushed along.
    if movers[0].better and count < GRID.cells // 2:
        assert round.to["v0"] == movers[0].wants[0]


@given(st.integers(0, 1 << 32), st.booleans(), st.floats(0.0, 0.4))
def test_the_steps_of_a_route_are_judged_together_as_they_are_one_by_one(
    seed: int, corners: bool, share: float
) -> None:
    chance = random.Random(seed)
    pace = np.where([chance.random() < share for _ in range(GRID.cells)], np.inf, 0.1).astype(np.float32)
    rules = PlannerConfig(corner_cutting=corners)
    steering = Steering(GRID, pace.reshape(8, 8), rules, 4, Bodies(GRID))
    cells = [chance.randrange(GRID.cells)]
    for _ in range(chance.randint(0, 20)):
        cells.append(chance.choice([other for _, other in GRID.neighbours(cells[-1])]))
    one_by_one = [steering.passable(tail, head) for tail, head in pairwise(cells)]
    assert steering.passable_steps(cells) == [*one_by_one, False].index(False)


# --- the warden ---------------------------------------------------------------------------------------------


def test_a_cell_is_free_again_only_by_the_word_of_its_host() -> None:
    warden = Warden(PLOTS, "a0", 3, table_of(1, 1, a1=[9, 10, 11]), {"a1": ["a1-00"]})
    assert warden.tick(0).grants["a1-00"].cells == [9, 10, 11]  # type: ignore[union-attr]
    warden.hear(standing("a1", [10, 11], seq=2), 0)
    assert warden.tick(S).grants["a1-00"].cells == [10, 11]  # type: ignore[union-attr]
    warden.hear(standing("a1", [9, 10, 11], seq=1), 0)  # late
    warden.hear(standing("a1", [10], seq=3, knows=(1, 0)), 0)  # of before the last grant
    assert warden.tick(2 * S).grants["a1-00"].cells == [10, 11]  # type: ignore[union-attr]
    warden.hear(standing("a1", [10], seq=4, knows=(1, 1)), 0)
    assert warden.tick(3 * S).grants["a1-00"].cells == [10]  # type: ignore[union-attr]


def test_what_an_older_life_may_stand_on_stays_shut_until_it_has_stopped_or_is_proved_dead() -> None:
    for end in (standing("a1", [9], seq=9, ended=True), standing("a1", [9], seq=9, life=1 << 33, dead=[1])):
        warden = Warden(PLOTS, "a0", 3, table_of(1, 1, a1=[9, 10]), {"a1": ["a1-00"]})
        warden.hear(standing("a1", [9], seq=1, life=1 << 32, vehicles=[]), 0)
        table = warden.tick(0)
        assert table is not None
        assert [(shut.agent, shut.life, shut.cells) for shut in table.shut] == [("a1", 1, [9, 10])]
        assert table.grants["a1-00"].cells == [9, 10]
        warden.hear(end, 0)
        assert all(shut.life != 1 for shut in warden.tick(S).shut)  # type: ignore[union-attr]


def test_an_older_life_is_told_that_it_is_replaced_by_a_warden_that_never_heard_the_younger() -> None:
    """The younger has died, and the warden knows of it by the table only."""
    table = table_of(1, 1, a1=[9])
    table.hosts["a1"] = (2 << 32, 7)
    warden = Warden(PLOTS, "a0", 3, table, {"a1": ["a1-00"]})
    for late in (standing("a1", [9], seq=50), standing("a1", [9], seq=51, ended=True)):
        warden.hear(late, S)
        told = warden.tick(S)
        (granted,) = warden.granted(table if told is None else told, S)
        assert (granted.host, granted.life) == ("a1", 2 << 32)
        warden = Warden(PLOTS, "a0", 3, table, {"a1": ["a1-00"]})
    older = Holdings(PLOTS, "a1", ["a1-00"])
    older.begin(1, [])
    older.watch([0])
    older.hear_granted(granted, lambda vehicle, cells: cells[0], S)
    assert older.replaced


def test_no_word_of_one_life_hides_that_of_another() -> None:
    """Both are heard under one key; what says that an older one has ended is said by no other."""
    assert not STANDING.newest


def test_a_grant_that_is_implausibly_far_ahead_is_refused_and_named() -> None:
    holdings = holdings_of()
    far = 3 * ((1 << 40) + 1)
    for lie in (table_of(far, 1, a0=[9]), table_of(1, 1 << 40, a0=[9])):
        hear(holdings, lie, S)
        assert "implausibly far ahead" in holdings.refused.pop()
        assert holdings.heard_ns(0) == 0
    hear(holdings, table_of(1, 1, a0=[9]), 2 * S)
    assert (list(holdings.path("a0-00")), holdings.heard_ns(0)) == ([9], 2 * S)


def test_a_life_that_is_implausibly_far_ahead_is_refused_and_named() -> None:
    warden = Warden(PLOTS, "a0", 3, table_of(1, 1, a1=[9]), {"a1": ["a1-00"]})
    warden.hear(standing("a1", [9], seq=1, life=1 << 61), 0)
    assert "a1 names a life" in warden.refused[0]
    assert warden.tick(0).hosts["a1"] == (1, 1)  # type: ignore[union-attr]
    assert first_life(5 << 32 | 7, 1) > 5 << 32 | 0xFFFF_FFFF
    assert not is_far_ahead(first_life(0, 3), 0)


def test_among_vehicles_of_one_age_each_goes_first_at_times() -> None:
    """As all are that began the run together: those of the last agent must not always give way."""
    places = {"a0": 18, "a1": 19, "a2": 20, "a3": 26, "a4": 28}
    first = set()
    for step in range(30):
        held = table_of(1, 1, **{host: [cell] for host, cell in places.items()})
        warden = Warden(PLOTS, "a0", 3, held, {host: [f"{host}-00"] for host in places})
        for host, cell in places.items():
            stand = Stand(f"{host}-00", cell, cell, [cell], [27], [27], 1, step << 12)
            warden.hear(standing(host, [cell], seq=2, vehicles=[stand]), 0)
        table = warden.tick(0)
        assert table is not None
        first.update(vehicle for vehicle, grant in table.grants.items() if 27 in grant.cells)
    assert first == set(held.grants)


def test_a_cell_that_one_under_way_holds_last_is_closed_though_the_same_plan_grants_it_more() -> None:
    held = table_of(1, 1, a1=[9, 10], a2=[18])
    warden = Warden(PLOTS, "a0", 3, held, {host: [f"{host}-00"] for host in ("a1", "a2")})
    drives = Stand("a1-00", 9, 10, [9, 10], [11], [], 0, 9 << 12)
    waits = Stand("a2-00", 18, 18, [18], [], [10, 26], 2, 0)
    warden.hear(standing("a1", [9, 10], seq=2, vehicles=[drives]), 0)
    warden.hear(standing("a2", [18], seq=2, vehicles=[waits]), 0)
    table = warden.tick(0)
    assert table is not None
    assert {vehicle: grant.cells for vehicle, grant in table.grants.items()} == {
        "a1-00": [9, 10, 11],
        "a2-00": [18, 26],
    }


# --- members ------------------------------------------------------------------------------------------------


def member_of(promised: int = 0) -> Member:
    return Member(PLOTS, MEMBERS[0], promised, table_of(0, 0), {}, 0)


def test_after_a_promise_nothing_older_is_stored() -> None:
    member = member_of()
    assert isinstance(member.hear_table(table_of(1, 1), 0)[0], Save)
    assert member.on_file == Stored(plot=0, agent=MEMBERS[0], epoch=1, seq=1)
    assert member.hear_claim(5, S // 10) == []  # the warden was heard just now
    assert isinstance(member.hear_claim(5, 2 * S)[0], Save)
    assert member.hear_claim(5, 9 * S) == []
    assert member.hear_table(table_of(1, 2), 2 * S) == [Stored(plot=0, agent=MEMBERS[0], epoch=5, seq=0)]
    assert member.stored.stamp == (1, 1)
    assert member.hear_table(table_of(5, 1), 2 * S)[-1] == Stored(plot=0, agent=MEMBERS[0], epoch=5, seq=1)


def test_the_second_member_says_what_the_first_has_not_said_and_something_in_each_beat() -> None:
    first, second = (Member(PLOTS, MEMBERS[n], 0, table_of(0, 0), {}, 0) for n in (2, 0))  # of epoch 1
    said = first.hear_table(table_of(1, 1), S)
    assert [type(action) for action in said] == [Save, Stored]
    assert [type(action) for action in second.hear_table(table_of(1, 1), S)] == [Save]
    assert second.tick(S) == [second.on_file]  # it has not heard the first
    second.hear_table(table_of(1, 2), S)
    second.hear_stored(Stored(plot=0, agent=MEMBERS[2], epoch=1, seq=2), S)
    assert second.tick(S) == []
    assert second.tick(S + BEAT_NS) == [Stored(plot=0, agent=MEMBERS[0], epoch=1, seq=2)]
    assert second.tick(2 * S) == []
    second.hear_table(table_of(1, 2), 2 * S)  # the warden tells it again
    assert second.tick(2 * S) == [second.on_file]


def test_what_has_not_changed_is_told_again_under_the_same_stamp_once_in_a_beat() -> None:
    warden = Warden(PLOTS, "a0", 3, table_of(1, 1, a1=[9, 10]), {"a1": ["a1-00"]})
    first = warden.tick(0)
    assert first is not None
    warden.hear(standing("a1", [9, 10], seq=2), 0)
    assert warden.tick(BEAT_NS // 2) is None
    assert warden.tick(BEAT_NS) is first
    warden.hear(standing("a1", [10], seq=3), BEAT_NS)
    assert warden.tick(BEAT_NS + 1) is None  # what is only freed can wait
    freed = warden.tick(2 * BEAT_NS)
    assert freed is not None
    assert (freed.seq, freed.hosts["a1"], freed.grants["a1-00"].cells) == (2, (1, 3), [10])
    warden.hear(standing("a1", [10], seq=4, vehicles=[]), 2 * BEAT_NS)  # it wants nothing here any more
    assert warden.tick(3 * BEAT_NS).hosts["a1"] == (1, 4)  # type: ignore[union-attr]


def warden_that_told(fleets: dict[str, list[str]]) -> tuple[Member, Table]:
    """A member that has just become warden, and the table that it told, which nobody has stored yet."""
    member = Member(PLOTS, MEMBERS[0], 0, table_of(0, 0, a0=[9]), fleets, 0)
    member.hear_standing(standing("a0", [9], seq=1), 2 * S)
    claim = member.tick(2 * S)[0]
    assert isinstance(claim, Save)
    member.hear_promise(MEMBERS[1], claim.promised, table_of(0, 0), 2 * S)
    member.hear_standing(standing("a0", [9], seq=2), 2 * S)
    (_, table) = member.tick(2 * S)
    assert isinstance(table, Table)
    return member, table


def test_a_table_is_told_again_by_its_number_only_once_both_others_have_stored_it() -> None:
    member, table = warden_that_told({"a0": ["a0-00"]})
    now_ns = 2 * S
    number = Stored(plot=0, agent=MEMBERS[0], epoch=table.epoch, seq=table.seq)
    for stored, told in (
        ((table.seq, None), table),  # the second has not said anything
        ((table.seq, table.seq), number),
        ((table.seq, table.seq - 1), table),  # it has lost its table, or its word was late: the whole does no harm
        ((None, table.seq), number),
    ):
        now_ns += BEAT_NS
        member.hear_standing(standing("a0", [9], seq=now_ns), now_ns)
        for other, seq in zip(MEMBERS[1:], stored, strict=True):
            if seq is not None:
                member.hear_stored(Stored(plot=0, agent=other, epoch=table.epoch, seq=seq), now_ns)
        assert [each for each in member.tick(now_ns) if not isinstance(each, Granted)] == [told]
    now_ns += 2 * BEAT_NS
    member.hear_standing(standing("a0", [9], seq=now_ns), now_ns)
    assert member.tick(now_ns) == [table]  # nobody has answered the number


def test_a_number_is_answered_as_the_table_that_it_stands_for() -> None:
    first, second = (Member(PLOTS, MEMBERS[n], 0, table_of(0, 0), {}, 0) for n in (2, 0))  # of epoch 1
    same = Stored(plot=0, agent=MEMBERS[1], epoch=1, seq=4)
    lags = [Stored(plot=0, agent=MEMBERS[2], epoch=0, seq=0)]
    assert first.hear_stored(same, S) == lags  # it has to be told the whole
    assert [first.hear_table(table_of(1, 4), S)[-1]] == first.hear_stored(same, S) == [first.on_file]
    second.hear_table(table_of(1, 4), S)
    assert second.tick(S) == [second.on_file]
    second.hear_stored(first.on_file, 2 * S)
    assert second.hear_stored(same, 2 * S) == []
    assert second.tick(2 * S) == [second.on_file]
    assert second.hear_claim(2, 2 * S + BEAT_NS) == []  # who tells a number leads, as who tells a table
    assert first.hear_stored(Stored(plot=0, agent=MEMBERS[1], epoch=1, seq=3), S) == []  # it came late


def test_a_number_of_a_later_epoch_ends_a_warden_and_one_of_an_earlier_epoch_is_told_so() -> None:
    member, table = warden_that_told({"a0": ["a0-00"]})
    later = next(epoch for epoch in range(table.epoch + 1, table.epoch + 3) if PLOTS.warden(0, epoch) == MEMBERS[1])
    assert member.hear_stored(Stored(plot=0, agent=MEMBERS[1], epoch=later, seq=7), 2 * S) == [member.on_file]
    assert member.warden is None
    member = member_of(promised=5)
    old = Stored(plot=0, agent=MEMBERS[1], epoch=1, seq=7)
    assert member.hear_stored(old, S) == [Stored(plot=0, agent=MEMBERS[0], epoch=5, seq=0)]


def test_an_epoch_has_one_warden_only_though_a_promise_comes_twice() -> None:
    member = member_of()
    member.hear_standing(standing("a1", [9], seq=1), 2 * S)
    save = member.tick(2 * S)[0]
    assert isinstance(save, Save)
    member.hear_promise(MEMBERS[1], save.promised, table_of(0, 0), 2 * S)
    first = member.warden
    assert first is not None
    member.hear_standing(standing("a1", [9], seq=3), 3 * S)
    member.tick(3 * S)  # nobody has acknowledged anything: it resigns
    assert member.warden is None
    member.hear_promise(MEMBERS[1], save.promised, table_of(0, 0), 3 * S)
    assert member.warden is None


def test_an_epoch_that_is_implausibly_far_ahead_is_refused_and_named() -> None:
    member = member_of()
    assert isinstance(member.hear_claim(1 << 60, S)[0], Refused)
    far = next(epoch for epoch in range(1 << 60, (1 << 60) + 3) if PLOTS.warden(0, epoch) != MEMBERS[0])
    assert isinstance(member.hear_table(table_of(far, 1), S)[0], Refused)
    assert member.promised == 0


# --- what a host holds --------------------------------------------------------------------------------------


def holdings_of() -> Holdings:
    holdings = Holdings(PLOTS, "a0", ["a0-00"])
    holdings.begin(1, [])
    holdings.watch([0])
    return holdings


def granted_of(table: Table, host: str = "a0") -> Granted:
    """What a table says to one host."""
    life, heard = table.hosts.get(host, (0, 0))
    grants = {vehicle: grant.cells for vehicle, grant in table.grants.items() if vehicle.startswith(host)}
    return Granted(
        plot=table.plot, host=host, agent=table.agent, epoch=table.epoch, seq=table.seq, life=life, heard=heard,
        grants=grants,
    )  # fmt: skip


def hear(holdings: Holdings, table: Table, now_ns: int = 0) -> None:
    holdings.hear_granted(granted_of(table), lambda vehicle, cells: cells[0], now_ns)


def test_a_life_that_is_replaced_places_no_vehicle_by_a_grant_that_comes_late() -> None:
    holdings = holdings_of()
    younger = msgspec.structs.replace(granted_of(table_of(1, 1, a0=[9])), life=2)
    holdings.hear_granted(younger, lambda vehicle, cells: cells[0], S)
    assert holdings.replaced
    hear(holdings, table_of(1, 2, a0=[9]), S)
    assert list(holdings.path("a0-00")) == []


def test_what_a_table_grants_is_told_once_two_of_three_members_have_stored_it() -> None:
    fleets = {"a0": ["a0-00"], "a1": ["a1-00"]}
    member = Member(PLOTS, MEMBERS[0], 0, table_of(0, 0, a0=[9], a1=[18]), fleets, 0)
    member.hear_standing(standing("a0", [9], seq=1), 2 * S)
    claim = member.tick(2 * S)[0]
    assert isinstance(claim, Save)
    member.hear_promise(MEMBERS[1], claim.promised, table_of(0, 0), 2 * S)
    wants = [Stand("a0-00", 9, 9, [9], [], [18, 10], 2, 0)]
    member.hear_standing(standing("a0", [9], seq=2, vehicles=wants), 2 * S)
    (_, table) = member.tick(2 * S)
    assert isinstance(table, Table)
    stored = Stored(plot=0, agent=MEMBERS[1], epoch=table.epoch, seq=table.seq)
    for too_old in (msgspec.structs.replace(stored, seq=0), msgspec.structs.replace(stored, epoch=0)):
        assert member.hear_stored(too_old, 2 * S) == []
    (granted,) = member.hear_stored(stored, 2 * S)  # only a0 has spoken
    assert isinstance(granted, Granted)
    assert (granted.host, granted.stamp, granted.heard) == ("a0", table.stamp, 2)
    assert (granted.grants, granted.occupied) == ({"a0-00": [9, 10]}, [18])
    assert member.hear_stored(stored, 2 * S) == []  # told just now
    assert [type(each) for each in member.hear_stored(stored, 2 * S + BEAT_NS)] == [Granted]


def test_a_host_takes_what_follows_its_path() -> None:
    holdings = holdings_of()
    hear(holdings, table_of(1, 1, a0=[9]))
    assert list(holdings.path("a0-00")) == [9]
    hear(holdings, table_of(1, 2, a0=[9, 10, 20]))
    assert list(holdings.path("a0-00")) == [9, 10]  # 20 does not follow


def test_a_cell_given_back_is_not_asked_for_before_the_table_shows_that_it_is_free() -> None:
    holdings = holdings_of()
    hear(holdings, table_of(1, 1, a0=[9]))
    hear(holdings, table_of(1, 2, a0=[9, 10, 11]))
    holdings.give_back("a0-00")
    wishes = {"a0-00": Wish(ahead=[10, 11], wants=[10, 17, 1], better=2)}
    (told,) = holdings.standings(wishes, S)
    said = told.standing
    assert holdings.standings(wishes, S + BEAT_NS - 1) == []  # nothing new
    assert len(holdings.standings(wishes, S + BEAT_NS)) == 1
    assert (said.vehicles[0].holds, said.vehicles[0].ahead, said.vehicles[0].wants) == ([9], [], [17, 1])
    hear(holdings, table_of(1, 3, a0=[9]))
    (told,) = holdings.standings(wishes, S + BEAT_NS)
    said = told.standing
    assert (said.vehicles[0].ahead, said.vehicles[0].wants) == ([10, 11], [10, 17, 1])


def test_the_older_of_two_lives_learns_that_it_is_replaced() -> None:
    holdings = holdings_of()
    table = table_of(1, 1, a0=[9])
    table.hosts["a0"] = (2, 1)
    hear(holdings, table)
    assert holdings.replaced
    assert list(holdings.path("a0-00")) == []
    assert all(told.standing.ended for told in holdings.standings({}, S))


def test_a_host_speaks_to_the_warden_that_it_hears_and_else_to_all_members() -> None:
    holdings = holdings_of()
    assert [told.members for told in holdings.standings({}, S)] == [MEMBERS]
    hear(holdings, table_of(1, 1, a0=[9]), 2 * S)
    assert [told.members for told in holdings.standings({}, 2 * S)] == [(PLOTS.warden(0, 1),)]
    hear(holdings, table_of(1, 1, a0=[9]), 3 * S)  # told again
    assert [told.members for told in holdings.standings({}, 3 * S)] == [(PLOTS.warden(0, 1),)]
    assert [told.members for told in holdings.standings({}, 4 * S)] == [MEMBERS]
    hear(holdings, table_of(0, 9, a0=[9]), 5 * S)  # of one that was replaced
    assert [told.members for told in holdings.standings({}, 5 * S)] == [MEMBERS]


def rights_of(agent: str, saved: dict[int, tuple[int, Table]] | None = None) -> RightOfWay:
    spawns = {name: {f"{name}-00": n} for n, name in enumerate(AGENTS)}
    return RightOfWay(agent, PLOTS, spawns, OwnRecord(disk=7), saved or {})


def test_a_replaced_life_finds_the_plots_that_keep_its_cells_shut_and_says_there_that_it_has_stopped() -> None:
    """Nobody else can: the later life has another file. It had left that plot long ago."""
    table = msgspec.structs.replace(table_of(1, 1), shut=[Shut("a4", 1 << 32, [9])])
    member = rights_of(MEMBERS[0], {0: (1, table)})
    (*_, known) = member.answer_known(KnownRequest(agent="a4", disk=7))
    assert isinstance(known, Known)
    assert known.plots == [0]
    older = rights_of("a4")
    older.begin(0)
    for name in AGENTS[:4]:
        older.hear_known(Known(agent=name, disk=7, life=0, plots=[]))
    assert older.settled
    older.holdings.plots.clear()
    older.holdings.replaced = True
    assert not older.settled  # so it is asked again what is known of it
    older.hear_known(known)
    (told,) = older.tick({}, S)
    assert isinstance(told, Tell)
    said = told.standing
    assert (said.plot, said.ended) == (0, True)


def test_whoever_waits_in_a_plot_without_a_warden_says_so() -> None:
    rights = rights_of("a0")
    rights.begin(0)
    life = rights.holdings.life

    def hear(seq: int, now_ns: int) -> None:
        table = table_of(1, seq, a0=[0])
        table.hosts["a0"] = (life, 1)
        rights.host.hear_granted(granted_of(table), now_ns)

    assert rights.host.unled(S) == {}
    hear(1, S)
    assert rights.host.unled(3 * S) == {}
    (sentence,) = rights.host.unled(4 * S).values()
    assert all(member in sentence for member in MEMBERS)
    hear(1, 4 * S)  # told again
    assert rights.host.unled(5 * S) == {}


@pytest.mark.parametrize("lie", [[0, -8], [-8], [56, 64], [1 << 31]])
def test_cells_from_nowhere_are_not_driven_to(lie: list[int]) -> None:
    holdings = holdings_of()
    hear(holdings, table_of(1, 1, a0=lie))
    hear(holdings, table_of(1, 2, a0=[*lie, -16]))
    assert all(0 <= cell < GRID.cells for cell in holdings.path("a0-00"))
