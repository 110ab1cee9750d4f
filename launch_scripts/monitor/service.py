"""The monitor's shell: draws what it hears of the swarm, frame by frame.

It only listens. It may be late, stalled, killed or absent; no process waits for it.
"""

from __future__ import annotations

import logging

import rerun as rr

from launch_scripts.monitor.drawing import Drawing
from launch_scripts.monitor.figures_panel import level_of, summary_markdown
from launch_scripts.monitor.ground.terrain_mesh import TerrainMesh
from launch_scripts.monitor.ground.windows import window_outlines
from launch_scripts.monitor.movers.movers_view import MoversView
from launch_scripts.monitor.serving.recording_watch import RecordingWatch
from launch_scripts.monitor.serving.sinks import Streams
from launch_scripts.report.recorder import RECORDED, Recorder
from launch_scripts.report.samples import messages_per_s
from shared_map.cost_map import CostMap
from shared_map.replication.replica import MapReplica
from shared_map.replication.sync import MapSync
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Bus, Disappeared, Event, Heard, Post
from swarm.clock import NS_PER_S
from swarm.grid import Window
from swarm.liveness import Peer
from swarm.runtime.membership import Member
from swarm.runtime.role import RoleSetup
from swarm.runtime.stats import Counters
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import Note
from swarm.wire.messages.vehicles import Fleet
from swarm.wire.topics import BODY, FLEET, FOLLOWED, MARKS, POSE, SIGHTED, Topic

log = logging.getLogger(__name__)

FRAME_HZ = 10.0
"""How often the view is drawn."""
_DRAWN: dict[Topic, float] = {FLEET: 0.5 / FRAME_HZ, POSE: 0.0, FOLLOWED: 0.5, SIGHTED: 0.0, BODY: 0.0}
"""What is drawn as it comes, and how often the newest of each key is taken. Marks come by way of the map's sync."""
_WINDOWS_NS = NS_PER_S
_TEXTURES_NS, _TEXTURES_AT_ONCE = NS_PER_S, 80
"""Marks come many times a second to the same tiles, and each of their photos is drawn once for all."""
_REFRESH_NS = NS_PER_S
_ANNOUNCE_NS = NS_PER_S // 2


class MonitorService:
    """Shows a run on a recording stream.

    rec        a recording stream whose sinks are set
    live_url   address of the live view; published once
    recording  watches the file of the recording, if there is one
    """

    def __init__(
        self,
        setup: RoleSetup,
        terrain: Terrain,
        bus: Bus,
        post: Post,
        rec: rr.RecordingStream | Streams,
        *,
        mesh: TerrainMesh | None = None,
        live_url: str | None = None,
        recording: RecordingWatch | None = None,
    ) -> None:
        self.recorder = Recorder(setup.scenario, terrain.grid)
        self._setup = setup
        self._terrain = terrain
        self._bus = bus
        self._post = post
        self._live_url = live_url
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post)
        self.counters: Counters = self._member.counters
        self._cost_map = CostMap(terrain)
        replica = MapReplica(terrain.grid, self._cost_map)
        self._sync = MapSync(replica, bus, post, setup.scenario.map, setup.role, at_ticks=True)
        self._mesh = mesh or TerrainMesh(terrain)
        self._target_ids = setup.scenario.target_ids
        self._rec = rec
        self._recording = recording
        self._drawing = Drawing(rec, self._mesh, self._target_ids)
        self._stale_tiles: dict[int, None] = {}
        self._movers = MoversView(rec, self._mesh, setup.scenario, self.recorder, self.counters, replica.filter)
        self._windows_new = False
        self._windows: dict[str, tuple[int, ...]] = {}
        """Target -> the window that its planner grew last."""
        self._windows_due_ns = 0
        self._frame = 0
        self._newest_stamp_ns = setup.started_ns
        self._started_ns = 0
        self._refresh_due_ns = self._textures_due_ns = 0
        self._next_refresh = 0
        self._last_sample_s = -1.0

    def start(self, now_ns: int) -> None:
        self._started_ns = now_ns
        self._member.join()
        for topic, every_s in {**RECORDED, **_DRAWN}.items():
            if topic is not MARKS:
                self._bus.subscribe(topic, self._post, every_s=every_s)
        self._bus.watch_alive(self._post)
        self._sync.start(now_ns)
        self._drawing.set_time(0, 0.0)
        self._begin_drawing()

    def handle(self, event: Event, now_ns: int) -> None:
        if isinstance(event, Appeared | Disappeared):
            self._alive(event.peer, isinstance(event, Appeared), now_ns)
            return
        if self._member.handle(event) or self._sync.handle(event, now_ns):
            return
        if not isinstance(event, Heard):
            return
        self.recorder.heard(event.message, event.fields, now_ns)
        self._movers.hear(event.message, now_ns)
        match event.message:
            case Fleet(stamp_ns=stamp_ns):  # not by poses: a tracker's clock may be wrong
                self._newest_stamp_ns = max(stamp_ns, self._newest_stamp_ns)
            case PlannerStatus(target=target, window=window):
                if self._windows.get(target) != tuple(window):
                    self._windows[target] = tuple(window)
                    self._windows_new = True
            case Note() as note:
                self._drawing.note(f"{note.role} {note.id}: {note.text}", level_of(note.kind))

    def tick(self, now_ns: int) -> None:
        """Draws one frame."""
        self._sync.tick(now_ns)
        self._member.tick(now_ns)
        self._announce(now_ns)
        self._frame += 1
        self._drawing.set_time(self._frame, self._seconds())
        self._watch_recording(now_ns)
        for window in self._cost_map.take_dirty():
            self._stale_tiles.update(dict.fromkeys(self._mesh.tiles_touching(window)))
        if not self._stale_tiles and now_ns >= self._refresh_due_ns:
            self._refresh(now_ns)
        if now_ns >= self._textures_due_ns:
            self._textures_due_ns = now_ns + _TEXTURES_NS
            self._draw_textures(_TEXTURES_AT_ONCE)
        self._movers.tick(now_ns)
        if self._windows_new and now_ns >= self._windows_due_ns:
            self._windows_new, self._windows_due_ns = False, now_ns + _WINDOWS_NS
            self._draw_windows()
        self._draw_plots(now_ns)

    def stop(self, now_ns: int) -> None:
        self._member.publish_stats(now_ns)

    # --- in -----------------------------------------------------------------------------------------------------

    def _alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        self.recorder.alive(peer, up, now_ns)
        if now_ns - self._started_ns > 2 * NS_PER_S:  # those that were there before are not news
            text = f"{peer.role} {peer.id} is {'up' if up else 'gone'}"
            self._drawing.note(text, "INFO" if up else "WARN")

    def _announce(self, now_ns: int) -> None:
        """Publishes the live view's address, once links have had time to learn of subscribers."""
        if self._live_url is not None and now_ns - self._started_ns >= _ANNOUNCE_NS:
            self._member.note(now_ns, "live_view", self._live_url)
            self._live_url = None

    def _watch_recording(self, now_ns: int) -> None:
        if self._recording is None:
            return
        sentence, begun = self._recording.look(now_ns)
        if begun:
            self._drawing = Drawing(self._rec, self._mesh, self._target_ids)
            self._begin_drawing()
        if sentence is not None:
            log.warning("%s", sentence)
            self._member.note(now_ns, "recording", sentence)

    def _begin_drawing(self) -> None:
        """Draws all that does not move."""
        self._drawing.begin()
        self._movers.begin()
        self._stale_tiles = dict.fromkeys(range(self._mesh.tile_rows * self._mesh.tile_cols))
        self._draw_textures(len(self._stale_tiles))

    def _seconds(self) -> float:
        return max(self._newest_stamp_ns - self._setup.started_ns, 0) / NS_PER_S

    # --- out ----------------------------------------------------------------------------------------------------

    def _refresh(self, now_ns: int) -> None:
        """Sends one texture again: a viewer which joins late has only what the server still holds."""
        self._refresh_due_ns = now_ns + _REFRESH_NS
        self._stale_tiles[self._next_refresh] = None
        self._next_refresh = (self._next_refresh + 1) % (self._mesh.tile_rows * self._mesh.tile_cols)

    def _draw_textures(self, most: int) -> None:
        for tile in list(self._stale_tiles)[:most]:
            del self._stale_tiles[tile]
            window = self._mesh.tile_window(tile)
            image = self._mesh.texture(window, self._cost_map.ground_s_per_m, self._terrain.ground_s_per_m)
            self._drawing.texture(tile, image)

    def _draw_windows(self) -> None:
        """Draws the window that each planner grew last, unless it is the whole terrain."""
        told = (Window(*self._windows[target]) for target in sorted(self._windows) if self._windows[target])
        parts = [window for window in told if not window.empty and window.cells < self._terrain.grid.cells]
        self._drawing.windows(window_outlines(self._mesh, parts))

    def _draw_plots(self, now_ns: int) -> None:
        samples = self.recorder.samples.newest
        if not samples or samples[-1].time_s == self._last_sample_s:
            return
        self._last_sample_s = samples[-1].time_s
        rates = messages_per_s(samples)
        self._drawing.plots(samples[-1], rates[-1][1] if rates else None)
        summary = self.recorder.summary(now_ns)
        self._movers.summarised(summary)
        self._drawing.summary(summary_markdown(self._setup, summary))
