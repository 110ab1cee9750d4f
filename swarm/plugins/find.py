"""From a name in the scenario to the code that it names, with its options checked.

A plug-in is called with its world and its options, and returns an object with the method of its kind's `Protocol`:
usually it is a class. An object that has the method already is used as it is. If the plug-in has an attribute
`Options`, a msgspec Struct, the table of the scenario becomes one of these. A key, type or value
that does not fit is refused. Otherwise the plug-in gets the table as it is.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import msgspec

from swarm.config.explain import converted, nearest
from swarm.config.input_files import quoted
from swarm.config.plugin_names import NamedPlugin, check_name, plugins_of
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError
from swarm.plugins.guard import Hangs, call_within, error_text

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
    check_name(named, "scenario")
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
        raise ConfigError(f"{key} of {named.name}: unknown key {unknown}{hint}; allowed here: {', '.join(allowed)}")
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
