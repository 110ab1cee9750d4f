"""The base of all messages and the wire version."""

from __future__ import annotations

import msgspec

from swarm.wire.fields import column as column
from swarm.wire.fields import pack_column as pack_column
from swarm.wire.routes import Route as Route
from swarm.wire.routes import Routes as Routes
from swarm.wire.routes import RouteStatus as RouteStatus
from swarm.wire.statements import FOREVER as FOREVER
from swarm.wire.statements import STAMP_LIMIT_NS as STAMP_LIMIT_NS
from swarm.wire.statements import TILE_AREA as TILE_AREA
from swarm.wire.statements import MarkKind as MarkKind

WIRE_VERSION = 3


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="schema"):
    """Base of all messages. Unknown fields are ignored, so that a newer sender can be understood."""

    def check(self) -> None:
        """Raise ValueError where a decoded message breaks its rules: the door asks.

        Most types are checked when they are made, by `__post_init__`; those that are made by the thousand, of what
        was checked already, only at the door."""


def schema_of(name: str) -> str:
    return f"{name}/{WIRE_VERSION}"


class Nothing(Message, frozen=True, kw_only=True, tag=schema_of("nothing")):
    """The request of a query that needs no argument."""
