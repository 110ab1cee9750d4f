"""The monitor: listens, records, serves on loopback, and delays no other process."""

import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
import warnings
from pathlib import Path
from typing import Any

import msgspec
import psutil
import pytest
from support.fake_run import fake_run
from support.monitor_rig import LIVE, NOBODY, SOMEBODY, Rig, hidden_truth, little_scenario, little_terrain
from support.processes import eventually
from support.target_reports import fleet

from launch_scripts import parent_death
from launch_scripts.monitor.live_layout import make_blueprint
from launch_scripts.monitor.rerun_outputs import Sinks, new_recording_path
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from swarm.bus.bus import Event, Heard
from swarm.clock import NS_PER_S
from swarm.config.scenario import MonitorConfig, Scenario
from swarm.errors import BusError
from swarm.peers import Peer
from swarm.wire.fields import pack_column
from swarm.wire.messages.orders import GoalState, GoalStates
from swarm.wire.messages.planning import Believed, Sighted
from swarm.wire.messages.processes import Stats
from swarm.wire.messages.vehicles import Followed, Obstacle
from swarm.wire.topics import STATS, TOPICS

SCENARIO, TERRAIN = little_scenario(), little_terrain()


def chunks(path: Path) -> list[Any]:
    """The content of a recording."""
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it has no footer
        return list(RrdReader(str(path)).stream())


def rows_by_entity(path: Path) -> dict[str, int]:
    """Entity -> rows logged over time, without static ones."""
    counts: dict[str, int] = {}
    for chunk in chunks(path):
        if not chunk.is_static:
            counts[str(chunk.entity_path)] = counts.get(str(chunk.entity_path), 0) + chunk.num_rows
    return counts


def still_entities(path: Path) -> set[str]:
    """Entities with something static."""
    return {str(chunk.entity_path) for chunk in chunks(path) if chunk.is_static}


def recorded(tmp_path: Path, scenario: Scenario = SCENARIO) -> tuple[Path, Rig]:
    """The recording of a run, and what made it."""
    rig = Rig(scenario, TERRAIN, new_recording_path(tmp_path))
    rig.play(fake_run(TERRAIN, hidden_truth(TERRAIN), scenario))
    rig.close()
    return tmp_path / "run.rrd", rig


def test_a_recording_holds_all_that_is_to_be_seen_and_who_each_instance_is(tmp_path: Path) -> None:
    _, rig = recorded(tmp_path)
    tiles = rig.mesh.tiles
    rows = rows_by_entity(tmp_path / "run.rrd")
    assert rows["/world/vehicles"] >= 11
    assert rows["/world/targets/balls"] >= 11
    for name in ("world/targets/poles", "world/trails/vehicles", "summary"):
        assert rows[f"/{name}"] >= 3, name
    for name in ("world/routes/t0", "world/routes/t1", "log"):
        assert rows[f"/{name}"] >= 1, name
    for plot in ("states", "captures_and_marks", "gap", "growth_ms", "messages"):
        assert rows[f"/plots/{plot}"] >= 3, plot
    textures = [rows[f"/world/ground/{tile}"] for tile in range(tiles)]
    assert min(textures) >= 1
    assert max(textures) >= 2, "marks change the photo"
    bright = components(tmp_path / "run.rrd", "/world/ground/0").keys()
    assert {"albedo_factor", "albedo_texture_buffer"} <= bright, "as it is painted, and bare ground is not"
    # With more than three components of an instance, the viewer shows only their number at the pointer.
    for entity, sentence in (("/world/vehicles", "vehicle"), ("/world/targets/balls", "target")):
        parts = components(tmp_path / "run.rrd", entity)
        parts = {name: rows for name, rows in parts.items() if not name.endswith("RowId")}
        assert set(parts) == {"positions", "colors", sentence}
        assert len(parts[sentence][-1]) == len(parts["positions"][-1])
    said = components(tmp_path / "run.rrd", "/world/vehicles")["vehicle"][-1]
    assert any(": following, route " in line for line in said)


def components(path: Path, entity: str, since_s: float = 0.0) -> dict[str, list[Any]]:
    """Component -> its rows from a time on."""
    found: dict[str, list[Any]] = {}
    for chunk in chunks(path):
        if str(chunk.entity_path) != entity or chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        at_s = [each.value / NS_PER_S for each in batch.column("sim_time")]
        for name in set(batch.schema.names) - {"sim_time", "tick", "log_time", "log_tick"}:
            rows = [row for t, row in zip(at_s, batch.column(name).to_pylist(), strict=True) if t >= since_s]
            found.setdefault(name.rpartition(":")[2], []).extend(row for row in rows if row is not None)
    return {name: rows for name, rows in found.items() if rows}


def test_who_opens_the_view_late_has_all_of_it_soon(tmp_path: Path) -> None:
    """The server may have dropped old data: the drawings after a viewer came hold every component."""
    longer = msgspec.structs.replace(SCENARIO, seconds=16.0)
    rig = Rig(longer, TERRAIN, tmp_path / "run.rrd", audience=NOBODY)
    told = list(fake_run(TERRAIN, hidden_truth(TERRAIN), longer))
    rig.play(each for each in told if each[0] < 11 * NS_PER_S)
    came_s = rig.service.at_s
    rig.audience = SOMEBODY
    rig.play(each for each in told if each[0] >= 12 * NS_PER_S)
    rig.close()
    tiles = [f"/world/ground/{tile}" for tile in range(rig.mesh.tiles)]
    for entity in ("/world/vehicles", "/world/targets/balls", "/world/targets/names", "/world/routes/t0", *tiles):
        whole, late = (components(tmp_path / "run.rrd", entity, since_s).keys() for since_s in (0.0, came_s))
        assert whole == late, entity


def test_while_no_one_looks_half_the_frames_are_drawn_and_packed_together(tmp_path: Path) -> None:
    frames, packs = {}, {}
    for name, audience in (("seen", SOMEBODY), ("unseen", NOBODY)):
        rig = Rig(SCENARIO, TERRAIN, tmp_path / name, audience=audience)
        rig.play(
            (tick * NS_PER_S // 10, fleet(20.0 * tick, ("a0-00", 0), at_m=(tick, 0.0))) for tick in range(1, 41)
        )
        rig.close()
        frames[name] = rows_by_entity(tmp_path / name)["/world/vehicles"]
        packs[name] = sum(str(chunk.entity_path) == "/world/vehicles" for chunk in chunks(tmp_path / name))
    assert packs["seen"] == frames["seen"] == 40
    assert frames["unseen"] in (20, 21)
    assert packs["unseen"] < 10, "by the clock of the wall, once a second"


@pytest.mark.parametrize("name", ["a0-03", "t1"])
def test_the_camera_follows_who_is_named(tmp_path: Path, name: str) -> None:
    following = msgspec.structs.replace(SCENARIO, monitor=MonitorConfig(live=False, follow=name))
    recorded(tmp_path, following)
    led = [tuple(row[0]) for row in components(tmp_path / "run.rrd", "/world/followed")["translation"]]
    assert len(set(led)) > 2, "it moves"


def sent(state: GoalState) -> GoalStates:
    return GoalStates(agent="a0", stamp_ns=1, states=[state])


SEEN = Sighted(
    author="a0.1", group="all", target="t0", seq=1, stamp_ns=1, until_ns=NS_PER_S,
    cell=0, x_m=0.0, y_m=0.0, uncertainty_m=30.0,
)  # fmt: skip
OBSTACLE = Obstacle(id="r1", incarnation=1, seq=1, x_m=100.0, y_m=-100.0, radius_m=2.0, lease_s=0.7)
BELIEVED = Believed(
    target="t0", incarnation=1, stamp_ns=0, side_m=30.0, cells=[5, 9], shares=pack_column([0.7, 0.3], "<f4")
)
SENT = GoalState(name="a0-00", stamp_ns=1, done=0, state="underway", cell=9)
DRAWN_AND_TAKEN_AWAY: dict[str, tuple[list[tuple[int, Any]], str, str, list[int]]] = {
    "a sighting ends": ([(NS_PER_S // 2, SEEN)], "targets/sighted", "strips", [0, 1, 0]),
    "an obstacle moves, and its lease ends": (
        [(NS_PER_S // 2, OBSTACLE), (NS_PER_S, msgspec.structs.replace(OBSTACLE, seq=2, x_m=130.0))],
        "obstacles", "centers", [0, 1, 1, 0],
    ),
    "a belief ends, and its planner is silent after another": (
        [
            (NS_PER_S // 2, BELIEVED), (2 * NS_PER_S, msgspec.structs.replace(BELIEVED, cells=[], shares=b"")),
            (3 * NS_PER_S, BELIEVED),
        ],
        "searched", "positions", [0, 2, 0, 2, 0],
    ),
    "a vehicle is sent somewhere, and recalled": (
        [
            (NS_PER_S // 4, fleet(1.0, ("a0-00", 3))), (NS_PER_S // 2, sent(SENT)),
            (2 * NS_PER_S, sent(msgspec.structs.replace(SENT, state="canceled", cell=None))),
        ],
        "goals/flags", "positions", [0, 1, 0],
    ),
}  # fmt: skip
"""The message, the entity and its component, and the number of instances in each of its rows."""


@pytest.mark.parametrize("what", DRAWN_AND_TAKEN_AWAY)
def test_what_is_told_is_drawn_when_it_changes_and_taken_away_when_it_is_over(tmp_path: Path, what: str) -> None:
    told, entity, component, instances = DRAWN_AND_TAKEN_AWAY[what]
    rig = Rig(SCENARIO, TERRAIN, tmp_path / "run.rrd")
    rig.play(told)
    rig.run(8)
    rig.close()
    rows = components(tmp_path / "run.rrd", f"/world/{entity}")[component]
    assert [len(row) for row in rows] == instances


def test_vehicles_sent_to_one_place_share_its_label(tmp_path: Path) -> None:
    rig = Rig(SCENARIO, TERRAIN, tmp_path / "run.rrd")
    states = [msgspec.structs.replace(SENT, name=name) for name in ("a0-00", "a0-01")]
    places = GoalStates(agent="a0", stamp_ns=1, states=states)
    rig.play([(NS_PER_S // 4, fleet(1.0, ("a0-00", 3), ("a0-01", 4))), (NS_PER_S // 2, places)])
    rig.run(2)
    rig.close()
    labels = components(tmp_path / "run.rrd", "/world/goals/names")["labels"]
    assert list(labels[-1]) == ["place of a0-00, a0-01"]


def test_no_recording_replaces_another(tmp_path: Path) -> None:
    assert [new_recording_path(tmp_path).name for _ in range(3)] == ["run.rrd", "run-2.rrd", "run-3.rrd"]


def test_a_route_that_leaves_the_map_is_counted_and_not_drawn() -> None:
    rig = Rig(SCENARIO, TERRAIN, None)
    route = Followed(vehicle="v", target="t0", start=0, directions=b"\x00", cost_s=1.0, lower_bound_s=1.0)
    rig.play([(1, route)])
    assert rig.service.counters.counts["routes_unreadable"] == 1
    rig.close()


def test_where_to_watch_is_told_to_those_that_begin_to_listen_later() -> None:
    rig = Rig(SCENARIO, TERRAIN, None, web_port=9090)
    rig.run(30)
    heard: list[Event] = []
    rig.speaker.subscribe(STATS, heard.append)
    rig.run(30)
    rig.close()
    told = [event.message for event in heard if isinstance(event, Heard)]
    assert [stats.web_port for stats in told if isinstance(stats, Stats) and stats.role == "monitor"][:1] == [9090]


def test_who_comes_and_who_goes_is_in_the_log_and_who_was_there_is_not() -> None:
    rig = Rig(SCENARIO, TERRAIN, None)
    told: list[str] = []
    rig.service._panel.note = lambda text, level: told.append(text)  # type: ignore[method-assign]
    rig.bus("early").declare_alive(Peer("agent", "a0", 7))
    rig.run(3)
    bus = rig.bus("late")
    bus.declare_alive(Peer("agent", "a1", 7))
    rig.run(1)
    bus.close()
    rig.run(1)
    rig.close()
    assert told == ["agent a1 is up", "agent a1 is gone"]


def test_a_monitor_speaks_of_nothing_but_itself() -> None:
    rig = Rig(SCENARIO, TERRAIN, None)
    for topic in TOPICS:
        rig.speaker.subscribe(topic, lambda _: None)
    rig.play(fake_run(TERRAIN, hidden_truth(TERRAIN), msgspec.structs.replace(SCENARIO, seconds=2.0)))
    rig.close()
    assert rig.said == {"run", "stats"}


# --- sinks: sockets and files ---------------------------------------------------------------------------------


def listeners() -> set[str]:
    """Addresses on which this process listens."""
    open_now = psutil.Process().net_connections("tcp")
    return {each.laddr.ip for each in open_now if each.status == psutil.CONN_LISTEN}


@pytest.mark.network
def test_page_and_stream_are_served_on_loopback_only_and_cannot_call_home(tmp_path: Path) -> None:
    sinks = Sinks("r", tmp_path / "run.rrd", LIVE, make_blueprint(TerrainMesh(TERRAIN)))
    url = sinks.page.server.url
    try:
        with urllib.request.urlopen(url, timeout=30) as reply:
            assert b"run_banner.js" in reply.read(), "the start page, at once"
        eventually(lambda: b'"view": true' in urllib.request.urlopen(f"{url}/run.json").read(), 10)
        with urllib.request.urlopen(url, timeout=30) as reply:
            assert "rerun%2Bhttp%3A%2F%2F127.0.0.1%3A" in reply.url, "led to the stream"
            assert b"re_viewer.js" in reply.read()
            policy = reply.headers["Content-Security-Policy"]
        assert policy.endswith("connect-src 'self'")
        with urllib.request.urlopen(f"{url}/re_viewer_bg.wasm", timeout=30) as reply:
            assert reply.headers["Content-Type"] == "application/wasm"
            assert reply.read(4) == b"\0asm"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{url}/etc/passwd", timeout=30)
        eventually(lambda: len(listeners()) > 1, 10)
        assert all(address.startswith("127.") for address in listeners())
    finally:
        began_s = time.monotonic()
        sinks.close()
    assert time.monotonic() - began_s < 4


def test_a_recording_that_finds_no_space_stops_no_one_and_goes_on_in_a_new_file(tmp_path: Path) -> None:
    """A limit of the size of files stands for the full disk: Rerun's sink ends at the first error all the same."""
    script = f"""
import pathlib, resource
import numpy
import rerun as rr
from launch_scripts.monitor.live_layout import make_blueprint
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from launch_scripts.monitor.rerun_outputs import Sinks, new_recording_path
from shared_map.terrain.terrain import terrain_of_pace
from swarm.config.scenario import MonitorConfig

_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
path = new_recording_path(pathlib.Path({str(tmp_path)!r}))
mesh = TerrainMesh(terrain_of_pace(numpy.ones((8, 8), numpy.float32)))
sinks = Sinks("r", path, MonitorConfig(live=False), make_blueprint(mesh))
for second in range(20):
    if second == 8:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    for stream in sinks.streams:
        stream.set_time("tick", sequence=second)
        stream.log("a", rr.Scalars(second))
    if begun := sinks.check_file(second * 10**9):
        print(second, begun, flush=True)
sinks.close()
"""
    told = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=100, check=True
    ).stdout.splitlines()
    assert told == [f"15 {tmp_path / 'run-2.rrd'}"], "tried at 5 s, when it has not grown for long, and 10 s later"
    assert rows_by_entity(tmp_path / "run-2.rrd")["/a"] == 4


def test_a_recording_that_begins_again_holds_all_that_does_not_move(tmp_path: Path) -> None:
    rig = Rig(SCENARIO, TERRAIN, tmp_path / "run.rrd")
    told = iter([None, tmp_path / "run-2.rrd"])
    rig.service._recording = lambda now_ns: next(told, None)
    rig.run(0.15)
    rig.sinks.begin_file(tmp_path / "run-2.rrd")
    rig.run(1.0)
    rig.close()
    first, second = still_entities(tmp_path / "run.rrd"), still_entities(tmp_path / "run-2.rrd")
    assert {"/world", "/world/ground/0", "/plots/gap"} <= first == second
    assert rows_by_entity(tmp_path / "run-2.rrd")["/world/ground/0"] > 0


@pytest.mark.skipif(sys.platform != "linux", reason="other systems cannot tie a child to its parent's end")
def test_a_tied_program_ends_with_its_parent_even_if_that_is_killed() -> None:
    parent_script = f"""
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-I", {parent_death.__file__!r}, str(os.getpid()), "/bin/sleep", "60"])
print(child.pid, flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", parent_script], stdout=subprocess.PIPE, text=True) as parent:
        child = Path(f"/proc/{int(parent.stdout.readline())}")
        eventually(lambda: b"sleep" in (child / "cmdline").read_bytes(), 10)
        parent.send_signal(signal.SIGKILL)
    eventually(lambda: not child.exists() or "\nState:\tZ" in (child / "status").read_text(), 10)


@pytest.mark.network
def test_a_taken_port_is_one_clear_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("launch_scripts.web.live_page.PORT_PATIENCE_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        config = MonitorConfig(web_port=port)
        with pytest.raises(
            BusError, match=rf"monitor\.web_port {port} cannot be opened: Address already in use; choose another"
        ):
            Sinks("r", None, config, make_blueprint(TerrainMesh(TERRAIN)))
