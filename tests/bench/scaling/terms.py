"""What costs are made of: terms, each message with who sends it to whom, each role with what makes it work. Pure.

This table is the model; the coefficients are fitted. Who adds a topic, or changes who hears one, changes it here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from bench.scaling.cost_model import Terms
from bench.scaling.quantities import Quantities

TERMS: Mapping[str, Callable[[Quantities], float]] = {
    "agents": lambda q: q.agents,
    "planners": lambda q: q.planners,
    "keepers": lambda q: q.keepers,
    "monitors": lambda q: q.monitors,
    "launchers": lambda q: q.launchers,
    "vehicles": lambda q: q.vehicles,
    "targets processes": lambda _: 1.0,
    "agents x rate": lambda q: q.agents * q.rate,
    "planners x rate": lambda q: q.planners * q.rate,
    "vehicles x rate": lambda q: q.vehicles * q.rate,
    "vehicles in tables x rate": lambda q: q.vehicles * q.rate if q.plots else 0.0,
    "shared regions x rate": lambda q: q.shared * q.rate,
    "shared plots x rate": lambda q: q.shared_plots * q.rate,
    "plots x rate": lambda q: q.plots * q.rate,
    "chases": lambda q: q.chases,
    "asks": lambda q: q.asks,
    "asks x planners": lambda q: q.asks * q.planners,
    "asked vehicles": lambda q: q.asks / q.agents * q.vehicles,
    "asked vehicles x planners": lambda q: q.asks / q.agents * q.vehicles * q.planners,
    "planners x side": lambda q: q.planners * q.side,
    "planners x cells": lambda q: q.planners * q.cells,
    "agents x cells": lambda q: q.agents * q.cells,
    "cells": lambda q: q.cells,
    "processes": lambda q: q.agents + q.planners + q.keepers + q.monitors + 1 + q.launchers,
}
"""Term -> its value. Messages and bytes by role are terms, too: see `Work`."""


def one(_: Quantities) -> float:
    return 1.0


HEARERS: Mapping[str, Callable[[Quantities], float]] = {
    "agents": lambda q: q.agents,
    "agents near": lambda q: q.hearers,
    "agents that listen": lambda q: q.listeners,
    "planners": lambda q: q.planners,
    "keepers": lambda q: q.keepers,
    "monitors": lambda q: q.monitors,
    "launchers": lambda q: q.launchers,
    "one": one,
    "its own and one": lambda q: 2 - 1 / max(q.launchers, 1),
}
"""Who takes a copy of a message -> how many they are."""


@dataclass(frozen=True)
class Sent:
    """What one role sends on one topic.

    messages, bytes  terms of what is sent a second, each message once
    to               role -> how many of it take a copy, as in `HEARERS`
    why              the mechanism, in words
    """

    topic: str
    source: str
    messages: Terms
    bytes: Terms
    to: Mapping[str, str]
    why: str


_WATCHED = {"launcher": "one", "monitor": "monitors"}
_FIGURES = {"keeper": "keepers", "launcher": "its own and one", "monitor": "monitors"}
"""One launcher records; each hears its own processes (decision 97)."""
_ALL_MAPS = {"agent": "agents", "planner": "planners", "keeper": "keepers", "monitor": "monitors"}

SENT: tuple[Sent, ...] = (
    Sent(
        "fleet",
        "agent",
        ("shared regions x rate",),
        ("shared regions x rate", "vehicles x rate"),
        {"targets": "one", **_WATCHED},
        "where an agent's vehicles are, for each region, each tick",
    ),
    Sent(
        "standing",
        "agent",
        ("shared plots x rate",),
        ("shared plots x rate", "vehicles x rate"),
        {"agent": "one"},
        "where vehicles would go next, to the warden of each plot",
    ),
    Sent(
        "granted",
        "agent",
        ("shared plots x rate",),
        ("shared plots x rate", "vehicles x rate"),
        {"agent": "one"},
        "what a warden grants, to each host",
    ),
    Sent(
        "table",
        "agent",
        ("plots x rate",),
        ("plots x rate", "vehicles in tables x rate"),
        {"agent": "one"},
        "a warden's table, to the two other members of its plot",
    ),
    Sent(
        "stored",
        "agent",
        ("plots x rate",),
        ("plots x rate",),
        {"agent": "one"},
        "that a table is on file, among the three members of a plot",
    ),
    Sent(
        "marks",
        "agent",
        ("vehicles",),
        ("vehicles",),
        {"agent": "agents near", "planner": "planners", "keeper": "keepers", **_WATCHED},
        "what vehicles find, to everyone who holds the region",
    ),
    Sent(
        "digest",
        "agent",
        ("agents", "vehicles"),
        ("agents", "vehicles"),
        {**_ALL_MAPS, "agent": "agents that listen"},
        "which sets an agent has put, to everyone who holds a map, of agents those near",
    ),
    Sent(
        "digest",
        "keeper",
        ("keepers",),
        ("keepers", "vehicles"),
        _ALL_MAPS,
        "all sets that a keeper holds, to everyone who holds a map",
    ),
    Sent(
        "chasers",
        "agent",
        ("chases", "vehicles"),
        ("chases", "vehicles"),
        {"planner": "one"},
        "which vehicles chase a target, to its planner",
    ),
    Sent(
        "cost",
        "agent",
        ("asks",),
        ("asks", "asked vehicles"),
        {"planner": "planners"},
        "an agent asks every planner what its vehicles would need",
    ),
    Sent(
        "cost",
        "planner",
        ("asks x planners",),
        ("asks x planners", "asked vehicles x planners"),
        {"agent": "one"},
        "every planner answers",
    ),
    Sent(
        "route",
        "agent",
        ("asks", "vehicles"),
        ("asks", "vehicles"),
        {"planner": "one"},
        "vehicles that change their target ask, one message for all of an agent and target",
    ),
    Sent(
        "route",
        "planner",
        ("asks", "vehicles"),
        ("asks", "vehicles"),
        {"agent": "one"},
        "routes as answers",
    ),
    Sent(
        "pushed-route",
        "planner",
        ("planners", "vehicles"),
        ("planners", "vehicles"),
        {"agent": "one"},
        "newer routes, where the target moved or the map changed",
    ),
    Sent(
        "followed",
        "agent",
        ("asks", "vehicles"),
        ("asks", "vehicles"),
        _WATCHED,
        "each route that a vehicle begins",
    ),
    Sent(
        "pose",
        "targets",
        ("planners",),
        ("planners",),
        {"agent": "agents", "planner": "one", **_WATCHED},
        "where a target is, to all agents and its planner",
    ),
    Sent(
        "sighted",
        "agent",
        ("planners",),
        ("planners",),
        {"keeper": "keepers", "monitor": "monitors"},
        "targets that vehicles see",
    ),
    Sent(
        "status",
        "planner",
        ("planners",),
        ("planners",),
        {"targets": "one", **_WATCHED},
        "how a planner is doing",
    ),
    Sent("stats", "agent", ("agents",), ("agents",), _FIGURES, "counters, once a second"),
    Sent("stats", "planner", ("planners",), ("planners",), _FIGURES, "counters, once a second"),
    Sent(
        "orders",
        "keeper",
        ("keepers",),
        ("keepers",),
        {**_ALL_MAPS, "targets": "one", "launcher": "launchers"},
        "what is ordered, to all, once a second",
    ),
)


KINDS_OF_BYTES: Mapping[str, str] = {"marks": "map", "digest": "map", "cost": "costs"}
"""Topic -> what its bytes are, where they make other work than most: marks are merged and repair trees, costs are
columns that are copied."""


@dataclass(frozen=True)
class Work:
    """What makes the processes of one role work.

    cpu      terms of seconds of CPU a second; "messages" and "bytes" are those that the role sends and takes
    memory   terms of bytes of memory, shared pages by their share
    """

    role: str
    cpu: Terms
    memory: Terms
    why: str


WORK: tuple[Work, ...] = (
    Work(
        "agent",
        ("agents x rate", "vehicles x rate", "plots x rate", "messages", "map bytes", "costs bytes"),
        ("agents", "vehicles", "cells"),
        "ticks, vehicles, members of plots, messages; marks and digests that are merged; costs of all targets",
    ),
    Work(
        "planner",
        ("planners x rate", "planners x side", "vehicles", "messages"),
        ("planners", "planners x cells", "cells"),
        "ticks, a tree that follows its target, vehicles that are led, messages",
    ),
    Work(
        "router",
        ("processes", "messages", "bytes"),
        ("launchers", "processes"),
        "sessions; each message once in, and once out for each copy",
    ),
    Work(
        "targets",
        ("targets processes", "planners x rate", "vehicles x rate", "messages"),
        ("targets processes", "cells"),
        "moves targets; the referee hears all positions",
    ),
    Work("keeper", ("keepers", "messages", "bytes"), ("keepers", "cells"), "stores every set, keeps last counters"),
    Work("monitor", ("monitors", "vehicles", "messages"), ("monitors", "vehicles", "cells"), "draws all there is"),
    Work(
        "launcher",
        ("launchers", "processes", "messages", "bytes"),
        ("launchers", "processes"),
        "watches its processes; one records what all say",
    ),
)


Change = Mapping[tuple[str, str, str], Callable[[Quantities], float]]
"""(topic, role that sends, role that hears or PUT) -> by what the copies that the role hears, or what is put, would
be multiplied if the protocol were changed."""
NO_CHANGE: Change = {}
PUT = "put"


def _near(q: Quantities) -> float:
    return q.near


CHANGES: Mapping[str, Change] = {
    "as it is": NO_CHANGE,
    "agents ask for the costs of targets near": {
        ("cost", "agent", "planner"): _near,
        ("cost", "planner", PUT): _near,
    },
    "planners hold what is near": {
        ("marks", "agent", "planner"): _near,
        ("digest", "agent", "planner"): _near,
        ("digest", "keeper", "planner"): _near,
    },
    "a keeper's digests go by region": {("digest", "keeper", "agent"): _near},
    "agents hear the targets near": {("pose", "targets", "agent"): _near},
}
"""What could be changed -> what that would save, where near is as large as what an agent holds."""
ALL_CHANGES: Change = {key: by for change in CHANGES.values() for key, by in change.items()}
