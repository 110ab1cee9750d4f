"""A monitor on a memory bus, and another sender."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from support import fake_run
from support.swarm_model import SwarmModel

from launch_scripts.monitor.ground_view import Scene
from launch_scripts.monitor.live_layout import layers_of, make_blueprint
from launch_scripts.monitor.rerun_outputs import Pen, Sinks
from launch_scripts.monitor.service import MonitorService
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from launch_scripts.web.http_server import Audience
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.bus.memory_bus import MemoryBus
from swarm.config.scenario import MonitorConfig, Scenario
from swarm.peers import Peer
from swarm.wire import topics
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkSet

_TOPICS = (
    topics.BELIEVED, topics.OBSTACLE, topics.FLEET, topics.FOLLOWED, topics.GOAL_STATES, topics.MARKS, topics.NOTE,
    topics.POSE, topics.SIGHTED, topics.STATS, topics.STATUS,
)  # fmt: skip
SILENT = MonitorConfig(live=False)
LIVE = MonitorConfig(live=True, web_port=0)
READ = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
NOBODY, SOMEBODY = Audience(now=0, ever=0), Audience(now=1, ever=1)


def little_scenario() -> Scenario:
    return fake_run.little_scenario(more="[monitor]\nlive = false\n")


def little_terrain() -> Terrain:
    rows, cols = np.mgrid[0:80, 0:100].astype(np.float32)
    elevation_m = (40 * np.sin(rows / 9) + 30 * np.cos(cols / 7)).astype(np.float32)
    return terrain_of_pace(np.full((80, 100), 0.1, np.float32), 25.0, elevation_m)


def hill(rows: int, cols: int, resolution_m: float = 10.0, top_m: float = 50.0) -> Terrain:
    """Rises evenly to the east."""
    elevation_m = np.tile(np.linspace(0, top_m, cols, dtype=np.float32), (rows, 1))
    return terrain_of_pace(np.ones((rows, cols), np.float32), resolution_m, elevation_m)


def hidden_truth(terrain: Terrain) -> NDArray[np.float32]:
    """A wall across the middle of the little terrain."""
    truth = np.array(terrain.pace_s_per_m)
    truth[30:34, 20:80] = np.inf
    return truth


class Rig(SwarmModel):
    """A monitor on a memory bus, and another sender. Frames are drawn while a run is played."""

    def __init__(
        self,
        scenario: Scenario,
        terrain: Terrain,
        path: Path | None,
        web_port: int = 0,
        config: MonitorConfig = SILENT,
        audience: Audience = SOMEBODY,
    ) -> None:
        """The audience is who looks; set `self.audience` for those who come and go."""
        self.audience = audience
        super().__init__(terrain=terrain, scenario=scenario, start_ns=0)
        self.speaker = self.bus("speaker")
        mesh = self.mesh = TerrainMesh(terrain)
        layers = layers_of(scenario, knows_truth=False)
        self.sinks = Sinks("run.1", path, config, make_blueprint(mesh, layers))
        scene = Scene(Pen(self.sinks.streams, mesh), layers)
        setup = self.setup("monitor", "0")
        self.service = self.start(
            "monitor",
            lambda bus, post: MonitorService(
                setup, terrain, bus, post, scene, web_port=web_port, audience=lambda: self.audience
            ),
        )

    @property
    def said(self) -> set[str]:
        return {what for _, source, _, what, _ in self.deliveries if source == "monitor"}

    def play(self, told: Iterable[tuple[int, Message | Peer]]) -> None:
        for now_ns, message in told:
            self.run_until(now_ns)
            if isinstance(message, Peer):
                self.speaker.declare_alive(message)
            else:
                say(self.speaker, self.terrain, message)
        self.run(1)

    def close(self) -> None:
        self.service.stop(self.now_ns)
        self.sinks.close()


def taking(host: str = "localhost") -> bytes:
    """A request for the stream of the live view."""
    head = f"POST {READ} HTTP/1.1\r\nHost: {host}\r\nContent-Type: application/grpc-web+proto\r\n"
    return head.encode() + b"Content-Length: 5\r\n\r\n" + bytes(5)


def say(bus: MemoryBus, terrain: Terrain, message: Message) -> None:
    """Publishes a message on its topic, under the key that its fields make; one that no view hears is left out."""
    told = {"agent": "a0", **{name: getattr(message, name) for name in message.__struct_fields__}}
    if isinstance(message, MarkSet):
        told["region"] = terrain.grid.region_of_tile(message.tile)
    for topic in _TOPICS:
        if topic.message is type(message):
            bus.publish(topic, message, **{field: told[field] for field in topic.fields})
