"""The topics: every key of the wire with its message, rate and quality of service.

`docs/reference/wire.md` is made of them, and of the docstring below each: what it is, and how often it is put or
asked.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import lru_cache

from swarm.errors import ProtocolError
from swarm.peers import Peer
from swarm.wire.access import MEMBERS, MEMBERS_OWN, Access, Act, access
from swarm.wire.codec import prime
from swarm.wire.messages import Message, Nothing, map_data, orders, planning, processes, traffic, vehicles


class Priority(Enum):
    """The priorities of Zenoh that topics use."""

    INTERACTIVE = "interactive"
    DATA = "data"
    BACKGROUND = "background"


_SHORT, _USUAL, _LONG, _FILE = 1 << 12, 1 << 16, 1 << 18, 8 << 20
"""Limits of payloads in bytes: of one thing; of what 1,000 vehicles, an agent's most, take 60 bytes each of, or a
digest (`MOST_DIGEST_BYTES`); of the same with names and columns of the longest kind, or a route over 100,000 cells;
and of files and of marks that were asked for."""


@dataclass(frozen=True, eq=False)
class Topic:
    """One topic.

    key                      template below the namespace; `{name}` stands for one chunk
    message                  the published message, or the reply to a query
    access                   which roles may put, serve, ask and hear it
    request                  for a queryable: the query; None for a topic that is only published
    bulk                     for a queryable: a message that carries many values, if the request asks for it
    costly                   for a queryable: askers take turns, by the field `asker` of the key; agents come before
                             all others
    published                whether values are put, not only answered
    free                     acts that count without a code of the run's secret (`swarm.wire.access`): all that a
                             stranger on loopback may do. `tests/laws/test_what_strangers_may_do.py` says of each
                             why its effect ends with it
    newest                   each value carries the whole state of its key, so a reader may skip to the newest
    echoed                   whether a process that puts and subscribes hears what it has put itself
    buffer                   samples that wait for a slow reader; the oldest are dropped first
    put_bytes                limit of a published payload; a longer one is rejected unread, as are questions and
                             answers
    ask_bytes, answer_bytes  the same of a question, and of each of its answers
    fields                   names of the chunks in `key`, in order
    """

    name: str
    key: str
    message: type[Message]
    access: Access
    request: type[Message] | None = None
    bulk: type[Message] | None = None
    costly: bool = False
    published: bool = True
    free: tuple[Act, ...] = ()
    newest: bool = True
    echoed: bool = True
    priority: Priority = Priority.DATA
    buffer: int = 1024
    put_bytes: int = _USUAL
    ask_bytes: int = _USUAL
    answer_bytes: int = _USUAL
    fields: tuple[str, ...] = field(init=False, repr=False)
    _pattern: re.Pattern[str] = field(init=False, repr=False)
    _repeated: tuple[str, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        pattern = re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]+)", re.escape(self.key))
        object.__setattr__(self, "_pattern", re.compile(pattern))
        for message_type in (self.message, self.request, self.bulk):
            if message_type is not None:
                prime(message_type)  # on one thread, before others decode it
        object.__setattr__(self, "fields", tuple(re.findall(r"{(\w+)}", self.key)))
        repeated = tuple(name for name in self.fields if name in self.message.__struct_fields__)
        object.__setattr__(self, "_repeated", repeated)

    def every(self, fields: Mapping[str, str | int]) -> dict[str, str]:
        """Returns each field of the topic as one part of a Zenoh key; fields that are not given become `*`.

        Raises TypeError on an unknown field, ValueError on a value that is not one chunk.
        """
        named = {name: _chunk(fields[name]) if name in fields else "*" for name in self.fields}
        if len(fields) > len(named) or any(name not in named for name in fields):
            unknown = next(name for name in fields if name not in named)
            raise TypeError(f"topic {self.name} has no field {unknown}; it has {', '.join(named)}")
        return named

    def expression(self, namespace: str, **fields: str | int) -> str:
        """The key expression for these fields; those not given become `*`. Raises as `every`."""
        return f"{namespace}/{self.key.format(**self.every(fields))}"

    def value(self, fields: Mapping[str, str | int]) -> tuple[Mapping[str, str], str]:
        """The fields of one value, without wildcards, and its key below the namespace. Raises TypeError on a
        missing field, and as `every`.

        A process puts under the same few keys again and again, so both are remembered.
        """
        return _value(self, tuple(fields.items()))

    def keyed(self, namespace: str, **fields: str | int) -> str:
        """The key of one value. Raises as `value`."""
        return f"{namespace}/{self.value(fields)[1]}"

    def below(self, fields: Mapping[str, str]) -> str:
        """The key below the namespace, of fields that are chunks already."""
        return self.key.format(**fields)

    def parse(self, namespace: str, key: str) -> dict[str, str] | None:
        """The fields of a key; None if it is not a key of this topic."""
        if not key.startswith(namespace + "/"):
            return None
        match = self._pattern.fullmatch(key, len(namespace) + 1)
        return match.groupdict() if match else None

    def check_key(self, fields: Mapping[str, str], message: Message) -> None:
        """Raises ProtocolError on a message with a field that differs from its key. Routers grant access by key, so
        the key decides who a sender is."""
        for name in self._repeated:
            stated = str(getattr(message, name))
            if stated != fields[name]:
                raise ProtocolError(f"{name} is {stated[:80]!r} in the message and {fields[name]!r} in its key")


def check_size(size: int, most_bytes: int) -> None:
    """Raises ProtocolError on a payload which is longer than its topic allows, before anything reads it."""
    if size > most_bytes:
        raise ProtocolError(f"payload of {size:,} bytes, at most {most_bytes:,}")


_CHUNK = re.compile(r"[^/*$?#\s]+|\*")


@lru_cache(maxsize=1 << 16)
def _value(topic: Topic, given: tuple[tuple[str, str | int], ...]) -> tuple[Mapping[str, str], str]:
    named = topic.every(dict(given))
    for name, chunk in named.items():
        if chunk == "*":
            raise TypeError(f"topic {topic.name} needs the field {name}")
    return named, topic.below(named)


def _chunk(value: str | int) -> str:
    chunk = str(value)
    if isinstance(value, int):
        return chunk
    if _CHUNK.fullmatch(chunk) is None:
        raise ValueError(f"{chunk!r} cannot be a part of a key: no '/', '*', '$', '?', '#' or blanks")
    return chunk


_REPLICAS = "agent keeper planner places monitor"
"""Roles which hold a replica of the map."""

OBEYING = "agent planner targets keeper"
"""Roles which go by orders."""
OBEYING_OWN = " ".join(f"{role}:role,id" for role in OBEYING.split())

RUN = Topic(
    "run", "run/{role}/{id}", processes.RunInfo, access(serve=MEMBERS_OWN, ask=MEMBERS), request=Nothing,
    published=False, free=("ask", "answer"), ask_bytes=_SHORT, answer_bytes=_LONG,
)  # fmt: skip
"""Run and terrain of a process.

Rate: asked at every start
"""
MARKS = Topic(
    "marks", "marks/{region}/{tile}/{author}", map_data.MarkSet,
    access(
        put="agent:author rover:author keeper planner", serve="agent:author rover:author keeper", ask=_REPLICAS,
        hear=f"{_REPLICAS} rover:author",
    ),
    request=map_data.MarksRequest, bulk=map_data.MarkSets, free=("ask",), buffer=8192, answer_bytes=2 * _LONG,
)  # fmt: skip
"""An author's whole set for a tile.

Rate: on change, at most 10 Hz a tile
"""
DIGEST = Topic(
    "digest", "digest/{author}", map_data.Digest,
    access(put="agent:author rover:author keeper:author", hear=_REPLICAS), priority=Priority.BACKGROUND,
)  # fmt: skip
"""Sets that a replica holds.

Rate: 1 Hz, and on change
"""
BASE_MAP = Topic(
    "base-map", "base/{keeper}", map_data.BaseMap, access(serve="keeper:keeper", ask=MEMBERS), request=Nothing,
    published=False, free=("ask",), priority=Priority.BACKGROUND, ask_bytes=_SHORT, answer_bytes=_FILE,
)  # fmt: skip
"""Terrain of a keeper, for machines without its files.

Rate: asked at a start
"""
BASE_TILES = Topic(
    "base-tiles", "base/{keeper}/tiles", map_data.BaseMapTile, access(serve="keeper:keeper", ask=MEMBERS),
    request=map_data.BaseMapRequest, published=False, free=("ask",), priority=Priority.BACKGROUND, ask_bytes=_LONG,
    answer_bytes=_FILE,
)  # fmt: skip
"""The terrain, by layer and region.

Rate: asked at a start
"""
FLEET = Topic(
    "fleet", "fleet/{region}/{author}", vehicles.Fleet, access(put="agent:author", hear="targets monitor planner"),
    put_bytes=_LONG,
)  # fmt: skip
"""Positions of an agent's vehicles.

Rate: every tick
"""
CHASERS = Topic(
    "chasers", "target/{target}/chasers/{author}", vehicles.Chasers,
    access(put="agent:author", hear="planner:target"), put_bytes=_LONG,
)  # fmt: skip
"""Vehicles of an agent which chase a target, and where their routes may begin.

Rate: on change, and after a vehicle has passed the published cell; else 1 Hz
"""
SENT = Topic(
    "sent", "place/{places}/sent/{author}", vehicles.Chasers, access(put="agent:author", hear="places:places"),
    put_bytes=_LONG,
)  # fmt: skip
"""The same for vehicles which are sent to places.

Rate: as chasers
"""
SHARED_COSTS = Topic(
    "shared-costs", "costs/{group}/{author}", vehicles.SharedCosts, access(put="agent:author", hear="agent"),
    echoed=False, put_bytes=2 * _LONG,
)  # fmt: skip
"""Costs from an agent's vehicles to each target.

Rate: per `vehicles.reassign_s`, if `groups[].assignment` needs it
"""
HOST_STATE = Topic(
    "host_state", "host_state/{shard}/{member}/{agent}", traffic.HostState,
    access(put="agent:agent rover:agent", hear="agent:member"), newest=False, priority=Priority.INTERACTIVE,
    put_bytes=_LONG,
)  # fmt: skip
"""Positions and wanted cells of a host's vehicles in a shard: to its leader, or to all members while it has none.
Two generations of a host may send.

Rate: on change, else 5 Hz
"""
TABLE = Topic(
    "table", "table/{shard}/{member}/{agent}", traffic.Table,
    access(put="agent:agent", serve="agent:agent", ask="agent:member", hear="agent:member"), request=traffic.Claim,
    echoed=False, priority=Priority.INTERACTIVE, put_bytes=_LONG, ask_bytes=_SHORT, answer_bytes=_LONG,
)  # fmt: skip
"""Granted cells of a shard, from its leader to a member. A query claims leadership: the member replies with its
stored table.

Rate: on change, and at 5 Hz until the others have it on file
"""
GRANTED = Topic(
    "granted", "granted/{shard}/{host}/{agent}", traffic.Granted,
    access(put="agent:agent", hear="agent:host rover:host"), priority=Priority.INTERACTIVE, put_bytes=_LONG,
)  # fmt: skip
"""Cells of a shard granted to one host.

Rate: on change, else 5 Hz
"""
WORD = Topic(
    "word", "word/{shard}/{host}/{agent}", traffic.Word, access(put="agent:agent", hear="agent:host rover:host"),
    priority=Priority.INTERACTIVE, put_bytes=_SHORT,
)  # fmt: skip
"""Digest of what a member has on file for a host; only with certificates.

Rate: on change, else 5 Hz
"""
LEFT = Topic(
    "left", "left/{host}/{agent}", traffic.Left,
    access(put="agent:agent rover:agent", hear="agent:host rover:host"), newest=False,
    priority=Priority.INTERACTIVE, put_bytes=_LONG,
)  # fmt: skip
"""Cells which a host's vehicles have left, to a host that waits for them.

Rate: on change, and at 5 Hz until the leader has counted it
"""
STORED = Topic(
    "stored", "stored/{shard}/{member}/{agent}", traffic.Stored, access(put="agent:agent", hear="agent:member"),
    echoed=False, priority=Priority.INTERACTIVE, put_bytes=_SHORT,
)  # fmt: skip
"""Number of a member's table on file.

Rate: per table by one member, 5 Hz by the others; 5 Hz by the leader instead of an unchanged table
"""
KNOWN = Topic(
    "known", "known/{agent}", traffic.Known, access(serve="agent:agent", ask="agent rover"),
    request=traffic.KnownRequest, published=False, priority=Priority.INTERACTIVE, ask_bytes=_SHORT,
    answer_bytes=_LONG,
)  # fmt: skip
"""Record of an agent about another host, for the next generation of that host.

Rate: asked at a start
"""
LEAVE = Topic(
    "leave", "leave/{agent}", vehicles.Removed, access(serve="agent:agent"), request=vehicles.RemoveVehicles,
    published=False, priority=Priority.INTERACTIVE, ask_bytes=_LONG, answer_bytes=_LONG,
)  # fmt: skip
"""Vehicles which an agent has removed for an operator.

Rate: asked
"""
FOLLOWED = Topic(
    "followed", "vehicle/{agent}/{vehicle}/followed", vehicles.Followed, access(put="agent:agent", hear="monitor"),
    priority=Priority.BACKGROUND, put_bytes=_LONG,
)  # fmt: skip
"""The route that a vehicle has begun.

Rate: per new route
"""
PUSHED_ROUTE = Topic(
    "pushed-route", "vehicle/{agent}/{vehicle}/route", planning.PushedRoute,
    access(put="planner places", hear="agent:agent rover:agent"), put_bytes=_LONG,
)  # fmt: skip
"""A newer route for a vehicle.

Rate: per update
"""
POSE = Topic(
    "pose", "target/{target}/pose", planning.TargetPose,
    access(put="targets tracker:target", hear="agent planner targets monitor tracker:target"), newest=False,
    free=("put",), put_bytes=_SHORT,
)  # fmt: skip
"""Position of a target, from one of its trackers.

Rate: per quarter of a cell, at least 2 Hz
"""
SIGHTED = Topic(
    "sighted", "sighted/{target}/{author}", planning.Sighted,
    access(put="agent:author", hear="agent planner keeper monitor"), put_bytes=_SHORT,
)  # fmt: skip
"""Position of a target, seen by a vehicle.

Rate: while it is in sight, at most 2 Hz
"""
TRUE_POSE = Topic(
    "true-pose", "world/target/{target}/pose", planning.TargetPose, access(put="targets", hear="agent targets"),
    put_bytes=_SHORT,
)  # fmt: skip
"""Position of an untracked target, for simulated sensors only.

Rate: as poses
"""
OBSTACLE = Topic(
    "body", "body/{id}", vehicles.Obstacle, access(put="rover:id targets", hear="agent rover targets monitor"),
    newest=False, free=("put",), priority=Priority.INTERACTIVE, put_bytes=_SHORT,
)  # fmt: skip
"""Position of an obstacle, such as an outside vehicle or a person. Two senders may use one id.

Rate: 10 Hz in motion, else at least 1 Hz
"""
ROUTE = Topic(
    "route", "target/{target}/route/{asker}", planning.RouteReply,
    access(serve="planner:target", ask="agent:asker rover:asker"), request=planning.RouteRequest, published=False,
    costly=True, free=("ask",), ask_bytes=_LONG, answer_bytes=4 * _LONG,
)  # fmt: skip
"""Routes from cells to the target.

Rate: asked
"""
COST = Topic(
    "cost", "target/{target}/cost/{asker}", planning.CostReply,
    access(serve="planner:target", ask="agent:asker targets:asker monitor:asker rover:asker"),
    request=planning.CostRequest, published=False, costly=True, free=("ask",), ask_bytes=_LONG,
    answer_bytes=2 * _LONG,
)  # fmt: skip
"""Cost-to-go of a batch of cells.

Rate: asked
"""
PLACE_ROUTE = Topic(
    "place-route", "place/{places}/route/{asker}", planning.PlaceRouteReply,
    access(serve="places:places", ask="agent:asker rover:asker"), request=planning.PlaceRouteRequest,
    published=False, costly=True, free=("ask",), ask_bytes=_LONG, answer_bytes=4 * _LONG,
)  # fmt: skip
"""Routes from cells to a place.

Rate: asked
"""
NAMELESS_ROUTE = replace(
    ROUTE, name="nameless-route", key="target/{target}/route",
    access=access(serve="planner:target", ask="agent rover"),
)  # fmt: skip
"""Routes to the target for askers without a name, who take turns as one.

Rate: asked
"""
NAMELESS_COST = replace(
    COST, name="nameless-cost", key="target/{target}/cost",
    access=access(serve="planner:target", ask="agent targets monitor rover"),
)  # fmt: skip
"""Costs for the same askers.

Rate: asked
"""
STATUS = Topic(
    "status", "target/{target}/status", planning.PlannerStatus,
    access(put="planner:target", hear="targets monitor tracker:target"), priority=Priority.BACKGROUND,
    put_bytes=_SHORT,
)  # fmt: skip
"""State of a planner.

Rate: 2 Hz
"""
BELIEVED = Topic(
    "believed", "target/{target}/believed", planning.Believed, access(put="planner:target", hear="monitor"),
    priority=Priority.BACKGROUND, put_bytes=_USUAL // 4,
)  # fmt: skip
"""Likely places of a target which is searched for.

Rate: 1 Hz during a search
"""
LEAD = Topic(
    "lead", "lead/{role}/{id}", processes.Heartbeat,
    access(put="planner:role,id places:role,id targets:role,id", hear="planner places targets monitor"),
    priority=Priority.INTERACTIVE, put_bytes=_SHORT,
)  # fmt: skip
"""Readiness and leadership among processes with one job.

Rate: 10 Hz, where there are standbys
"""
ZONES = Topic(
    "zones", "order/{keeper}/zone", orders.Zones, access(serve="keeper:keeper"), request=orders.ZoneOrder,
    published=False, priority=Priority.INTERACTIVE, answer_bytes=_FILE,
)  # fmt: skip
"""Adds, removes and lists zones.

Rate: asked by people
"""
GIVE_ORDER = Topic(
    "give-order", "order/{keeper}/give", orders.Orders, access(serve="keeper:keeper"), request=orders.GiveOrder,
    published=False, priority=Priority.INTERACTIVE, ask_bytes=_LONG, answer_bytes=4 * _LONG,
)  # fmt: skip
"""Gives an order.

Rate: asked by people
"""
ORDERS = Topic(
    "orders", "orders/{role}/{id}", orders.Orders,
    access(put="keeper:role,id", serve=OBEYING_OWN, ask=OBEYING, hear=f"{OBEYING} monitor"), request=Nothing,
    priority=Priority.INTERACTIVE, put_bytes=4 * _LONG, ask_bytes=_SHORT, answer_bytes=4 * _LONG,
)  # fmt: skip
"""Orders in force, from keepers. A starting process which finds no keeper asks any other.

Rate: 1 Hz, and on change
"""
OBEYED = Topic(
    "obeyed", "obeyed/{role}/{id}", orders.Obeyed, access(serve="agent:role,id planner:role,id targets:role,id"),
    request=orders.Obey, published=False, priority=Priority.INTERACTIVE, ask_bytes=_LONG, answer_bytes=_SHORT,
)  # fmt: skip
"""Reply of a process as soon as it obeys an order.

Rate: asked after each order
"""
SEND_VEHICLE = Topic(
    "send-vehicle", "order/{keeper}/send", orders.Goals, access(serve="keeper:keeper"), request=orders.SendVehicle,
    published=False, priority=Priority.INTERACTIVE, answer_bytes=_FILE,
)  # fmt: skip
"""Sends a vehicle to places, recalls it, and lists sent vehicles.

Rate: asked by people
"""
GOALS = Topic(
    "goals", "goals/{id}/{agent}", orders.Goals,
    access(put="keeper:id", serve="keeper:id", ask="agent:agent keeper", hear="agent:agent keeper"),
    request=Nothing, priority=Priority.INTERACTIVE, put_bytes=4 * _LONG, ask_bytes=_SHORT, answer_bytes=4 * _LONG,
)  # fmt: skip
"""Places to which an agent's vehicles are sent, as on a keeper's disk.

Rate: 1 Hz for agents with goals, and on change
"""
GOAL_STATES = Topic(
    "goal-states", "reached/{agent}", orders.GoalStates, access(put="agent:agent", hear="keeper monitor"),
    put_bytes=_LONG,
)  # fmt: skip
"""Progress of an agent's vehicles towards their places.

Rate: 1 Hz for agents with goals, and on change
"""
STATS = Topic(
    "stats", "stats/{role}/{id}", processes.Stats,
    access(put=MEMBERS_OWN, serve="keeper", ask="monitor", hear="monitor keeper"), request=Nothing, free=("ask",),
    priority=Priority.BACKGROUND, put_bytes=_LONG, ask_bytes=_SHORT, answer_bytes=_LONG,
)  # fmt: skip
"""Counts of a process; keepers serve the last ones of ended processes.

Rate: 1 Hz
"""
NOTE = Topic(
    "note", "note/{role}/{id}", processes.Note, access(put=MEMBERS_OWN, hear="monitor"), newest=False,
    priority=Priority.BACKGROUND, put_bytes=_USUAL // 4,
)  # fmt: skip
"""Event for people.

Rate: as it happens
"""

TOPICS = tuple(each for each in tuple(globals().values()) if isinstance(each, Topic))
"""Every topic above, in order. Access control, limits of payloads and the lock of the wire go by these, so a topic
that was left out would be denied by every router and checked by no test."""

ALIVE_KEY = "alive/{role}/{id}/{incarnation}"
"""Liveliness tokens, one per process, which raises no other than its own. All roles may watch them."""
_TOKEN = re.compile(r"(?:.*/)?alive/([A-Za-z0-9_.-]{1,64})/([A-Za-z0-9_.-]{1,64})/([0-9]{1,19})")


NO_ASKER = "-"
"""In the key of an answer, the asker of a question under many names."""


def asker_of(role: str, id: str) -> str:
    """The name under which a process asks."""
    return f"{role}.{id}"


UNPROVEN = "~"
"""Stands before the name of an asker that no code proves. No name has this character."""


def proven_asker(fields: Mapping[str, str], proven: bool) -> Mapping[str, str]:
    """The fields of the key of a question, with the asker's name marked if it is not proven."""
    name = fields.get("asker", "*")
    return fields if proven or name == "*" else {**fields, "asker": UNPROVEN + name}


def rank_of(asker: str) -> int:
    """The class of priority of an asker: 0 for agents of the run, which come first, 1 for other proven names, 2 for
    the rest."""
    if asker.startswith("agent."):
        return 0
    return 1 if asker and not asker.startswith(UNPROVEN) else 2


def peer_of(key: str) -> Peer:
    """The process whose liveliness token stands under a key. Raises ProtocolError, and nothing else, on another
    key: an invalid token must not end its reader."""
    match = _TOKEN.fullmatch(key)
    if match is None or int(match[3]) >= 1 << 62:
        raise ProtocolError(f"{key[:200]} is no token: {ALIVE_KEY}, with an incarnation below 2^62")
    return Peer(match[1], match[2], int(match[3]))
