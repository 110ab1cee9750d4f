"""The monitor's shell: draws what it hears of the swarm, frame by frame.

It listens, and asks planners for the costs that its layers show. It may be late, stalled, killed or absent; no
process waits for it.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path

from PIL import Image

from launch_scripts.monitor import live_layout
from launch_scripts.monitor.ground_view import GroundView, Scene, scenario_areas
from launch_scripts.monitor.movers_view import MoversView
from launch_scripts.monitor.rerun_outputs import Pen, RateLimit, Sinks, new_recording_path
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from launch_scripts.observe import run_state as facts
from launch_scripts.observe.latest_messages import LatestState, plan_of
from launch_scripts.observe.run_observer import HEARD, ROUTES_S, RunObserver
from launch_scripts.observe.run_state import state_of
from launch_scripts.web.http_server import Audience
from launch_scripts.web.live_page import LivePage
from shared_map.array_files import give_back_memory
from shared_map.cost_map import CostMap
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.store import load_terrain, load_truth
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import class_terrains, load_classes
from swarm.bus.bus import Appeared, Bus, Disappeared, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.ground import HiddenConfig
from swarm.config.vehicle_classes import aloft_classes
from swarm.peers import Peer
from swarm.runtime.membership import Member, MemberService
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.stats import VIEWERS
from swarm.wire.messages.planning import CostReply, PlannerStatus
from swarm.wire.messages.processes import Note, Stats
from swarm.wire.messages.vehicles import Fleet
from swarm.wire.topics import BELIEVED, COST, FLEET, FOLLOWED, NOTE, OBSTACLE, SIGHTED, Topic

log = logging.getLogger(__name__)

_READ: dict[Topic, float] = {
    **HEARD, NOTE: 0.0, FLEET: 0.0, FOLLOWED: ROUTES_S, SIGHTED: 0.0, OBSTACLE: 0.0, BELIEVED: 0.5
}  # fmt: skip
"""Topics on show, and the interval at which the newest of each key is taken; 0 for each frame. Marks come by way of
the map's sync."""
_ROUTES_SEEN_S = 0.5
"""Interval at which routes are taken for viewers."""
_UNSEEN = 2
"""Without viewers every second frame is left out: frames are drawn for the recording only."""
_EVERY_S = {"redraw": 10.0, "figures": 1.0}
"""Shortest interval of complete redraws for new viewers, and the interval of metrics."""
_ANSWER_S = 5.0
"""Longest wait for a planner's costs. A planner replies within 1 s, or states that it has no tree; the remainder is
for a busy machine."""


class MonitorService(MemberService):
    """Shows a run on a recording stream.

    scene      terrain and other inputs that are known beforehand
    web_port   port of the live view's page on this machine; 0: it has none
    recording  begins another file where one has ended, and returns it (`Sinks.check_file`)
    audience   viewers of the stream; if not given, there is always one
    """

    def __init__(
        self,
        setup: RoleSetup,
        terrain: Terrain,
        bus: Bus,
        post: Post,
        scene: Scene,
        *,
        web_port: int = 0,
        recording: Callable[[int], Path | None] = lambda now_ns: None,
        audience: Callable[[], Audience] = lambda: Audience(now=1, ever=1),
    ) -> None:
        scenario = setup.scenario
        self.observed = LatestState(plan_of(scenario, setup.started_ns), terrain.grid)
        self.over = False
        """Set for good by `stop`. Read by other threads, too."""
        self.figures: list[str] = []
        """The newest figures in lines, for the start page. Read by other threads, too."""
        self._setup, self._bus, self._post, self._pen = setup, bus, post, scene.pen
        self._recording, self._audience = recording, audience
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post, setup.before)
        self._member.web_port = web_port
        cost_map = CostMap(terrain, learning=scenario.map.learning)
        replica = MapReplica(terrain.grid, cost_map)
        self._sync = MapSync(replica, bus, post, scenario.map, setup.role)
        self._panel = live_layout.FiguresPanel(scene.pen, scenario.target_ids)
        self._movers = MoversView(scene.pen, scenario, self.observed, self.counters, replica.filter)
        self._ground = GroundView(scene, terrain, cost_map, replica, scenario, self._movers.colours.legend())
        self._observer = RunObserver(bus, post, self.observed, _READ)
        self._watched = False
        self._drawn_for = 0
        """Number of viewers that had ever connected at the last complete redraw."""
        self._limit = RateLimit(_EVERY_S)
        self._turn = self._frame = 0
        """Ticks so far, and those in which something was drawn."""
        self._newest_stamp_ns = setup.started_ns
        self._started_ns = 0
        self._member.needs("the shared map", lambda: self._sync.joined)

    def start(self, now_ns: int) -> None:
        self._started_ns = now_ns
        self._member.join()
        self._observer.keep_samples()
        self._observer.ask_gone()
        self.observed.alive(self._member.peer, True, now_ns)  # others receive it, and no process receives itself
        self._sync.start(now_ns)
        self._pen.set_time(0, 0.0)
        self._begin_drawing()

    def handle(self, event: Event, now_ns: int) -> None:
        if isinstance(event, Appeared | Disappeared):
            self._alive(event.peer, isinstance(event, Appeared), now_ns)
            return
        if self._member.on_member_event(event) or self._sync.on_map_event(event, now_ns):
            return
        match event:
            case Replied(message=Stats()):
                self._observer.take(event, now_ns)
            case Replied(message=CostReply() as costs):
                self._ground.hear_costs(costs, now_ns)
            case Heard():
                self._hear(event, now_ns)

    def tick(self, now_ns: int) -> None:
        """Processes received messages and draws one frame, if one is due."""
        self._member.tick(now_ns)
        self._turn += 1
        audience = self._audience()
        self.counters.gauge(VIEWERS, float(audience.now))
        if self._watched != (watched := audience.now > 0):
            self._watched = watched
            self._observer.pace(FOLLOWED, _ROUTES_SEEN_S if watched else ROUTES_S, now_ns)
        if watched or self._turn % _UNSEEN == 0:
            self._draw_frame(now_ns, audience.ever)

    def stop(self, now_ns: int) -> None:
        for sample in self._observer.due(now_ns, all=True):
            self._hear(sample, now_ns)
        self.observed.touch(now_ns)
        self._limit.all_due()
        self._ground.finish()
        self._draw_plots(now_ns)  # the last that the recording shows is how the run ended
        self.over = True
        self._member.publish_stats(now_ns)

    @property
    def at_s(self) -> float:
        """Seconds since launch that the view has come to. Read by other threads, too."""
        return max(self._newest_stamp_ns - self._setup.started_ns, 0) / NS_PER_S

    # --- in -----------------------------------------------------------------------------------------------------

    def _hear(self, event: Heard, now_ns: int) -> None:
        self._observer.take(event, now_ns)
        self._movers.on_observed(event.message, now_ns)
        match event.message:
            case Fleet(stamp_ns=stamp_ns):  # not by poses: a tracker's clock may be wrong
                self._newest_stamp_ns = max(stamp_ns, self._newest_stamp_ns)
            case PlannerStatus() as status:
                self._ground.hear_status(status)
            case Note() as note:
                self._panel.note(f"{note.role} {note.id}: {note.text}", live_layout.level_of(note.kind))

    def _alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        self.observed.alive(peer, up, now_ns)
        if now_ns - self._started_ns > 2 * NS_PER_S:  # those that were there before are not news
            self._panel.note(f"{peer.role} {peer.id} is {'up' if up else 'gone'}", "INFO")

    def _watch_recording(self, now_ns: int) -> None:
        if (path := self._recording(now_ns)) is not None:
            self._begin_drawing()
            sentence = f"the recording had ended, and goes on in {path}"
            log.warning("%s", sentence)
            self._member.note(now_ns, "recording", sentence)

    def _begin_drawing(self) -> None:
        """Draws all that does not move."""
        self._pen.forget()
        self._panel.begin()
        self._ground.begin()
        self._movers.begin()

    # --- out ----------------------------------------------------------------------------------------------------

    def _draw_frame(self, now_ns: int, viewers: int) -> None:
        """Draws one frame; `viewers` is the number of those that have ever connected."""
        self._sync.tick(now_ns)
        for sample in self._observer.due(now_ns):
            self._hear(sample, now_ns)
        self._frame += 1
        self._pen.set_time(self._frame, self.at_s)
        self._watch_recording(now_ns)
        if viewers > self._drawn_for and self._limit.due("redraw", now_ns):
            self._drawn_for = viewers
            self._pen.forget()
            self._ground.draw_anew()
            self._movers.draw_anew()
        if (target := self._ground.tick(now_ns, self._watched)) is not None:
            request = self._ground.samples.request
            self._member.ask_by_name(COST, request, tag="cost", timeout_s=_ANSWER_S, target=target)
        self._movers.tick(now_ns, self._watched)
        self._draw_plots(now_ns)
        if self._watched:
            self._pen.flush()

    def _draw_plots(self, now_ns: int) -> None:
        if self._limit.due("figures", now_ns):  # by our own clock: a swarm that says nothing any more is news, too
            state = state_of(self.observed, now_ns)
            self._movers.summarised(state)
            self._panel.plots(state)
            self._panel.summary(live_layout.summary_markdown(self._setup, state))
            self.figures = [facts.fact("elapsed_s").labelled(state), *facts.lines(state)]


def load_view(
    setup: RoleSetup,
    terrain: Terrain,
    bus: Bus,
    post: Post,
    closing: contextlib.ExitStack,
    page: LivePage | None = None,
) -> MonitorService:
    """Prepares drawing, opens the recording and the live view's ports, and makes the service.

    closing  closes what it opens
    page     of the live view, which is served already

    Raises SwarmError where a file or a port cannot be opened
    """
    Image.preinit()  # loads what writes pictures, or the first frame would wait for it
    scenario, config = setup.scenario, setup.scenario.monitor
    seen = load_terrain(setup)  # mapped once more: of what the mesh has read most is not read again
    load_classes(setup, seen)
    mesh = TerrainMesh(seen, config.height_factor, class_terrains(scenario, seen, aloft_classes(scenario)))
    del seen
    knows_truth = scenario.terrain.hidden != HiddenConfig()
    layers = live_layout.layers_of(scenario, knows_truth=knows_truth)
    blueprint = live_layout.make_blueprint(mesh, layers, vehicles=scenario.vehicle_count, follow=config.follow)
    path = None if setup.run_dir is None else new_recording_path(setup.run_dir)
    sinks = Sinks(f"{setup.run_id}.{setup.incarnation:x}", path, config, blueprint, page)
    closing.callback(sinks.close)
    truth = load_truth(setup, terrain) if knows_truth else None
    scene = Scene(Pen(sinks.streams, mesh), layers, truth, scenario_areas(scenario, terrain.grid))
    service = MonitorService(
        setup,
        terrain,
        bus,
        post,
        scene,
        web_port=sinks.web_port,
        recording=sinks.check_file,
        audience=sinks.audience,
    )
    give_back_memory()  # a hundred megabytes of a large map, of which its picture was made
    life, command = f"{setup.incarnation:x}", "" if path is None else f"rerun {path}"
    known = {"life": life, "recording": command, "name": f"{scenario.name}, run {setup.run_id}"}
    if sinks.page is not None:
        sinks.page.run = lambda: {**known, "at_s": service.at_s, "over": service.over, "figures": service.figures}
    return service
