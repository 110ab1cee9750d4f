"""The laws of the tree under everything that happens to it, for every strategy, and where a growth is left to a
worker: until it is adopted, answers are of the older tree, keep every law and say where they lead. While only the
kernels of a first route are compiled, a tree keeps every law, and calls no other."""

import sys
from collections.abc import Callable
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import slow_twins as naive
from support.effort import few
from support.planner_play import Play
from support.planner_strategies import (
    STRATEGIES,
    Job,
    Marks,
    Move,
    happenings,
    paces,
    planner_configs,
    random_climb,
    random_pace,
)
from support.planner_swarm import GRID, Swarm, flat

from planner_service import growth_times
from planner_service.growth_times import WindowSchedule, block_half
from planner_service.kernel_build import FIRST, LATER
from planner_service.strategy import STAGES
from shared_map.terrain.slope_and_climb import ENTRIES, Climb, climb_of
from swarm.config.ground import CostConfig
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.wire.messages.planning import RouteRequest
from swarm.wire.route_columns import NO_TARGET, RouteStatus
from swarm.wire.topics import ROUTE


@st.composite
def climbs(draw: st.DrawFn, shape: tuple[int, int]) -> Climb:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return random_climb(
        rng, GridSpec(*shape, 1.0), draw(st.sampled_from([0.0, 0.1, 0.5])), draw(st.sampled_from([0.1, 0.3, 10.0]))
    )


@pytest.mark.parametrize("directed", [False, True])
@given(paces(), planner_configs(), happenings(), st.data())
@settings(max_examples=few(200), deadline=None)
def test_whatever_happens_routes_arrive_are_legal_cost_what_they_say_and_bounds_hold(
    directed: bool, pace: np.ndarray, config: PlannerConfig, events: list[Move | Marks | Job], data: st.DataObject
) -> None:
    play = Play(pace, config, climb=data.draw(climbs(pace.shape)) if directed else None)
    play.check()
    for event in events:
        play.happen(event)
        play.check()


@pytest.mark.parametrize("directed", [False, True])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_long_walk_with_marks_keeps_the_laws(strategy: str, directed: bool) -> None:
    rng = np.random.default_rng(5)
    pace = random_pace(rng, 30, 27, 10.0, 0.15)
    climb = random_climb(rng, GridSpec(30, 27, 1.0), 0.15, 0.35) if directed else None
    config = PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9)  # type: ignore[arg-type]
    kinds = Play(pace, config, climb=climb).walk(rng, 50, 7)
    assert strategy in ("full", "exact") or kinds & {"window", "coarse"}, kinds


def one_way() -> Climb:
    """A terrace: from column 20 on the ground lies 1 m lower, which may be driven down and not up."""
    heights = np.zeros((30, 40), np.float32)
    heights[:, 20:] = -1.0
    climb = climb_of(GridSpec(30, 40, 1.0), heights, CostConfig(directional=True, max_slope_deg=60))
    factors = climb.factors.copy()
    factors[ENTRIES + 10 :] = np.inf
    return replace(climb, factors=factors)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_who_has_a_way_only_to_where_the_target_is_now_gets_one(strategy: str) -> None:
    """Down a terrace there is a way, up it none: when the target comes up, those below lose their ways; once it is
    down again, all have one."""
    config = PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9)  # type: ignore[arg-type]
    play = Play(np.ones((30, 40), np.float32), config, climb=one_way())
    kinds = []
    for rows, cols in ((15, 16), *6 * ((0, 1),), *6 * ((0, -1),), (1, 1), (1, 1)):
        play.happen(Move(rows, cols))
        kinds.append(play.last.kind)
        play.check()
    assert strategy in ("full", "exact") or "full" in kinds[1:], kinds
    assert strategy in ("full", "exact") or {"window", "coarse"} & {*kinds}, kinds


def test_the_windows_of_variable_range_are_as_wide_as_in_the_papers_figure_3() -> None:
    """k_min = 2: 9 cells with every move, 17 from one block of 4 to the next, 33 from one of 8 to the next."""
    grid = GridSpec(64, 64, 1.0)
    widths = [2 * block_half(grid, grid.cell(33, col - 1), grid.cell(33, col), 2) + 1 for col in range(33, 49)]
    assert widths == [9, 9, 9, 17, 9, 9, 9, 33, 9, 9, 9, 17, 9, 9, 9, 65]


@pytest.mark.parametrize("outside", [-1, 10**6])
def test_a_growth_for_a_target_that_was_outside_is_made_up_for_once_it_is_back(outside: int) -> None:
    play = Play(
        random_pace(np.random.default_rng(3), 20, 20, 5.0, 0.1), PlannerConfig(), chosen_by=STAGES["rotate"]
    )
    play.tree.update(play.pace, outside, [], 0)
    grown = play.tree.full_job(outside)()
    play.tree.adopt(grown, play.pace, play.target, [], 0, np.arange(400))
    assert play.tree.target_cell == play.target
    play.check()


def test_what_got_cheaper_while_a_worker_grew_lowers_the_bounds_that_its_tree_gives() -> None:
    """A ring road: the target in the west drives on south, so that the way around the south becomes the better one
    for those in the east, of which the tree does not know. Their road gets cheaper while a worker grows."""
    pace = np.full((41, 41), np.inf, np.float32)
    pace[[10, 30], 5:36] = 10.0
    pace[10:31, [5, 35]] = 10.0
    play = Play(pace, PlannerConfig(k_min=0, cpu_budget=1e-9), chosen_by=STAGES["rotate"])
    play.target = play.grid.cell(20, 5)
    play.happen(Move(0, 0))
    play.happen(Job("begin"))
    pace[14:27, 35] = 1.0
    play.since.append(Window(14, 35, 27, 36))
    play.version += 1
    play.tree.update(pace, play.target, play.since, play.version)
    play.happen(Job("end"))
    for _ in range(3):
        play.happen(Move(1, 0))
    assert play.last.kind == "window"
    play.check()


def test_a_forced_range_gives_the_best_route_and_proves_it() -> None:
    pace = random_pace(np.random.default_rng(4), 40, 40, 5.0, 0.1)
    play = Play(pace, PlannerConfig(k_min=0, cpu_budget=1e-9), chosen_by=STAGES["rotate"])
    while play.last.kind != "window":
        play.happen(Move(1, 1))
    assert play.tree.force([0]).kind == "forced"
    route, best = play.tree.routes([0])[0], naive.cost_to_go(play.pace, play.target, **play.rules)
    assert route.cost_s == pytest.approx(best.flat[0], rel=1e-5)
    assert route.lower_bound_s == pytest.approx(best.flat[0], rel=1e-4)
    play.check()


@given(st.integers(0, 63), st.integers(0, 63), st.integers(0, 63), st.integers(0, 63), st.integers(0, 5))
def test_a_window_reaches_at_least_as_far_as_the_target_moved(a: int, b: int, c: int, d: int, k: int) -> None:
    grid = GridSpec(64, 64, 1.0)
    old, new = grid.cell(a, b), grid.cell(c, d)
    window = grid.around(new, block_half(grid, old, new, k))
    assert window.contains(a, b)
    assert window.contains(c, d)


LARGE = mock.patch.object(growth_times, "INLINE_NS", 100)
"""Every map counts as too large: growing seven of its cells takes too long."""


@given(paces(), planner_configs(), happenings())
@settings(max_examples=few(200), deadline=None)
def test_whatever_happens_answers_keep_the_laws_and_a_worker_catches_up(
    pace: np.ndarray, config: PlannerConfig, events: list[Move | Marks | Job]
) -> None:
    with LARGE:
        play = Play(pace, config, has_worker=True)
        play.check()
        for event in events:
            play.happen(event)
            play.check()
        for _ in range(2):
            play.happen(Job("begin"))
            play.happen(Job("end"))
        play.check()
        if np.isfinite(play.pace.flat[play.target]):
            assert play.tree.target_cell == play.target


def test_every_second_of_the_cells_of_an_array_has_its_route() -> None:
    play = Play(np.ones((20, 20), np.float32), PlannerConfig())
    every = np.arange(play.grid.cells)
    some, whole = play.tree.routes(every[::2]), play.tree.routes(every)
    np.testing.assert_array_equal(some.cost_s, whole.cost_s[::2])
    np.testing.assert_array_equal(play.tree.cost_to_go_at(every[::2]), play.tree.cost_to_go_at(every)[::2])


@LARGE
def test_the_bound_beyond_the_frontier_counts_time_only_where_length_has_a_price() -> None:
    play = Play(np.ones((40, 40), np.float32), PlannerConfig(length_weight=4.0), has_worker=True)
    routes = play.tree.routes(np.arange(play.grid.cells))
    beyond = routes.statuses == NO_TARGET
    assert beyond.any()
    bound, optimum = routes.lower_bound_s[beyond], naive.cost_to_go(play.pace, play.target, **play.rules)
    assert (bound > 0).all()
    assert (bound <= optimum.reshape(-1)[beyond]).all()


@LARGE
def test_after_a_jump_the_older_tree_leads_where_it_led_and_follows_the_map() -> None:
    pace = random_pace(np.random.default_rng(1), 40, 40, 5.0, 0.1)
    play = Play(pace, PlannerConfig(k_min=0), has_worker=True, chosen_by=STAGES["rotate"])
    assert play.last.wants_full
    play.check()
    play.happen(Job("begin"))
    play.happen(Job("end"))
    before = play.target
    with mock.patch.object(play.tree._tree, "grow", side_effect=AssertionError("grown by the thread that answers")):
        play.happen(Move(30, 30))
        assert (play.tree.ready, play.tree.target_cell, play.last.wants_full) == (True, before, True)
        play.happen(Job("begin"))
        play.happen(Marks(3, 1))
        play.check()
        play.happen(Job("end"))
    assert play.tree.target_cell == play.target != before
    play.check()


def test_a_query_waits_for_the_first_tree_but_not_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth_times, "INLINE_NS", 100)
    for growth_s, expected in ((0.4, RouteStatus.OK), (30.0, RouteStatus.NO_TARGET)):
        monkeypatch.setattr(growth_times, "MODEL_NS_PER_CELL", int(growth_s * 1e9 / GRID.cells))
        swarm = Swarm(flat())
        swarm.cells["t"] = GRID.cell(20, 30)
        swarm.run(0.25)
        assert swarm.ear.ask(ROUTE, RouteRequest(cells=[0]), target="t") == []
        swarm.run(1.3)
        (reply,) = swarm.ear.replies
        assert reply.routes[0].status is expected


def test_while_a_worker_grows_after_a_jump_routes_say_where_they_lead_and_how_old_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(growth_times, "INLINE_NS", 100)
    monkeypatch.setattr(growth_times, "MODEL_NS_PER_CELL", int(0.4e9 / GRID.cells))
    monkeypatch.setattr(WindowSchedule, "half", lambda *_: 40)
    swarm = Swarm(flat(), "multi_resolution")
    first, second = GRID.cell(20, 5), GRID.cell(20, 45)
    swarm.cells["t"] = first
    swarm.run(1.0)
    assert swarm.ear.routes(0).target_cell == first
    swarm.cells["t"] = second
    swarm.run(0.3)
    reply = swarm.ear.routes(0)
    assert (reply.target_cell, reply.routes[0].status) == (first, RouteStatus.OK)
    assert reply.tree_age_ms > 300
    swarm.run(1.0)
    reply = swarm.ear.routes(0)
    assert (reply.target_cell, reply.routes[0].status) == (second, RouteStatus.OK)


# --- while only the kernels of a first route are compiled ----------------------------------------


class Guard:
    """Stands for a kernel that is not compiled until `open`."""

    opened = False

    def __init__(self, kernel: Callable[..., object]) -> None:
        self.kernel = kernel

    def __call__(self, *arguments: object) -> object:
        assert Guard.opened, f"{self.kernel} is called before it is compiled"
        return self.kernel(*arguments)


@pytest.fixture
def guarded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Guards every name in the planner by which one of the later kernels is called."""
    guards = {id(kernel): Guard(kernel) for kernel in LATER}
    found = set()
    for name, module in list(sys.modules.items()):
        if name.startswith("planner_service") and name != "planner_service.kernel_build":
            for key, value in list(vars(module).items()):
                if id(value) in guards:
                    monkeypatch.setattr(module, key, guards[id(value)])
                    found.add(id(value))
    assert found == set(guards)
    Guard.opened = False


@pytest.mark.usefixtures("guarded")
@given(paces(), planner_configs(), happenings(), st.integers(0, 10))
@settings(max_examples=few(150), deadline=None)
def test_whatever_happens_before_and_after_the_last_kernel_is_there_keeps_the_laws(
    pace: np.ndarray, config: PlannerConfig, events: list[Move | Marks | Job], opens: int
) -> None:
    Guard.opened = False
    play = Play(pace, config, lambda: Guard.opened)
    play.check()
    for n, event in enumerate(events):
        Guard.opened |= n == opens
        play.happen(event)
        play.check()


@pytest.mark.usefixtures("guarded")
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_strategy_begins_with_whole_trees_and_goes_on_as_it_would(strategy: str) -> None:
    pace = random_pace(np.random.default_rng(2), 40, 40, 5.0, 0.1)
    config = PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9)  # type: ignore[arg-type]
    play = Play(pace, config, lambda: Guard.opened)
    for event in (Move(1, 1), Job("begin"), Marks(3, 3), Move(1, 0), Job("end"), Job("force"), Move(0, 1)):
        play.happen(event)
        play.check()
        assert play.last.kind in ("full", "bounded", "none")
        assert play.tree.routes(np.arange(play.grid.cells)).gaps.max(initial=1.0) < 1.0001
    Guard.opened = True
    kinds = set()
    for _ in range(8):
        play.happen(Move(1, 0))
        play.check()
        kinds.add(play.last.kind)
    assert (kinds <= {"full", "bounded", "none"}) == (strategy == "full")


def test_no_kernel_is_in_both_lists() -> None:
    assert not {id(kernel) for kernel in FIRST} & {id(kernel) for kernel in LATER}
