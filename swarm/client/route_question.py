"""A route from one cell to a target, asked for once."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

from swarm.client.route import Route
from swarm.client.session import Session
from swarm.errors import BusError
from swarm.wire.fields import check_id
from swarm.wire.messages.planning import RouteReply, RouteRequest
from swarm.wire.topics import ROUTE


def ask_route(session: Session, target: str, cell: int, vehicle_class: str, timeout_s: float) -> Future[Route]:
    """The best route of a class of vehicles; its failure is a BusError. Raises ConfigError if the target's id is
    none."""
    check_target(session, target)
    asked = session.ask(ROUTE, RouteRequest(cells=[cell], vehicle_class=vehicle_class), timeout_s, target=target)
    found: Future[Route] = Future()

    def finish(done: Future[list[Any]]) -> None:
        error = done.exception()
        if error is not None:
            found.set_exception(BusError(f"no route to {target!r}: {error}"))
            return
        reply: RouteReply = done.result()[0]
        try:
            found.set_result(Route.of(session.frame, reply.routes[0], reply))
        except (ValueError, IndexError) as error:
            found.set_exception(BusError(f"the planner of {target!r} answers nonsense: {error}"))

    asked.add_done_callback(finish)
    return found


def check_target(session: Session, target: str) -> None:
    """Raise ConfigError, and count it, if the id is none."""
    try:
        check_id("target", target)
    except ValueError as error:
        raise session.refused(str(error)) from error
