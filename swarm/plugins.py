"""Plug-ins: from a name in the scenario to the code that it names, and the guard through which it is called.

A plug-in is called with its world and its options, and returns an object with the method of its kind's `Protocol`:
usually it is a class. An object that has the method already is used as it is. If the plug-in has an attribute
`Options`, a msgspec Struct, the table of the scenario becomes one of these. A key, type or value
that does not fit is refused. Otherwise the plug-in gets the table as it is.

A plug-in that raises, hangs or returns what breaks its contract is out for the rest of the process's life: its
fault is said once, with its name, its kind and the place, and its caller does what `PluginKind.failing` says.
"""

from __future__ import annotations

import dataclasses
import faulthandler
import functools
import importlib
import importlib.util
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import msgspec

from swarm.config.explain import allowed_here, converted, nearest
from swarm.config.input_files import quoted
from swarm.config.plugin_names import NamedPlugin, check_name, plugins_of
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError, SwarmError

T = TypeVar("T")
OnFault = Callable[[str], None]
"""Takes a fault in one sentence."""


KILLED_BY = signal.SIGVTALRM
"""Signal that ends a process whose call cannot be interrupted."""
_KILL_FACTOR = 5
"""A call that exceeds its limit by this factor, or swallows this number of alarms, ends its process."""


class Hangs(BaseException):
    """A call has taken longer than it may. No `Exception`, so that code which catches those does not swallow it."""


def call_within(seconds: float, call: Callable[[], T]) -> T:
    """Returns the result of `call`. Raises `Hangs` in it after this time (s), and again at the same interval.

    An alarm of the operating system ends loops, sleeps and waits alike. It does not reach native code that never
    comes back to the interpreter, nor end a call that swallows it, as a bare `except` does. Once the first has used
    five times as much processor time, or the other has swallowed it five times, the process is killed, and the line
    that it hangs in is on its standard error. On another thread than the main one there is neither.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    _print_line_when_killed()
    before = signal.signal(signal.SIGALRM, _Alarm().ring)
    began_s = time.monotonic()
    left_s, every_s = signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
    signal.setitimer(signal.ITIMER_VIRTUAL, _KILL_FACTOR * seconds)
    try:
        try:
            return call()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    finally:
        # Again: the alarm may have come after the call, before it was put off.
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGALRM, before)
        if left_s:  # an alarm of another user, such as a test's
            signal.setitimer(signal.ITIMER_REAL, max(left_s - (time.monotonic() - began_s), 1e-3), every_s)


class _Alarm:
    """Rings for one call."""

    def __init__(self) -> None:
        self._rung = 0

    def ring(self, signum: int, frame: FrameType | None) -> None:
        self._rung += 1
        if self._rung >= _KILL_FACTOR:
            signal.raise_signal(KILLED_BY)
        raise Hangs


@functools.cache
def _print_line_when_killed() -> None:
    # Written by the signal's handler itself, which needs no interpreter; then the signal kills.
    faulthandler.register(KILLED_BY, file=2, all_threads=False, chain=True)


def error_text(error: BaseException) -> str:
    """An error of a plug-in in words, with the line that raised it."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = ""
    if trace is not None:
        where = f" ({Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno})"
    text = " ".join(str(error).split())
    return f"{type(error).__name__}{f': {text}' if text else ''}"[:200] + where


class Nonsense(SwarmError):  # noqa: N818
    """A result of a plug-in breaks its contract: the value found, and the value expected."""


class Guard:
    """The single place where one plug-in is called.

    report  takes its fault
    works   false once it has failed: then it is not called any more
    """

    def __init__(self, plugin: Plugin, report: OnFault) -> None:
        self.works = True
        self._plugin = plugin
        self._report = report

    def ask(self, call: Callable[[], object], check: Callable[[object], T], otherwise: Callable[[], T]) -> T:
        """Returns the result of `call` after `check`, or of `otherwise` if the plug-in fails or has failed.

        check  raises `Nonsense` on what breaks the contract; what else it raises counts as the plug-in's fault, too
        """
        if not self.works:
            return otherwise()
        kind = self._plugin.named.kind
        try:
            return check(call_within(kind.call_s, call))
        except Nonsense as nonsense:
            self._fail(f"returned {nonsense}")
        except Hangs:
            self._fail(f"took more than {kind.call_s:g} s")
        except (Exception, SystemExit) as error:
            self._fail(f"raised {error_text(error)}")
        return otherwise()

    def _fail(self, what: str) -> None:
        self.works = False
        kind = self._plugin.named.kind
        self._report(f"{self._plugin} of {self._plugin.named.key}: {kind.method} {what}; {kind.failing}")


Factory = Callable[[Any, Any], Any]
"""(world, options) -> the object with the method."""
START_S = 60.0
"""Importing a plug-in and making one takes longer if it hangs."""


@dataclasses.dataclass(frozen=True, slots=True)
class Plugin:
    """A plug-in that was found, and its options.

    factory  None if the name is one of the kind's own table, which its owner keeps
    """

    named: NamedPlugin
    factory: Factory | None
    options: Any

    def __str__(self) -> str:
        return f"{self.named.kind.name} plug-in {self.named.name!r}"

    def make(self, world: object) -> Any:
        """Makes the object of an external plug-in. Raises ConfigError if that raises, hangs or lacks the method of
        its kind."""
        assert self.factory is not None
        factory = self.factory
        made = _started(self.named, "could not be made", lambda: factory(world, self.options))
        if not callable(getattr(made, self.named.kind.method, None)):
            found = type(made).__name__
            raise ConfigError(f"{self.named.key}: {self} has no method {self.named.kind.method}, found {found}")
        return made


def find_plugin(named: NamedPlugin, folder: str) -> Plugin:
    """Imports the plug-in that a scenario names, and checks its options. Raises ConfigError with the key, the value
    found and the value expected.

    folder  where modules lie that are not installed
    """
    kind, name = named.kind, named.name
    if name in kind.built_in:
        if named.options:
            raise ConfigError(f"{named.key}: {name!r} takes no options, found {quoted(dict(named.options))}")
        return Plugin(named, None, None)
    found = _imported(named, folder)
    return Plugin(named, found, _options(named, getattr(found, "Options", None)))


def check_plugins(scenario: Scenario, roles: Collection[str]) -> None:
    """Finds every plug-in that these roles call, so that a fault is said once, before processes start."""
    for named in plugins_of(scenario):
        if named.kind.role in roles:
            find_plugin(named, scenario.plugin_folder)


def source_of(named: NamedPlugin, folder: str) -> bytes:
    """The text of the module that a name stands for, without running it; empty where there is none to be found."""
    try:
        _reach(folder)
        spec = importlib.util.find_spec(named.name.partition(":")[0])
        return Path(spec.origin).read_bytes() if spec is not None and spec.origin is not None else b""
    except (ImportError, ValueError, AttributeError, OSError):
        return b""


def _reach(folder: str) -> None:
    """Makes modules of this folder be imported."""
    if folder not in sys.path:
        sys.path.append(folder)  # last: it hides nothing that is installed
        importlib.invalidate_caches()


def _imported(named: NamedPlugin, folder: str) -> Factory:
    kind, name = named.kind, named.name
    check_name(named)
    module, _, attribute = name.partition(":")
    _reach(folder)
    found: object = _started(named, "could not be imported", lambda: importlib.import_module(module))
    for part in attribute.split("."):
        if not hasattr(found, part):
            known = [each for each in vars(found) if not each.startswith("_")]
            where = getattr(found, "__file__", None) or module
            raise ConfigError(f"{named.key}: {name!r}: no {part!r} in {where}{nearest(part, known)}")
        found = getattr(found, part)
    if not isinstance(found, type) and callable(getattr(found, kind.method, None)):
        return lambda world, options: found  # it is made already
    if not callable(found):
        raise ConfigError(f"{named.key}: {name!r} is {quoted(found)}; expected a class or a function")
    return found


def _options(named: NamedPlugin, wanted: Any) -> Any:
    if wanted is None:
        return dict(named.options)
    key = f"{named.key.rpartition('.')[0]}.options" if named.kind.name == "cost_layer" else f"{named.key}_options"
    if not (isinstance(wanted, type) and issubclass(wanted, msgspec.Struct)):
        raise ConfigError(f"{named.key}: Options of {named.name!r} is no msgspec Struct")
    options = converted(dict(named.options), wanted, f"{key} of {named.name}")
    allowed = [field.encode_name for field in msgspec.structs.fields(wanted)]
    for unknown in named.options.keys() - set(allowed):  # a struct that does not forbid them
        hint = nearest(unknown, allowed)
        raise ConfigError(f"{key} of {named.name}: unknown key {unknown}{hint}{allowed_here(allowed, hint)}")
    return options


def _started(named: NamedPlugin, what: str, call: Callable[[], Any]) -> Any:
    """Returns the result of a call that imports or makes a plug-in. Raises ConfigError where it fails."""
    try:
        return call_within(START_S, call)
    except ConfigError:
        raise
    except Hangs:
        raise ConfigError(f"{named.key}: {named.name!r} {what} within {START_S:g} s") from None
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{named.key}: {named.name!r} {what}: {error_text(error)}") from error


def named_plugin(scenario: Scenario, key: str) -> Plugin:
    """The plug-in that a key of a scenario names, such as ``vehicles.sensor``."""
    named = next(each for each in plugins_of(scenario) if each.key == key)
    return find_plugin(named, scenario.plugin_folder)
