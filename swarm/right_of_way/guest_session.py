"""Right of way for a program of one's own: a thread that keeps it, and calls that may be made from any other."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from types import TracebackType

from swarm.bus.bus import Bus
from swarm.clock import NS_PER_S, Clock, MonotonicClock
from swarm.errors import BusError
from swarm.grid import GridSpec
from swarm.right_of_way.guest_service import GuestService
from swarm.right_of_way.life_file import Lives
from swarm.runtime.inbox import Inbox

log = logging.getLogger(__name__)

_TICK_S = 0.1
_LEAVE_S = 3.0


class GuestSession:
    """Right of way of one vehicle: which cells of the map it may stand on and enter.

    >>> with GuestSession("rover", grid, bus, LifeFile(path)) as rover:  # doctest: +SKIP
    ...     rover.enter(cell)
    ...     rover.want([cell, *route])
    ...     if rover.may_enter(route[0], timeout_s=10.0):
    ...         drive()
    ...         rover.left(cell)

    The vehicle drives into a cell only while `may_enter` of it is true, and says which it has left. At its end the
    session leaves; a program that dies leaves its cells shut, until the next one of the same name and file enters,
    or an operator says that the vehicle is gone (`swarm vehicle gone`).

    name   of the vehicle, unlike all agents of the scenario
    grid   of the run's map
    bus    opened with the run's secret, or with the vehicle's certificate, `rover.GROUP.NAME`
    lives  the vehicle's file; closed with this session, as the bus is
    """

    def __init__(self, name: str, grid: GridSpec, bus: Bus, lives: Lives, clock: Clock | None = None) -> None:
        self._clock = clock or MonotonicClock()
        self._inbox = Inbox()
        self._changed = threading.Condition(threading.RLock())
        """Guards the service; notified whenever it may have come to hold other cells."""
        self._closed = threading.Event()
        self._bus = bus
        self._lives = lives
        self._failure: BaseException | None = None
        self.warnings: list[str] = []
        """Sentences about why it waits, or what cannot be true."""
        incarnation = self._clock.now_ns()
        self._service = GuestService(name, grid, incarnation, lives, bus, self._inbox.post, self._warn)
        self._service.start(self._clock.now_ns())
        self._thread = threading.Thread(target=self._run, name=f"guest-{name}", daemon=True)
        self._thread.start()

    def __enter__(self) -> GuestSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- what the driver asks and says ----------------------------------------------------------------------

    @property
    def cells(self) -> tuple[int, ...]:
        """The cells that it may stand on and enter, in driving order, its own first. They grow by themselves, and
        shrink by `want`, `left` and `leave` only; all are lost at once when another process takes the name."""
        with self._changed:
            guest = self._service.guest
            return () if guest is None else guest.cells

    @property
    def replaced(self) -> bool:
        """Whether another process has taken the name: this vehicle must stand still, and its cells stay shut."""
        with self._changed:
            guest = self._service.guest
            return guest is not None and guest.replaced

    def enter(self, cell: int, timeout_s: float | None = None) -> bool:
        """Ask for the cell where the vehicle stands. Returns whether it is granted within `timeout_s`; None asks
        without waiting. It stays asked for: call again to ask for another one.

        Raises ValueError for a cell outside the map, or if it has entered already.
        """
        with self._changed:
            self._service.enter(cell, self._clock.now_ns())
        return self._wait(lambda: bool(self.cells), timeout_s)

    def want(self, path: Sequence[int], aside: Sequence[int] = ()) -> None:
        """Say where it would go: the cell on which it stands first, each next to the one before. Cells that it
        holds and that are not the beginning of this path are given back.

        aside  neighbours to which it would go, too, to let others pass; `cells` then names one instead

        Raises ValueError if it has not entered, or the path begins elsewhere or leaps.
        """
        with self._changed:
            guest = self._service.guest
            if guest is None:
                raise ValueError("it has not entered: no agent of the run has answered yet")
            guest.want(path, aside)
            self._service.tell(self._clock.now_ns())

    def may_enter(self, cell: int, timeout_s: float | None = None) -> bool:
        """Whether the vehicle may drive into a cell, after waiting for it for so long."""
        return self._wait(lambda: cell in self.cells, timeout_s)

    def left(self, cell: int) -> None:
        """It has left a cell for the next of `cells`. Raises ValueError if it holds none after it."""
        with self._changed:
            guest = self._service.guest
            if guest is None:
                raise ValueError("it has not entered")
            guest.left(cell)
            self._service.tell(self._clock.now_ns())

    def leave(self, timeout_s: float | None = _LEAVE_S) -> bool:
        """The vehicle stands on no cell any more. Returns whether that is known where it counts, so that others may
        drive there."""
        with self._changed:
            self._service.leave(self._clock.now_ns())
        return self._wait(lambda: self._service.guest is None or self._service.guest.gone, timeout_s)

    def close(self) -> None:
        """Leave, and end the session."""
        if not self._closed.is_set():
            self.leave()
            with self._changed:
                self._closed.set()
                self._service.stop()
            self._inbox.close()
            self._thread.join(2 * _TICK_S + 1.0)
            self._bus.close()
            self._lives.close()

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
                        self._service.handle(event, now_ns)
                    if now_ns >= due_ns:
                        due_ns = now_ns + int(_TICK_S * NS_PER_S)
                        self._service.tick(now_ns)
                    self._changed.notify_all()
        except BaseException as error:
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _warn(self, text: str) -> None:
        log.warning(text)
        self.warnings.append(text)
