"""A route from a planner of a running swarm: asked for, printed, and written for other programs."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import typer

from launch_scripts.commands.shared_options import Where
from launch_scripts.commands.terrain_routes import DescribedRoute, metres_along, write_route
from launch_scripts.observe.run_observer import ask_run, frame_of_run
from shared_map.terrain.map_frame import MapFrame
from swarm.bus.bus import Bus
from swarm.client.route import Route as DrivenRoute
from swarm.client.terrain_frame import Frame
from swarm.config.explain import choice
from swarm.config.vehicle_classes import GROUND
from swarm.errors import BusError, ConfigError, TerrainError
from swarm.places import Place, cell_of, fields_of, written
from swarm.runtime.operator import AGAIN_S, replies_to
from swarm.wire.access import OPERATOR
from swarm.wire.codec import encode_json
from swarm.wire.messages import Message
from swarm.wire.messages.planning import PlaceRouteReply, PlaceRouteRequest, RouteReply, RouteRequest
from swarm.wire.route_columns import Route, RouteStatus, TargetStatus
from swarm.wire.topics import PLACE_ROUTE, ROUTE, Topic, asker_of

M = TypeVar("M", bound=Message)

_TIMEOUT_S = 5.0
"""A planner answers within 1 s, or says that it has no tree; five times that is for a busy machine, as for plans of
ROS."""


_PLACE = "place"
"""Target of a route to a place."""
_NO_PLACE = {
    "growing": "its tree is still growing; ask again",
    "lethal_goal": "it is lethal",
    "outside_goal": "it is outside the map",
}


@dataclass(frozen=True)
class Answer:
    """A planner's answer, and where the terrain lies."""

    reply: RouteReply
    frame: MapFrame
    start: int
    took_ms: float

    @property
    def route(self) -> Route:
        """The only route of the reply."""
        return self.reply.routes[0]

    @cached_property
    def driven(self) -> DrivenRoute:
        """The route as vehicles get it. Raises BusError if it leads over cells that are none."""
        try:
            return DrivenRoute.of(Frame(self.frame.grid), self.route, self.reply)
        except ValueError as error:
            raise BusError(f"the planner's route is none: {error}") from error

    @property
    def goal(self) -> int | None:
        """End of the route, of a search the cell to search; None if the planner does not state it."""
        return next(reversed(self.driven.cells), None) if self.driven.searching else self.target_cell

    @property
    def target_cell(self) -> int | None:
        """Current or last known cell of the target."""
        cell = self.reply.target_cell
        return cell if cell is not None and 0 <= cell < self.frame.grid.cells else None

    def path(self) -> list[int]:
        """The cells of the route, of a pulled one those in which it turns; none without one."""
        cells, turns = self.driven.cells, self.driven.turns
        return [cells[turn] for turn in turns or range(len(cells))]


def ask_planner(bus: Bus, where: object, target: str, start: Place, vehicle_class: str = GROUND) -> Answer:
    """Asks for the route. Raises BusError or ConfigError in one sentence."""
    frame = frame_of_run(bus, where)
    cell = cell_of(start, frame, "--from")
    row, col = frame.grid.row_col(cell)
    request = RouteRequest(row=row, col=col, vehicle_class=vehicle_class)
    began_s = time.monotonic()
    try:
        reply = _reply(bus, ROUTE, request, RouteReply, f"planner-{target}", "", target=target)
    except BusError:
        needed = {process.partition("planner-")[2] for member in ask_run(bus) for process in member.crew}
        there = choice(target, sorted(needed - {""}), " there are: ")
        raise BusError(f"no planner of target {target!r} answers {where}{there}") from None
    return Answer(reply, frame, cell, (time.monotonic() - began_s) * 1e3)


def ask_place(bus: Bus, where: Where, start: Place, end: Place, vehicle_class: str) -> Answer:
    """Asks for the route between two places, until it is known. Raises BusError or ConfigError in one sentence."""
    frame = frame_of_run(bus, where)
    cell, goal = cell_of(start, frame, "--from"), cell_of(end, frame, "--to")
    request = PlaceRouteRequest(to=goal, cells=[cell], vehicle_class=vehicle_class)
    began_s = time.monotonic()
    while True:
        found = _reply(bus, PLACE_ROUTE, request, PlaceRouteReply, "places-*", where.plans_no_places)
        spent_s = time.monotonic() - began_s
        if found.status != "growing" or spent_s > _TIMEOUT_S:
            break
    if found.status != "ok":
        near = found.nearest_cell  # a planner may say anything
        nearest = (
            "" if near is None or near >= frame.grid.cells else f"; the nearest open cell is {written(frame, near)}"
        )
        raise TerrainError(f"there is no route to {written(frame, goal)}: {_NO_PLACE[found.status]}{nearest}")
    reply = RouteReply(
        target=_PLACE, incarnation=found.incarnation, target_cell=goal, map_version=found.map_version,
        tree_age_ms=0.0, rows=frame.grid.rows, cols=frame.grid.cols, routes=found.routes,
        vehicle_class=vehicle_class,
    )  # fmt: skip
    return Answer(reply, frame, cell, spent_s * 1e3)


def _reply(bus: Bus, topic: Topic, request: Message, kind: type[M], server: str, missing: str, **fields: Any) -> M:
    """The reply of this kind to a query. Raises ConfigError if the query is refused, BusError(missing) if no
    process replies.

    server  the name of the process that replies; `*` stands for any id. If the run has such a process, the query is
            repeated: a standby, or the restarted process, may be about to take over
    """
    asker, until_s = asker_of(OPERATOR, "command"), time.monotonic() + _TIMEOUT_S
    while True:
        replies, failure = replies_to(bus, topic, request, _TIMEOUT_S, asker=asker, **fields)
        for reply in replies:
            if isinstance(reply, kind):
                return reply
        if failure is not None and failure != "timeout":
            raise ConfigError(failure)
        needed = [name for member in ask_run(bus) for name in member.crew if fnmatch(name, server)]
        if not needed or time.monotonic() > until_s:
            raise BusError(f"{needed[0]} does not answer" if needed else missing)
        time.sleep(AGAIN_S)


def as_json(answer: Answer) -> str:
    """The planner's answer, with its places in all coordinates that the terrain has."""
    frame, goal, last, cells = answer.frame, answer.goal, answer.target_cell, answer.path()
    fields = json.loads(encode_json(answer.reply))
    fields["crs"] = frame.grid.crs
    fields["from"] = fields_of(frame, answer.start)
    fields["to"] = None if goal is None else fields_of(frame, goal)
    fields["searching"] = answer.driven.searching
    if answer.driven.searching:
        fields["last_seen"] = None if last is None else fields_of(frame, last)
    if cells:
        route = _route(answer, cells)
        fields["path"] = {name: line.round(6).tolist() for name, line in zip("xy", route.metres(), strict=True)}
        if frame.grid.crs != "local":
            lat, lon = frame.to_degrees(*route.metres()).round(9).tolist()
            fields["path"] |= {"lat": lat, "lon": lon}
    return json.dumps(fields)


def write(answer: Answer, path: Path) -> None:
    """Write the route as `write_route`. Raises TerrainError if there is none."""
    cells = answer.path()
    if not cells:
        raise TerrainError(f"nothing is written to {path}: there is no route")
    write_route(_route(answer, cells), path)


def _route(answer: Answer, cells: list[int]) -> DescribedRoute:
    grid = answer.frame.grid
    path = np.array(cells, np.int64)
    route = answer.route
    return DescribedRoute(
        name=f"{'in search of' if answer.driven.searching else 'to'} {answer.reply.target}",
        grid=grid,
        cells=path,
        cost_s=route.cost_s,
        lower_bound_s=route.lower_bound_s,
        at_m=metres_along(grid, path),
    )


def _lethal(answer: Answer) -> str:
    reply = answer.reply
    places = [cell for cell in (reply.lethal_target, reply.nearest_cell) if cell is not None]
    texts = [written(answer.frame, cell) if cell < answer.frame.grid.cells else "outside" for cell in places]
    nearest = f"the nearest cell that can be reached is {texts[1]}" if texts[1:] else "no cell near it is open"
    return f"{TargetStatus.LETHAL}: {reply.target} is on lethal ground, {texts[0]}; {nearest}"


def show(answer: Answer) -> None:
    """Prints an answer for people."""
    reply, found = answer.reply, answer.route
    if reply.lethal_target is not None:
        typer.echo(_lethal(answer))
        return
    if not answer.driven.cells:
        meaning = {
            RouteStatus.UNREACHABLE: "there is no way from there",
            RouteStatus.OUTSIDE: f"the cell is outside the terrain of {reply.rows} x {reply.cols} cells",
            RouteStatus.LETHAL_START: "the cell is lethal, no vehicle can stand on it",
            RouteStatus.NO_TARGET: "the planner does not know where its target is",
            RouteStatus.SEARCHING: "the target is unseen, and others get places to search first: ask again",
        }[found.status]
        typer.echo(f"{found.status.value}: {meaning}")
        return
    gap = (
        f"proven to be at most {found.gap - 1:.2%} above the optimum" if math.isfinite(found.gap) else "gap unknown"
    )
    typer.echo(f"from {written(answer.frame, answer.start)}")
    if answer.driven.searching:
        goal = answer.goal
        place = "where this leads" if goal is None else written(answer.frame, goal)
        typer.echo(f"searching: {reply.target} is unseen; {place} is a place to search, in {found.cost_s:.1f} s")
    else:
        typer.echo(f"to {_target(answer)} in {found.cost_s:.1f} s, {gap}")
    many, turns = len(found.directions), len(found.turns)
    if turns:
        way = f"{turns - 1} straight segments through {many + 1} cells, {found.length_m:.0f} m"
        typer.echo(f"{way}; time and proof are of the route over neighbours that was pulled straight")
    else:
        typer.echo(f"{many} steps, {found.length_m:.0f} m")
    age_s = reply.tree_age_ms / 1e3
    grown = "" if reply.target == _PLACE else f"tree grown whole {age_s:.1f} s ago and kept up since, "
    typer.echo(f"{grown}map version {reply.map_version}, answered in {answer.took_ms:.1f} ms")
    # How old the pose is by which the planner answers.
    if reply.pose_age_s is not None and reply.tracker_lost:
        where = f"{reply.target} is lost: it has no tracker, and this is its position {reply.pose_age_s:.1f} s ago"
        typer.secho(where, fg="yellow")
    elif reply.pose_age_s is not None:
        typer.echo(f"pose {reply.pose_age_s:.1f} s old")


def _target(answer: Answer) -> str:
    cell = answer.target_cell
    return answer.reply.target if cell is None else f"{answer.reply.target} at {written(answer.frame, cell)}"
