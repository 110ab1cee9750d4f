"""ROS types by distribution: their messages, CDR and hashes. rosbags knows them; two things are repaired here.

rosbags hashes `char` as a type of its own, ROS 2 as uint8, which changes every service's hash (ServiceEventInfo has
a char[16]). And it knows no services, so those in use are in `added_types.toml`, with the message that it lacks.
"""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from launch_scripts.gateways.ros2.rmw import NO_HASH
from swarm.errors import ProtocolError

LARGEST_MESSAGE_BYTES = 1 << 24
"""Larger messages of a peer are dropped unread. A grid of 4096 x 4096 cells has as many."""
_DTYPES = {"byte": "uint8", "char": "uint8", "string": "object"}
REQUEST, RESPONSE, _EVENT = "_Request", "_Response", "_Event"
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
_GID: Any = (Nodetype.ARRAY, ((Nodetype.BASE, ("uint8", 0)), 16))
Distribution = Literal["humble", "jazzy", "kilted", "lyrical", "rolling"]
"""ROS 2 distribution of the peers: it determines the hashes of types, which are part of every key."""
_ADDED: dict[str, str] = tomllib.loads(Path(__file__).with_name("added_types.toml").read_text(encoding="utf-8"))
"""Name -> definition, as .msg files have it."""


class RosTypes:
    """The types of one distribution.

    distribution  whose
    """

    def __init__(self, distribution: Distribution) -> None:
        self.distribution = distribution
        rolling = distribution == "rolling"
        self._store = get_typestore(Stores.LATEST if rolling else Stores[f"ROS2_{distribution.upper()}"])
        for name, text in _ADDED.items():
            if name not in self._store.fielddefs:
                package, _, base = name.split("/")
                as_message = f"{package}/msg/{base}"  # what rosbags makes of every name
                self._store.register({name: get_types_from_msg(text, as_message)[as_message]})
        if _EVENT_INFO in self._store.fielddefs:  # but in Humble, which hashes nothing
            constants, fields = self._store.fielddefs[_EVENT_INFO]
            adapted = [(field, _GID if field == "client_gid" else kind) for field, kind in fields]
            self._store.fielddefs[_EVENT_INFO] = (constants, adapted)
            for name in _ADDED:
                if name.endswith(RESPONSE):
                    self._link_service(name.removesuffix(RESPONSE))

    def _link_service(self, name: str) -> None:
        """Adds the type of a service whose request and response are known: what its hash is computed from."""

        def at_most_one(part: str) -> Any:
            return Nodetype.SEQUENCE, ((Nodetype.NAME, name + part), 1)

        event = [
            ("info", (Nodetype.NAME, _EVENT_INFO)),
            ("request", at_most_one(REQUEST)),
            ("response", at_most_one(RESPONSE)),
        ]
        self._store.register({name + _EVENT: ([], event)})
        parts = (("request_message", REQUEST), ("response_message", RESPONSE), ("event_message", _EVENT))
        self._store.register({name: ([], [(field, (Nodetype.NAME, name + part)) for field, part in parts])})

    def hash_of(self, name: str) -> str:
        """RIHS01_... of a message or a service (of the service itself, not of its parts)."""
        return NO_HASH if self.distribution == "humble" else self._store.hash_rihs01(name)

    def definition_of(self, name: str) -> str:
        """The definition of a message with those that it is made of, as recordings keep it."""
        return str(self._store.generate_msgdef(name, ros_version=2)[0])

    def make(self, name: str, /, **fields: Any) -> Any:
        """Returns a message of a type, such as geometry_msgs/msg/Point with x=1.0.

        Missing fields are 0, false or empty. A dict stands for a message which is within.
        """
        made = {
            field: self._value(node, inner, fields.pop(field, None))
            for field, (node, inner) in self._store.fielddefs[name][1]
        }
        if fields:
            raise TypeError(f"{name} has no field {next(iter(fields))!r}")
        return self._store.types[name](**made)

    def _value(self, node: Nodetype, inner: Any, given: Any) -> Any:
        """Returns the value of a field, of which nothing may be given."""
        if node is Nodetype.NAME:
            return self.make(inner, **given or {}) if given is None or isinstance(given, dict) else given
        if node is Nodetype.BASE:
            kind = inner[0]
            none: object = "" if kind == "string" else False if kind == "bool" else 0.0 if "float" in kind else 0
            return none if given is None else given
        (element, of), many = inner
        if element is Nodetype.NAME:
            return [self._value(element, of, each) for each in given or ()]
        return (
            np.zeros(many if node is Nodetype.ARRAY else 0, _DTYPES.get(of[0], of[0])) if given is None else given
        )

    def pack(self, message: Any, name: str) -> bytes:
        """CDR, little-endian, with its header of four bytes. Bytes are CDR already."""
        return message if isinstance(message, bytes) else bytes(self._store.serialize_cdr(message, name))

    def unpack(self, content: bytes, name: str) -> Any:
        """Decodes a received message. Raises ProtocolError if it is not of this type."""
        if len(content) > LARGEST_MESSAGE_BYTES:
            raise ProtocolError(f"{name} has {len(content)} bytes, expected at most {LARGEST_MESSAGE_BYTES}")
        try:
            return self._store.deserialize_cdr(content, name)
        except (SerdeError, IndexError, OverflowError, MemoryError) as error:
            raise ProtocolError(f"{name} of {len(content)} bytes is not CDR of its type: {error}") from error


@cache
def types_of(distribution: Distribution) -> RosTypes:
    """The types of a distribution, loaded once: it takes a sixth of a second."""
    return RosTypes(distribution)
