"""Read-only view of a swarm for programs: positions, targets, routes, marks and events."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from swarm.bus.bus import Event, Heard, LinkChanged, Replied
from swarm.client.session import Session, Stream
from swarm.clock import NS_PER_S
from swarm.grid import TILE_CELLS, GridSpec, walk
from swarm.runtime.tracker_ownership import Trackings
from swarm.wire.messages.map_data import MarkKind, MarkSet, MarksRequest
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.processes import Note
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, Followed, Obstacle, VehicleState
from swarm.wire.topics import FLEET, FOLLOWED, MARKS, NOTE, OBSTACLE, POSE

_SILENCE_NS = 5 * NS_PER_S
"""A fleet that was silent for this time is no longer shown. Agents publish at each tick, and at once when they
leave."""
EVERY_S = 0.2
"""Default time between two readings of positions: five a second are smooth to an eye."""
_HEARD = (FLEET, OBSTACLE, POSE, FOLLOWED, NOTE, MARKS)
_MARKS_TAG = "observer-marks"
_MOST_SETS = 1 << 16
"""Sets of marks that are held: a quarter of what a replica may hold (docs/reference/limits.md)."""
_ZONES = "operator."
"""Authors with this prefix write zones."""


@dataclass(frozen=True, slots=True)
class SeenVehicle:
    """A vehicle at its last reported place.

    state   idle, waiting, following, arrived, stranded, lost, outdated; "outside" if it is not the swarm's own
    target  the target that it chases, None if there is none
    """

    id: str
    group: str
    x_m: float
    y_m: float
    heading_rad: float | None
    state: str
    target: str | None
    vehicle_class: str = "ground"


@dataclass(frozen=True, slots=True)
class SeenTarget:
    """A target at the last place that its owner among the trackers reported.

    captures  how often it was captured
    tracker   name of the owner, if it has one
    lost      no tracker publishes it now: this is its last known position
    """

    id: str
    x_m: float
    y_m: float
    captures: int
    tracker: str | None
    lost: bool


@dataclass(frozen=True, slots=True)
class Mark:
    """Current state of a marked cell: lethal, or its pace in s/m."""

    lethal: bool
    pace_s_per_m: float | None


class Observer:
    """Positions, targets, routes, marks and notes of a swarm, from its creation on. Made by `Swarm.observer`; use
    it in a `with`, or `leave`. Each property is a copy, made when it is read.

    notes  sentences for people, as they come: `for note in observer.notes`; captures have the kind "capture"
    """

    def __init__(self, session: Session, every_s: float = EVERY_S) -> None:
        self._session = session
        self.notes: Stream[Note] = Stream()
        self._fleets: dict[tuple[str, int], tuple[Fleet, int]] = {}
        """(author, region) -> its newest message, and when it came."""
        self._obstacles: dict[str, tuple[Obstacle, int]] = {}
        self._trackings = Trackings(session.frame.grid)
        self._routes: dict[str, Followed] = {}
        self._sets: dict[tuple[int, str], MarkSet] = {}
        """(tile, author) -> its newest set."""
        self._new_routes: dict[str, None] = {}
        self._new_sets: dict[tuple[int, str], None] = {}
        """Changes since `take_routes` and `take_mark_sets`."""
        session.add(self)
        bus, post = session.bus, session.post
        for topic in _HEARD:  # of fleets only the newest: they come at every tick, of every vehicle
            bus.subscribe(topic, post, every_s=every_s if topic is FLEET else 0.0)
        self._ask_marks()

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *_: object) -> None:
        self.leave()

    @property
    def vehicles(self) -> Mapping[str, SeenVehicle]:
        """Vehicles whose reports are still valid, by id."""
        with self._session.lock:
            now_ns = self._session.now_ns()
            seen: dict[str, SeenVehicle] = {}
            for fleet, heard_ns in self._fleets.values():
                if now_ns - heard_ns < _SILENCE_NS:
                    seen |= {each.id: each for each in _in_fleet(fleet, self._session.frame.grid)}
            for obstacle, heard_ns in self._obstacles.values():
                if now_ns - heard_ns < obstacle.lease_s * NS_PER_S:
                    seen[obstacle.id] = SeenVehicle(
                        obstacle.id,
                        obstacle.group,
                        obstacle.x_m,
                        obstacle.y_m,
                        obstacle.heading_rad,
                        "outside",
                        None,
                    )
            return seen

    @property
    def targets(self) -> Mapping[str, SeenTarget]:
        """All known targets, by id."""
        with self._session.lock:
            now_ns = self._session.now_ns()
            lost = self._trackings.lost(now_ns)
            return {
                id: SeenTarget(id, pose.x_m, pose.y_m, pose.captures, pose.tracker, id in lost)
                for id, pose in self._trackings.poses().items()
            }

    @property
    def routes(self) -> Mapping[str, list[tuple[float, float]]]:
        """Points in metres of the routes that vehicles of the swarm have begun last, by vehicle."""
        with self._session.lock:
            return {id: self._points(id) for id in self._routes}

    def take_routes(self) -> Mapping[str, list[tuple[float, float]]]:
        """Returns the entries of `routes` that are new since the last call."""
        with self._session.lock:
            taken, self._new_routes = self._new_routes, {}
            return {id: self._points(id) for id in taken}

    def take_mark_sets(self) -> list[MarkSet]:
        """The newest set of marks of each tile and author, of those that have come since the last call: what a
        replica merges."""
        with self._session.lock:
            taken, self._new_sets = self._new_sets, {}
            return [self._sets[key] for key in taken]

    def _points(self, vehicle: str) -> list[tuple[float, float]]:
        frame, route = self._session.frame, self._routes[vehicle]
        return [frame.centre_m(cell) for cell in walk(frame.grid, route.start, route.directions)]

    @property
    def marks(self) -> Mapping[int, Mark]:
        """Current marks for all vehicles, by cell: the newest of several marks of a cell."""
        with self._session.lock:
            grid = self._session.frame.grid
            sets = [each for (tile, _), each in self._sets.items() if grid.class_of_tile(tile)[0] == 0]
            return marked(sets, grid, self._session.swarm_now_ns())

    def on_event(self, event: Event, now_ns: int) -> None:
        match event:
            case Heard(message=Fleet() as fleet):
                self._fleets[fleet.author, fleet.region] = fleet, now_ns
            case Heard(message=Obstacle() as obstacle):
                self._obstacles[obstacle.id] = obstacle, now_ns
            case Heard(topic=topic, message=TargetPose() as pose) if topic is POSE:
                self._trackings.counted(pose, now_ns)
            case Heard(message=Followed() as followed):
                self._on_followed(followed)
            case Heard(message=Note() as note):
                self.notes.put(note)
            case Heard(message=MarkSet() as marks):
                self._on_marks(marks)
            case Replied(tag=tag, message=MarkSet() as marks) if tag == _MARKS_TAG:
                self._on_marks(marks)
            case LinkChanged(up=True):
                self._ask_marks()

    def tick(self, now_ns: int) -> None:
        pass

    def leave(self) -> None:
        """Ends the observation. May be repeated."""
        with self._session.lock:
            self.notes.close()
            for topic in _HEARD:
                self._session.bus.unsubscribe(topic)
            self._session.remove(self)

    def _ask_marks(self) -> None:
        self._session.bus.ask(MARKS, MarksRequest(), self._session.post, tag=_MARKS_TAG, timeout_s=5.0)

    def _on_marks(self, marks: MarkSet) -> None:
        held = self._sets.get((marks.tile, marks.author))
        newer = held is None or (marks.epoch, marks.seq) > (held.epoch, held.seq)
        grid = self._session.frame.grid
        class_number, place = grid.class_of_tile(marks.tile)
        # Beyond the last tile is what authors have learned, of no class.
        known = place < grid.tiles + (class_number == 0) and class_number <= len(self._session.run.classes)
        if newer and known and (held is not None or len(self._sets) < _MOST_SETS):
            self._sets[marks.tile, marks.author] = marks
            self._new_sets[marks.tile, marks.author] = None

    def _on_followed(self, followed: Followed) -> None:
        try:
            walk(self._session.frame.grid, followed.start, followed.directions)
        except ValueError:
            self._session.problem("routes_refused", f"a route of {followed.vehicle} leaves the terrain")
        else:
            self._routes[followed.vehicle] = followed
            self._new_routes[followed.vehicle] = None


def _in_fleet(fleet: Fleet, grid: GridSpec) -> list[SeenVehicle]:
    def floats(column: bytes) -> Sequence[float]:
        return memoryview(column).cast("f").tolist()

    targets = [None if each == NO_TARGET else fleet.target_ids[each] for each in fleet.targets]
    columns = (
        fleet.ids,
        floats(fleet.east_m),
        floats(fleet.south_m),
        floats(fleet.heading_rad),
        fleet.states,
        targets,
    )
    return [
        SeenVehicle(
            id, fleet.group, grid.west_m + east_m, grid.north_m - south_m, heading_rad,
            VehicleState(state).name.lower(), target, fleet.vehicle_class,
        )
        for id, east_m, south_m, heading_rad, state, target in zip(*columns, strict=True)
    ]  # fmt: skip


def marked(sets: Iterable[MarkSet], grid: GridSpec, now_ns: int) -> dict[int, Mark]:
    """The winning statements of these sets, which are for the same vehicles, by cell of the grid: the newest wins,
    on equal stamps that of the larger author id, and an operator's over all others, as in
    `shared_map.replication.merge`."""
    won: dict[int, tuple[bool, int, str, int, float]] = {}
    for each in sets:
        zone = each.author.startswith(_ZONES)
        row, col = divmod(grid.class_of_tile(each.tile)[1], grid.tile_cols)
        corner_row, corner_col = row * TILE_CELLS, col * TILE_CELLS
        untils_ns = memoryview(each.untils_ns).cast("q") if each.untils_ns else None
        rows = zip(
            memoryview(each.cells).cast("H"), each.kinds, memoryview(each.paces).cast("f"),
            memoryview(each.stamps_ns).cast("q"), strict=True,
        )  # fmt: skip
        for number, (cell, kind, pace, stamp_ns) in enumerate(rows):
            if untils_ns is not None and untils_ns[number] <= now_ns:
                continue
            row, col = corner_row + cell // TILE_CELLS, corner_col + cell % TILE_CELLS
            if not grid.inside(row, col):
                continue  # in a tile that the border cuts
            at = grid.cell(row, col)
            statement = (zone, stamp_ns, each.author, kind, pace)
            if at not in won or statement[:3] > won[at][:3]:
                won[at] = statement
    return {
        cell: Mark(kind == MarkKind.LETHAL, pace if kind == MarkKind.PACE else None)
        for cell, (*_, kind, pace) in sorted(won.items())
        if kind != MarkKind.CLEAR
    }
