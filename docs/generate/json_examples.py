"""JSON that a person may put: the least that is accepted on each key that programs outside the swarm may put on."""

from __future__ import annotations

import json
import typing
from typing import Any

import msgspec

from launch_scripts.process_table import ROLES as STARTED_ROLES
from swarm.wire.access import ROLES
from swarm.wire.fields import taken_apart
from swarm.wire.topics import TOPICS, Topic

OUTSIDE_ROLES = tuple(role for role in ROLES if role not in STARTED_ROLES)
"""Roles of programs that no launcher starts."""

_KEY_FIELDS = {"role": "rover", "id": "r1", "target": "t0", "author": "all.r1.1", "region": "0", "tile": "3"}
_VALUES: dict[str, Any] = {
    "group": "all", "role": "rover", "kind": "hello", "text": "battery low", "x_m": 1205.0, "y_m": -860.0,
    "cell": 3702, "radius_m": 2.0, "seq": 1, "epoch": 1, "held": {"all.r1.1": [[3, 1, 1]]}, "cells": [5, 6],
    "kinds": [1, 1], "paces": [0, 0], "incarnation": 1790000000000000000, "stamp_ns": 1790000000000000000,
    "stamps_ns": [1790000000000000000, 1790000000000000000],
}  # fmt: skip
_BY_TYPE: dict[Any, Any] = {int: 1, float: 1.0, str: "word", bool: True, list: [], dict: {}, bytes: []}


def put_from_outside() -> list[Topic]:
    """The topics that programs which no launcher starts may put on, by the table of topics."""
    return [
        topic
        for topic in TOPICS
        if not topic.trusted and any(grant.role in OUTSIDE_ROLES for grant in topic.access.put)
    ]


def key_fields(topic: Topic) -> dict[str, str]:
    return {name: _KEY_FIELDS.get(name, "x") for name in topic.fields}


def example(topic: Topic) -> str:
    """The shortest JSON for a topic: what its message needs and its key does not say."""
    hints = typing.get_type_hints(topic.message, include_extras=True)
    needed = (field.name for field in msgspec.structs.fields(topic.message) if field.required)
    return json.dumps({name: _value(name, hints[name]) for name in needed if name not in topic.fields})


def _value(name: str, hint: Any) -> Any:
    bare = taken_apart(hint)[0]
    return _VALUES.get(name, _BY_TYPE.get(typing.get_origin(bare) or bare))
