"""`connect`: from an endpoint to a swarm that is ready to be used, and the orders to it."""

from __future__ import annotations

import atexit
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarm.bus.bus import AskEnded, Bus, Replied
from swarm.client.observer import EVERY_S, Observer
from swarm.client.own_reports import Target
from swarm.client.route import Route
from swarm.client.session import Session, SwarmThread
from swarm.client.terrain_frame import Frame, Point, listed, point
from swarm.client.vehicle import Vehicle
from swarm.clock import Clock, MonotonicClock
from swarm.errors import BusError, ConfigError, NoAnswerError, RunMismatchError, SwarmError
from swarm.grid import real
from swarm.runtime.operator import AGAIN_S, Acknowledged, Operator, checked, replies_to
from swarm.wire.access import OPERATOR, Authenticator
from swarm.wire.messages import WIRE_VERSION, Nothing
from swarm.wire.messages.orders import GiveOrder, Order, SendVehicle, Then, VehicleGoals, Zone, ZoneOrder
from swarm.wire.messages.planning import GROUND, POSE_LEASE_S, PlaceRouteReply, PlaceRouteRequest
from swarm.wire.messages.processes import RunInfo
from swarm.wire.topics import PLACE_ROUTE, RUN, asker_of
from swarm.wire.versions import are_neighbours

if TYPE_CHECKING:
    from swarm.bus.zenoh_bus import ZenohBus
    from swarm.right_of_way.external_on_bus import ExternalSession
    from swarm.runtime.inbox import Inbox


class Orders:
    """Gives orders. Made by `Swarm.orders`. Each call waits until a keeper has stored the order and the processes
    concerned obey it. It returns the processes that obey and those that have not replied.

    Each raises ConfigError where the order is not possible, in the keeper's words, and BusError without a keeper.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._operator = Operator(session.bus)

    def pause(self) -> Acknowledged:
        """Stops all vehicles and simulated targets where they are."""
        return self._give(subject="pause")

    def resume(self) -> Acknowledged:
        """Resumes all vehicles and simulated targets after `pause`."""
        return self._give(subject="pause", off=True)

    def stop(self, vehicle: str) -> Acknowledged:
        """Stops one vehicle of the swarm."""
        return self._give(subject="vehicle", name=vehicle)

    def go(self, vehicle: str) -> Acknowledged:
        """Starts a stopped vehicle again."""
        return self._give(subject="vehicle", name=vehicle, off=True)

    def send(self, vehicle: str, places: Sequence[str], *, then: Then = "hold") -> Acknowledged:
        """Sends a vehicle of the swarm to places, one after the other, instead of an earlier order.

        places  as commands have them: "46.81,9.84", "xy:X,Y" or "cell:ROW,COL"
        then    after the last: "hold" there, "chase" targets again, or "repeat" from the first
        """
        order = checked(SendVehicle, {"vehicle": vehicle, "places": places, "then": then})
        return self._operator.give(order)[1]

    def recall(self, vehicle: str) -> Acknowledged:
        """Ends the places of a vehicle, which then chases targets again."""
        return self._operator.give(checked(SendVehicle, {"vehicle": vehicle, "off": True}))[1]

    def goals(self) -> list[VehicleGoals]:
        """Returns the places to which each vehicle was sent."""
        return list(self._operator.goals().goals)

    def chase(self, group: str, targets: Sequence[str] | None) -> Acknowledged:
        """States which targets the vehicles of a group may chase; None: those of the scenario."""
        named = [] if targets is None else targets
        return self._give(subject="group", name=group, targets=named, off=targets is None)

    def add_target(
        self, id: str, x_m: float, y_m: float, *, walk: str | None = None, speed_m_per_s: float | None = None
    ) -> Acknowledged:
        """Adds a simulated target.

        x_m, y_m       its start, in metres of the terrain's frame
        walk           still, random, waypoints (default) or evade
        speed_m_per_s  on level open ground, 4 by default
        """
        cell = self._session.frame.cell(x_m, y_m)
        return self._give(subject="target", name=id, cell=cell, walk=walk, speed_m_per_s=speed_m_per_s, new=True)

    def move_target(self, id: str, x_m: float, y_m: float) -> Acknowledged:
        """Moves a simulated target to a place (m, in the terrain's frame), from which it goes on."""
        return self._give(subject="target", name=id, cell=self._session.frame.cell(x_m, y_m))

    def remove_target(self, id: str) -> Acknowledged:
        """Removes a target: no vehicle chases it any more."""
        return self._give(subject="target", name=id, off=True)

    def set(self, key: str, value: float | None) -> Acknowledged:
        """Changes a setting that may change during the run; None restores the scenario's value."""
        return self._give(subject="set", name=key, value=value, off=value is None)

    def add_zone(
        self,
        polygon_m: Sequence[tuple[float, float]],
        *,
        name: str = "",
        pace_s_per_m: float | None = None,
        for_s: float | None = None,
        vehicle_class: str | None = None,
    ) -> tuple[str, Acknowledged]:
        """Closes an area, or gives it a pace. Returns the zone's name, too.

        polygon_m     corners (x_m, y_m) in the map's frame
        name          a zone of this name is replaced; empty: the keeper chooses one
        pace_s_per_m  None: no vehicle enters
        for_s         the zone ends by itself; None: never
        vehicle_class  for vehicles of this class only; None: for all
        """
        corners = [list(point("polygon_m", corner)) for corner in listed("polygon_m", polygon_m)]
        fields = {
            "action": "add", "name": name, "kind": "lethal" if pace_s_per_m is None else "pace",
            "pace_s_per_m": pace_s_per_m, "polygon_m": corners,
            "lasts_s": for_s, "vehicle_class": vehicle_class,
        }  # fmt: skip
        zones, acknowledged = self._operator.zone(checked(ZoneOrder, fields))
        return zones.changed, acknowledged

    def remove_zone(self, name: str) -> Acknowledged:
        """Opens an area again."""
        return self._operator.zone(checked(ZoneOrder, {"action": "remove", "name": name}))[1]

    def zones(self) -> list[Zone]:
        """Returns the active zones."""
        return list(self._operator.zones().zones)

    def given(self) -> list[Order]:
        """Orders in force, without zones and goals."""
        return list(self._operator.orders().orders)

    def _give(self, **fields: Any) -> Acknowledged:
        return self._operator.give(checked(GiveOrder, fields))[1]


_ASK_S = 1.0
"""Longest wait for one round of answers; rounds follow until the timeout of `connect`."""


class Swarm:
    """A running swarm. Made by `connect`; use it in a `with`, or `close` it. The end of the program does it, too.

    It may be used from any thread. Callbacks come on a thread of its own, one after the other.

    A lost link is restored, and the last statements of vehicles and targets are then sent again immediately.
    Meanwhile nothing raises: published messages are lost, `connected` is false, and leases expire. If another run
    is in the namespace when the link is back, every call raises RunMismatchError, as cells may mean other places
    there.
    """

    def __init__(
        self,
        session: Session,
        stop: Callable[[], None] = lambda: None,
        open_trusted: Callable[[], Bus] | None = None,
    ) -> None:
        self._session = session
        self._stop = stop
        self._open_trusted = open_trusted or (lambda: session.bus)
        """Opens a bus whose messages right of way accepts."""

    def __enter__(self) -> Swarm:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def frame(self) -> Frame:
        """The terrain: its grid, places and cells."""
        return self._session.frame

    @property
    def run_id(self) -> str:
        """Id of the run, equal in all of its processes."""
        return self._session.run.run_id

    @property
    def scenario(self) -> str:
        """Name of the scenario that runs."""
        return self._session.run.scenario

    @property
    def connected(self) -> bool:
        """True if the link to the router is up, as far as is known."""
        return self._session.connected

    @property
    def run(self) -> RunInfo:
        """Description of the run, from the reply of one of its processes when the connection began."""
        return self._session.run

    @property
    def now_ns(self) -> int:
        """The time by the swarm's clocks, in ns since 1970: that by which marks begin and end."""
        return self._session.swarm_now_ns()

    @property
    def ended(self) -> SwarmError | None:
        """Reason why the connection is unusable (closed, or another run in the namespace); None while it works."""
        return self._session.ended

    @property
    def counts(self) -> Counter[str]:
        """Counters since the connection began: rejected and missed messages, reported problems, and those of the
        bus. One that nothing has counted is 0."""
        return Counter({**self._session.bus.counts, **self._session.counts})

    def vehicle(
        self,
        id: str,
        *,
        group: str = "all",
        radius_m: float = 1.0,
        lease_s: float = 2.0,
        right_of_way: bool | str | Path = False,
        vehicle_class: str = GROUND,
    ) -> Vehicle:
        """A vehicle that is not the swarm's own. It exists for others from the first `Vehicle.at` on.

        id             letters, digits, '_' and '.'; not of any other vehicle
        group          of the scenario, which owns the vehicle and reads its marks
        radius_m       of the circle around its place which others keep clear, up to 100 m
        lease_s        others avoid its last place for this time after its last message
        right_of_way   it may reserve cells, which no other vehicle enters then (`Vehicle.reserve`). Works for the
                       swarm's user only, or with the certificate `rover.GROUP.ID`. The state for its next
                       generation is kept in the file of this path; if True, in a file of this user for each run and
                       id
        vehicle_class  whose routes it asks for: one of the scenario's classes of vehicles
        """
        vehicle = Vehicle(self._session, id, group, radius_m, lease_s, vehicle_class)
        if right_of_way:
            file = None if right_of_way is True else Path(right_of_way)
            try:
                vehicle.give_way(self._external(id, file))
            except BaseException:
                vehicle.leave()
                raise
        return vehicle

    def _external(self, id: str, file: Path | None) -> ExternalSession:
        """Opens the session of right of way for an external vehicle. Raises StoreError if another program has the
        file."""
        from swarm.right_of_way.external_on_bus import ExternalSession
        from swarm.right_of_way.generations import GenerationFile
        from swarm.runtime.run_secret import state_folder

        generations = GenerationFile(file or state_folder() / "vehicles" / self.run_id / id)
        try:
            return ExternalSession(id, self.frame.traffic, self._open_trusted(), generations)
        except BaseException:
            generations.close()
            raise

    def target(self, id: str, *, tracker: str | None = None, lease_s: float = POSE_LEASE_S) -> Target:
        """A target of the scenario that this program tracks: its walk there is `external`.

        id       of the target
        tracker  name of this tracker; one that restarts under its old name continues at once
        lease_s  after this time without a pose the target is lost, or the next tracker owns it
        """
        return Target(self._session, id, tracker, lease_s)

    def route_soon(
        self, target: str, x_m: float, y_m: float, *, vehicle_class: str = GROUND, timeout_s: float = 5.0
    ) -> Future[Route]:
        """The best route to a target from any place, without waiting and without a vehicle.

        The future fails with BusError if no planner replies. Raises ConfigError on a place outside the terrain.
        """
        return self._session.ask_route(target, self.frame.cell(x_m, y_m), vehicle_class, timeout_s)

    def route(self, start_m: Point, goal_m: Point, *, vehicle_class: str = GROUND, timeout_s: float = 5.0) -> Route:
        """The best route between two places, (x_m, y_m) each. Waits until it is known, `timeout_s` at most, also
        while the process that plans to places is replaced.

        Raises ConfigError on a place outside the terrain, BusError where no process plans to places.
        """
        until_s = time.monotonic() + self._session.number("timeout_s", timeout_s, 0, 1e9)
        start, goal = self.frame.cell(*point("start_m", start_m)), self.frame.cell(*point("goal_m", goal_m))
        self._session.check_ids(vehicle_class=vehicle_class)
        request = PlaceRouteRequest(to=goal, cells=[start], vehicle_class=str(vehicle_class))
        while True:
            left_s = max(until_s - time.monotonic(), 0.1)
            waiting = self._session.ask(PLACE_ROUTE, request, left_s, asker=asker_of(OPERATOR, "client"))
            try:
                reply: PlaceRouteReply = self._session.answers(waiting, left_s)[0]
                if reply.status != "growing" or time.monotonic() >= until_s:
                    return Route.of(self.frame, reply.routes[0], reply)
            except NoAnswerError:
                if not self._session.run.plans_to_places or time.monotonic() >= until_s:
                    raise
                time.sleep(AGAIN_S)
            except (ValueError, IndexError) as error:
                raise BusError(f"the planner of places answers nonsense: {error}") from error

    def orders(self) -> Orders:
        """Orders to the swarm: pause, close areas, add targets ... For the user of the swarm, or with certificates
        for `operator.NAME` only."""
        self._session.trust()
        return Orders(self._session)

    def observer(self, *, every_s: float = EVERY_S) -> Observer:
        """Subscribes to events of the swarm from now on.

        every_s  interval at which positions of the swarm's vehicles are read (s)
        """
        return Observer(self._session, self._session.number("every_s", every_s, 0, 1e6, more=True))

    def on_problem(self, callback: Callable[[str], None]) -> None:
        """Registers a callback, which gets a sentence about each problem that no call can raise: another process
        uses one of our ids, a planner does not answer. Each problem is reported at most once a minute, logged, and
        counted in `counts`."""
        self._session.on_problem(callback)

    def close(self) -> None:
        """Removes all vehicles and targets of this program, and disconnects. May be repeated; the end of the
        program does it, too."""
        atexit.unregister(self.close)
        self._stop()
        self._session.close()


def connect(
    endpoint: str = "tcp/127.0.0.1:7447",
    *,
    namespace: str = "swarm",
    ca: str | None = None,
    certificate: str | None = None,
    key: str | None = None,
    timeout_s: float = 10.0,
) -> Swarm:
    """Connects to a running swarm and reads its terrain.

    endpoint          of a router; beyond this machine `tls/HOST:PORT`, with the three files
    namespace         the scenario's `network.namespace`
    ca                certificate of the swarm's authority, PEM
    certificate, key  of this program, whose name says what it may do: rover.GROUP.ID, tracker.TARGET, operator.NAME
    timeout_s         how long to wait for a router, and for a process that belongs to a run

    Raises ConfigError on an invalid argument, BusError if no router or process replies, RunMismatchError if two
    runs share the namespace or the run's wire version is no neighbour of ours.
    """
    from swarm.bus.zenoh_bus import open_bus
    from swarm.config.explain import converted
    from swarm.config.scenario import NetworkConfig
    from swarm.endpoints import check_endpoint
    from swarm.runtime.inbox import Inbox
    from swarm.runtime.run_secret import authenticator_of

    given = {"ca": ca, "certificate": certificate, "key": key}
    files = {name: each for name, each in given.items() if each is not None}
    if files.keys() != given.keys() and (files or str(endpoint).startswith("tls/")):
        raise ConfigError(f"endpoint {endpoint!r}: a tls/ endpoint needs ca, certificate and key, others none")
    timeout_s = real("timeout_s", timeout_s)
    fields: dict[str, Any] = {"namespace": namespace, "connect": [endpoint], "connect_timeout_s": timeout_s}
    network = converted(fields | ({"tls": files} if files else {}), NetworkConfig, "connect", "settings")
    check_endpoint(endpoint, bool(files), "endpoint")
    began_s = time.monotonic()
    bus, inbox = open_bus(network), Inbox()
    try:
        clock = MonotonicClock()
        run, ahead_ns = _run(bus, inbox, began_s + timeout_s, f"{namespace!r} at {endpoint}", clock)
        session = Session(bus, run, clock, inbox.post, ahead_ns)
        session.trust = lambda: _trust(bus, authenticator_of(network, run.run_id))
    except BaseException:
        bus.close()
        raise
    thread = SwarmThread(session, inbox.take)

    def open_trusted() -> Bus:
        return open_bus(network, authenticator=authenticator_of(network, session.run.run_id))

    swarm = Swarm(session, thread.end, open_trusted)
    atexit.register(swarm.close)  # a program that ends takes its vehicles away
    return swarm


def _run(bus: Bus, inbox: Inbox, until_s: float, where: str, clock: Clock) -> tuple[RunInfo, int]:
    """The run of a namespace, as a process with a grid describes it, and by how many ns the clocks of its processes
    are ahead of ours. Raises BusError, RunMismatchError."""
    while True:
        answers: list[tuple[RunInfo, int]] = []
        bus.ask(RUN, Nothing(), inbox.post, tag="run", timeout_s=_ASK_S)
        while not isinstance(event := inbox.take(_ASK_S), AskEnded):
            match event:
                case Replied(message=RunInfo() as info):
                    answers.append((info, clock.now_ns()))
                case None if time.monotonic() > until_s:
                    break
        if (found := agreed(answers, where)) is not None:
            return found
        if time.monotonic() > until_s:
            raise BusError(f"no process of a swarm answers in namespace {where}: is one running there?")
        time.sleep(0.1)


def _trust(bus: ZenohBus, authenticator: Authenticator | None) -> None:
    """Gives a bus the secret of its run. Raises ConfigError if no process of the run answers with that secret."""
    if bus.authenticator is not None or authenticator is None:
        return
    bus.trust(authenticator)
    proof = replace(RUN, free=("ask",))  # an answer to it needs the code of the run
    proofs = (replies_to(bus, proof, Nothing(), _ASK_S, role=role)[0] for role in ("agent", "planner", "keeper"))
    if not any(proofs):
        bus.trust(None)
        raise ConfigError("no process of the run answers with this user's secret: only its user marks and orders")


def agreed(answers: Sequence[tuple[RunInfo, int]], where: str) -> tuple[RunInfo, int] | None:
    """Returns the majority answer: the run to which most processes belong, and the offset of their clocks. A single
    foreign process therefore decides nothing. None without any that has a grid.

    answers  with the time at which each came, by our clock

    Raises RunMismatchError if two runs have as many processes, or the run's builds are no neighbours of this one.
    """
    with_grid = [(info, came_ns) for info, came_ns in answers if info.run_id and info.rows and info.cols]
    if not with_grid:
        return None
    (run, many), *others = Counter(_grid_of(info) for info, _ in with_grid).most_common()
    if others and others[0][1] == many:
        runs = " and ".join(sorted({run[0], others[0][0][0]}))
        raise RunMismatchError(f"two runs, or two descriptions of one, {runs}, are in namespace {where}: end one")
    of_run = [(info, came_ns) for info, came_ns in with_grid if _grid_of(info) == run]
    [(wire, _)] = Counter(info.wire_version for info, _ in of_run).most_common(1)
    if not are_neighbours(wire, WIRE_VERSION):
        raise RunMismatchError(
            f"the run in namespace {where} speaks wire version {wire}, this program {WIRE_VERSION}: only "
            "neighbouring versions understand each other, so install the run's"
        )
    ahead_ns = sorted(info.now_ns - came_ns for info, came_ns in of_run if info.now_ns)
    return of_run[0][0], ahead_ns[len(ahead_ns) // 2] if ahead_ns else 0


def _grid_of(info: RunInfo) -> tuple[str, int, int, float, float, float, str, int]:
    parts = info.traffic_parts or 1
    return info.run_id, info.rows, info.cols, info.resolution_m, info.west_m, info.north_m, info.crs, parts
