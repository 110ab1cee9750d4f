"""A vehicle that is not the swarm's own: says where it is, follows a target's routes, marks the map."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, NamedTuple

from swarm.bus.bus import Asked, Event, Heard, LinkChanged
from swarm.client.own_reports import Reported
from swarm.client.route import Route
from swarm.client.session import Session, Stream
from swarm.client.terrain_frame import checked_cell, listed
from swarm.clock import NS_PER_S
from swarm.config.scenario import agent_of
from swarm.errors import ConfigError
from swarm.grid import TILE_CELLS, GridSpec, brief, joined
from swarm.wire.messages import map_data, planning
from swarm.wire.messages.vehicles import LONGEST_OBSTACLE_LEASE_S, MOST_M_PER_S, MOST_RADIUS_M, Obstacle
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import DIGEST, MARKS, OBSTACLE, PLACE_ROUTE, PUSHED_ROUTE, ROUTE, asker_of

if TYPE_CHECKING:
    from swarm.right_of_way.external_on_bus import ExternalSession


class _Statement(NamedTuple):
    kind: map_data.MarkKind
    pace_s_per_m: float
    stamp_ns: int
    until_ns: int


class OwnMarks:
    """The mark sets of one author, which belongs to one group: published, answered on query and
    summarised in digests. No network, no NumPy.

    A process of the swarm keeps a whole replica (`shared_map`); this keeps only what its own author says.
    """

    def __init__(self, author: str, group: str, grid: GridSpec) -> None:
        self.author = author
        self._group = group
        self._grid = grid
        self._tiles: dict[int, dict[int, _Statement]] = {}
        """Tile -> cell in it -> its last mark."""
        self._sets: dict[int, map_data.MarkSet] = {}
        """Tile -> its newest set."""
        self._stamp_ns = 0
        """Timestamp of the newest mark: no later mark is older, even if the clock is set back."""
        self._digests = 0

    @property
    def any(self) -> bool:
        """True if there are any marks."""
        return bool(self._sets)

    def state(
        self,
        cells: Iterable[int],
        kind: map_data.MarkKind,
        pace_s_per_m: float,
        now_ns: int,
        until_ns: int = map_data.FOREVER,
        class_number: int = 0,
    ) -> list[map_data.MarkSet]:
        """Makes one statement about all these cells of the grid. Returns the sets to put.

        class_number  for whom: 0 is all vehicles, a class of the scenario counts from 1 on
        """
        self._stamp_ns = max(self._stamp_ns + 1, now_ns)
        statement = _Statement(kind, pace_s_per_m, self._stamp_ns, until_ns)
        changed: dict[int, None] = {}
        for cell in cells:
            row, col = self._grid.row_col(cell)
            tile = self._grid.tile_for(self._grid.tile_of(cell), class_number)
            changed[tile] = None
            self._tiles.setdefault(tile, {})[row % TILE_CELLS * TILE_CELLS + col % TILE_CELLS] = statement
        return [self._set(tile, now_ns) for tile in changed]

    def overruled(self, other: map_data.MarkSet, now_ns: int) -> list[map_data.MarkSet]:
        """Takes a set under our name; if a keeper took us for dead and shortened it, returns its replacement."""
        mine = self._sets.get(other.tile)
        if mine is None or (other.epoch, other.seq) <= (mine.epoch, mine.seq) or other.epoch + 1 >= 1 << 62:
            return []
        return [self._set(other.tile, now_ns, epoch=other.epoch + 1)]

    def answer(self, request: map_data.MarksRequest) -> list[map_data.MarkSet]:
        """Returns the requested mark sets."""
        if request.authors and self.author not in request.authors:
            return []
        return [each for tile, each in self._sets.items() if not request.tiles or tile in request.tiles]

    def digest(self) -> map_data.Digest:
        """Digest of the sets, by which others find those that they lack."""
        self._digests += 1
        rows = b"".join(
            struct.pack("<IQQ", tile, each.epoch, each.seq) for tile, each in sorted(self._sets.items())
        )
        return map_data.Digest(author=self.author, role="rover", held={self.author: rows}, seq=self._digests)

    def region_of(self, of: map_data.MarkSet) -> int:
        return self._grid.region_of_tile(self._grid.class_of_tile(of.tile)[1])

    def _set(self, tile: int, now_ns: int, epoch: int | None = None) -> map_data.MarkSet:
        stated = self._tiles[tile]
        for cell in [cell for cell, each in stated.items() if each.until_ns <= now_ns]:
            del stated[cell]
        before = self._sets.get(tile)
        rows = sorted(stated.items())
        many = len(rows)
        ends = any(each.until_ns != map_data.FOREVER for each in stated.values())
        made = self._sets[tile] = map_data.MarkSet(
            author=self.author,
            group=self._group,
            tile=tile,
            epoch=epoch if epoch is not None else 1 if before is None else before.epoch,
            seq=0 if before is None else before.seq + map_data.SEQ_STEP,
            cells=struct.pack(f"<{many}H", *(cell for cell, _ in rows)),
            kinds=bytes(each.kind for _, each in rows),
            paces=struct.pack(f"<{many}f", *(each.pace_s_per_m for _, each in rows)),
            stamps_ns=struct.pack(f"<{many}q", *(each.stamp_ns for _, each in rows)),
            untils_ns=struct.pack(f"<{many}q", *(each.until_ns for _, each in rows)) if ends else b"",
        )
        made.check()
        return made


_REPEAT_NS = NS_PER_S // 2
"""Time between two reports of a vehicle that stands. A new agent listens for a second before it drives."""
_ASK_AGAIN_NS = NS_PER_S
"""A follower asks again at this interval: planners forget vehicles that were silent for five seconds."""
_DIGEST_NS = NS_PER_S
"""Time between two digests of marks, by which replicas notice what they have missed."""
_TIMEOUT_S = 5.0
"""Longest wait for a route if a program does not say: a planner that begins grows its tree for seconds."""
_NEAR_END_CELLS = 16
"""Distance to the end of a truncated route, in cells, at which a vehicle requests its continuation."""


class Vehicle(Reported):
    """One vehicle. Made by `Swarm.vehicle`; use it in a `with`, or `leave` at the end.

    id             of the vehicle; no other process may report one of the same id
    group          group that owns the vehicle and reads its marks
    radius_m       radius of the circle around its position which others keep clear
    lease_s        others avoid its last place for this time after its last message
    vehicle_class  vehicle class for which it requests routes
    incarnation    when it joined, in ns: tells it from an earlier generation under the same id
    """

    def __init__(
        self,
        session: Session,
        id: str,
        group: str,
        radius_m: float,
        lease_s: float,
        vehicle_class: str = planning.GROUND,
    ) -> None:
        session.check_ids(id=id, group=group, vehicle_class=vehicle_class)
        if agent_of(id) != id:
            text = f"id {id!r} has a '-', by which the swarm names vehicles of its own agents"
            raise session.refused(f"{text}: write {id.replace('-', '_')!r}")
        self.group = group
        self.radius_m = session.number("radius_m", radius_m, 0, MOST_RADIUS_M)
        self.vehicle_class = vehicle_class
        lease_s = session.number("lease_s", lease_s, 0, LONGEST_OBSTACLE_LEASE_S, more=True)
        super().__init__(session, OBSTACLE, "vehicle", id, lease_s, _REPEAT_NS)
        self._target: str | None = None
        self._goal: int | None = None
        """The cell of the place that is followed; None if a target is followed."""
        self._route: Route | None = None
        self._ask_due_ns = 0
        self._asking: str | None = None
        """The target of the last question, until that is answered."""
        self._streams: list[Stream[Route]] = []
        self._on_route: list[Callable[[Route], None]] = []
        self._marks = OwnMarks(f"{group}.{id}.{self.incarnation:x}", group, session.frame.grid)
        self._digest_due_ns = 0
        self._way: ExternalSession | None = None
        self._join()

    # --- place --------------------------------------------------------------------------------------------------

    def at(self, x_m: float, y_m: float, *, heading_rad: float | None = None, speed_m_per_s: float = 0.0) -> None:
        """States where the vehicle is. From their next tick on, all vehicles of the swarm avoid this place and
        the places ahead. The library repeats it until the next call or `leave`: without another call the vehicle
        counts as at rest.

        x_m, y_m       in the terrain's frame; of a latitude and longitude: `at(*swarm.frame.from_wgs84(lat, lon))`
        heading_rad    clockwise from north; None if it may go any way
        speed_m_per_s  by the wall clock

        Raises ConfigError on a location outside the terrain and on a value that is not a number; the previous
        position is kept. Lethal ground raises nothing, as only planners know the map: a vehicle there gets routes
        with status "lethal_start", and, if it follows a target, a problem.
        """
        session = self._session
        with session.lock:
            self._cell_at(x_m, y_m)
            if heading_rad is not None:
                heading_rad = session.number("heading_rad", heading_rad)
            self._say(
                x_m,
                y_m,
                group=self.group,
                heading_rad=heading_rad,
                speed_m_per_s=session.number("speed_m_per_s", speed_m_per_s, 0, MOST_M_PER_S),
                radius_m=self.radius_m,
            )
        if self._way is not None and not self._way.stands(self._counted(self._way)):
            cell = self.traffic_cell
            session.problem("unreserved", f"vehicle {self.id} is in cell {cell}, into which it was not let: stop")

    @property
    def cell(self) -> int:
        """Cell of the terrain of the last reported position. Raises ConfigError before the first `at`."""
        word = self._reported
        return self._session.frame.cell(word.x_m, word.y_m)

    @property
    def traffic_cell(self) -> int:
        """Cell of right of way of the last reported position. Raises as `cell`."""
        word = self._reported
        return self._session.frame.traffic.cell_at(word.x_m, word.y_m)

    @property
    def _reported(self) -> Obstacle:
        if self._word is None:
            raise ConfigError(f"vehicle {self.id} has not said where it is: call at() first")
        word: Obstacle = self._word
        return word

    # --- right of way -------------------------------------------------------------------------------------------

    def give_way(self, way: ExternalSession) -> None:
        """Makes it reserve cells from now on. Called once, before the first `at`."""
        self._way = way

    def reserve(self, cells: Sequence[int], timeout_s: float = 0.0) -> list[int]:
        """Requests cells of right of way in driving order, such as the next ones of `cells_of` a route, and waits
        up to `timeout_s` (s) until the vehicle may enter the first. Returns the cells that it may enter now: no
        other vehicle enters them before the vehicle has left them by its `at`. Reserved cells that are not in
        `cells` are released.

        Raises ConfigError if a cell is not beside the one before it, and unless the vehicle was made with
        `right_of_way`.
        """
        way = self._has_way()
        here, traffic = self._counted(way), self._session.frame.traffic
        wanted = [checked_cell(traffic, cell) for cell in listed("cells", cells)]
        path = [here, *(wanted[1:] if wanted[:1] in ([here], [self.traffic_cell]) else wanted)]
        try:
            way.want(path)
        except ValueError as error:
            raise self._session.refused(f"vehicle {self.id}: {error}") from error
        if len(path) > 1:
            self.may_enter(path[1], timeout_s)
        return list(way.cells[1:])

    def may_enter(self, cell: int, timeout_s: float = 0.0) -> bool:
        """Returns True if the vehicle may drive into a cell now, after waiting up to a timeout. Raises ConfigError
        unless it was made with `right_of_way`."""
        wait_s = self._session.number("timeout_s", timeout_s, 0, 1e9)
        return self._has_way().may_enter(checked_cell(self._session.frame.traffic, cell), wait_s)

    def cells_of(self, route: Route) -> list[int]:
        """Returns the cells of right of way of a route, from where the vehicle is if the route passes its cell.
        Without `map.traffic_cell_m` in the scenario they are those of the route."""
        here, cells = self.traffic_cell, route.cells
        way, _ = joined(self._session.frame.traffic, cells, (), [here]) if cells else ([], [])
        return way[way.index(here) :] if here in way else way

    def _counted(self, way: ExternalSession) -> int:
        """The cell of right of way in which it counts at its last reported position."""
        return way.counted(self.traffic_cell, self._reported.x_m, self._reported.y_m)

    def _has_way(self) -> ExternalSession:
        if self._way is None:
            raise ConfigError(
                f"vehicle {self.id} has no right of way: make it with swarm.vehicle({self.id!r}, right_of_way=True)"
            )
        return self._way

    # --- routes -------------------------------------------------------------------------------------------------

    def route(self, target: str, timeout_s: float = _TIMEOUT_S) -> Route:
        """The best route to a target from where the vehicle is. Raises BusError if its planner does not answer."""
        found: Route = self._session.answers(self.route_soon(target, timeout_s), timeout_s)
        return found

    def route_soon(self, target: str, timeout_s: float = _TIMEOUT_S) -> Future[Route]:
        """Like `route`, without waiting: `await asyncio.wrap_future(vehicle.route_soon(target))`."""
        return self._session.ask_route(target, self.cell, self.vehicle_class, timeout_s, self.id)

    def follow(self, target: str) -> Stream[Route]:
        """Routes to a target from now on: the first one, and a newer one whenever the target moves, the map changes
        or the route runs out. Ends the previous subscription to routes. `newest` of the stream is the route to
        drive.

        target  its id, or a place that stays: "46.81,9.84", "xy:X,Y" or "cell:ROW,COL"
        """
        session = self._session
        with session.lock:
            session.check_open()
            goal = session.frame.cell_named(target) if isinstance(target, str) and "," in target else None
            if goal is None:
                session.check_ids(target=target)
            _ = self.cell
            self.unfollow()
            self._target, self._goal, self._ask_due_ns = target, goal, 0
            stream: Stream[Route] = Stream(16)
            self._streams.append(stream)
            session.bus.subscribe(PUSHED_ROUTE, session.post, agent=self.id, vehicle=self.id)
        return stream

    def on_route(self, callback: Callable[[Route], None]) -> None:
        """Calls with every route of the target that is followed. It is called on the connection's thread, so it
        must not wait for answers."""
        self._on_route.append(self._session.checked_call(callback))

    def unfollow(self) -> None:
        """Follows nothing any more; streams of routes end."""
        with self._session.lock:
            if self._target is not None:
                self._session.bus.unsubscribe(PUSHED_ROUTE, agent=self.id, vehicle=self.id)
            self._target, self._goal, self._route = None, None, None
            for stream in self._streams:
                stream.close()
            self._streams.clear()

    def _ask(self, now_ns: int) -> None:
        """Asks for a route from here, which keeps us registered with the planner."""
        target, before = self._target, self._route
        assert target is not None
        self._ask_due_ns = now_ns + _ASK_AGAIN_NS
        if self._asking == target:
            return
        near_end = before is not None and before.remaining_s > 0 and self.cell in before.cells[-_NEAR_END_CELLS:]
        ran_out = before is not None and (not before.ok or near_end)
        from_here: dict[str, Any] = {
            "cells": [self.cell],
            "vehicles": [self.id],
            "vehicle_class": self.vehicle_class,
        }
        asker = asker_of("rover", self.id)
        if self._goal is None:
            request = planning.RouteRequest(force=ran_out, **from_here)
            asked = self._session.ask(ROUTE, request, _TIMEOUT_S, target=target, asker=asker)
        else:
            place = planning.PlaceRouteRequest(to=self._goal, **from_here)
            asked = self._session.ask(PLACE_ROUTE, place, _TIMEOUT_S, asker=asker)
        self._asking = target

        def finish(done: Future[list[Any]]) -> None:
            with self._session.lock:
                if self._asking == target:
                    self._asking = None
                if self._target != target:
                    return
                if (error := done.exception()) is not None:
                    self._session.problem("routes_missed", f"vehicle {self.id} gets no route to {target}: {error}")
                else:
                    self._take(done.result()[0])

        asked.add_done_callback(finish)

    def _take(self, reply: planning.RouteReply | planning.PlaceRouteReply | planning.PushedRoute) -> None:
        """Takes a received route, and reports it if it differs from the last one."""
        try:
            given = reply.route if isinstance(reply, planning.PushedRoute) else reply.routes[0]
            route = Route.of(self._session.frame, given, reply)
        except (ValueError, IndexError) as error:
            self._session.problem("routes_refused", f"the planner of {self._target} answers nonsense: {error}")
            return
        if given.status is RouteStatus.LETHAL_START:
            where = "row {}, col {}".format(*self._session.frame.grid.row_col(given.start))
            text = f"vehicle {self.id} is on lethal ground, {where}: no route leads from there"
            self._session.problem("lethal_start", text)
        if self._route is not None and route.is_rest_of(self._route):
            return
        self._route = route
        for stream in self._streams:
            stream.put(route)
        for callback in self._on_route:
            self._session.call(lambda callback=callback: callback(route))  # type: ignore[misc]

    # --- map ----------------------------------------------------------------------------------------------------

    def mark(
        self,
        cells: Iterable[int],
        *,
        lethal: bool = False,
        pace_s_per_m: float | None = None,
        clear: bool = False,
        for_s: float | None = None,
        only_for: str | None = None,
    ) -> int:
        """States something about cells, for all vehicles and planners. Returns how many cells were stated. Without
        certificates it counts only from the user of the swarm.

        cells         such as `swarm.frame.cells_within(x_m, y_m, radius_m)`
        lethal        no vehicle may enter them
        pace_s_per_m  pace that the cells have
        clear         they are as the map had them before
        for_s         lifetime of the mark; None: it holds until another mark replaces it
        only_for      vehicle class to which the statement applies; there it overrides non-lethal marks for all
                      classes

        Raises ConfigError on a cell outside, on a pace beyond its bounds, on a class that there is not, and unless
        exactly one thing is stated.
        """
        session = self._session
        for name, flag in (("lethal", lethal), ("clear", clear)):
            if type(flag).__name__ not in ("bool", "bool_"):
                raise session.refused(f"{name} is {brief(flag)}, expected True or False")
        if (lethal, pace_s_per_m is not None, clear).count(True) != 1:
            raise session.refused("mark states one thing: lethal=True, pace_s_per_m=... or clear=True")
        if pace_s_per_m is not None:
            pace_s_per_m = session.number("pace_s_per_m", pace_s_per_m, map_data.PACE_LEAST, map_data.PACE_MOST)
        if for_s is not None:
            for_s = session.number("for_s", for_s, 0, 1e9, more=True)
        class_number = 0 if only_for is None else session.class_number(only_for, "only_for")
        kind = map_data.MarkKind.LETHAL if lethal else map_data.MarkKind.CLEAR if clear else map_data.MarkKind.PACE
        if not self._marks.any:
            session.trust()  # which asks the network: others wait for the lock meanwhile
        with session.lock:
            session.check_open()
            try:
                once = dict.fromkeys(checked_cell(session.frame.grid, cell) for cell in listed("cells", cells))
            except ConfigError as error:
                raise session.refused(str(error)) from None
            if not once:
                return 0
            now_ns = session.swarm_now_ns()
            until_ns = map_data.FOREVER if for_s is None else now_ns + int(for_s * NS_PER_S)
            if not self._marks.any:
                session.bus.serve(MARKS, session.post, author=self._marks.author)
                session.bus.subscribe(MARKS, session.post, author=self._marks.author)
            sets = self._marks.state(once, kind, pace_s_per_m or 0.0, now_ns, until_ns, class_number)
            self._put_marks(sets)
            self._digest_due_ns = 0
        return len(once)

    def _put_marks(self, sets: Iterable[map_data.MarkSet]) -> None:
        for each in sets:
            region = self._marks.region_of(each)
            self._session.bus.publish(MARKS, each, region=region, tile=each.tile, author=each.author)

    def _answer_marks(self, asked: Asked, request: map_data.MarksRequest) -> None:
        for each in self._marks.answer(request):
            asked.answer(each, region=self._marks.region_of(each), tile=each.tile, author=each.author)
        asked.end()

    # --- a part of its session ----------------------------------------------------------------------------------

    def on_event(self, event: Event, now_ns: int) -> None:
        match event:
            case Heard(message=Obstacle() as obstacle) if (
                obstacle.id == self.id and obstacle.incarnation != self.incarnation
            ):
                self._on_double(obstacle)
            case Heard(message=planning.PushedRoute() as pushed) if pushed.vehicle == self.id and (
                pushed.target_cell == self._goal if pushed.target is None else pushed.target == self._target
            ):
                self._take(pushed)
            case Heard(message=map_data.MarkSet() as marks) if marks.author == self._marks.author:
                self._put_marks(self._marks.overruled(marks, self._session.swarm_now_ns()))
            case Asked(topic=topic, request=map_data.MarksRequest() as request, fields=fields) if (
                topic is MARKS and fields["author"] in ("*", self._marks.author)
            ):
                self._answer_marks(event, request)
            case LinkChanged(up=True):
                self._repeat_due_ns = self._ask_due_ns = self._digest_due_ns = 0

    def _on_double(self, other: Obstacle) -> None:
        if other.lease_s == 0:
            return
        started = "later" if other.incarnation > self.incarnation else "earlier"
        what = f"another process, which started {started}, reports vehicle {self.id}: vehicles avoid both places"
        self._session.problem("doubles_heard", what)

    def tick(self, now_ns: int) -> None:
        super().tick(now_ns)
        if self._target is not None and now_ns >= self._ask_due_ns:
            self._ask(now_ns)
        if self._marks.any and now_ns >= self._digest_due_ns:
            self._digest_due_ns = now_ns + _DIGEST_NS
            self._session.bus.publish(DIGEST, self._marks.digest(), author=self._marks.author)

    def leave(self) -> None:
        """Takes the vehicle away: its place is free at once. Its marks stay. May be repeated."""
        session = self._session
        with session.lock:
            self.unfollow()
            super().leave()
            if self._way is not None:
                self._way.close()
                self._way = None
            if self._marks.any:
                session.bus.unserve(MARKS, author=self._marks.author)
                session.bus.unsubscribe(MARKS, author=self._marks.author)
