"""Growths that stop and go on, and the trees kept of them, beside a Dijkstra that knows nothing of them."""

import numpy as np
import pytest
from support import slow_twins as naive
from support.effort import few
from support.kernel_oracle import WALLS, loaded
from support.planner_strategies import RULES, inside, open_cell, random_climb, random_pace, random_window

from planner_service.goal_tree_cache import GoalTrees
from planner_service.kernels.dial_growth import NO_AIM
from planner_service.target_tree import TargetTree
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.partial_growth import PartialGrowth
from swarm.config.scenario import PlannerConfig, Strategy
from swarm.grid import GridSpec, Window
from swarm.wire.route_columns import RouteBatch, RouteStatus

ROUNDING = 1e-5


def marked(rng: np.random.Generator, pace: np.ndarray, ratio: float) -> Window:
    """A patch of other ground, walls among it, of cells that stay in the range of paces."""
    window = random_window(rng, pace, *rng.integers(1, 4, 2).tolist())
    patch = inside(pace, window)
    patch[:] = random_pace(rng, *patch.shape, ratio, float(rng.choice([0.0, 0.3, 1.0])))
    return window


def costs_of(growth: PartialGrowth, pace: np.ndarray) -> np.ndarray:
    cost = growth.cost.reshape(pace.shape[0] + 2, -1)[1:-1, 1:-1].reshape(-1)
    return np.where(cost < 0, np.inf, cost)


@pytest.mark.parametrize("rules", RULES)
def test_a_growth_that_stops_is_exact_where_it_was_and_bounds_the_rest(rules: dict) -> None:
    rng, aimed = np.random.default_rng(1), 0
    for n in range(60):
        pace = random_pace(rng, *rng.integers(5, 40, 2), (1.0, 3.0, 40.0, 900.0)[n % 4], WALLS[n % 4])
        ground, goal = loaded(pace, **rules), open_cell(rng, pace)
        best = naive.cost_to_go(pace, goal, **rules).reshape(-1)
        growth, ways = PartialGrowth(ground), CostToGoTree(ground)
        growth.begin(ground.pad(goal))
        farthest, asker = 0.0, goal
        for _ in range(12):
            changes, most, aim = rng.random() < 0.2, int(rng.choice([1 << 40, 1, 30])), NO_AIM
            askers = None
            if changes:
                growth.learn(ground.apply(pace, [marked(rng, pace, 2.0) for _ in range(20)]))
            if np.isfinite(pace.flat[goal]) and rng.random() < 0.7:  # else its parents are of an older map and root
                ways.grow(goal)
            if rng.random() < 0.5 or np.isinf(pace.flat[asker]):
                asker = open_cell(rng, pace)
            if changes or rng.random() < 0.3:  # the target moves
                beside = [cell for _, cell in ground.grid.neighbours(goal) if np.isfinite(pace.flat[cell])]
                goal = int(rng.choice(beside or [open_cell(rng, pace)]))
                more = [open_cell(rng, pace) for _ in range(rng.integers(0, 4))]
                askers = ground.pad_all(np.array([asker, *more]))
                aim = growth.aim_at(askers, ground.pad(goal), ways.parent)
                growth.begin(ground.pad(goal))
                farthest, best = 0.0, naive.cost_to_go(pace, goal, **rules).reshape(-1)
            elif rng.random() < 0.3:  # a tree that was put down goes on like one in hand
                growth.resume(growth.cut(), np.inf)
            askers = np.array([ground.pad(asker)]) if askers is None else askers
            growth.go_on(askers, most, aim)
            aimed += growth.bound == 0
            cost = costs_of(growth, pace)
            has = np.isfinite(cost)
            assert has.sum() == growth.touched
            np.testing.assert_allclose(cost[has], best[has], rtol=ROUNDING)
            left = ~has & np.isfinite(pace.reshape(-1))
            assert (best[left] >= growth.bound * (1 - ROUNDING)).all()
            cells = np.flatnonzero(np.isin(ground.pad_all(np.arange(pace.size)), askers))
            assert has[cells].all() or most < 1 << 40 or np.isinf(best[cells]).any()
            # It goes no farther than the bucket of the farthest asker.
            farthest = max(farthest, best[cells].max())
            if 0 < growth.bound < np.inf:
                assert growth.bound <= farthest * (1 + ROUNDING) + ground.lowest_cell_cost
                assert (cost[has] <= growth.bound * (1 + ROUNDING)).all()
        everywhere = np.flatnonzero(np.isfinite(ground.cell_cost))
        growth.go_on(everywhere, 1 << 40)
        np.testing.assert_allclose(costs_of(growth, pace), best, rtol=ROUNDING)
        if np.isinf(best[np.isfinite(pace.reshape(-1))]).any():
            assert growth.bound == np.inf, "whoever has no path is to hear so, not to wait"
    assert aimed > 20


@pytest.mark.parametrize("strategy", ["full", "auto"])
def test_who_is_shut_off_from_the_target_is_told_so_at_the_first_ask(strategy: Strategy) -> None:
    for room in (1, 2, 30):
        pace = np.full((3, 40), np.inf, np.float32)
        pace[1, :room] = 1.0
        tree = TargetTree(GridSpec(*pace.shape, 1.0), PlannerConfig(strategy=strategy))
        tree.update(pace, 40, [], 0)
        assert tree.routes([40]).statuses[0] == 0
        pace[1, 35] = 1.0
        tree.update(pace, 40, [Window(1, 35, 2, 36)], 1)
        assert tree.routes([75])[0].status is RouteStatus.UNREACHABLE


def test_a_growth_aims_at_what_the_route_to_the_last_root_costs_to_the_new_one() -> None:
    pace = (1.0 + 0.05 * np.random.default_rng(5).random((64, 64))).astype(np.float32)
    ground, touched = loaded(pace, **RULES[0]), []
    ways, asker, root = CostToGoTree(ground), np.array([ground.pad(32 * 64 + 50)]), 32 * 64 + 10
    ways.grow(root)
    for parent in (np.empty(0, np.uint8), ways.parent):
        growth = PartialGrowth(ground)
        for goal, aimed in ((root, False), (root + 1, True)):
            aim = growth.aim_at(asker, ground.pad(goal), parent) if aimed else NO_AIM
            growth.begin(ground.pad(goal))
            growth.go_on(asker, 1 << 40, aim)
        touched.append(growth.touched)
    assert touched[1] < 0.75 * touched[0]


@pytest.mark.parametrize("kind", ["narrow", "wide", "directed"])
def test_lives_of_goals_on_a_map_that_changes_are_answered_as_by_dijkstra(kind: str) -> None:
    rng = np.random.default_rng(2)
    answered = dict.fromkeys(
        ("ok", "no_target", "unreachable", "lethal_goal", "lethal_start", "outside", "kept"), 0
    )
    for n in range(few(450 if kind == "narrow" else 75)):
        rules, ratio = RULES[n % 5], {"narrow": (1.3, 6.0, 300.0)[n % 3], "wide": 1e5, "directed": 5.0}[kind]
        pace = random_pace(rng, *rng.integers(4, 34, 2), ratio, WALLS[n % 4])
        climb = random_climb(rng, GridSpec(*pace.shape, 1.0), 0.3, 0.9) if kind == "directed" else None
        ground = loaded(pace, climb=climb, **rules)
        trees = GoalTrees(ground, int(rng.choice([0, 6_000, 1 << 30])))
        goals = [open_cell(rng, pace) for _ in range(3)]
        for _ in range(25):
            if rng.random() < 0.4:
                trees.changed(ground.apply(pace, [marked(rng, pace, ratio) for _ in range(rng.integers(1, 4))]))
            goal = int(rng.choice(goals))
            start = int(rng.integers(pace.size)) if rng.random() < 0.95 else int(rng.choice([-1, pace.size]))
            found = trees.ask(goal, start, int(rng.choice([1, 40, 1 << 40])))
            route = found.route
            answered["lethal_goal" if found.lethal_goal else str(route.status)] += 1
            answered["kept"] += not found.grown_cells
            assert trees.bytes <= max(trees._budget, 0)
            assert route.start == start
            inside = 0 <= start < pace.size
            if not inside or not np.isfinite(pace.flat[[goal, start]]).all():
                expected = (
                    "outside" if not inside else "lethal_start" if np.isfinite(pace.flat[goal]) else "unreachable"
                )
                assert str(route.status) == expected
                continue
            best = naive.cost_to_go(pace, goal, **rules, climb=climb).flat[start]
            assert route.lower_bound_s <= best * (1 + 1e-12)
            if route.status is RouteStatus.OK:
                driven = naive.drive(ground.grid, PlannerConfig(**rules), pace, climb, RouteBatch.of([route]))
                assert driven.last[0] == goal
                assert route.cost_s == pytest.approx(driven.time_s[0], rel=1e-6)
                assert route.cost_s == pytest.approx(best, rel=ROUNDING)
                assert route.lower_bound_s >= best * (1 - 10 * ROUNDING)
            elif route.status is RouteStatus.UNREACHABLE:
                assert best == np.inf
            else:
                assert found.grows
                assert found.grown_cells > 0
    unseen = {name for name, count in answered.items() if not count}
    assert unseen <= ({"no_target"} if kind != "narrow" else set()), answered


def test_who_asks_again_after_every_slice_is_answered_however_small_the_slices_and_the_cache_are() -> None:
    pace = random_pace(np.random.default_rng(3), 20, 20, 4.0, 0.1)
    pace.flat[[0, 19, 399]] = 1.0
    trees = GoalTrees(loaded(pace, **RULES[0]), 10_000)
    asks = 0
    left = {(0, 399), (19, 399), (399, 0)}
    while left:
        asks += 1
        assert asks < 3 * pace.size
        for goal, start in sorted(left):
            if trees.ask(goal, start, 1).route.status is RouteStatus.OK:
                left.remove((goal, start))


def test_far_changes_and_costly_ones_beside_the_route_need_no_growth() -> None:
    pace = np.ones((60, 60), np.float32)
    ground = loaded(pace, **RULES[0])
    trees = GoalTrees(ground, 1 << 30)
    goal, start = 30 * 60 + 10, 30 * 60 + 25
    grown = trees.ask(goal, start, 1 << 40)
    assert grown.grown_cells < 1_200
    for window in (Window(50, 50, 60, 60), Window(27, 12, 29, 20)):
        pace[window.row0 : window.row1, window.col0 : window.col1] = np.inf
        trees.changed(ground.apply(pace, [window]))
        again = trees.ask(goal, start, 1 << 40)
        assert not again.grown_cells
        assert again.route == grown.route
    pace[30, 20] = np.inf
    trees.changed(ground.apply(pace, [Window(30, 20, 31, 21)]))
    assert trees.ask(goal, start, 1 << 40).grown_cells > 0


@pytest.mark.parametrize("strategy", ["full", "auto"])
def test_a_tree_follows_its_target_no_farther_than_its_askers(strategy: Strategy) -> None:
    rng = np.random.default_rng(4)
    pace = random_pace(rng, 120, 130, 3.0, 0.1)
    pace[40:81, 40:81] = np.clip(pace[40:81, 40:81], 1.0, 3.0)
    grid = GridSpec(*pace.shape, 1.0)
    tree = TargetTree(grid, PlannerConfig(strategy=strategy))
    kinds: list[str] = []

    def followed(target: int, asked: np.ndarray, dirty: list[Window]) -> int:
        update = tree.update(pace, target, dirty, len(kinds))
        routes, best = tree.routes(asked), naive.cost_to_go(pace, target, **RULES[0]).flat[asked]
        np.testing.assert_allclose(routes.cost_s, best, rtol=ROUNDING)
        assert (routes.lower_bound_s <= best * (1 + 1e-12)).all()
        assert (routes.lower_bound_s >= best * (1 - 10 * ROUNDING)).all()
        kinds.append(update.kind)
        return update.cells

    for n in range(20):
        dirty = [marked(rng, pace[40:81, 40:81], 3.0)] if n % 3 == 0 else []
        pace[40:81, 40:81] = np.clip(pace[40:81, 40:81], 1.0, 3.0)
        near = grid.cell(60, 50 + n) + np.array([0, 6, -6 * grid.cols, 5 * grid.cols - 5])
        changed = [Window(w.row0 + 40, w.col0 + 40, w.row1 + 40, w.col1 + 40) for w in dirty]
        assert followed(grid.cell(60, 50 + n), near, changed) < 2_000
    assert set(kinds) == {"bounded"}
    for n, asked in enumerate(([1], [1], [1, 0])):  # a growth that aims at one vehicle; then another asks with it
        followed(grid.cell(60, 69 - n), grid.cell(60, 60) + 20 * np.array(asked), [])
    far = np.flatnonzero(np.isfinite(pace))[[0, -1]]
    far = far[np.isfinite(naive.cost_to_go(pace, grid.cell(60, 70), **RULES[0]).flat[far])]
    for n in range(4):
        followed(grid.cell(60, 70 + n), far, [])
    assert kinds[-1] == ("exact" if strategy == "auto" else "bounded")
