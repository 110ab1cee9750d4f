"""The base of all messages and the wire version."""

from __future__ import annotations

from swarm.wire.fields import Bounded

WIRE_VERSION = 8


class Message(Bounded, frozen=True, kw_only=True, tag_field="schema"):
    """Base of all messages. Unknown fields are ignored, so that a newer sender can be understood."""

    def check(self) -> None:
        """Raise ValueError where a decoded message breaks a rule of its type. Called by the codec.

        Most types check themselves when they are made, as `Bounded` does. Those which are made by the thousand
        from fields that were checked already do it here.
        """


def schema_of(name: str) -> str:
    """The tag of a message type: its name and the wire version."""
    return f"{name}/{WIRE_VERSION}"


class Nothing(Message, frozen=True, kw_only=True, tag=schema_of("nothing")):
    """The request of a query without arguments."""
