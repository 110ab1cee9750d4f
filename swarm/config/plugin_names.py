"""The kinds of plug-ins, and the names under which a scenario may call one.

A name is one of the kind's own table, or `module:Name`. Only a scenario names a plug-in: it is the user's own file,
and what it names is run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

from swarm.config.explain import nearest
from swarm.config.input_files import quoted
from swarm.config.scenario import Assigner, Dynamics, Scenario, Sensor, Strategy, TargetConfig, VehicleConfig, Walk
from swarm.errors import ConfigError


@dataclass(frozen=True, slots=True)
class PluginKind:
    """Kind of a plug-in: its name, and the consequence for a process whose plug-in fails.

    name      in messages
    role      the role that calls it; every role builds the map, if it is not prepared
    built_in  names of the kind's own table
    method    what a plug-in is asked for, as its `Protocol` names it
    failing   what the process does without it, as the end of a sentence
    call_s    a call that takes longer hangs, and is broken off
    """

    name: str
    role: str
    built_in: tuple[str, ...]
    method: str
    failing: str
    call_s: float = 2.0


_KINDS = (
    PluginKind(
        "sensor", "agent", get_args(Sensor), "look", "this agent's vehicles see only the cells next to them now"
    ),
    PluginKind("walk", "targets", get_args(Walk), "choose", "the target stays at rest now"),
    PluginKind("cost_layer", "any", (), "cost", "there is no map without it", call_s=300.0),
    PluginKind("assignment", "agent", get_args(Assigner), "assign", "this agent spreads its vehicles evenly now"),
    PluginKind("strategy", "planner", get_args(Strategy), "row", "this planner keeps exact trees now"),
    PluginKind(
        "dynamics", "agent", get_args(Dynamics), "speed", "this agent's vehicles drive as the ground allows now"
    ),
)
PLUGIN_KINDS: Mapping[str, PluginKind] = {kind.name: kind for kind in _KINDS}
"""Every kind of plug-in, by its name."""


@dataclass(frozen=True, slots=True)
class NamedPlugin:
    """One place of a scenario that names a plug-in: the key, what it names, and the options that it gives."""

    kind: PluginKind
    key: str
    name: str
    options: Mapping[str, object]


def plugins_of(scenario: Scenario) -> list[NamedPlugin]:
    """Every place of a scenario that may name a plug-in, those that name a built-in one included."""
    vehicles, planner = scenario.vehicles, scenario.planner
    sensor, assignment = PLUGIN_KINDS["sensor"], PLUGIN_KINDS["assignment"]
    dynamics, strategy = PLUGIN_KINDS["dynamics"], PLUGIN_KINDS["strategy"]
    return [
        NamedPlugin(sensor, "vehicles.sensor", vehicles.sensor, vehicles.sensor_options),
        NamedPlugin(assignment, "vehicles.assignment", vehicles.assignment, vehicles.assignment_options),
        *(
            _assignment_named_by(group.assignment, f"groups[{n}].assignment", vehicles)
            for n, group in enumerate(scenario.groups)
            if group.assignment is not None
        ),
        NamedPlugin(dynamics, "vehicles.dynamics", vehicles.dynamics, vehicles.dynamics_options),
        NamedPlugin(strategy, "planner.strategy", planner.strategy, planner.strategy_options),
        *(walk_named_by(target, f"targets[{n}].walk") for n, target in enumerate(scenario.targets)),
        *cost_layers_of(scenario),
    ]


def assignment_key(scenario: Scenario, group: str) -> str:
    """The key that says which assigner a group has: its own, or that of all vehicles."""
    own = next((n for n, each in enumerate(scenario.groups) if each.name == group and each.assignment), None)
    return "vehicles.assignment" if own is None else f"groups[{own}].assignment"


def _assignment_named_by(name: str, key: str, vehicles: VehicleConfig) -> NamedPlugin:
    kind = PLUGIN_KINDS["assignment"]
    return NamedPlugin(kind, key, name, {} if name in kind.built_in else vehicles.assignment_options)


def walk_named_by(target: TargetConfig, key: str) -> NamedPlugin:
    """The walk of a target, which stands under `key`."""
    return NamedPlugin(PLUGIN_KINDS["walk"], key, target.walk, target.walk_options)


def cost_layers_of(scenario: Scenario) -> list[NamedPlugin]:
    """The plug-ins that have a part in the map, in the order in which they are applied."""
    kind = PLUGIN_KINDS["cost_layer"]
    return [
        NamedPlugin(kind, f"cost.layers[{n}].layer", each.layer, each.options)
        for n, each in enumerate(scenario.cost.layers)
    ]


def check_name(plugin: NamedPlugin) -> None:
    """Raises ConfigError where a name is neither built in nor `module:Name`. Imports nothing."""
    name, allowed = plugin.name, plugin.kind.built_in
    if name in allowed or ":" in name:
        return
    choices = ", ".join([*map(repr, allowed), "or a plug-in as 'module:Name'"])
    near = nearest(name, allowed)
    raise ConfigError(f"{plugin.key}: found {quoted(name)}{f'{near} A' if near else '; a'}llowed: {choices}")
