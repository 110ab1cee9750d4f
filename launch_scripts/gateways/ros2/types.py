"""ROS types by distribution: their classes, CDR and hashes. rosbags knows them; two things are repaired here.

rosbags hashes `char` as a type of its own, ROS 2 as uint8, which changes every service's hash (ServiceEventInfo has
a char[16]); and it knows no services, so those in use are stated below, with the messages that it lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from launch_scripts.gateways.ros2.graph import NO_HASH
from swarm.errors import ProtocolError

LARGEST_MESSAGE_BYTES = 1 << 24
"""What a peer sends is not even looked at beyond it. A grid of 4096 x 4096 cells has as many."""


class Distribution(StrEnum):
    """Which ROS 2 the peers have: it decides about the hashes of types, which are part of every key."""

    HUMBLE = "humble"
    JAZZY = "jazzy"
    KILTED = "kilted"
    LYRICAL = "lyrical"
    ROLLING = "rolling"


_STORES = {
    Distribution.HUMBLE: Stores.ROS2_HUMBLE,
    Distribution.JAZZY: Stores.ROS2_JAZZY,
    Distribution.KILTED: Stores.ROS2_KILTED,
    Distribution.LYRICAL: Stores.ROS2_LYRICAL,
    Distribution.ROLLING: Stores.LATEST,
}

_MESSAGES: Mapping[str, str] = {
    "map_msgs/msg/OccupancyGridUpdate": "std_msgs/Header header\nint32 x\nint32 y\n"
    "uint32 width\nuint32 height\nint8[] data",
}
_SERVICES: Mapping[str, tuple[str, str]] = {
    "std_srvs/srv/Trigger": ("", "bool success\nstring message"),
    "std_srvs/srv/SetBool": ("bool data", "bool success\nstring message"),
    "std_srvs/srv/Empty": ("", ""),
    "nav_msgs/srv/GetMap": ("", "nav_msgs/OccupancyGrid map"),
    "nav_msgs/srv/GetPlan": (
        "geometry_msgs/PoseStamped start\ngeometry_msgs/PoseStamped goal\nfloat32 tolerance",
        "nav_msgs/Path plan",
    ),
}  # fmt: skip
REQUEST, RESPONSE = "_Request", "_Response"


class RosTypes:
    """The types of one distribution.

    distribution  whose
    """

    def __init__(self, distribution: Distribution) -> None:
        self.distribution = distribution
        self._store = get_typestore(_STORES[distribution])
        _hash_char_as_uint8(self._store)
        for name, text in _MESSAGES.items():
            self.add_message(name, text)
        for name, (request, response) in _SERVICES.items():
            self.add_service(name, request, response)

    def add_message(self, name: str, text: str) -> None:
        """Add what rosbags lacks. `name` is "pkg/msg/X", "pkg/srv/X_Request" or "pkg/action/X_Goal"; `text` as .msg
        files have it."""
        if name in self._store.fielddefs:
            return
        package, _, base = name.split("/")
        as_message = f"{package}/msg/{base}"  # what rosbags makes of every name
        self._store.register({name: get_types_from_msg(text, as_message)[as_message]})

    def add_service(self, name: str, request: str, response: str) -> None:
        """Add a service with its parts: "pkg/srv/X"."""
        self.add_message(name + REQUEST, request)
        self.add_message(name + RESPONSE, response)
        self.link_service(name)

    def link_service(self, name: str) -> None:
        """Add the type of a service whose request and response are known: what its hash is computed from."""
        if "service_msgs/msg/ServiceEventInfo" not in self._store.fielddefs:
            return  # Humble, which hashes nothing

        def at_most_one(part: str) -> Any:
            return Nodetype.SEQUENCE, ((Nodetype.NAME, name + part), 1)

        info = (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")
        event = [("info", info), ("request", at_most_one(REQUEST)), ("response", at_most_one(RESPONSE))]
        parts = ("Request", "Response", "Event")
        self._store.register({f"{name}_Event": ([], event)})
        self._store.register(
            {name: ([], [(f"{part.lower()}_message", (Nodetype.NAME, f"{name}_{part}")) for part in parts])}
        )

    @property
    def names(self) -> list[str]:
        """Of all types: messages, and the parts of services."""
        return sorted(self._store.fielddefs)

    def hash_of(self, name: str) -> str:
        """RIHS01_... of a message or a service (of the service itself, not of its parts)."""
        return NO_HASH if self.distribution is Distribution.HUMBLE else self._store.hash_rihs01(name)

    def definition_of(self, name: str) -> str:
        """The definition of a message with those that it is made of, as recordings keep it."""
        return str(self._store.generate_msgdef(name, ros_version=2)[0])

    def make(self, name: str, /, **fields: Any) -> Any:
        """A message of a type, such as make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=0.0)."""
        return self._store.types[name](**fields)

    def pack(self, message: Any, name: str) -> bytes:
        """CDR, little-endian, with its header of four bytes."""
        return bytes(self._store.serialize_cdr(message, name))

    def unpack(self, content: bytes, name: str) -> Any:
        """A message that somebody sent. Raises ProtocolError on what is none of this type."""
        if len(content) > LARGEST_MESSAGE_BYTES:
            raise ProtocolError(f"{name} has {len(content)} bytes, expected at most {LARGEST_MESSAGE_BYTES}")
        try:
            return self._store.deserialize_cdr(content, name)
        except (SerdeError, IndexError, OverflowError, MemoryError) as error:
            raise ProtocolError(f"{name} of {len(content)} bytes is not CDR of its type: {error}") from error


@lru_cache(maxsize=len(Distribution))
def types_of(distribution: Distribution) -> RosTypes:
    """The types of a distribution, loaded once: it takes a sixth of a second."""
    return RosTypes(distribution)


def _hash_char_as_uint8(store: Typestore) -> None:
    def repaired(field: Any) -> Any:
        node, (inner, bound) = field[0], field[1] if isinstance(field[1], tuple) else (field[1], 0)
        if node is Nodetype.BASE and inner == "char":
            return node, ("uint8", bound)
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            return node, (repaired(inner), bound)
        return field

    for name, (constants, fields) in list(store.fielddefs.items()):
        store.fielddefs[name] = (constants, [(field, repaired(kind)) for field, kind in fields])
