"""The gateway's wire format as ROS 2 peers expect it: keys, tokens, attachments, hashes, CDR."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import count
from types import SimpleNamespace
from typing import Any, get_args

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from launch_scripts.gateways.ros2 import rmw
from launch_scripts.gateways.ros2.gateway_settings import TopicRow
from launch_scripts.gateways.ros2.ros_node import Input, Node
from launch_scripts.gateways.ros2.ros_types import Distribution, types_of
from swarm.errors import ProtocolError

# The hashes as ROS nodes print them (`ros2 topic info -v`) and other stacks publish them.
PUBLISHED = {
    "geometry_msgs/msg/PoseStamped": "10f3786d",
    "geometry_msgs/msg/PoseArray": "af0cc36d",
    "nav_msgs/msg/Path": "1957a5bb",
    "nav_msgs/msg/OccupancyGrid": "8d348150",
    "map_msgs/msg/OccupancyGridUpdate": "c4095b0b",
    "nav_msgs/msg/Odometry": "3cc97dc7",
    "sensor_msgs/msg/NavSatFix": "62223ab3",
    "visualization_msgs/msg/MarkerArray": "86cb8800",
    "tf2_msgs/msg/TFMessage": "e369d0f0",
    "std_msgs/msg/String": "df668c74",
    "std_srvs/srv/Trigger": "eeff2cd6",
    "nav_msgs/srv/GetPlan": "234f7aff",
    "nav_msgs/srv/GetMap": "c8ae77c9",
}
NODE = rmw.NodeName(0, "54c1e0b8e18f2313ebc2c48bce10effe", "swarm_gateway")
NAMES = st.from_regex(r"[a-z][a-z0-9_]{0,8}(/[a-z][a-z0-9_]{0,8}){0,2}", fullmatch=True)


@pytest.mark.parametrize("distribution", [each for each in get_args(Distribution) if each != "humble"])
@pytest.mark.parametrize("name", PUBLISHED)
def test_hashes_are_those_that_ros_publishes(distribution: Distribution, name: str) -> None:
    assert types_of(distribution).hash_of(name).startswith(f"RIHS01_{PUBLISHED[name]}")


def test_humble_has_no_hashes() -> None:
    assert types_of("humble").hash_of("nav_msgs/msg/Path") == rmw.NO_HASH


def test_key_and_token_of_a_latched_map() -> None:
    hash = types_of("jazzy").hash_of("nav_msgs/msg/OccupancyGrid")
    endpoint = rmw.Endpoint(
        NODE, 4, rmw.Kind.PUBLISHER, "/map", "nav_msgs/msg/OccupancyGrid", hash, rmw.Qos.LATCHED.value
    )
    assert endpoint.key == f"0/map/nav_msgs::msg::dds_::OccupancyGrid_/{hash}"
    assert endpoint.token == (
        "@ros2_lv/0/54c1e0b8e18f2313ebc2c48bce10effe/0/4/MP/%/%/swarm_gateway/%map/"
        f"nav_msgs::msg::dds_::OccupancyGrid_/{hash}/1:1:1,1:,:,:,,"
    )


@given(
    domain=st.integers(0, 232), number=st.integers(1, 10**6), kind=st.sampled_from(rmw.Kind), topic=NAMES,
    qos=st.sampled_from(rmw.Qos), more=st.sampled_from(["", "/", "/x/y"]),
)  # fmt: skip
def test_a_token_reads_back_what_it_says(
    domain: int, number: int, kind: rmw.Kind, topic: str, qos: rmw.Qos, more: str
) -> None:
    node = rmw.NodeName(domain, NODE.zid, "n")
    said = rmw.Endpoint(node, number, kind, f"/{topic}", "nav_msgs/msg/Path", "RIHS01_00", qos.value)
    assert rmw.read_token(said.token + more) == said
    assert rmw.read_token(node.token) is None


@given(st.text(max_size=80) | NAMES.map(lambda text: f"@ros2_lv/0/{text}/0/0/MP/%/%/n/{text}/{text}/h/q"))
def test_a_strange_token_raises_only_a_protocol_error(key: str) -> None:
    with suppress(ProtocolError):
        seen = rmw.read_token(key)
        assert seen is None or all(part.isprintable() for part in (seen.node.name, seen.topic, seen.type_name))


@pytest.mark.parametrize("place", [8, 9, 10, 11, 12])
@pytest.mark.parametrize("sign", ["\x1b[2J", "\n", "\u202e"])
def test_no_name_of_a_peer_steers_a_terminal(place: int, sign: str) -> None:
    parts = rmw.Endpoint(NODE, 1, rmw.Kind.PUBLISHER, "/map", "nav_msgs/msg/Path", "RIHS01_00", "").token.split("/")
    parts[place] = sign + parts[place]
    with pytest.raises(ProtocolError) as error:
        rmw.read_token("/".join(parts))
    assert str(error.value).isprintable()


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_attachments_are_33_bytes_and_read_back(sequence: int, stamp_ns: int, gid: bytes) -> None:
    packed = rmw.attachment(sequence, stamp_ns, gid)
    assert (len(packed), packed[16], packed[17:]) == (33, 16, gid)
    assert int.from_bytes(packed[:8], "little", signed=True) == sequence
    assert rmw.read_attachment(packed) == (sequence, stamp_ns, gid)


@given(st.binary(max_size=60))
def test_other_attachments_are_refused(content: bytes) -> None:
    if len(content) != 33 or content[16] != 16:
        with pytest.raises(ProtocolError):
            rmw.read_attachment(content)


def test_an_empty_request_is_one_byte() -> None:
    types = types_of("jazzy")
    request = types.make("std_srvs/srv/Trigger_Request", structure_needs_at_least_one_member=0)
    assert types.pack(request, "std_srvs/srv/Trigger_Request") == b"\0\1\0\0\0"


@given(st.binary(max_size=200), st.sampled_from(sorted(set(PUBLISHED) - {n for n in PUBLISHED if "/srv/" in n})))
def test_bytes_that_are_no_message_raise_only_a_protocol_error(content: bytes, name: str) -> None:
    types = types_of("jazzy")
    for each in (content, b"\0\1\0\0" + content, b"\0\0\0\0" + content):
        with suppress(ProtocolError):
            types.unpack(each, name)


def test_the_newest_message_waits_until_someone_asks_and_is_taken_once() -> None:
    types, name = types_of("jazzy"), "std_msgs/msg/String"
    endpoint = SimpleNamespace(topic="/said", type_name=name)
    kept: list[Callable[[Any], None]] = []
    node: Any = SimpleNamespace(types=types, dropped=lambda topic, error: None)
    node.listen = lambda topic, row, keep: kept.append(keep) or endpoint
    node.read = partial(Node.read, node)
    taken: list[str] = []
    row = TopicRow("said", "/said", name, rmw.Qos.DEFAULT, "", hz=1e9)
    heard = Input(node, "/said", row, lambda message, _: taken.append(message.data), most_bytes=100)
    now_ns = count()
    for data, ticks in (("old", 0), ("new", 2), ("x" * 200, 1)):
        kept[0](SimpleNamespace(payload=zenoh.ZBytes(types.pack(types.make(name, data=data), name))))
        for _ in range(ticks):
            heard.tick(next(now_ns))
    assert taken == ["new"], "the older one, one taken twice, or more bytes than a message may have"
