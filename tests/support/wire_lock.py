"""The lock of the wire: every key and message as it was written last, so that no change breaks the rules of
versions unnoticed (docs/design/wire-format.md).

    PYTHONPATH=.:tests python -m support.wire_lock       writes it, unless a change breaks a rule
"""

import enum
import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from docs.generate.wire_page import REQUIRED, messages, parts, rows
from swarm.wire.messages import WIRE_VERSION, Message
from swarm.wire.topics import ALIVE_KEY, TOPICS, Topic
from swarm.wire.versions import are_neighbours, name_and_version, read_schemas, written_schema

PATH = Path(__file__).parents[2] / "docs" / "wire.lock"
NEVER_STEP = ("run", "nothing")
"""Messages by which builds of any two versions say which they are."""

Lock = Mapping[str, Any]
"""`wire_version`, `token`; `keys`: name -> what a topic is; `messages`: name -> `reads`, `writes`, `structs`: each
a list of fields "name | type | default", `layouts` of these, and `values` of enumerations."""


def lock() -> Lock:
    """The wire of this build."""
    return {
        "wire_version": WIRE_VERSION,
        "token": ALIVE_KEY,
        "keys": {topic.name: _key(topic) for topic in TOPICS},
        "messages": {name_and_version(read_schemas(kind)[0])[0]: _locked(kind) for kind in messages()},
    }


def _key(topic: Topic) -> str:
    kinds = (topic.message, topic.request, topic.bulk)
    names = ["none" if kind is None else kind.__name__ for kind in kinds]
    return " | ".join([topic.key, *names, f"free: {', '.join(topic.free) or 'nothing'}"])


def _locked(kind: type[Message]) -> dict[str, Any]:
    structs = (kind, *parts(kind))
    enums = [each for struct in structs for each in parts(struct, enum.Enum)]
    return {
        "reads": sorted(name_and_version(schema)[1] for schema in read_schemas(kind)),
        "writes": name_and_version(written_schema(kind))[1],
        "structs": {struct.__name__: [" | ".join(row) for row in rows(struct)] for struct in structs},
        "layouts": {struct.__name__: _layout(struct) for struct in structs},
        "values": {each.__name__: [member.value for member in each] for each in enums},
    }


def _layout(struct: type[msgspec.Struct]) -> str:
    """The layout of fields, and whether fields of a later build are skipped."""
    config = struct.__struct_config__
    return ("list" if config.array_like else "map") + (", no other fields" if config.forbid_unknown_fields else "")


def document() -> str:
    """The lock as text: a topic a line, a field a line, so that a change shows where it is."""
    return json.dumps(lock(), indent=1) + "\n"


def faults() -> list[str]:
    """Broken rules since the lock was written last, a sentence each."""
    return list(broken(json.loads(PATH.read_text(encoding="utf-8")), lock()))


def broken(before: Lock, now: Lock) -> Iterator[str]:
    """The rules that a change from one lock to another breaks."""
    was, is_now = before["wire_version"], now["wire_version"]
    if before["token"] != now["token"]:
        yield f"the key of liveliness tokens was {before['token']} and is {now['token']}: it never changes"
    if not 0 <= is_now - was <= 1:
        yield f"the wire version was {was} and is {is_now}: it rises by one at a time"
    if not are_neighbours(was, is_now):
        return
    if was == is_now:
        for name, topic in before["keys"].items():
            if topic != now["keys"].get(name):
                yield f"the key of topic {name} has changed: the wire version has to rise"
    for name, message in before["messages"].items():
        if name in now["messages"]:
            yield from _broken_message(name, message, now["messages"][name], was != is_now)
        elif was == is_now:
            yield f"the message {name} is gone: the wire version has to rise"


def _broken_message(name: str, before: Lock, now: Lock, moved: bool) -> Iterator[str]:
    if before["writes"] not in now["reads"]:
        yield f"{name} of version {before['writes']}, which the build before writes, is no longer read"
    if now["writes"] not in before["reads"]:
        yield f"{name} is written in version {now['writes']}, which the build before does not read"
    if max(now["reads"]) == max(before["reads"]):
        for sentence in _changed(before, now):
            yield f"{sentence}: {name} needs a step to its next version (swarm/wire/versions.py)"
        for struct, fields in before["structs"].items():
            for field in now["structs"].get(struct, [])[len(fields) :]:
                if field.endswith(f" | {REQUIRED}"):
                    added = f"{struct}.{field.partition(' | ')[0]} is added without a default"
                    yield f"{added}: builds before this one do not send it"
    elif name in NEVER_STEP:
        yield f"{name} has taken a step: it never does"
    elif not moved:
        yield f"{name} has taken a step: the wire version has to rise"


def _changed(before: Lock, now: Lock) -> Iterator[str]:
    """The differences in one version of a message. Fields may be added behind the others."""
    for struct, fields in before["structs"].items():
        kept = now["structs"].get(struct, [])
        for index, field in enumerate(fields):
            if kept[index : index + 1] != [field]:
                is_now = f"is {kept[index]}" if index < len(kept) else "is gone"
                yield f"{struct}.{field.partition(' | ')[0]} was {field} and {is_now}"
    for what in ("layouts", "values"):
        for part, was in before[what].items():
            is_now = now[what].get(part)
            if is_now != was and (what == "values" or is_now is not None):
                yield f"{part} was {json.dumps(was)} and is {json.dumps(is_now)}"


if __name__ == "__main__":
    if found := faults():
        sys.exit("\n".join(found))
    PATH.write_text(document(), encoding="utf-8")
