"""Right of way of a vehicle that is not in the scenario, on the bus.

`ExternalSession` is what a program of one's own uses: a thread that keeps the right of way, and calls that may be
made from any other. `ExternalService` is the same without the thread, for another loop to drive. `say_gone` is an
operator's statement that such a vehicle is not on the map any more.
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import blake2s

from swarm.bus.bus import Appeared, AskEnded, Bus, Disappeared, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S, MonotonicClock
from swarm.errors import BusError, ConfigError, SwarmError
from swarm.grid import REGION_CELLS, GridSpec
from swarm.peers import Peer
from swarm.right_of_way.external_vehicle import Answers, ExternalVehicle, Removal
from swarm.right_of_way.generations import MemoryGenerations
from swarm.right_of_way.holdings import SendState
from swarm.right_of_way.host import AskKnown
from swarm.right_of_way.shards import Shards
from swarm.runtime.inbox import Inbox
from swarm.wire.fields import check_id
from swarm.wire.messages.traffic import Granted, Known, KnownRequest, Left, Word
from swarm.wire.topics import GRANTED, HOST_STATE, KNOWN, LEFT, WORD

_NOBODY_NS = 10 * NS_PER_S
"""Time without a reply after which an external vehicle is informed of it."""
_ANSWERS_S = 0.3
"""A new generation waits this time for the agents' answers before it begins."""
_ASK_AGAIN_NS = NS_PER_S
"""Time until agents are asked again what they know, where too few have answered."""
_ROLE = "rover"


@dataclass
class ExternalService:
    """Right of way of one vehicle that is not in the scenario, on a bus that may carry other things, too.

    `handle` and `tick` are called by one thread, `tick` some ten times a second. The bus needs the run's secret, or
    a certificate of the external vehicle, `rover.GROUP.NAME`.

    name         of the external vehicle, as in its certificate; no agent of the scenario has it
    grid         the cells of right of way
    incarnation  nanosecond of this process's start, which tells its liveliness token from that of another
    warn         called with a sentence about what cannot be, or why the vehicle waits

    Raises ConfigError if the name is none.
    """

    name: str
    grid: GridSpec
    incarnation: int
    generations: MemoryGenerations
    bus: Bus
    post: Post
    warn: Callable[[str], None]
    external: ExternalVehicle | None = None
    """None until an agent has sent the list of agents."""
    _warned: set[str] = field(default_factory=set)
    _tag: str = ""
    _asking: bool = False
    _ask_due_ns: int = 0
    _check_due_ns: int = 0
    _tokens: set[Peer] = field(default_factory=set)
    _began_ns: int = 0
    _cell: int | None = None
    """The cell to enter, once there is an external vehicle."""

    def __post_init__(self) -> None:
        try:
            check_id("external vehicle", f"{self.name}-00")
        except ValueError as error:
            raise ConfigError(str(error)) from error
        self._answers = Answers(proven=self.bus.proves_names)

    def start(self, now_ns: int) -> None:
        self.bus.watch_alive(self.post, role=_ROLE)
        for topic in (GRANTED, WORD, LEFT):
            self.bus.subscribe(topic, self.post, host=self.name)
        self.bus.declare_alive(Peer(_ROLE, self.name, self.incarnation))
        self._began_ns = now_ns
        self._ask(now_ns)

    def stop(self) -> None:
        for topic in (GRANTED, WORD, LEFT):
            self.bus.unsubscribe(topic, host=self.name)

    def enter(self, cell: int, now_ns: int) -> None:
        """Asks for the cell on which the vehicle stands. Raises as `ExternalVehicle.enter`."""
        if not 0 <= cell < self.grid.cells:
            raise ValueError(f"cell {cell} is outside the map of {self.grid.cells} cells")
        self._cell = cell
        if self.external is not None:
            self.external.enter(cell)
            if self.external.needs_generation and not self._asking:
                self._ask(now_ns)
        self.tell(now_ns)

    def leave(self, now_ns: int) -> None:
        """Gives all cells back."""
        self._cell = None
        if self.external is not None:
            self.external.leave()
        self.tell(now_ns)

    def on_external_event(self, event: Event, now_ns: int) -> None:
        """Takes up an event about the right of way of this external vehicle; any other changes nothing."""
        external = self.external
        match event:
            case Heard(message=(Granted() | Word()) as granted) if external and granted.host == self.name:
                external.host.hear_granted(granted, now_ns)
            case Heard(message=Left() as left) if external:
                external.host.hear_left(left)
            case Replied(tag=self._tag, message=Known() as known):
                self._take_answers(self._answers.hear(known))
            case AskEnded(tag=self._tag):
                self._take_answers(self._answers.end_query())
                self._asking = False
                self._ask_due_ns = now_ns + _ASK_AGAIN_NS
                if self.external is not None:
                    if generations := self.external.begin(self._chance(now_ns)):
                        self.generations.save(generations)
                    self.tell(now_ns)
            case Appeared(peer=peer) | Disappeared(peer=peer) if (peer.role, peer.id) == (_ROLE, self.name):
                up = isinstance(event, Appeared)
                (self._tokens.add if up else self._tokens.discard)(peer)
                if external:
                    external.host.hear_token(peer, up=up)
            case _:
                pass

    def tick(self, now_ns: int) -> None:
        if now_ns >= self._check_due_ns:
            self._check_due_ns = now_ns + NS_PER_S
            if (why := self.generations.check()) is not None:
                self._warn_once(why)
        external = self.external
        if not (self._asking or (external is not None and external.settled)) and now_ns >= self._ask_due_ns:
            self._ask(now_ns)
        if external is None:
            if now_ns - self._began_ns > _NOBODY_NS:
                self._warn_once(
                    f"no agent answers {self.name}: it needs one that drives in this run, and a name of its own"
                )
            return
        self.tell(now_ns)
        for text in (*external.host.refused, *external.host.unled(now_ns).values()):
            self._warn_once(text)
        external.host.refused.clear()

    def tell(self, now_ns: int) -> None:
        """Sends new statements without waiting for the next tick."""
        if self.external is not None:
            self._perform(self.external.tick(now_ns), now_ns)

    def _take_answers(self, agreed: Sequence[Known]) -> None:
        if not agreed:
            return
        known, external = agreed[0], self.external
        # An agent tells of larger shards only if the whole run has them; one that says less may not belong.
        if external is None or (known.shard_cells > external.host.shards.side and not external.cells):
            if self.name in known.agents:
                self._warn_once(
                    f"{self.name} is an agent of this run's scenario: an external vehicle needs another name"
                )
                return
            shards = Shards(self.grid, known.agents, known.shard_cells, proven=self.bus.proves_names)
            self.external = external = ExternalVehicle(shards, self.name, self.generations.generations)
            for peer in self._tokens:
                external.host.hear_token(peer, up=True)
            if self._cell is not None:
                external.enter(self._cell)
        for known in agreed:
            if known.shard_cells == external.host.shards.side:
                external.host.hear_known(known)

    def _ask(self, now_ns: int) -> None:
        self._asking, self._tag = True, f"known-{self.name}-{now_ns}"  # what answers an earlier query is too old
        request = _question(self.name, self.grid)
        self.bus.ask(KNOWN, request, self.post, tag=self._tag, timeout_s=_ANSWERS_S)

    def _perform(self, actions: Sequence[object], now_ns: int) -> None:
        for action in actions:
            match action:
                case AskKnown():
                    self._ask(now_ns)
                case Left() as left:
                    self.bus.publish(LEFT, left, host=left.host, agent=self.name)
                case SendState(members, state):
                    for member in members:
                        self.bus.publish(HOST_STATE, state, shard=state.shard, member=member, agent=self.name)

    def _chance(self, now_ns: int) -> int:
        seed = f"{self.name}/{self.incarnation}/{now_ns}".encode()
        return int.from_bytes(blake2s(seed, digest_size=4).digest(), "little")

    def _warn_once(self, text: str) -> None:
        if text not in self._warned and len(self._warned) < 100:
            self._warned.add(text)
            self.warn(text)


log = logging.getLogger(__name__)

_TICK_S = 0.1
"""Time between two ticks: half a heartbeat, so that each heartbeat is sent in time."""
_ENTER_S, _LEAVE_S = 5.0, 3.0
"""Longest waits for the first cell, and at the end for the word that all cells are free: a few hops, or an election
of a leader, which takes a second."""


class ExternalSession:
    """Right of way of one vehicle: which cells of the map it may stand on and enter.

    >>> with ExternalSession("rover", grid, bus, GenerationFile(path)) as rover:  # doctest: +SKIP
    ...  rover.enter(cell)
    ...  rover.want([cell, *route])
    ...  if rover.may_enter(route[0], timeout_s=10.0):
    ...  drive()
    ...  rover.left(cell)

    The vehicle drives into a cell only while `may_enter` of it is true, and says which it has left. At its end the
    session leaves. A program that dies leaves its cells shut, until the next one of the same name and file enters,
    or an operator removes the vehicle (`swarm order vehicle forget`).

    name         of the vehicle, unlike all agents of the scenario
    grid         the run's cells of right of way
    bus          opened with the run's secret, or with the vehicle's certificate, `rover.GROUP.NAME`
    generations  the vehicle's file; closed with this session, as the bus is
    """

    def __init__(self, name: str, grid: GridSpec, bus: Bus, generations: MemoryGenerations) -> None:
        self._clock = MonotonicClock()
        self._inbox = Inbox()
        self._changed = threading.Condition(threading.RLock())
        """Guards the service; notified whenever it may have come to hold other cells."""
        self._closed = threading.Event()
        self._entered = False
        """True if `stands` was called."""
        self._bus = bus
        self._generations = generations
        self._failure: BaseException | None = None
        self.warnings: list[str] = []
        """Sentences about why it waits, or what cannot be true."""
        incarnation = self._clock.now_ns()
        self._service = ExternalService(name, grid, incarnation, generations, bus, self._inbox.post, self._warn)
        self._service.start(self._clock.now_ns())
        self._thread = threading.Thread(target=self._run, name=f"external-{name}", daemon=True)
        self._thread.start()

    def __enter__(self) -> ExternalSession:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- what the driver asks and says ----------------------------------------------------------------------

    @property
    def cells(self) -> tuple[int, ...]:
        """The cells that it may stand on and enter, in driving order, its own first. They grow by themselves, and
        shrink by `want`, `left` and `leave` only; all are lost at once when another process takes the name."""
        with self._changed:
            external = self._service.external
            return () if external is None else external.cells

    @property
    def replaced(self) -> bool:
        """True if another process has taken the name: this vehicle must stand still, and its cells stay shut."""
        with self._changed:
            external = self._service.external
            return external is not None and external.host.replaced

    def enter(self, cell: int, timeout_s: float | None = None) -> bool:
        """Asks for the cell where the vehicle stands. Returns whether it is granted within `timeout_s`; None asks
        without waiting. It stays asked for: call again to ask for another one.

        Raises ValueError for a cell outside the map, or if it has entered already.
        """
        with self._changed:
            self._service.enter(cell, self._clock.now_ns())
        return self._wait(lambda: bool(self.cells), timeout_s)

    @property
    def _vehicle(self) -> ExternalVehicle:
        if self._service.external is None:
            raise ValueError("it has not entered: no agent of the run has answered yet")
        return self._service.external

    def want(self, path: Sequence[int], aside: Sequence[int] = ()) -> None:
        """States where it would go: the cell on which it stands first, each next to the one before. Cells that it
        holds and that are not the beginning of this path are given back.

        aside  neighbours to which it would go, too, to let others pass; `cells` then names one instead

        Raises ValueError if it has not entered, or the path begins elsewhere or leaps.
        """
        with self._changed:
            self._vehicle.want(path, aside)
            self._service.tell(self._clock.now_ns())

    def may_enter(self, cell: int, timeout_s: float | None = None) -> bool:
        """Returns True if the vehicle may drive into a cell, after waiting up to a timeout."""
        return self._wait(lambda: cell in self.cells, timeout_s)

    def left(self, cell: int) -> None:
        """It has left a cell for the next of `cells`. Raises ValueError if it holds none after it."""
        with self._changed:
            self._vehicle.left(cell)
            self._service.tell(self._clock.now_ns())

    def counted(self, cell: int, x_m: float, y_m: float) -> int:
        """The cell in which the vehicle counts at a place in `cell` (`ExternalVehicle.counted`)."""
        with self._changed:
            external = self._service.external
            return cell if external is None else external.counted(cell, x_m, y_m)

    def stands(self, cell: int) -> bool:
        """The vehicle is in a cell: those behind it are given back. Returns whether it was let in there.

        Until it holds a cell, the one in which it stands is requested; the first is waited for, as another vehicle
        may be there.
        """
        with self._changed:
            held = self.cells
            if not held:
                waits_s, self._entered = None if self._entered else _ENTER_S, True
                return self.enter(cell, waits_s) and cell in self.cells
            for behind in held[: held.index(cell)] if cell in held else ():
                self.left(behind)
            return cell in held

    def leave(self, timeout_s: float | None = _LEAVE_S) -> bool:
        """The vehicle stands on no cell any more. Returns whether that is known where it counts, so that others may
        drive there."""
        with self._changed:
            self._service.leave(self._clock.now_ns())
        return self._wait(lambda: self._service.external is None or self._service.external.gone, timeout_s)

    def close(self) -> None:
        """Leaves, and ends the session; also after its thread has failed, of which `may_enter` and `leave` tell."""
        if not self._closed.is_set():
            with suppress(SwarmError):  # what else the program has is left and closed all the same
                self.leave()
            with self._changed:
                self._closed.set()
                self._service.stop()
            self._thread.join(2 * _TICK_S + 1.0)
            self._bus.close()
            self._generations.close()

    # --- its thread -----------------------------------------------------------------------------------------

    def _wait(self, true: Callable[[], bool], timeout_s: float | None) -> bool:
        with self._changed:
            found = self._changed.wait_for(lambda: true() or self._failure is not None, timeout_s or 0.0)
            if self._failure is not None:
                raise BusError(f"right of way has ended: {self._failure}") from self._failure
            return found

    def _run(self) -> None:
        due_ns = self._clock.now_ns()
        try:
            while not self._closed.is_set():
                event = self._inbox.take(_TICK_S)
                with self._changed:
                    if self._closed.is_set():
                        return
                    now_ns = self._clock.now_ns()
                    if event is not None:
                        self._service.on_external_event(event, now_ns)
                    if now_ns >= due_ns:
                        due_ns = now_ns + int(_TICK_S * NS_PER_S)
                        self._service.tick(now_ns)
                    self._changed.notify_all()
        except BaseException as error:
            log.error("right of way of %s has ended: %s", self._service.name, error)
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _warn(self, text: str) -> None:
        log.warning(text)
        self.warnings.append(text)


_WORDS_S = 0.5
"""An operator waits for agents' answers for this time, and asks again: one round is enough where no agent hangs."""


def _question(name: str, grid: GridSpec) -> KnownRequest:
    """Asks what agents know of an external vehicle; those answer which have the same cells of right of way."""
    return KnownRequest(agent=name, disk=0, shard_cells=REGION_CELLS * grid.parts)


def say_gone(bus: Bus, name: str, grid: GridSpec, timeout_s: float) -> bool:
    """Removes an external vehicle, and waits until its cells are free. Returns whether they are within the timeout.

    bus   opened with the run's secret, or the external vehicle's own certificate
    grid  the run's cells of right of way

    Raises ConfigError where no such external vehicle is known, or it is no external vehicle, or its program still
    runs.
    """
    inbox = Inbox()
    clock = MonotonicClock()
    answers = Answers(proven=bus.proves_names)
    bus.watch_alive(inbox.post)
    bus.subscribe(GRANTED, inbox.post, host=name)
    bus.subscribe(WORD, inbox.post, host=name)
    bus.ask(KNOWN, _question(name, grid), inbox.post, tag="known", timeout_s=_WORDS_S)
    removal: Removal | None = None
    begun, due_ns = False, 0
    until_ns = clock.now_ns() + int(timeout_s * NS_PER_S)
    while (now_ns := clock.now_ns()) < until_ns:
        match inbox.take(_TICK_S):
            case Appeared(peer) if peer.id == name:
                raise ConfigError(f"{name} is alive: end its program, or use `swarm order vehicle remove`")
            case Replied(message=Known() as heard):
                for known in answers.hear(heard):
                    if name in known.agents:
                        raise ConfigError(
                            f"{name} is an agent of the scenario, not an external vehicle: start it again instead"
                        )
                    if removal is None or (not begun and known.shard_cells > removal.host.shards.side):
                        shards = Shards(grid, known.agents, known.shard_cells, proven=bus.proves_names)
                        removal = Removal(shards, name)
                    if known.shard_cells == removal.host.shards.side:
                        removal.hear_known(known)
            case AskEnded() if removal is not None and not begun and removal.host.informed:
                if not removal.known:
                    raise ConfigError(f"no agent knows an external vehicle {name!r}")
                removal.begin(secrets.randbits(32))
                begun = True
            case AskEnded() if not begun:
                answers.end_query()
                bus.ask(KNOWN, _question(name, grid), inbox.post, tag="known", timeout_s=_WORDS_S)
            case Heard(message=(Granted() | Word()) as granted) if removal is not None:
                removal.host.hear_granted(granted, now_ns)
            case _:
                pass
        if removal is not None and begun and now_ns >= due_ns:
            due_ns = now_ns + int(_TICK_S * NS_PER_S)
            for statement in removal.tick(now_ns):
                for member in statement.members:
                    bus.publish(HOST_STATE, statement.state, shard=statement.state.shard, member=member, agent=name)
            if removal.done:
                return True
    return False
