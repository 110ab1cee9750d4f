"""Outgoing side of the gateway: the swarm's state and the time in, messages to publish out. Core: no bus, no clock.

Each row of the table of topics has a function here which yields its messages. It is called at the row's rate; late
calls are skipped, never repeated. Topics of vehicles and targets come and go with them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from launch_scripts.gateways.ros2 import map_messages, ros_messages
from launch_scripts.gateways.ros2.gateway_settings import TARGET, VEHICLE, Settings, TopicRow
from launch_scripts.gateways.ros2.map_messages import MapFeed
from launch_scripts.gateways.ros2.ros_messages import Level, PackedPlaces, Place, RosMessages, ros_name
from shared_map.cost_map import merged
from swarm.client.observer import Observer, SeenTarget, SeenVehicle
from swarm.clock import NS_PER_S
from swarm.grid import Window

MOST_VEHICLES = 1000
"""Limit of published vehicles: each has topics of its own, and each topic a token."""
MOST_CUBES = 5000
"""The marked cells of each kind that are drawn; all of them are in the map."""
_STEP_HZ, _SELDOM_HZ = 10.0, 1.0
"""Rates of topics without a rate of their own, and of large ones."""
_SELDOM = ("map", "plan")
_STANDS_NS = NS_PER_S // 2
"""A vehicle without another position for this time is at rest."""
_BAD_STATES = ("stranded", "lost")
ToWgs84 = Callable[[float, float], tuple[float, float]]
Say = Callable[[str], None]


class Channel(Struct, frozen=True):
    """One topic in ROS.

    row    name of its row in the table
    topic  with its leading slash
    """

    row: str
    topic: str


class Put(Struct, frozen=True):
    """Put a message; bytes are CDR already."""

    channel: Channel
    message: Any


@dataclass(frozen=True)
class Health:
    """State of the gateway's two sides, as the shell knows it.

    run     id of the run
    up      whether the links to both routers are up
    counts  messages published, dropped and refused since the start
    """

    run: str = ""
    up: bool = True
    counts: Mapping[str, int] = field(default_factory=dict)


class _Now(NamedTuple):
    """Time and view of a tick."""

    now_ns: int
    stamp_ns: int
    vehicles: Mapping[str, SeenVehicle]
    targets: Mapping[str, SeenTarget]
    health: Health


_Messages = Iterator[tuple[str | None, Any]]
"""Messages of a row, each with the name in ROS of its vehicle or target; None if there is one for all."""


class Moving:
    """State of one vehicle as published to ROS. Its speed is the difference of its last two positions, by a clock
    that never leaps: so are all times here.

    id              in the swarm
    frames          the one that does not move, and its own
    place           a heading of None is published as the last known one
    twist           m/s forward, negative backwards; rad/s clockwise
    route           float64 (n, 2): x, y; what it follows
    route_is_new    it was not published yet
    """

    def __init__(self, id: str, frames: tuple[str, str], seen: SeenVehicle, now_ns: int, made: RosMessages) -> None:
        self.id, self.frames = id, frames
        self.place: Place = (seen.x_m, seen.y_m, seen.heading_rad)
        self.twist = (0.0, 0.0)
        self.route: NDArray[np.float64] = np.empty((0, 2), np.float64)
        self.route_is_new = False
        self.odometry = ros_messages.packed_odometry(made, frames)
        self._moved_ns = now_ns

    def take(self, seen: SeenVehicle, now_ns: int) -> None:
        """Takes in where it is now."""
        x_m, y_m, before_rad = self.place
        heading_rad = before_rad if seen.heading_rad is None else seen.heading_rad
        if self.place == (seen.x_m, seen.y_m, heading_rad):
            if now_ns - self._moved_ns > _STANDS_NS:
                self.twist = (0.0, 0.0)
            return
        # Of two positions far apart in time, the first was left at an unknown time: no less than a report ago.
        since_s = (now_ns - self._moved_ns) / NS_PER_S
        if since_s > 0:
            east_m, north_m = seen.x_m - x_m, seen.y_m - y_m
            forward_m = math.hypot(east_m, north_m)
            turn_rad = 0.0
            if heading_rad is not None:
                forward_m = east_m * math.sin(heading_rad) + north_m * math.cos(heading_rad)
                if before_rad is not None:
                    turn_rad = (heading_rad - before_rad + math.pi) % math.tau - math.pi
            self.twist = (forward_m / since_s, turn_rad / since_s)
        self.place, self._moved_ns = (seen.x_m, seen.y_m, heading_rad), now_ns


class Gateway:
    """Outgoing topics of one gateway about one run.

    settings  forwarded topics, and their types
    messages  in the frame of published positions
    feed      the shared map
    say       receives sentences for people
    to_wgs84  (latitude, longitude) of a place of the terrain; None where there are none
    """

    def __init__(
        self, settings: Settings, messages: RosMessages, feed: MapFeed, say: Say, to_wgs84: ToWgs84 | None = None
    ) -> None:
        self._rows = {row.name: row for row in settings.rows() if to_wgs84 is not None or row.name != "fix"}
        self._bare, self._patterns = settings.frames.bare, settings.vehicles
        self._messages, self._feed, self._say = messages, feed, say
        self._vehicles: dict[str, Moving] = {}
        """By name in ROS."""
        self._targets: dict[str, str] = {}
        """Name in ROS -> id."""
        self._refused: set[str] = set()
        """Vehicles and targets that are not published; each is reported once."""
        self._crew_changed = False
        """Vehicles have come or gone since /tf_static was put."""
        self._transforms: dict[str | None, PackedPlaces] = {}
        """Transforms of each group, since its vehicles changed last."""
        self._fresh: list[Window] = []
        """Windows that have changed since markers were put last."""
        self._changed: list[Window] = []
        """Windows that have changed since the map or its updates were put last."""
        self._due_ns = dict.fromkeys(self._rows, 0)
        """Due time of each row, by the clock that never leaps."""
        self.channels = self._channels_now()
        """The topics that are to be up, each a publisher with its token."""
        pose = ros_messages.packed_pose(messages)
        self._makers: dict[str, Callable[[_Now], _Messages]] = {
            "map": self._make_map, "map_updates": self._make_updates, "tf_static": self._make_static,
            "tf": self._make_transforms,
            "odom": self._make_each(lambda each, at_ns: each.odometry.at(at_ns, [each.place], each.twist)),
            "pose": self._make_each(lambda each, at_ns: pose.at(at_ns, [each.place])),
            "plan": self._make_plans,
            "fix": self._make_each(
                lambda each, at_ns: to_wgs84 and messages.fix(at_ns, each.frames[1], *to_wgs84(*each.place[:2]))
            ),
            "poses": self._make_all_poses, "targets": self._make_targets, "target_pose": self._make_target_poses,
            "markers": self._make_markers, "diagnostics": self._make_diagnostics,
        }  # fmt: skip

    def whole_map(self, stamp_ns: int) -> Any:
        """nav_msgs/OccupancyGrid of the map as it is known now."""
        return map_messages.occupancy_grid(self._messages, stamp_ns, self._feed.occupancy(self._feed.grid.window))

    def tick(
        self,
        now_ns: int,
        stamp_ns: int,
        swarm_now_ns: int,
        view: Observer,
        health: Health,
        robots: Collection[str] = (),
    ) -> list[Put]:
        """Returns due messages, in order; each is for one of `channels`.

        now_ns        by a clock that never leaps, by which all rates are kept
        stamp_ns      by the clock of this machine, since 1970, which stamps what ROS hears
        swarm_now_ns  by the swarm's clocks, by which marks expire
        robots        vehicles which are not published, because they publish their own positions to ROS
        """
        due = {name for name, at_ns in self._due_ns.items() if now_ns >= at_ns}
        if not due:
            return []
        vehicles = {id: each for id, each in view.vehicles.items() if id not in robots}
        now = _Now(now_ns, stamp_ns, vehicles, view.targets, health)
        self._follow(now)
        for id, points_m in view.take_routes().items():
            if (moving := self._vehicles.get(ros_name(id))) is not None and moving.id == id:
                moving.route, moving.route_is_new = np.array(list(points_m), np.float64).reshape(-1, 2), True
        if due & {"map", "map_updates", "markers"}:
            self._feed.merge(view.take_mark_sets(), swarm_now_ns)
            changed = self._feed.take_changes()
            if "markers" in self._rows:
                self._fresh += changed
            if "map_updates" in self._rows:
                self._changed = merged(changed, self._changed)
        puts: list[Put] = []
        for name, make in self._makers.items():
            if name in due:
                self._due_ns[name] = _next_ns(self._rows[name], now_ns)
                puts += [Put(self._channel(name, of), message) for of, message in make(now)]
        return puts

    # --- who is there ---------------------------------------------------------------------------------------------

    def _follow(self, now: _Now) -> None:
        """Updates positions. Topics of new vehicles come up, those of vehicles that have left go. A target of a
        scenario stays."""
        gone = [name for name, moving in self._vehicles.items() if moving.id not in now.vehicles]
        for name in gone:
            del self._vehicles[name]
        came = [id for id, seen in now.vehicles.items() if self._take(id, seen, now.now_ns)]
        if came or gone:
            self._transforms, self._crew_changed = {}, True
        targets = len(self._targets)
        for id in now.targets:
            if self._targets.setdefault(ros_name(id), id) != id:
                self._refuse(f"target {id}", f"{self._targets[ros_name(id)]} is called {ros_name(id)}, too")
        if came or gone or len(self._targets) > targets:
            self.channels = self._channels_now()

    def _take(self, id: str, seen: SeenVehicle, now_ns: int) -> bool:
        """Returns True for a vehicle that is published from now on."""
        name = ros_name(id)
        moving = self._vehicles.get(name)
        if moving is not None and moving.id == id:
            moving.take(seen, now_ns)
        elif not any(fnmatchcase(id, each) for each in self._patterns):
            pass
        elif moving is not None:
            self._refuse(f"vehicle {id}", f"{moving.id} is called {name}, too")
        elif len(self._vehicles) >= MOST_VEHICLES:
            self._refuse(f"vehicle {id}", f"there are {MOST_VEHICLES} already")
        else:
            frames = ("odom", "base_link") if self._bare else ros_messages.frames_of(name)
            self._vehicles[name] = Moving(id, frames, seen, now_ns, self._messages)
            return True
        return False

    def _refuse(self, who: str, why: str) -> None:
        if who not in self._refused and len(self._refused) < MOST_VEHICLES:
            self._refused.add(who)
            self._say(f"{who} is not published to ROS: {why}")

    def _channels_now(self) -> frozenset[Channel]:
        names: dict[str | None, Iterable[str | None]]
        names = {None: (None,), VEHICLE: self._vehicles, TARGET: self._targets}
        return frozenset(self._channel(row.name, of) for row in self._rows.values() for of in names[row.per])

    def _channel(self, row: str, name: str | None = None) -> Channel:
        return Channel(row, self._rows[row].topic.replace(VEHICLE, name or "").replace(TARGET, name or ""))

    # --- vehicles -------------------------------------------------------------------------------------------------

    def _make_each(self, message: Callable[[Moving, int], Any]) -> Callable[[_Now], _Messages]:
        """Returns the maker of a topic that every vehicle has, from its message at a stamp."""
        return lambda now: ((name, message(each, now.stamp_ns)) for name, each in self._vehicles.items())

    def _make_plans(self, now: _Now) -> _Messages:
        for name, each in self._vehicles.items():
            if each.route_is_new:
                each.route_is_new = False
                yield name, self._messages.path(now.stamp_ns, each.route)

    def _groups(self) -> _Messages:
        """Vehicles whose transforms go into one message, with the name of the one that has a topic of its own."""
        if self._bare:
            yield from ((name, [each]) for name, each in self._vehicles.items())
        elif self._vehicles:
            yield None, list(self._vehicles.values())

    def _make_transforms(self, now: _Now) -> _Messages:
        for name, group in self._groups():
            if name not in self._transforms:
                frames = [each.frames for each in group]
                self._transforms[name] = ros_messages.packed_transforms(self._messages, frames)
            yield name, self._transforms[name].at(now.stamp_ns, [each.place for each in group])

    def _make_static(self, now: _Now) -> _Messages:
        """The frames that do not move lie in the map's origin."""
        changed, self._crew_changed = self._crew_changed, False
        for name, group in self._groups() if changed else ():
            pairs = [(self._messages.map.frame, each.frames[0]) for each in group]
            transforms = [self._messages.transform(now.stamp_ns, pair) for pair in pairs]
            yield name, self._messages.transforms(transforms)

    def _make_all_poses(self, now: _Now) -> _Messages:
        vehicles = sorted(self._vehicles.values(), key=lambda each: each.id)
        points_m = np.array([each.place[:2] for each in vehicles], np.float64).reshape(-1, 2)
        yield None, self._messages.pose_array(now.stamp_ns, points_m, [each.place[2] for each in vehicles])

    # --- targets. An untracked target may be anywhere: it is published again when a tracker returns ---------------

    def _tracked(self, now: _Now) -> dict[str, SeenTarget]:
        """By name in ROS."""
        seen = now.targets
        return {name: seen[id] for name, id in self._targets.items() if id in seen and not seen[id].lost}

    def _make_target_poses(self, now: _Now) -> _Messages:
        for name, each in self._tracked(now).items():
            yield name, self._messages.pose_stamped(now.stamp_ns, each.x_m, each.y_m)

    def _make_targets(self, now: _Now) -> _Messages:
        tracked = sorted(self._tracked(now).values(), key=lambda each: each.id)
        places = np.array([(each.x_m, each.y_m) for each in tracked], np.float64).reshape(-1, 2)
        yield None, self._messages.pose_array(now.stamp_ns, places)

    # --- the map --------------------------------------------------------------------------------------------------

    def _make_map(self, now: _Now) -> _Messages:
        if self._feed.whole_is_due(now.now_ns):
            self._changed = []
            yield None, self.whole_map(now.stamp_ns)

    def _make_updates(self, now: _Now) -> _Messages:
        changed, self._changed = self._changed, []
        for window in changed:
            cells = self._feed.occupancy(window)
            yield None, map_messages.occupancy_update(self._messages, now.stamp_ns, cells, window)

    def _make_markers(self, now: _Now) -> _Messages:
        grid, fresh = self._feed.grid, self._fresh
        self._fresh = []
        lethal, paced, zones = (cells[:MOST_CUBES].tolist() for cells in self._feed.marked)
        drawn = [
            *(map_messages.route(grid, map_messages.corners(each.route)) for each in self._vehicles.values()),
            *map_messages.marked_cells(grid, lethal, paced, zones),
            map_messages.windows(grid, fresh),
        ]
        yield None, map_messages.marker_array(self._messages, now.stamp_ns, drawn)

    # --- how all are ----------------------------------------------------------------------------------------------

    def _make_diagnostics(self, now: _Now) -> _Messages:
        """Yields for vehicles, targets, map and gateway: whether each is well, a sentence, and values."""
        states = Counter(each.state for each in now.vehicles.values())
        bad = ", ".join(f"{states[state]} {state}" for state in _BAD_STATES if states[state])
        lost = sorted(each.id for each in now.targets.values() if each.lost)
        captures = sum(each.captures for each in now.targets.values())
        grid, health, knows = self._feed.grid, now.health, self._feed.knows_ground
        west_m, south_m = self._messages.map.origin_m
        vehicles = bad or f"{len(now.vehicles)} vehicles"
        nothing = "marks alone: the terrain of the run is not on this machine"
        rows: tuple[tuple[str, Level, str, Mapping[str, object]], ...] = (
            ("vehicles", Level.WARN if bad or not now.vehicles else Level.OK, vehicles,
             {"vehicles": len(now.vehicles), **dict(sorted(states.items()))}),
            ("targets", Level.WARN if lost else Level.OK,
             f"no tracker for {', '.join(lost[:10])}" if lost else f"{len(now.targets)} targets",
             {"targets": len(now.targets), "lost": len(lost), "captures": captures}),
            ("map", Level.OK if knows else Level.WARN, "ground and marks" if knows else nothing,
             {"crs": grid.crs, "origin_x_m": west_m, "origin_y_m": south_m, "rows": grid.rows, "cols": grid.cols,
              "resolution_m": grid.resolution_m}),
            ("gateway", Level.OK if health.up else Level.ERROR,
             "both links are up" if health.up else "a link is down",
             {"run": health.run, **dict(sorted(health.counts.items()))}),
        )  # fmt: skip
        statuses = [self._messages.diagnostic(f"swarm: {row[0]}", *row[1:]) for row in rows]
        header = self._messages.header(now.stamp_ns, "")
        yield None, self._messages.types.make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=statuses)


def _next_ns(row: TopicRow, now_ns: int) -> int:
    """The next multiple of its period: topics of one rate stay together, and no delay adds up."""
    hz = row.hz or (_SELDOM_HZ if row.name in _SELDOM else _STEP_HZ)
    period_ns = int(NS_PER_S / hz)
    return (now_ns // period_ns + 1) * period_ns
