"""The names of rmw_zenoh for nodes and endpoints: keys of data, liveliness tokens, QoS, attachments. Pure.

Source: rmw_zenoh's design.md and its liveliness_utils; checked against two independent stacks (tests).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, StrEnum

import xxhash

from swarm.errors import ProtocolError

TOKEN_SPACE = "@ros2_lv"
NO_HASH = "TypeHashNotSupported"
"""Stands for the hash where a distribution has none: Humble."""
_GID_BYTES = 16
"""Bytes of an endpoint's id in an attachment of rmw_zenoh."""
_ATTACHMENT = struct.Struct(f"<qqB{_GID_BYTES}s")
_TOKEN_PARTS = 13
"""Parts of an endpoint's token that every version has. Newer ones append, which is left unread."""
_NODE_PARTS = 9
"""Parts of a node's token: space, domain, session, node, entity, NN, enclave, namespace and name."""


class Kind(StrEnum):
    """Kind of an endpoint, as in its token."""

    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


class Qos(Enum):
    """The qualities of service in use, as tokens spell them: reliability:durability:history,depth and the rest.

    Nothing of the first three is left out, for each reader has defaults of its own.
    """

    DEFAULT = "1:2:1,10:,:,:,,"
    """Reliable, volatile, the last 10."""
    LATCHED = "1:1:1,1:,:,:,,"
    """Reliable, transient local, the last one: a late subscriber gets it."""
    SENSOR = "2:2:1,5:,:,:,,"
    """Best effort, volatile, the last 5."""
    TRANSFORMS = "1:2:1,100:,:,:,,"
    """Reliable, volatile, the last 100: /tf."""


@dataclass(frozen=True, slots=True)
class NodeName:
    """A node of a Zenoh session. ROS distinguishes nodes of one session by number; ours has one.

    zid  of the session, 32 hexadecimal digits
    """

    domain: int
    zid: str
    name: str

    @property
    def token(self) -> str:
        return f"{TOKEN_SPACE}/{self.domain}/{self.zid}/0/0/NN/{self.tail}"

    @property
    def tail(self) -> str:
        """Enclave, namespace and name. There is no enclave, as nothing here speaks ROS's own security. Peers may
        have a namespace, which is left unread."""
        return f"%/%/{self.name}"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher, subscription, service or client of a node.

    number     in its session, from 1 on
    topic      with its leading slash: "/map"
    type_name  "nav_msgs/msg/OccupancyGrid", of a service without _Request
    type_hash  "RIHS01_..." or NO_HASH; of a service, the service's own
    qos        as the token spells it
    """

    node: NodeName
    number: int
    kind: Kind
    topic: str
    type_name: str
    type_hash: str
    qos: str

    @property
    def key(self) -> str:
        """The Zenoh key of the data, or of the service's queryable."""
        return f"{self.node.domain}/{self.topic.strip('/')}/{dds_name(self.type_name)}/{self.type_hash}"

    @property
    def token(self) -> str:
        node = self.node
        return (  # in a token a slash of the topic is '%'
            f"{TOKEN_SPACE}/{node.domain}/{node.zid}/0/{self.number}/{self.kind}/{node.tail}/"
            f"{self.topic.replace('/', '%') or '%'}/{dds_name(self.type_name)}/{self.type_hash}/{self.qos}"
        )

    @property
    def gid(self) -> bytes:
        """16 bytes that name it in attachments: XXH3-128 of the token, low half first."""
        return xxhash.xxh3_128_digest(self.token.encode())[::-1]


def dds_name(type_name: str) -> str:
    """Returns nav_msgs::msg::dds_::Path_ for nav_msgs/msg/Path."""
    package, kind, base = type_name.split("/")
    return f"{package}::{kind}::dds_::{base}_"


def type_name_of(dds: str) -> str:
    """nav_msgs::msg::dds_::Path_ -> nav_msgs/msg/Path. Raises ProtocolError."""
    parts = dds.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        raise ProtocolError(f"type is {dds!r}, expected package::kind::dds_::Name_")
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """Returns the attachment of a message, request or reply: 33 bytes, as Zenoh serialises int64, int64 and array.

    sequence  counted by the sender from 1 on; a reply repeats its request's
    stamp_ns  when it was sent, since 1970
    gid       of the sending endpoint; a reply repeats its request's
    """
    return _ATTACHMENT.pack(sequence, stamp_ns, len(gid), gid)


def read_attachment(content: bytes) -> tuple[int, int, bytes]:
    """Returns the parts of which an attachment is made. Raises ProtocolError."""
    if len(content) != _ATTACHMENT.size or content[_ATTACHMENT.size - _GID_BYTES - 1] != _GID_BYTES:
        raise ProtocolError(f"attachment has {len(content)} bytes, expected 33 with a gid of 16")
    sequence, stamp_ns, _, gid = _ATTACHMENT.unpack(content)
    return sequence, stamp_ns, gid


def read_token(key: str) -> Endpoint | None:
    """Returns the endpoint which a token tells of; None of a node's. Raises ProtocolError on anything else."""
    parts = key.split("/")
    if len(parts) >= _NODE_PARTS and parts[0] == TOKEN_SPACE and parts[5] == "NN":
        return None
    if len(parts) < _TOKEN_PARTS or parts[0] != TOKEN_SPACE:
        raise ProtocolError(
            f"token {key[:200]!r} has {len(parts)} parts, expected {_TOKEN_PARTS} below {TOKEN_SPACE}"
        )
    if not key.isprintable():  # names go to logs and terminals, which they might steer
        raise ProtocolError(f"token {key[:200]!r} has signs that no name in ROS has")
    try:
        domain, number, kind = int(parts[1]), int(parts[4]), Kind(parts[5])
    except ValueError as error:
        raise ProtocolError(f"token {key[:200]!r}: {error}") from error
    node = NodeName(domain, parts[2], parts[8])
    topic, type_name = parts[9].replace("%", "/"), type_name_of(parts[10])
    return Endpoint(node, number, kind, topic, type_name, parts[11], parts[12])


# --- peers which will never meet us -------------------------------------------------------------------------------

_MEETS_AND_DOES = {
    Kind.PUBLISHER: (Kind.SUBSCRIPTION, "publishes"),
    Kind.SUBSCRIPTION: (Kind.PUBLISHER, "subscribes to"),
    Kind.SERVICE: (Kind.CLIENT, "serves"),
    Kind.CLIENT: (Kind.SERVICE, "asks"),
}
MOST_REPORTED = 1000
"""Limit of sentences, after which no more are reported."""


class PeerWatch:
    """Tells of each peer's fault once."""

    def __init__(self) -> None:
        self._reported: set[str] = set()

    def sentences(self, seen: Endpoint, ours: Iterable[Endpoint]) -> list[str]:
        """Returns one sentence about the reason why a peer's endpoint does not match one of ours of the same name;
        empty if there is none, or if it was reported before."""
        meets, does = _MEETS_AND_DOES[seen.kind]
        faults = [_why_not(seen, mine) for mine in ours if mine.topic == seen.topic and mine.kind is meets]
        if not faults or None in faults:
            return []
        sentence = f"node {seen.node.name[:80]} {does} {seen.topic[:120]} {faults[0]}"
        if sentence in self._reported or len(self._reported) >= MOST_REPORTED:
            return []
        self._reported.add(sentence)
        return [sentence]


def _why_not(seen: Endpoint, mine: Endpoint) -> str | None:
    ours = mine.node.domain
    if seen.node.domain != ours:
        return f"in domain {seen.node.domain}, and this gateway is in domain {ours} (ROS_DOMAIN_ID, --domain)"
    if seen.type_name != mine.type_name:
        return f"as {seen.type_name[:120]}, and here it is {mine.type_name}"
    if seen.type_hash == mine.type_hash:
        return None
    if NO_HASH in (seen.type_hash, mine.type_hash):
        theirs = "humble" if seen.type_hash == NO_HASH else "a distribution after humble"
        mine_is = "humble" if mine.type_hash == NO_HASH else "a later one"
        return f"as {theirs} does, and this gateway speaks as {mine_is} (--distribution)"
    return (
        f"with another definition of {mine.type_name}: hash {seen.type_hash[:20]}, here {mine.type_hash[:20]} "
        "(--distribution, or a changed message)"
    )
