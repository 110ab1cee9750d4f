"""Every message on the wire, by subject: frozen types whose tag (`schema`) names type and version: "marks/8".

The base of all is here, with the wire version of this build. `swarm.wire.codec` decodes messages, and
`swarm.wire.fields` has the types of their fields. A decoded message keeps the rules of its docstring and checks;
whether its cells lie in the grid is checked by its reader.
"""

from __future__ import annotations

from swarm.wire.fields import Bounded

WIRE_VERSION = 10
"""The wire that this build speaks. It rises by one, once a release, where a message steps to a version that builds
before it do not read, or where a key changes (`swarm.wire.versions`, docs/design/wire-format.md). Two neighbours
share a run."""
_FIRST_VERSION = 8
"""Version of every message when each got a version of its own."""


class Message(Bounded, frozen=True, kw_only=True, tag_field="schema"):
    """Base of all messages. Unknown fields are ignored, so that a newer sender can be understood."""

    def check(self) -> None:
        """Raises ValueError where a decoded message breaks a rule of its type. Called by the codec.

        Most types check themselves when they are made, as `Bounded` does. Those which are made by the thousand
        from fields that were checked already do it here.
        """


def schema_of(name: str, version: int = _FIRST_VERSION) -> str:
    """The tag of a message type: its name and its own version, such as "marks/8"."""
    return f"{name}/{version}"


class Nothing(Message, frozen=True, kw_only=True, tag=schema_of("nothing")):
    """The request of a query without arguments."""
