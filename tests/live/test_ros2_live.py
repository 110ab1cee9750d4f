"""`gateway ros2` beside a real swarm: heard by a foreign stack, by plain Zenoh, by a late node of ours."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh
from support.far_processes import NAMESPACE, Far, on_free_port
from support.live_swarm import SWARM, LiveSwarm
from support.made_up_swarm import swarm_peer
from support.processes import eventually
from support.ros_node import PeerNode
from support.ros_peer import Gateway, RosPeer, ros_router, write_definitions

from launch_scripts.gateways.ros2.gateway_settings import ROWS
from launch_scripts.gateways.ros2.rmw import Qos
from launch_scripts.gateways.ros2.ros_node import open_ros
from launch_scripts.gateways.ros2.ros_types import types_of
from swarm.bus.zenoh_bus import open_bus
from swarm.config.scenario import NetworkConfig

pytestmark = pytest.mark.network

OPTIONS = ("--no-live",)
TYPES = types_of("jazzy")
OUT = list(ROWS)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Port of the ROS side's router."""
    with ros_router() as port:
        yield port


def beside(live: LiveSwarm, port: int, folder: Path) -> Gateway:
    return Gateway(live.endpoint, f"tcp/127.0.0.1:{port}", folder, "--runs", live.runs)


@pytest.fixture(scope="module")
def gateway(live: LiveSwarm, port: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    """One for all tests down to that which kills it."""
    with beside(live, port, tmp_path_factory.mktemp("gateway")) as gateway:
        yield gateway


@pytest.fixture
def session(port: int) -> Iterator[zenoh.Session]:
    """Session of a node of ours at the ROS side's router."""
    with open_ros(f"tcp/127.0.0.1:{port}") as session:
        yield session


@pytest.fixture(scope="module")
def definitions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_definitions(tmp_path_factory.mktemp("definitions"), TYPES)


def topic_of(row: str) -> str:
    return ROWS[row].topic.format(vehicle="a0_01", target="t0")


def test_a_foreign_stack_lists_every_topic(gateway: Gateway, port: int) -> None:
    program = "from zenoh_ros2_sdk.cli import main; main()"
    # This terrain has no coordinates.
    expected = {f"{topic_of(row)} [{ROWS[row].type_name}]" for row in OUT if row != "fix"}

    def missing() -> set[str]:
        listed = subprocess.run(
            [sys.executable, "-c", program, "--no-daemon", "--router", f"127.0.0.1:{port}",
             "topic", "list", "-t"],
            capture_output=True, text=True, timeout=30, check=False,
        )  # fmt: skip
        return expected - set(listed.stdout.splitlines())

    eventually(lambda: not missing(), 60, "every topic in the list")  # each is there once it has something to tell


def test_a_latched_map_comes_to_who_comes_late(gateway: Gateway, session: zenoh.Session) -> None:
    node = PeerNode(session, "late", TYPES)
    maps, frames = [], []
    time.sleep(1.5)  # the map was put long before
    node.subscribe("/map", ROWS["map"].type_name, maps.append, Qos.LATCHED)
    node.subscribe("/tf_static", ROWS["tf_static"].type_name, frames.append, Qos.LATCHED)
    eventually(lambda: maps and frames, 15, "the map and the frames")
    grid = maps[0]
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (128, 96, 30.0)
    assert grid.data.min() >= 0, "the terrain of the run is on this machine: every cell is known"
    assert {each.child_frame_id for each in frames[-1].transforms} == {
        f"a{agent}_{n:02}/odom" for agent in (0, 1) for n in range(6)
    }
    node.close()


def test_a_peer_of_another_domain_or_distribution_is_logged(gateway: Gateway, session: zenoh.Session) -> None:
    elsewhere = PeerNode(session, "far", TYPES, domain=7)
    elsewhere.subscribe("/map", ROWS["map"].type_name, lambda message: None)
    eventually(lambda: "node far subscribes to /map in domain 7" in gateway.text, 15, "the word about a domain")
    elsewhere.close()
    older = PeerNode(session, "old", types_of("humble"))
    older.subscribe("/map", ROWS["map"].type_name, lambda message: None)
    eventually(lambda: "node old subscribes to /map as humble does" in gateway.text, 15, "the word about humble")
    older.close()


def test_after_kill_9_of_the_gateway_nothing_of_it_is_left(gateway: Gateway, session: zenoh.Session) -> None:
    there: set[str] = set()
    node = PeerNode(session, "watcher", TYPES)
    node.watch("0", lambda seen, is_there: there.add(seen.topic) if is_there else there.discard(seen.topic))
    eventually(lambda: {topic_of(row) for row in OUT if row != "fix"} <= there, 40, "all topics")
    gateway.kill()
    eventually(lambda: not there, 15, "the end of all tokens")
    node.close()


def test_the_gateway_ends_at_ctrl_c_and_says_what_it_lacks(live: LiveSwarm, port: int, tmp_path: Path) -> None:
    with beside(live, port, tmp_path) as gateway:
        gateway.process.send_signal(2)
        assert gateway.process.wait(40) == 0, gateway.text
        assert "Traceback" not in gateway.text
    alone = subprocess.run(
        [*SWARM, "gateway", "ros2", "--connect", live.endpoint, "--ros", "tcp/127.0.0.1:9"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert alone.returncode == 4
    assert alone.stderr == (
        "swarm: no router of the ROS side listens at tcp/127.0.0.1:9: start rmw_zenohd, or name it by --ros\n"
    )


def poses_heard(port: int, within_s: float) -> None:
    """Waits until a node at this router hears where vehicles are."""
    with open_ros(f"tcp/127.0.0.1:{port}") as session:
        received: list[object] = []
        PeerNode(session, "hearer", TYPES).subscribe("/swarm/poses", ROWS["poses"].type_name, received.append)
        eventually(lambda: received, within_s, "poses of vehicles")


@contextmanager
def made_up_swarm(network: NetworkConfig, run_id: str) -> Iterator[None]:
    """A router, and agents with 25 vehicles."""
    with open_bus(network, mode="router"), Far(network) as far:
        far.start(swarm_peer, 25, 90.0, run_id)
        yield


def gateway_of(network: NetworkConfig, port: int, folder: Path) -> Gateway:
    words = ("--namespace", network.namespace, "--runs", folder)
    return Gateway(network.connect[0], f"tcp/127.0.0.1:{port}", folder, *words)


def test_a_foreign_stack_hears_every_type(tmp_path: Path, definitions: Path) -> None:
    network = on_free_port(NAMESPACE)
    with ExitStack() as ends:
        ends.enter_context(made_up_swarm(network, "bench"))
        port = ends.enter_context(ros_router())
        peer = ends.enter_context(RosPeer(port, definitions))
        # Before the gateway starts: the SDK does not ask for latched messages.
        for row in OUT:
            peer.hear(topic_of(row), ROWS[row].type_name)
        ends.enter_context(gateway_of(network, port, tmp_path))
        eventually(lambda: all(peer.received[topic_of(row)] for row in OUT), 40, "a message of each topic")
        pose = peer.received[topic_of("pose")][-1]
        assert pose["header"]["frame_id"] == "map"
        assert pose["header"]["stamp"]["sec"] == pytest.approx(time.time(), abs=60)
        assert 500 < pose["pose"]["position"]["x"] < 4000
        assert pose["pose"]["position"]["y"] == pytest.approx(20_480 - 500)
        assert len(peer.received["/swarm/poses"][-1]["poses"]) == 25
        assert len(peer.received[topic_of("plan")][-1]["poses"]) == 201
        assert peer.received[topic_of("fix")][-1]["latitude"] == pytest.approx(47.85, abs=0.2)
        assert peer.received["/map"][0]["info"]["width"] == 2048


def test_either_side_may_go_and_come_back_and_the_next_run_is_told_as_well(tmp_path: Path) -> None:
    network = on_free_port(NAMESPACE)
    with ExitStack() as ends:
        with made_up_swarm(network, "first"):
            with ros_router() as port:
                gateway = ends.enter_context(gateway_of(network, port, tmp_path))
                poses_heard(port, 40)
            eventually(lambda: "the ROS router" in gateway.text, 15, "the word about the router that is gone")
            with ros_router(port):
                poses_heard(port, 20)
        ends.enter_context(ros_router(port))
        ends.enter_context(made_up_swarm(network, "second"))
        eventually(lambda: "run second" in gateway.text, 40, "the next run")
        poses_heard(port, 20)
        assert gateway.process.poll() is None, gateway.text
        assert "Traceback" not in gateway.text
