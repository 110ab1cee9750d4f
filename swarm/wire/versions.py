"""Versions of messages: what a build reads, what it writes, and which builds share a run
(docs/design/wire-format.md).

A message keeps its version while fields are added at its end, with defaults: unknown fields are ignored, absent
ones have their default. Any other change is a `Step` to a new version:

1. the build of wire version W in which the step begins reads both versions and writes the older one;
2. from W + 1 on a build writes the newer one, and reads the older one still;
3. from W + 2 on no process which may share a run writes the older one, and the step is removed from `STEPS`.

Each build therefore writes a version that its neighbours on both sides read, in any order of restarts: no process
has to know which others live. A message takes its next step at W + 2 at the earliest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from swarm.errors import ProtocolError
from swarm.wire.messages import WIRE_VERSION, Message

Fields = dict[str, Any]
"""Content of a message in MessagePack, without `schema`."""


@dataclass(frozen=True, slots=True)
class Step:
    """Conversion of a message from the previous version to the version of its type.

    begun_in  wire version of the first builds that read the new one
    raised    fields of the version before as those of the new one
    lowered   the reverse: what only the new one can say is left out
    """

    begun_in: int
    raised: Callable[[Fields], Fields]
    lowered: Callable[[Fields], Fields]

    def writes_older(self, wire: int) -> bool:
        """Returns True if builds of a wire version write the previous version."""
        return wire <= self.begun_in

    def reads_older(self, wire: int) -> bool:
        """Returns True if builds of a wire version read the previous version: as long as a neighbour writes it."""
        return self.writes_older(wire - 1)


_MOST_DIGITS = 9
"""More would be read by int() in a time that grows with the square of the digits."""

STEPS: dict[type[Message], Step] = {}
"""The steps that are under way. Empty: no message has changed so since each has a version of its own."""


def name_and_version(schema: str) -> tuple[str, int]:
    """The parts of a schema such as "marks/8"; version -1 where it has none. It may be anybody's: Python raises on
    numbers of thousands of digits."""
    name, _, version = schema.rpartition("/")
    is_one = version.isascii() and version.isdigit() and len(version) <= _MOST_DIGITS
    return (name, int(version)) if is_one else (schema, -1)


def schema_of_type(message_type: type[Message]) -> str:
    """The `schema` of a message type, such as "marks/8"."""
    return str(message_type.__struct_config__.tag)


def read_schemas(message_type: type[Message]) -> tuple[str, ...]:
    """The schemas that this build takes for a message of this type, the newest first."""
    newest = schema_of_type(message_type)
    step = STEPS.get(message_type)
    if step is None or not step.reads_older(WIRE_VERSION):
        return (newest,)
    return newest, _before(newest)


def written_schema(message_type: type[Message]) -> str:
    """The schema under which this build writes a message of this type."""
    newest = schema_of_type(message_type)
    step = STEPS.get(message_type)
    return newest if step is None or not step.writes_older(WIRE_VERSION) else _before(newest)


def _before(schema: str) -> str:
    name, version = name_and_version(schema)
    return f"{name}/{version - 1}"


def as_read(fields: Fields, message_type: type[Message]) -> Fields:
    """Fields with a `schema`, as those of the type's own version. Raises ProtocolError on a version that this build
    does not read."""
    newest, found = schema_of_type(message_type), fields.get("schema")
    if found == newest or not isinstance(found, str):
        return fields
    readable = read_schemas(message_type)
    if found not in readable:
        name, version = name_and_version(found)
        if name == name_and_version(newest)[0] and version >= 0:
            versions = " and ".join(str(name_and_version(each)[1]) for each in readable)
            raise ProtocolError(
                f"{name} is of version {version}, but this build, of wire version {WIRE_VERSION}, reads {versions}"
            )
        return fields  # another message: the decoder says so
    try:
        older = {key: value for key, value in fields.items() if key != "schema"}
        return {"schema": newest} | STEPS[message_type].raised(older)
    except Exception as error:  # converters meet what a network brings
        raise ProtocolError(f"{found} cannot be read as {newest}: {error!r}"[:300]) from error


def as_written(message: Message) -> Fields | None:
    """Returns the fields and `schema` of a message's older version if this build writes that one, else None."""
    written = written_schema(type(message))
    if written == schema_of_type(type(message)):
        return None
    fields: Fields = msgspec.to_builtins(message, builtin_types=(bytes,))
    del fields["schema"]
    return {"schema": written} | STEPS[type(message)].lowered(fields)


FIRST_SHARED = 10
"""Builds of this wire version and later share no run with those before, which have other rules of right of way:
vehicles of the two would meet."""


def are_neighbours(one: int, other: int) -> bool:
    """Returns True if builds of two wire versions may share a run."""
    return abs(one - other) <= 1 and (one < FIRST_SHARED) == (other < FIRST_SHARED)
