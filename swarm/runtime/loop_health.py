"""The health of a process, as its own loop tells it at each tick: to other threads and processes, and to systemd.

The loop writes into a small piece of memory (`Board`) without waiting; readers take no lock that it holds. A
process that is stopped or whose loop hangs can therefore still be read: its last record ages.

A supervisor such as systemd gets the datagrams of sd_notify(3) on the Unix socket that `NOTIFY_SOCKET` names. None
may hold the loop up, so one for which there is no space is not sent; what matters is said again.

The first use of a module or kernel in the loop, where all others wait for it, is counted and logged, in tests an
error. Modules and kernels that a role can ever need are loaded before its loop or beside it, on another thread.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import IntEnum
from importlib import import_module
from importlib.machinery import ModuleSpec
from typing import Any, NamedTuple
from zlib import crc32

import msgspec

from swarm.clock import NS_PER_S
from swarm.runtime.stats import FIRST_USES, Counters

log = logging.getLogger(__name__)

refused = False
"""True in tests: a first use in a loop is an error."""
_this = threading.local()
"""`counters` of the service whose loop this thread runs; None in a simulation. Unset on other threads."""


class FirstUseError(AssertionError):
    """The loop of a process loads something."""


@contextmanager
def in_loop(counters: Counters | None) -> Iterator[None]:
    """Marks this thread as the loop of a process.

    counters  of its service; None in a simulation, whose counts must not depend on what is loaded already
    """
    if _watch not in sys.meta_path:
        sys.meta_path.insert(0, _watch)  # asked about each module that is not loaded
    _this.counters = counters
    try:
        yield
    finally:
        del _this.counters


class Modules:
    """Modules that a role may need, loaded on a thread beside its loop, once it asks for them."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._thread: threading.Thread | None = None

    def there(self) -> bool:
        """Returns True if they are loaded; the first call begins that."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._load, name="load-modules", daemon=True)
            self._thread.start()
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Waits for them: before the loop, or in a simulation. Raises what a module raises."""
        if not self.there() and self._thread is not None:
            self._thread.join()
        self._load()

    def _load(self) -> None:
        for name in self._names:
            import_module(name)


def note(what: str) -> None:
    """Records that the calling thread loads something now."""
    if not hasattr(_this, "counters"):
        return
    if refused:
        raise FirstUseError(f"{what} is loaded in the loop of a process")
    if _this.counters is not None:
        _this.counters.count(FIRST_USES)
        log.warning("%s is loaded in the loop of this process, which waits for it", what)


class _Watch:
    """A finder of modules that finds none."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        note(f"module {name}")
        return None


_watch = _Watch()

_LONGEST_STATUS = 200
"""Characters of a status. `systemctl status` shows one line."""
_PINGS_PER_LIMIT = 4
"""A ping may come late, or be lost, twice."""


class Supervisor:
    """Tells a supervisor (systemd) when the process is up, that its loop turns, and what it does.

    address    of the socket: a path, or `@name` in the abstract namespace; None: there is no supervisor
    limit_ns   after this time without a ping the supervisor takes the process for hung; None: it does not watch
    """

    def __init__(self, address: str | None, limit_ns: int | None = None) -> None:
        self._address = address
        self._every_ns = None if limit_ns is None else limit_ns // _PINGS_PER_LIMIT
        self._due_ns = 0
        self._sent_ready = False
        self._status: str | None = None
        """Content of the next datagram; None: nothing new."""
        self._socket = None if address is None else _opened()

    def says(self, what: str) -> None:
        """Publishes the current activity of the process, in a line for people (`systemctl status`)."""
        self._status = "".join(each if each.isprintable() else " " for each in what)[:_LONGEST_STATUS]
        self._send([])

    def on_turn(self, now_ns: int) -> None:
        """The loop has turned: at the first time the process is up, at later ones it is still alive."""
        words = [] if self._sent_ready else ["READY=1"]
        if self._every_ns is not None and now_ns >= self._due_ns:
            words.append("WATCHDOG=1")
        if words and self._send(words):
            self._sent_ready = True
            self._due_ns = now_ns + (self._every_ns or 0)

    def ends(self) -> None:
        self._send(["STOPPING=1"])

    def _send(self, words: list[str]) -> bool:
        """Returns True if it has arrived."""
        if self._socket is None or self._address is None:
            return True
        lines = [*words, *([] if self._status is None else [f"STATUS={self._status}"])]
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        try:
            self._socket.sendto("\n".join(lines).encode(), address)
        except OSError as error:
            log.debug("NOTIFY_SOCKET %s: %s", self._address, error)
            return False
        self._status = None
        return True


def supervisor_of(environment: Mapping[str, str]) -> Supervisor:
    """Returns the supervisor that an environment names; a null one if it names none."""
    address = environment.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return Supervisor(None)
    pid, limit_us = environment.get("WATCHDOG_PID", ""), environment.get("WATCHDOG_USEC", "")
    meant = pid in ("", str(os.getpid()))
    return Supervisor(address, int(limit_us) * 1000 if meant and limit_us.isdecimal() and int(limit_us) else None)


def _opened() -> socket.socket:
    opened = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
    opened.setblocking(False)
    return opened


HUNG_S, HUNG_PERIODS = 10.0, 20
"""A loop that has not ticked for this time hangs: longer than a busy machine keeps a process from its tick."""
SLOT_BYTES = 1024
"""Bytes of one record: a head of 23 and the missing needs, some ten of `_LONGEST_NEED` characters at most."""
BOARD_BYTES = 2 * SLOT_BYTES
_HEAD = struct.Struct("<IQQBH")
"""Checksum of the rest, time of writing, `limit_ns`, phase, length of the record that follows."""
_CHECKED = 4
"""Bytes of the checksum itself, which it does not cover."""
_WRITE_NS = NS_PER_S // 10
"""Least time between two records without news: a hundredth of `HUNG_S`, by which readers judge."""
_LONGEST_NEED = 100
"""Characters of one need: a line in a terminal."""
GENERATION_BEFORE = "the end of the generation before it"
"""Need of a process that was started to follow one which still runs."""


class Phase(IntEnum):
    """STARTS until the loop turns, which may take as long as its router is not there; ENDS once it is asked to."""

    STARTS = 0
    RUNS = 1
    ENDS = 2


class Vitals(NamedTuple):
    """Last health record of a process.

    stamp_ns  when, on the monotonic clock of the machine
    limit_ns  if older, its loop hangs
    lacks     what its role needs and is not there, one short text each; empty if it is ready
    """

    stamp_ns: int
    limit_ns: int
    phase: Phase
    lacks: tuple[str, ...]

    def hangs(self, now_ns: int) -> bool:
        """Returns True if its loop has not turned for too long. The loop of a process that starts or ends does not
        turn."""
        return self.phase is Phase.RUNS and now_ns - self.stamp_ns > self.limit_ns


class Board:
    """Memory of `BOARD_BYTES`, shared or not, into which one thread writes and which any other reads.

    Two slots with checksums, written in turn: a reader takes the newer of those that are whole, so a writer that is
    stopped or killed in the middle of one harms nothing.
    """

    def __init__(self, memory: Any = None) -> None:
        """`memory`: a bytearray, or an array of c_char; if not given, one of this process's own."""
        self._memory = bytearray(BOARD_BYTES) if memory is None else memory
        self._slot = 0

    def write(self, vitals: Vitals) -> None:
        """Called by one thread only."""
        lacks = [need[:_LONGEST_NEED] for need in vitals.lacks]
        while len(text := msgspec.json.encode(lacks)) > SLOT_BYTES - _HEAD.size:
            lacks.pop()
        record = _HEAD.pack(0, vitals.stamp_ns, vitals.limit_ns, vitals.phase, len(text)) + text
        at = self._slot * SLOT_BYTES
        self._memory[at : at + len(record)] = struct.pack("<I", crc32(record[_CHECKED:])) + record[_CHECKED:]
        self._slot = 1 - self._slot

    def read(self) -> Vitals | None:
        """Returns the last complete record; None if there is none. Any thread may call it, in any process
        which maps the memory."""
        found = [_record(bytes(self._memory[at : at + SLOT_BYTES])) for at in (0, SLOT_BYTES)]
        return max((each for each in found if each is not None), default=None)


def _record(slot: bytes) -> Vitals | None:
    checksum, stamp_ns, limit_ns, phase, length = _HEAD.unpack_from(slot)
    if not stamp_ns or crc32(slot[_CHECKED : _HEAD.size + length]) != checksum:
        return None
    lacks = msgspec.json.decode(slot[_HEAD.size : _HEAD.size + length], type=tuple[str, ...])
    return Vitals(stamp_ns, limit_ns, Phase(phase), lacks)


class Health:
    """Health reports of one process's loop: on a board, and to the supervisor that started it."""

    def __init__(self, board: Board | None = None, supervisor: Supervisor | None = None) -> None:
        self.board = board or Board()
        self._supervisor = supervisor or Supervisor(None)
        self._written = Vitals(0, 0, Phase.STARTS, ())
        self._limit_ns = 0
        self.starts("its start")

    def starts(self, what: str) -> None:
        """Reports that the process is still starting, before its loop."""
        self._write(Vitals(time.monotonic_ns(), 0, Phase.STARTS, (what,)))
        self._supervisor.says(what)

    def begins(self, tick_hz: float) -> None:
        """The loop ticks from now on, at this rate."""
        self._limit_ns = int(max(HUNG_S, HUNG_PERIODS / tick_hz) * NS_PER_S)

    def on_turn(self, lacks: Sequence[str]) -> None:
        """The loop has ticked. `lacks`: as in `Vitals`."""
        now_ns = time.monotonic_ns()
        vitals = Vitals(now_ns, self._limit_ns, Phase.RUNS, tuple(lacks))
        news = (vitals.phase, vitals.lacks) != (self._written.phase, self._written.lacks)
        if news or now_ns - self._written.stamp_ns >= _WRITE_NS:
            self._write(vitals)
        if news:
            self._supervisor.says(f"waits for {', '.join(lacks)}" if lacks else "ready")
        self._supervisor.on_turn(now_ns)

    def ends(self) -> None:
        """Reports that the loop has ended, and that the process ends next."""
        self._write(Vitals(time.monotonic_ns(), 0, Phase.ENDS, ("it ends",)))
        self._supervisor.ends()

    def _write(self, vitals: Vitals) -> None:
        self.board.write(vitals)
        self._written = vitals
