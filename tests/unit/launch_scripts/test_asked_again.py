"""A question about places while the process that answers is replaced: it is asked again."""

from concurrent.futures import Future
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from support.makers import run_info

from launch_scripts.commands import swarm_route
from swarm.client import BusError
from swarm.client import connected_swarm as client
from swarm.client.session import Session
from swarm.client.terrain_frame import Frame
from swarm.errors import NoAnswerError
from swarm.grid import GridSpec
from swarm.places import read_place
from swarm.wire.messages.planning import PlaceRouteReply
from swarm.wire.messages.processes import RunInfo
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus

GRID = GridSpec(10, 10, 10.0)
ROUTE = Route(status=RouteStatus.OK, start=0, directions=b"\2", cost_s=1.0, lower_bound_s=1.0, length_m=10.0)
REPLY = PlaceRouteReply(
    to_cell=1, incarnation=1, map_version=0, routes=RouteBatch.of([ROUTE]).columns(), status="ok",
    vehicle_class="ground",
)  # fmt: skip


@pytest.fixture(params=["client", "command"])
def ask(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that asks for a route of a run with such a crew, the first `silent` times in vain; it returns the
    end of the route and how often it asked."""
    waited = SimpleNamespace(s=0.0)
    clock = SimpleNamespace(monotonic=lambda: waited.s, sleep=lambda s: setattr(waited, "s", waited.s + s))
    monkeypatch.setattr(client, "time", clock)
    monkeypatch.setattr(swarm_route, "time", clock)

    def by_client(info: RunInfo, silent: int) -> tuple[int, int]:
        asked: list[Any] = []

        def answers(*_: object) -> list[PlaceRouteReply]:
            if len(asked) <= silent:
                raise NoAnswerError("no process answers")
            return [REPLY]

        def ask(*_: object, **__: object) -> Future[Any]:
            asked.append(1)
            return Future()

        number = partial(Session.number, SimpleNamespace())
        session: Any = SimpleNamespace(
            run=info, frame=Frame.of(info), ask=ask, answers=answers, number=number, check_ids=lambda **_: None
        )
        route = client.Swarm(session).route((5.0, -5.0), (15.0, -5.0))
        return route.cells[-1], len(asked)

    def by_command(info: RunInfo, silent: int) -> tuple[int, int]:
        asked: list[Any] = []

        def replies_to(*_: object, **__: object) -> tuple[list[PlaceRouteReply], None]:
            asked.append(1)
            return ([] if len(asked) <= silent else [REPLY]), None

        monkeypatch.setattr(swarm_route, "replies_to", replies_to)
        monkeypatch.setattr(swarm_route, "ask_run", lambda _: [info])
        monkeypatch.setattr(swarm_route, "frame_of_run", lambda *_: Frame.of(info))
        bus: Any = None
        where: Any = SimpleNamespace(plans_no_places="no process plans routes to places here")
        start, end = read_place("cell:0,0", "from"), read_place("cell:0,1", "to")
        answer = swarm_route.ask_place(bus, where, start, end, "ground")
        return answer.path()[-1], len(asked)

    return by_client if request.param == "client" else by_command


def test_while_another_takes_over_a_route_to_a_place_is_asked_for_again(ask: Any) -> None:
    assert ask(run_info(GRID, crew=["keeper-k", "places-all", "places-all.r1"]), 3) == (1, 4)


def test_a_process_that_never_answers_is_named_and_one_that_no_run_needs_is_asked_once(ask: Any) -> None:
    with pytest.raises(BusError, match=r"places-all does not answer|no process answers"):
        ask(run_info(GRID, crew=["places-all"]), 1_000)
    with pytest.raises(BusError, match=r"no process (plans routes to places here|answers)"):
        ask(run_info(GRID, crew=["keeper-k"]), 1_000)
