"""The page of a run and its recording for Foxglove."""

import html.parser
import itertools
import json
import math
import re
import shutil
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from support.command import Swarm
from support.fake_run import BEGAN_NS, GRID, HOSTILE

from launch_scripts.gateways.ros2.ros_messages import RosMap, ros_name
from launch_scripts.observe.summed_counts import percent
from launch_scripts.report.mcap_export import export_mcap, frame_names, instants_of, lines_of
from launch_scripts.report.report_and_tracks import GROUND_PACE_FILE, TRACKS_FILE, RunTracks, read_tracks
from swarm.clock import NS_PER_S
from swarm.wire.messages.map_data import STAMP_LIMIT_NS, MarkKind


class Reader(html.parser.HTMLParser):
    """A browser's view of a page: its elements, their sources, its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loaded: list[str] = []
        self.handlers: list[str] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "data", "action"):
                self.loaded.append(value or "")
            if name.startswith("on"):
                self.handlers.append(name)

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_the_page_needs_no_network_and_runs_nothing_that_a_file_or_a_message_said(run: Path) -> None:
    text = (run / "report.html").read_text()
    page = Reader(text)
    assert page.tags.count("script") == 1
    assert page.handlers == []
    assert [place for place in page.loaded if not place.startswith(("data:image/", "#"))] == []
    assert re.findall(r"url\((?!#)[^)]*\)|@import", text) == []
    assert "default-src 'none'" in text
    assert "".join(page.words).count(HOSTILE) == 2  # the note and the scenario, as text


def test_figures_on_the_page_are_those_of_the_report(run: Path) -> None:
    report = json.loads((run / "report.json").read_text())
    text = (run / "report.html").read_text()
    words = " ".join(Reader(text).words)
    shown = re.sub(r"\s+", " ", words)
    gap = report["certified_gap"]
    assert report["captures"] > 0
    for figure in (
        f"{report['captures']} captures",
        f"{percent(gap['mean'])} certified gap, mean",
        f"{percent(gap['p95'])} certified gap, p95",
        f"{report['marks']} marks",
    ):
        assert figure in shown, figure
    for section in ("by_target", "by_vehicle"):
        for id, row in report[section].items():
            assert re.search(rf"{id} (?:\S+ ground )?{row['captures']} ", shown), id
        if section == "by_vehicle":
            assert text.count(f'id="vehicle:{id}"') == 1, "the map can be pressed there"
    assert report["ground_shows"] == ["forbidden", "hidden"]
    assert "forbidden zone" in shown


def test_certified_gaps_over_time_are_of_the_routes_begun_in_between(run: Path) -> None:
    series = json.loads((run / "report.json").read_text())["series"]
    begun = np.array(series["routes_begun"])
    told = np.array([np.nan if gap is None else gap for gap in series["certified_gap_mean"]])
    assert (np.isnan(told) == (begun == 0)).all()
    whole = json.loads((run / "report.json").read_text())["certified_gap"]
    assert np.nansum((told - 1) * begun) / begun.sum() == pytest.approx(whole["mean"] - 1, rel=1e-3, abs=1e-5)


def test_the_page_is_written_again_from_the_folder_alone(run: Path, tmp_path: Path, swarm: Swarm) -> None:
    copy = tmp_path / "r1"
    shutil.copytree(run, copy)
    before = (copy / "report.html").read_text()
    (copy / "report.html").unlink()
    assert swarm("runs report r1 --runs", tmp_path)[0] == 0
    assert (copy / "report.html").read_text() == before.replace(f"up {run.parent.name}/", f"up {tmp_path.name}/")
    for content, sentence in ((b"{}", "is damaged"), (b'{"series": 3, "by_vehicle": 7}', "is damaged")):
        (copy / "report.json").write_bytes(content)
        code, _, told = swarm("runs report r1 --runs", tmp_path)
        assert (code > 0, told.count("\n"), sentence in told) == (True, 1, True)


# --- `swarm runs export --format mcap` ----------------------------------------------------------------------------

TOPICS = {"/map", "/marks", "/rosout", "/swarm/markers", "/swarm/poses", "/targets", "/tf", "/tf_static"}


@pytest.fixture(scope="module")
def tracks(run: Path) -> RunTracks:
    return read_tracks(run / TRACKS_FILE)


@pytest.fixture(scope="module")
def recording(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    export_mcap(run, out, force=False)
    return out / "r1.mcap"


@pytest.fixture(scope="module")
def heard(recording: Path) -> dict[str, list[tuple[int, Any]]]:
    """Topic -> (time, message), as mcap and mcap-ros2-support read them by the definitions in the file."""
    topics = defaultdict(list)
    with recording.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            topics[channel.topic].append((message.log_time, decoded))
    return topics


# --- values -------------------------------------------------------------------------------------------------------


def test_every_vehicle_is_at_every_time_where_its_track_says(
    heard: dict[str, list[tuple[int, Any]]], tracks: RunTracks
) -> None:
    expected = {
        (f"{ros_name(each.id)}/base_link", int(time_ns)): RosMap(GRID).to_ros(x_m, y_m)
        for each in tracks.vehicles
        for time_ns, (x_m, y_m) in zip(each.time_ns, each.xy_m.tolist(), strict=True)
    }
    found, turned = {}, defaultdict(list)
    for time_ns, told in heard["/tf"]:
        for each in told.transforms:
            assert each.header.stamp.sec * NS_PER_S + each.header.stamp.nanosec == time_ns
            assert each.header.frame_id == each.child_frame_id.replace("base_link", "odom")
            place = each.transform.translation
            found[each.child_frame_id, time_ns] = (place.x, place.y)
            turned[each.child_frame_id].append((place, each.transform.rotation))
    assert found == expected
    for places in turned.values():
        for (here, rotation), (there, _) in itertools.pairwise(places):
            step = there.x - here.x, there.y - here.y
            if any(step):
                yaw = 2 * math.atan2(rotation.z, rotation.w)
                assert (math.cos(yaw), math.sin(yaw)) == pytest.approx(np.array(step) / math.hypot(*step))
    for (time_ns, told), (_, poses) in zip(heard["/tf"], heard["/swarm/poses"], strict=True):
        assert poses.header.frame_id == "map"
        at = [(each.position.x, each.position.y) for each in poses.poses]
        assert at == [found[each.child_frame_id, time_ns] for each in told.transforms]


def test_every_frame_hangs_on_the_terrain(heard: dict[str, list[tuple[int, Any]]], tracks: RunTracks) -> None:
    ((time_ns, still),) = heard["/tf_static"]
    assert time_ns == min(times[0][0] for times in heard.values())
    parents = {each.child_frame_id: each.header.frame_id for each in still.transforms}
    for _, told in heard["/tf"]:
        parents |= {each.child_frame_id: each.header.frame_id for each in told.transforms}
    origin = still.transforms[0].transform.translation
    assert (parents["map"], origin.x, origin.y) == ("terrain", 500_000, 5_200_000 - 48 * 25)
    for each in tracks.vehicles:
        assert parents[parents[f"{ros_name(each.id)}/base_link"]] == "map"


def test_the_last_grid_has_the_marks_of_the_end(heard: dict[str, list[tuple[int, Any]]], tracks: RunTracks) -> None:
    grids = [np.array(told.data, np.int8) for _, told in heard["/marks"]]
    assert len(grids) > 1
    for before, after in itertools.pairwise(grids):
        assert (after[before >= 0] == before[before >= 0]).all()
        assert (after >= 0).sum() > (before >= 0).sum()
    last = grids[-1].reshape(48, 64)[::-1].reshape(-1)
    marked = tracks.marks.kinds != MarkKind.CLEAR
    assert set(np.flatnonzero(last >= 0).tolist()) == set(tracks.marks.cells[marked].tolist())
    lethal = tracks.marks.cells[tracks.marks.kinds == MarkKind.LETHAL]
    assert (last[lethal] == 100).all()
    paced = tracks.marks.kinds == MarkKind.PACE
    lost = 100 * (1 - 0.1 / tracks.marks.paces[paced])
    assert np.abs(last[tracks.marks.cells[paced]] - lost).max() <= 0.51


def test_markers_show_the_route_that_each_vehicle_has_begun_last(
    heard: dict[str, list[tuple[int, Any]]], tracks: RunTracks
) -> None:
    assert len(tracks.routes) > len(tracks.vehicles)
    for now_ns, told in heard["/swarm/markers"]:
        newest = {route.vehicle: route for route in tracks.routes if route.time_ns <= now_ns}
        shown = [each for each in told.markers if each.ns == "routes" and each.action == 0]
        ends = {((p := each.points)[0].x, p[0].y, p[-1].x, p[-1].y) for each in shown}
        wanted = set()
        for route in newest.values():
            if len(route.cells) > 1:
                first, last = (RosMap(GRID).to_ros(*GRID.centre_m(int(route.cells[n]))) for n in (0, -1))
                wanted.add((*first, *last))
        assert ends == wanted
        captured = {each.id for each in tracks.captures if now_ns - 5 * NS_PER_S < each.time_ns[0] <= now_ns}
        assert len([each for each in told.markers if each.ns == "captures" and each.action == 0]) == len(captured)


def test_the_log_has_every_note_alarm_and_capture(
    heard: dict[str, list[tuple[int, Any]]], run: Path, tracks: RunTracks
) -> None:
    report = json.loads((run / "report.json").read_text())
    lines = [(time_ns, told.name, told.msg, told.level) for time_ns, told in heard["/rosout"]]
    for note in report["notes"]:
        at_ns = BEGAN_NS + note["t_s"] * NS_PER_S
        assert any(
            abs(time_ns - at_ns) < 1e6 and (name, text, level) == (note["from"], note["text"], 20)
            for time_ns, name, text, level in lines
        )
    captured = [time_ns for time_ns, _, text, _ in lines if "captured" in text]
    assert len(captured) == len(tracks.captures) > 0
    assert np.abs(np.array(captured) - [each.time_ns[0] for each in tracks.captures]).max() < 2e6
    for alarm in report["alarms"]:
        assert any(alarm["text"] in text and level >= 30 for *_, text, level in lines) or alarm["since_s"] is None


# --- the file -----------------------------------------------------------------------------------------------------


def test_the_file_is_indexed_compressed_in_order_and_says_which_run_it_is(recording: Path) -> None:
    with recording.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary.statistics is not None
        assert {each.topic for each in summary.channels.values()} == TOPICS
        assert {each.message_encoding for each in summary.channels.values()} == {"cdr"}
        assert {each.encoding for each in summary.schemas.values()} == {"ros2msg"}
        assert {each.compression for each in summary.chunk_indexes} == {"zstd"}
        (about,) = reader.iter_metadata()
        assert (about.metadata["run"], about.metadata["crs"]) == ("r1", "EPSG:32632")
        times = [message.log_time for *_, message in reader.iter_messages(log_time_order=False)]
        assert times == sorted(times)
        assert len(times) == summary.statistics.message_count


def test_an_older_run_has_no_map_and_says_so(run: Path, tmp_path: Path, swarm: Swarm) -> None:
    old = tmp_path / "old"
    old.mkdir()
    shutil.copy(run / TRACKS_FILE, old)
    code, out, _ = swarm("runs export --format mcap", old)
    assert (code, f"no /map: there is no {GROUND_PACE_FILE}" in out) == (0, True)
    with (old / "export" / "old.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
        assert {each.topic for each in summary.channels.values()} == TOPICS - {"/map"}


def test_what_cannot_be_exported_is_said_in_a_sentence_and_leaves_no_file(
    run: Path, tmp_path: Path, swarm: Swarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged = tmp_path / "damaged"
    for file, content, complaint in (
        (TRACKS_FILE, b"PK", "tracks.npz is damaged"),
        (GROUND_PACE_FILE, b"PK", "ground.npz is damaged"),
        ("report.json", b'{"notes": [{"t_s": "soon"}]}', "report.json is damaged: Expected `float`, got `str`"),
        ("report.json", b'{"notes": 5}', "report.json is damaged"),
        ("report.json", b"[]", "report.json is damaged"),
    ):
        damaged.mkdir(exist_ok=True)
        for each in (TRACKS_FILE, GROUND_PACE_FILE, "report.json"):
            (damaged / each).write_bytes(content if each == file else (run / each).read_bytes())
        code, _, told = swarm("runs export --format mcap", damaged)
        assert (code > 0, complaint in told, told.count("\n")) == (True, True, 1), told
        assert not list(damaged.rglob("*.mcap*"))
    with monkeypatch.context() as patched:
        patched.delitem(sys.modules, "launch_scripts.report.mcap_export")
        patched.setitem(sys.modules, "mcap.writer", None)
        code, _, told = swarm("runs export --format mcap", run)
    needed = "swarm: this needs mcap, which is not installed: install the extra 'ros2' (docs/start/install.md)"
    assert (code, told.strip()) == (2, needed)


@given(st.lists(st.integers(-(10**9), 10**12)), st.integers(0, 10**11), st.integers(0, 10**12), st.integers(2, 50))
def test_changes_are_told_soon_seldom_and_all(changes: list[int], first_ns: int, lasts_ns: int, most: int) -> None:
    last_ns = first_ns + lasts_ns
    instants = instants_of(changes, first_ns, last_ns, most)
    assert instants == sorted(set(instants))
    assert len(instants) <= most + 1
    period_ns = max(NS_PER_S, lasts_ns // (most - 1) + 1)
    for change in changes:
        within = min(max(change, first_ns), last_ns)
        assert any(within <= each <= within + period_ns for each in instants)
    assert all(first_ns <= each <= last_ns for each in instants)


@given(st.sets(st.text("aA1_-.", min_size=1, max_size=4)))
def test_no_two_vehicles_share_a_frame(ids: set[str]) -> None:
    names = frame_names(ids)
    assert set(names) == ids
    assert len(set(names.values())) == len(ids)
    assert all(name in (ros_name(id), id) for id, name in names.items())


@given(st.floats(-1e308, 1e308), st.integers(0, 2**62))
def test_a_line_of_any_time_is_of_a_time_that_messages_may_have(t_s: float, began_ns: int) -> None:
    report = {"notes": [{"t_s": t_s, "text": "it", "from": "targets"}]}
    [line] = lines_of(report, Path("report.json"), began_ns, [])
    assert 0 <= line.time_ns < STAMP_LIMIT_NS
