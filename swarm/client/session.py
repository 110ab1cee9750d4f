"""A connection to a running swarm: what vehicles, targets and observers of a program share, and its streams."""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any, Generic, Protocol, TypeVar

from swarm.bus.bus import AskEnded, Bus, Event, LinkChanged, Post, Replied
from swarm.client.route import Route
from swarm.client.terrain_frame import Frame
from swarm.clock import NS_PER_S, Clock
from swarm.config.explain import choice
from swarm.errors import BusError, ConfigError, NoAnswerError, ProtocolError, RunMismatchError, SwarmError
from swarm.grid import brief, real, whole
from swarm.wire.codec import M, decode, encode
from swarm.wire.fields import check_id
from swarm.wire.messages import Message, Nothing
from swarm.wire.messages.planning import RouteReply, RouteRequest
from swarm.wire.messages.processes import RunInfo
from swarm.wire.topics import NAMELESS_ROUTE, ROUTE, RUN, Topic, asker_of

log = logging.getLogger(__name__)

TICK_S = 0.05
"""Time between two ticks: a tenth of that between two reports of a vehicle with the usual lease."""
_RUN_TIMEOUT_S = 2.0
"""Longest wait for the answer to which run is in the namespace."""
_COMPARE_AGAIN_NS = 2 * NS_PER_S
"""Time until that query is repeated if no process has replied."""
_REPORT_AGAIN_NS = 60 * NS_PER_S
"""Time until the same problem is reported again: once a minute, as in logs of the bus."""
_SAME_CLOCK_NS = NS_PER_S
"""Clocks that differ by less are not corrected: an answer is as old as a tick."""
_MOST_REPORTED = 1024
"""Problems that are remembered, to report each once. Beyond this number all are forgotten; then some are reported
twice."""


C = TypeVar("C", bound=Callable[..., Any])


class Part(Protocol):
    """A vehicle, a target or an observer, on its swarm's thread and under its lock."""

    def on_event(self, event: Event, now_ns: int) -> None: ...
    def tick(self, now_ns: int) -> None: ...
    def leave(self) -> None: ...


class Session:
    """The state behind `Swarm`: calls from any thread on one side, events of the bus on the other.

    `handle` and `tick` are called by one thread, which also calls the callbacks, outside of the lock.

    frame   the terrain
    run     what a process of the run said of it
    counts  rejected, lost and reported messages since the connection began
    ahead_ns  by how much the swarm's clocks are ahead of ours; what we stamp is corrected by it
    """

    def __init__(self, bus: Bus, run: RunInfo, clock: Clock, post: Post | None = None, ahead_ns: int = 0) -> None:
        self.bus = bus
        self.trust: Callable[[], None] = lambda: None
        """Gives the bus the secret of the run, so that marks and orders count."""
        self.run = run
        self.frame = Frame.of(run)
        self.counts: Counter[str] = Counter()
        self.lock = threading.RLock()
        """Held while anything below, or a part, is read or changed."""
        self.post: Post = post if post is not None else self.on_session_event
        self.connected = True
        """True if the link to the router is up, as far as is known."""
        self.ended: SwarmError | None = None
        """Reason why nothing can be said any more: closed, or the run is another one."""
        self._clock = clock
        self._ahead_ns = ahead_ns if abs(ahead_ns) > _SAME_CLOCK_NS else 0
        self._parts: list[Part] = []
        self._asked: dict[str, tuple[Future[list[Any]], list[Any]]] = {}
        """Tag -> the caller that waits for replies, and the replies received."""
        self._tags = itertools.count(1)
        self._compare_due_ns: int | None = None
        """Time of the next query for the namespace's run, if no process has replied since the link is back."""
        self._later: list[Callable[[], None]] = []
        """Callbacks to call once the lock is free."""
        self._reported_ns: dict[str, int] = {}
        """Problem -> time of its last report."""
        self._on_problem: list[Callable[[str], None]] = []
        self._owner: int | None = None
        """The thread that calls `handle` and `tick`."""
        bus.watch_links(self.post)

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def swarm_now_ns(self) -> int:
        """The time by the swarm's clocks, which marks are stamped with: of two about a cell the later counts."""
        return max(self.now_ns() + self._ahead_ns, 0)

    # --- for parts ----------------------------------------------------------------------------------------------

    def add(self, part: Part) -> None:
        with self.lock:
            self.check_open()
            id = getattr(part, "id", None)
            if id is not None and any(type(each) is type(part) and each.id == id for each in self._parts):  # type: ignore[attr-defined]
                raise self.refused(f"{type(part).__name__.lower()} {id} is in use in this program already")
            self._parts.append(part)

    def remove(self, part: Part) -> None:
        with self.lock:
            self._parts = [each for each in self._parts if each is not part]

    def check_open(self) -> None:
        """Raises the reason if the session has ended."""
        if self.ended is not None:
            raise self.ended

    def publish(self, topic: Topic, message: M, **fields: str | int) -> M:
        """Puts a message that follows the rules of its type. Raises ConfigError, and counts it, if it does not."""
        self.check_open()
        try:
            checked = decode(encode(message), type(message))
        except ProtocolError as error:
            raise self.refused(str(error)) from error
        self.bus.publish(topic, checked, **fields)
        return checked

    def refused(self, sentence: str) -> ConfigError:
        """The error of a value that was not sent, counted."""
        self.counts["refused"] += 1
        return ConfigError(sentence)

    def number(
        self, name: str, value: Any, least: float = -math.inf, most: float = math.inf, *, more: bool = False
    ) -> float:
        """A number that a program gives. Raises ConfigError, and counts it, on anything else or beyond its bounds.

        more  the value must exceed `least`
        """
        try:
            return real(name, value, least, most, more=more)
        except ConfigError as error:
            raise self.refused(str(error)) from None

    def check_ids(self, **ids: str) -> None:
        """Raises ConfigError, and counts it, where one of these is no id."""
        for name, id in ids.items():
            try:
                check_id(name, id)
            except ValueError as error:
                raise self.refused(str(error)) from error

    def class_number(self, name: str, argument: str) -> int:
        """The number of one of the scenario's classes, by which marks name it. Raises ConfigError, and counts it,
        if there is no such class."""
        self.check_ids(**{argument: name})
        classes = self.run.classes
        if name not in classes:
            known = f"there are {', '.join(classes)}" if classes else "the scenario has no [[classes]]"
            raise self.refused(f"{argument}: there is no class {name!r} beside that of [cost]; {known}")
        return classes.index(name) + 1

    def ask(self, topic: Topic, request: Message, timeout_s: float, **fields: str) -> Future[list[Any]]:
        """Sends a query. Returns a future of all replies, which fails with BusError after `timeout_s` (s)."""
        timeout_s = self.number("timeout_s", timeout_s, 0, 1e9)
        self.check_open()
        waiting: Future[list[Any]] = Future()
        with self.lock:
            tag = f"client-{next(self._tags)}"
            self._asked[tag] = (waiting, [])
        self.bus.ask(topic, request, self.post, tag=tag, timeout_s=timeout_s, **fields)
        return waiting

    def ask_route(
        self, target: str, cell: int, vehicle_class: str, timeout_s: float, vehicle: str | None = None
    ) -> Future[Route]:
        """The best route of a class of vehicles from a cell. Its failure is a BusError.

        vehicle  id of the vehicle which asks; without one the question shares the turn of nameless askers

        Raises ConfigError if the target's id is none.
        """
        self.check_ids(target=target, vehicle_class=vehicle_class)
        request = RouteRequest(cells=[cell], vehicle_class=str(vehicle_class))
        found: Future[Route] = Future()

        def finish(done: Future[list[Any]]) -> None:
            if not found.set_running_or_notify_cancel():
                return  # its asker has given up
            try:
                reply: RouteReply = done.result()[0]
                found.set_result(Route.of(self.frame, reply.routes[0], reply))
            except (ValueError, IndexError) as error:
                found.set_exception(BusError(f"the planner of {target!r} answers nonsense: {error}"))
            except SwarmError as error:
                known = [name.removeprefix("planner-") for name in self.run.crew if name.startswith("planner-")]
                there = "" if target in known else choice(target, known, " the scenario has ")
                found.set_exception(BusError(f"no route to {target!r}: {error}{there}"))

        topic, asker = (NAMELESS_ROUTE, {}) if vehicle is None else (ROUTE, {"asker": asker_of("rover", vehicle)})
        self.ask(topic, request, timeout_s, target=target, **asker).add_done_callback(finish)
        return found

    def answers(self, waiting: Future[Any], timeout_s: float) -> Any:
        """Waits for the replies to a query. Raises BusError; ConfigError if called on the thread that delivers
        replies."""
        if threading.get_ident() == self._owner:
            raise ConfigError("a callback must not wait for an answer: ask from another thread, or follow a target")
        try:
            return waiting.result(timeout_s + 2.0)
        except TimeoutError as error:
            raise BusError(f"no answer within {timeout_s:g} s") from error

    def call(self, callback: Callable[[], None]) -> None:
        """Calls something of the program's once the lock is free."""
        self._later.append(callback)

    def on_problem(self, callback: Callable[[str], None]) -> None:
        self._on_problem.append(self.checked_call(callback))

    def checked_call(self, callback: C) -> C:
        """A function to be called. Raises ConfigError, and counts it, on anything else."""
        if not callable(callback):
            raise self.refused(f"callback is {brief(callback)}, expected a function")
        return callback

    def problem(self, kind: str, sentence: str) -> None:
        """Counts a problem, and reports it in the log and to callbacks, once a minute."""
        self.counts[kind] += 1
        now_ns = self.now_ns()
        if now_ns - self._reported_ns.get(sentence, -_REPORT_AGAIN_NS) < _REPORT_AGAIN_NS:
            return
        if len(self._reported_ns) >= _MOST_REPORTED:
            self._reported_ns.clear()
        self._reported_ns[sentence] = now_ns
        log.warning("%s", sentence)
        for callback in self._on_problem:
            self.call(lambda callback=callback: callback(sentence))  # type: ignore[misc]

    # --- events -------------------------------------------------------------------------------------------------

    def on_session_event(self, event: Event) -> None:
        now_ns = self.now_ns()
        with self.lock:
            self._owner = threading.get_ident()
            match event:
                case Replied(tag=tag, message=message) if tag in self._asked:
                    self._asked[tag][1].append(message)
                case AskEnded(tag=tag, replies=replies, failure=failure) if tag in self._asked:
                    waiting, found = self._asked.pop(tag)
                    if replies:
                        self.call(lambda: waiting.set_result(found))
                    elif failure and failure != "timeout":
                        self.call(lambda: waiting.set_exception(BusError(f"no answer: {failure}")))
                    else:
                        self.call(lambda: waiting.set_exception(NoAnswerError("no process answers")))
                case _:
                    if isinstance(event, LinkChanged):
                        self.connected = event.up
                        if event.up:
                            self._compare_run()
                    for part in self._parts:
                        part.on_event(event, now_ns)
        self._call_later()

    def tick(self) -> None:
        now_ns = self.now_ns()
        with self.lock:
            self._owner = threading.get_ident()
            if self.ended is None:
                if self._compare_due_ns is not None and now_ns >= self._compare_due_ns:
                    self._compare_due_ns = None
                    self._compare_run()
                for part in self._parts:
                    part.tick(now_ns)
        self._call_later()

    def close(self) -> None:
        """Withdraws all reports, and closes the session."""
        with self.lock:
            for part in list(self._parts):
                part.leave()
            self.ended = self.ended or BusError("the connection to the swarm is closed")
            waiting, self._asked = list(self._asked.values()), {}
        for future, _ in waiting:
            future.set_exception(self.ended)
        self.bus.close()

    def _compare_run(self) -> None:
        """After a cut the namespace may hold another run, in which our cells mean other places. Routers may be back
        long before a process of a run is."""
        asked = self.ask(RUN, Nothing(), _RUN_TIMEOUT_S)

        def compare(done: Future[list[Any]]) -> None:
            runs = [] if done.exception() else [each for each in done.result() if each.run_id]
            if not runs:
                self._compare_due_ns = self.now_ns() + _COMPARE_AGAIN_NS
                return
            if any(each.run_id == self.run.run_id for each in runs):
                return
            with self.lock:
                self.ended = RunMismatchError(
                    f"run {self.run.run_id} is over, and run {runs[0].run_id} is in its namespace: connect again"
                )
                log.warning("%s", self.ended)

        asked.add_done_callback(compare)

    def _call_later(self) -> None:
        while self._later:
            with self.lock:
                callbacks, self._later = self._later, []
            for callback in callbacks:
                try:
                    callback()
                except Exception:
                    self.counts["callbacks_failed"] += 1
                    log.exception("a callback failed; the connection goes on")


class SwarmThread:
    """The one thread on which a live session's events and ticks are handled."""

    def __init__(self, session: Session, take: Callable[[float], Event | None]) -> None:
        self._session = session
        self._take = take
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="swarm-client", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        due_s = 0.0
        while not self._ended.is_set():
            event = self._take(max(0.0, due_s - time.monotonic()))
            if event is not None:
                self._session.on_session_event(event)
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + TICK_S
                self._session.tick()

    def end(self) -> None:
        self._ended.set()
        if self._thread is not threading.current_thread():
            self._thread.join(2.0)


T = TypeVar("T")
MOST_WAITING = 1024
"""Values that wait to be read; the oldest are dropped first."""


class Stream(Generic[T]):
    """Values in the order of their arrival. One reader takes each value; a slow one misses the oldest.

    It ends when it is closed, or the connection is: loops over it end then.
    """

    def __init__(self, most: int = MOST_WAITING) -> None:
        self._waiting: deque[T] = deque(maxlen=whole("most", most))
        self._changed = threading.Condition()
        self.closed = False
        self.newest: T | None = None
        """The value that came last, whether it was read or not; None before the first."""

    def put(self, value: T) -> None:
        """Adds a value, from any thread. Dropped once the stream is closed."""
        with self._changed:
            if not self.closed:
                self._waiting.append(value)
                self.newest = value
            self._changed.notify_all()

    def close(self) -> None:
        """Ends it: readers receive the remaining items, and then stop."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def next(self, timeout_s: float | None = None) -> T | None:
        """The next value; None if there is none within the timeout, or it has ended."""
        if timeout_s is not None:
            timeout_s = real("timeout_s", timeout_s, -1e9, 1e9)
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self.closed, timeout_s)
            return self._waiting.popleft() if self._waiting else None

    def __iter__(self) -> Iterator[T]:
        while (value := self.next()) is not None:
            yield value
