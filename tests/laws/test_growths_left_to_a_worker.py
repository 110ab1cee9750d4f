"""On a large map a growth is a worker's. Until it is adopted, answers are of the older tree, keep every law and say
where they lead."""

from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from support.effort import few
from support.planner_play import Play
from support.planner_strategies import Job, Marks, Move, happenings, paces, planner_configs, random_pace
from support.planner_swarm import GRID, Swarm, flat

from planner_service import growth_times
from planner_service.growth_times import WindowSchedule
from planner_service.strategy import STAGES
from swarm.config.scenario import PlannerConfig
from swarm.wire.messages.planning import RouteRequest
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import ROUTE

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
    swarm = Swarm(flat())
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
