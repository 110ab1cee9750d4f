"""The node and a foreign stack hear, ask and answer each other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.processes import eventually
from support.ros_node import PeerNode
from support.ros_peer import RosPeer, ros_router, write_definitions

from launch_scripts.gateways.ros2.ros_node import open_ros
from launch_scripts.gateways.ros2.ros_types import Distribution, types_of

pytestmark = pytest.mark.network
TYPES = types_of(Distribution.JAZZY)


@pytest.fixture
def port() -> Iterator[int]:
    with ros_router() as port:
        yield port


def test_a_foreign_peer_and_the_node_hear_and_answer_each_other(port: int, tmp_path: Path) -> None:
    heard: list[Any] = []
    with open_ros(f"tcp/127.0.0.1:{port}") as session:
        node = PeerNode(session, "node", TYPES)
        node.subscribe("/uav1/odom", "nav_msgs/msg/Odometry", heard.append)
        node.serve(
            "/swarm/hold",
            "std_srvs/srv/Trigger",
            lambda _, reply: reply(TYPES.make("std_srvs/srv/Trigger_Response", success=True, message="held")),
        )
        said = node.publisher("/said", "std_msgs/msg/String")
        with RosPeer(port, write_definitions(tmp_path, TYPES)) as peer:
            peer.put("/uav1/odom", "nav_msgs/msg/Odometry", hz=20, pose={"pose": {"position": {"x": 4.5}}})
            eventually(lambda: heard, 10, "odometry of the peer")
            assert heard[0].pose.pose.position.x == 4.5
            answer = peer.ask("/swarm/hold", "std_srvs/srv/Trigger")
            assert answer["message"] == {"success": True, "message": "held"}
            peer.hear("/said", "std_msgs/msg/String")

            def told() -> bool:
                said.put(TYPES.make("std_msgs/msg/String", data="a word"))
                return {"data": "a word"} in peer.heard["/said"]

            eventually(told, 10, "a word at the peer")
        node.close()
