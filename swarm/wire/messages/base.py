"""The base of all messages and the wire version."""

from __future__ import annotations

import msgspec

WIRE_VERSION = 2


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
