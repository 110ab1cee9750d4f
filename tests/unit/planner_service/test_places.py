"""Routes to any place: as an oracle has them on the map of the moment, within bounds, and fair to agents."""

import math
import random
from itertools import groupby
from typing import Any

import numpy as np
import pytest
from support.planner_swarm import COLS, GRID, RES, driven_s, flat, optimum_s, planning, rough
from support.swarm_model import SwarmModel

import planner_service.places_service as places
from planner_service.places_service import PlacesService, _ClassTrees
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.partial_growth import PartialGrowth
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import AskEnded, Event, Replied
from swarm.config.scenario import place_job, places_of
from swarm.config.scenario_files import parse_scenario
from swarm.grid import walk
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.planning import PlaceRouteReply, PlaceRouteRequest, PushedRoute
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.route_columns import Route, RouteStatus
from swarm.wire.topics import PLACE_ROUTE, PUSHED_ROUTE, SENT

GROUPS = {"red": ["*"], "blue": [], "green": ["*"]}
Pace = np.ndarray[Any, np.dtype[np.float32]]


class PlacesWorld(SwarmModel):
    """The process, and askers."""

    def __init__(self, pace: Pace, groups: str = "[[groups]]", job: str = "all") -> None:
        super().__init__(terrain=terrain_of_pace(pace, RES), scenario=parse_scenario(f"[[targets]]\n{groups}"))
        plans, self._job = planning(self, "places", job), job
        self.service = self.start("places", lambda bus, post: PlacesService(plans(bus, post)))
        self.client, self._author = self.bus("client"), self.writer(f"{job}.a0.1")
        self.pushed: list[PushedRoute] = []
        self.client.subscribe(PUSHED_ROUTE, lambda event: self.pushed.append(event.message))
        self.run(1.0)

    def tell(self, goals: dict[str, tuple[int, int]], agent: str = "all.a0.1") -> None:
        """Says that vehicles on cells go to places."""
        ids, cells, places = (
            list(goals),
            *(np.array([pair[n] for pair in goals.values()], np.uint32).tobytes() for n in range(2)),
        )
        told = Chasers(target=None, author=agent, stamp_ns=self.now_ns, ids=ids, cells=cells, goals=places)
        self.client.publish(SENT, told, places=self._job, author=agent)

    def mark(self, cells: Any, paces: Any) -> None:
        """Marks cells as lethal, or with a pace."""
        paces = np.broadcast_to(np.asarray(paces, np.float32), len(cells))
        kinds = np.where(np.isinf(paces), np.uint8(MarkKind.LETHAL), np.uint8(MarkKind.PACE)).astype(np.uint8)
        stated = np.where(np.isinf(paces), np.float32(0), paces).astype(np.float32)
        self._author.sync.publish(self._author.replica.write(cells, kinds, stated, self.now_ns))

    def ask(self, to: int, *cells: int, asker: str = "rover.r1", **fields: Any) -> list[Event]:
        """The list to which the events of a question are added."""
        heard: list[Event] = []
        request = PlaceRouteRequest(to=to, cells=list(cells), **fields)
        self.client.ask(PLACE_ROUTE, request, heard.append, tag="p", places=self._job, asker=asker)
        return heard

    def settled(self, to: int, cell: int, asker: str) -> list[Event]:
        """The events of a question, once it is answered or refused."""
        heard = self.ask(to, cell, asker=asker)
        self.until(lambda: heard, within_s=2.0)
        return heard

    def answer(self, to: int, *cells: int, **fields: Any) -> PlaceRouteReply:
        """The answer, once nothing grows any more."""
        while True:
            heard = self.ask(to, *cells, **fields)
            self.until(lambda heard=heard: heard, within_s=2.0)  # type: ignore[misc]
            assert isinstance(heard[0], Replied), heard
            reply = heard[0].message
            if reply.status != "growing":
                return reply


@pytest.mark.seeds(5)
def test_routes_are_as_an_oracle_has_them_while_marks_change_the_map(seed: int) -> None:
    pace, chance = rough(seed), random.Random(seed)
    world, now = PlacesWorld(pace), np.array(pace)
    for _ in range(6):
        for _ in range(4):
            to, *cells = (chance.randrange(GRID.cells) for _ in range(4))
            reply, best = world.answer(to, *cells), optimum_s(now, to)
            if math.isinf(now.flat[to]):
                assert reply.status == "lethal_goal" or all(math.isinf(now.flat[cell]) for cell in cells)
                if reply.status == "lethal_goal":
                    near, open_cells = reply.nearest_cell, np.argwhere(np.isfinite(now).reshape(GRID.shape))
                    away = np.hypot(*(open_cells - GRID.row_col(to)).T).min()
                    assert near is not None
                    assert math.dist(GRID.row_col(near), GRID.row_col(to)) == pytest.approx(away)
                    assert math.isfinite(now.flat[near])
                continue
            for cell, route in zip(cells, reply.routes, strict=True):
                if math.isinf(now.flat[cell]):
                    assert route.status is RouteStatus.LETHAL_START
                elif math.isinf(best[cell]):
                    assert route.status is RouteStatus.UNREACHABLE
                else:
                    assert driven_s(now, route) == pytest.approx(best[cell], rel=1e-5)
                    assert route.cost_s == pytest.approx(best[cell], rel=1e-5)
                    assert best[cell] * (1 - 1e-5) <= route.lower_bound_s * (1 + 2e-5) <= route.cost_s * (1 + 3e-5)
        marked = np.array(sorted({chance.randrange(GRID.cells) for _ in range(30)}), np.uint32)
        marked = marked[np.isfinite(pace.reshape(-1)[marked])]
        paces = np.array([chance.choice((np.inf, 0.4)) for _ in marked], np.float32)
        world.mark(marked, paces)
        now.reshape(-1)[marked] = paces
        world.run(1.0)


@pytest.mark.seeds(5)
def test_a_vehicle_on_its_way_has_the_cheapest_route_whatever_changes_and_asks_once(seed: int) -> None:
    pace, chance = rough(seed, lethal=0.05), random.Random(seed)
    free = np.flatnonzero(np.isfinite(pace)).tolist()
    world, now = PlacesWorld(pace), np.array(pace)
    goals = {f"a0-{n:02d}": (chance.choice(free), chance.choice(free)) for n in range(6)}
    given: dict[str, Route] = {}
    for id, (cell, to) in goals.items():
        (given[id],) = world.answer(to, cell, vehicles=[id], asker="agent.a0").routes
    for turn in range(6):
        if turn == 3:
            goals["a0-00"] = goals["a0-00"][0], chance.choice(free)
        world.tell(goals)
        kept = [cell for pair in goals.values() for cell in pair]
        marked = np.array(sorted(set(chance.sample(free, 40)).difference(kept)), np.uint32)
        paces = np.array([chance.choice((0.05, 0.6, np.inf)) for _ in marked], np.float32)
        world.mark(marked, paces)
        now.reshape(-1)[marked] = paces
        world.run(3.0)
        given.update({each.vehicle: each.route for each in world.pushed})
        for id, (cell, to) in goals.items():
            best = optimum_s(now, to)[cell]
            if math.isinf(best):
                assert given[id].status is RouteStatus.UNREACHABLE
            else:
                assert driven_s(now, given[id]) == pytest.approx(best, rel=1e-5)
                assert walk(GRID, cell, given[id].directions)[-1] == to
    told = [each.vehicle for each in world.pushed]
    assert max(told.count(id) for id in goals) <= 6 + 1, "a change is pushed once"
    world.pushed.clear()
    world.tell(dict(list(goals.items())[:1]))
    world.mark(marked, 0.01)
    world.run(3.0)
    assert {each.vehicle for each in world.pushed} <= {"a0-00"}, "who goes nowhere is pushed nothing"


def test_a_cheaper_cell_has_only_those_vehicles_asked_for_again_whose_route_it_may_outdo() -> None:
    world = PlacesWorld(flat())
    goals = {f"a0-{row:02d}": (GRID.cell(row, 2), GRID.cell(row, 14)) for row in (2, 14, 26, 38)}
    for id, (cell, to) in goals.items():
        world.answer(to, cell, vehicles=[id], asker="agent.a0")
    world.tell(goals)
    asked: list[str] = []
    wait = world.service._wait
    world.service._wait = lambda question: (asked.extend(question.request.vehicles), wait(question))[1]  # type: ignore[method-assign]
    for row, col, outdone in ((20, 45, []), (13, 8, ["a0-14"])):
        world.mark([GRID.cell(row, col)], 0.05)
        world.run(2.0)
        world.tell(goals)
        assert asked == outdone


def test_an_agent_of_another_group_is_refused_and_its_vehicles_are_pushed_nothing() -> None:
    groups = "\n".join(f"[[groups]]\nname = '{name}'\nreads = []\nvehicles = 1" for name in ("red", "blue"))
    world = PlacesWorld(flat(), groups, "red")
    assert isinstance(world.settled(1, 2, "agent.a0")[0], Replied)
    assert world.settled(1, 2, "agent.a1")[0].failure == "agent.a1 is of group blue: ask its own places"
    world.tell({"a0-00": (1, 300), "a1-00": (2, 300)}, "red.a0.1")
    world.run(0.5)
    world.tell({"a0-00": (1, 400), "a1-00": (2, 400)}, "red.a0.1")
    world.run(2.0)
    assert {each.vehicle for each in world.pushed} == {"a0-00"}


def test_who_asks_for_the_vehicles_of_others_has_them_pushed_nothing_and_a_rover_does_not_come_first() -> None:
    world, to = PlacesWorld(flat()), GRID.cell(20, 40)
    for vehicle, asker in (("a0-00", "agent.a0"), ("a0-01", "rover.r1"), ("r1", "rover.r1"), ("r2", "rover.r1")):
        world.answer(to, GRID.cell(20, 2), vehicles=[vehicle], asker=asker)
    askers: list[str] = []
    wait = world.service._wait
    world.service._wait = lambda question: (askers.append(question.asker), wait(question))[1]  # type: ignore[method-assign]
    world.mark([GRID.cell(20, 20)], np.inf)
    world.run(2.0)
    assert sorted(each.vehicle for each in world.pushed) == ["a0-00", "r1"]
    assert sorted(each for each in askers if each != "all") == ["agent.a0", "rover.r1"]


def test_the_worker_alone_touches_trees_and_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy of a large tree takes longer than an answer may wait."""
    world = PlacesWorld(rough(3))
    at_work: list[bool] = []
    touched: list[tuple[str, bool]] = []
    work = _ClassTrees.work

    def working(self: _ClassTrees, *given: Any) -> Any:
        at_work.append(True)
        try:
            return work(self, *given)
        finally:
            at_work.pop()

    monkeypatch.setattr(_ClassTrees, "work", working)
    for kind, name in ((CostGrid, "load"), (CostGrid, "apply"), (PartialGrowth, "cut"), (PartialGrowth, "begin")):
        method = getattr(kind, name)

        def watched(*given: Any, name: str = name, method: Any = method) -> Any:
            touched.append((name, bool(at_work)))
            return method(*given)

        monkeypatch.setattr(kind, name, watched)
    for turn in range(4):
        world.answer(GRID.cell(20, 2 + turn), GRID.cell(20, 45))
        world.mark([GRID.cell(21, 20 + turn)], 0.5)
        world.run(0.5)
    assert set(touched) == {(name, True) for name in ("load", "apply", "cut", "begin")}


@pytest.mark.parametrize("max_cells", [0, 3])
def test_a_part_of_a_route_says_what_the_rest_costs(monkeypatch: pytest.MonkeyPatch, max_cells: int) -> None:
    pace = rough(3)
    world = PlacesWorld(pace)
    to = GRID.cell(20, 2)
    best = optimum_s(pace, to)
    starts = [GRID.cell(20, 45), GRID.cell(20, 45), GRID.cell(20, 3), GRID.cell(20, 2)]
    whole = world.answer(to, *starts).routes
    monkeypatch.setattr(places, "MOST_STEPS", 20)
    parts = world.answer(to, *starts, max_cells=max_cells).routes
    for start, route, all_of_it in zip(starts, parts, whole, strict=True):
        assert route.directions == all_of_it.directions[: max_cells or 5]
        end = walk(GRID, start, route.directions)[-1]
        assert route.remaining_s == pytest.approx(best[end], rel=1e-5)
        assert route.cost_s == pytest.approx(best[start], rel=1e-5)


def test_marks_beside_a_goal_do_not_keep_a_far_asker_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "SLICE_CELLS", 20)
    monkeypatch.setattr(places, "_CELL_NS", 200_000)  # 0.4 s for the whole map
    world = PlacesWorld(flat())
    heard = world.ask(GRID.cell(2, 2), GRID.cell(30, COLS - 2), asker="agent.a0")
    for turn in range(40):
        if heard:
            break
        world.mark([GRID.cell(3, 3)], 0.3 + 0.01 * (turn % 2))
        world.run(0.1)
    assert heard[0].message.status == "ok"


def test_a_far_question_keeps_its_turn_from_all_but_nearer_ones_and_those_of_agents(monkeypatch):
    monkeypatch.setattr(places, "SLICE_CELLS", 200)
    world, worked, work = PlacesWorld(flat()), list[int](), _ClassTrees.work
    monkeypatch.setattr(_ClassTrees, "work", lambda *given: (worked.append(given[1].request.to), work(*given))[1])
    far = GRID.cell(30, COLS - 2)
    asked = [(GRID.cell(2, 2 + n), far, f"agent.a{n}") for n in range(4)]
    asked += [(GRID.cell(3, 2 + n), far, f"rover.r{n}") for n in range(4)]
    near = GRID.cell(20, 20), GRID.cell(20, 24), "agent.near"
    heard = [world.ask(to, cell, asker=asker) for to, cell, asker in (*reversed(asked), near)]
    world.until(lambda: all(heard), within_s=1.0)
    turns = [to for to, _ in groupby(worked)]
    begun = [*dict.fromkeys(turns)]
    assert len(worked) > 4 * len(turns), "slices follow each other"
    assert begun[1] == near[0]
    assert {*begun[2:6]} == {to for to, _, asker in asked if asker.startswith("agent")}
    assert len(turns) == len(begun) + 1, "only the first had to let others pass"


@pytest.mark.parametrize("kind", ["agent", "rover"])
def test_near_goals_without_end_leave_a_turn_to_a_far_question_of_the_same_kind(monkeypatch, kind: str) -> None:
    monkeypatch.setattr(places, "SLICE_CELLS", 200)
    monkeypatch.setattr(places, "_CELL_NS", 5000)  # 1 ms a slice
    world = PlacesWorld(flat())
    heard = world.ask(GRID.cell(2, 2), GRID.cell(30, COLS - 2), asker=f"{kind}.far")
    flood = [[]]
    for _ in range(50):
        near = GRID.cell(20, 20), GRID.cell(20, 22)
        flood = [each for each in flood if not each] + [world.ask(*near, asker=f"{kind}.near") for _ in range(20)]
        world.run(0.01)
    assert len(flood) > 100, "the process is not idle"
    assert heard[0].message.status == "ok"


def test_ten_thousand_goals_of_a_stranger_leave_memory_bounded_and_agents_first(monkeypatch):
    monkeypatch.setattr(places.settings, "PLACE_TREES_BYTES", 100_000)
    world = PlacesWorld(flat())
    chance = random.Random(1)
    asked = [
        world.ask(chance.randrange(GRID.cells), chance.randrange(GRID.cells), asker="rover.stranger")
        for _ in range(10_000)
    ]
    agent = world.ask(GRID.cell(1, 1), GRID.cell(30, COLS - 2), asker="agent.a0")
    world.run(0.25)
    assert isinstance(agent[0], Replied), "an agent does not wait behind the stranger's"
    answered = sum(isinstance(heard[0], Replied) for heard in asked if heard)
    assert answered < 1000
    refused = [heard[0].failure for heard in asked if heard and isinstance(heard[0], AskEnded)]
    assert any("too many questions wait here" in str(failure) for failure in refused)
    trees = world.service._classes["ground"].trees
    assert trees.bytes <= 100_000
    assert len(world.service._near) + len(world.service._far) <= 4096


def test_each_group_asks_a_process_that_knows_what_the_group_may_know() -> None:
    groups = [f'[[groups]]\nname = "{name}"\nreads = {reads}' for name, reads in GROUPS.items()]
    scenario = parse_scenario("\n".join(["[[targets]]", "[planner]", "places = true", *groups]))
    assert {name: place_job(scenario, name) for name in GROUPS} == {"red": "red", "blue": "blue", "green": "red"}
    assert places_of(scenario) == ["red", "blue"]
