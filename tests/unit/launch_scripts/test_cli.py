"""The command line: valid input, and the answers to it. Mistakes get a sentence and an exit code."""

import csv
import json
import socket
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command import Swarm
from support.makers import route_reply, run_info
from support.map_strategies import GRID as MARKED
from support.map_strategies import set_of

from launch_scripts import ports
from launch_scripts.commands.shared_options import Tls
from launch_scripts.commands.swarm_route import Answer, as_json, show, write
from launch_scripts.launcher import run_options
from launch_scripts.observe.run_folders import begin_run, run_facts
from launch_scripts.observe.run_observer import frame_of_members
from shared_map.keeper.mark_store import KeeperStore
from shared_map.pace_measurements import Measurement
from shared_map.replication.replica import MapReplica
from shared_map.terrain.map_frame import MapFrame
from swarm.config.scenario import MonitorConfig, Scenario, TlsConfig
from swarm.config.scenario_files import load_scenario
from swarm.errors import BusError, TerrainError
from swarm.grid import GridSpec
from swarm.places import cell_of
from swarm.wire.messages.map_data import SEQ_STEP, MarkKind, MarkSet
from swarm.wire.messages.processes import RunInfo
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus


def test_the_version_is_the_packages_with_the_commit_of_a_checkout_as_in_a_run(
    swarm: Swarm, tmp_path: Path
) -> None:
    code, said, errors = swarm("--version")
    assert (code, errors, said.partition("+")[0].strip()) == (0, "", f"swarm {version('terrain-swarm')}")
    begin_run(tmp_path, run_options.find_scenario("jacksboro"), "run")
    assert said == f"swarm {run_facts(tmp_path)['versions']['terrain_swarm']}\n"


def test_a_folder_stands_for_the_three_files_of_tls(tmp_path: Path) -> None:
    names = ("ca.pem", "ca.key", "operator.anna.pem", "operator.anna.key")
    files = [tmp_path / name for name in names]
    for file in files:
        file.write_text("")
    (ca, _, certificate, key) = map(str, files)
    assert Tls(tls_dir=str(tmp_path)).tls() == TlsConfig(ca=ca, certificate=certificate, key=key)
    (tmp_path / "planner.t0.key").write_text("")  # of several, each process finds its own
    own = Tls(tls_dir=str(tmp_path)).tls()
    assert own == TlsConfig(ca=ca, certificate=str(tmp_path), key=str(tmp_path))


def test_a_port_gives_the_live_view_the_next_and_0_picks_free_ones() -> None:
    scenario = run_options.with_port(Scenario(), 8000)
    assert scenario.network.listen == scenario.network.connect == ("tcp/127.0.0.1:8000",)
    assert scenario.monitor.web_port == 8001
    ports.check_ports(run_options.with_port(Scenario(), 0), ("router", "monitor"))


def test_ports_of_the_live_view_matter_only_if_it_is_served_here() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        scenario = Scenario(monitor=MonitorConfig(web_port=port))
        with pytest.raises(
            BusError, match=rf"port {port} of the live view \(monitor.web_port\) is taken.* --port N"
        ):
            ports.check_ports(scenario, ("monitor",))
        with pytest.raises(BusError, match=rf"port {port} of the metrics .*another with --metrics-port N; 0 picks"):
            ports.check_ports(scenario, (), ("127.0.0.1", port))
        ports.check_ports(scenario, ("agent",))


def test_two_hosts_have_ports_of_their_own_unless_they_overlap() -> None:
    hosts = {"127.0.0.1": True, "localhost": True, "0.0.0.0": True, "::": True, "::1": False, "10.0.0.1": False}
    assert {host: ports._overlap(host, "127.0.0.1") for host in hosts} == hosts
    assert not ports._overlap("0.0.0.0", "::1")


def test_simulate_prints_the_report_of_a_run_and_leaves_its_folder(swarm: Swarm, tmp_path: Path) -> None:
    code, out, _ = swarm(
        "simulate", "synthetic", "--seconds", "2", "--seed", "9", "--runs", str(tmp_path), "--json"
    )
    assert code == 0
    printed = json.loads(out)
    assert printed["scenario"] == "synthetic"
    last = tmp_path / "LAST"
    report = json.loads((last / "report.json").read_text())
    assert {name: report[name] for name in printed if name != "run_id"} == {
        name: value for name, value in printed.items() if name != "run_id"
    }
    assert report["run_id"] == last.resolve().name
    again = load_scenario(last / "scenario.toml")
    assert (again.name, again.seed, again.seconds) == ("synthetic", 9, 2.0)


# --- `swarm route --target` ---------------------------------------------------------------------------------------

GRID = GridSpec(60, 80, 20.0, 500_000.0, 5_200_000.0, "EPSG:32632")
FRAME = MapFrame(GRID)
START = GRID.cell(10, 10)


WAY: dict[str, Any] = {"directions": bytes([1, 1, 2]), "cost_s": 30.0, "lower_bound_s": 29.0, "length_m": 76.57}


def answer(status: RouteStatus = RouteStatus.OK, target: int | None = START - 80 * 2 + 3, **way: Any) -> Answer:
    """A route of two steps to the north-east and one to the east, or none."""
    route = Route(status=status, start=START, **(WAY if status is RouteStatus.OK else way))
    return Answer(route_reply(RouteBatch.of([route]), GRID, target="t3", target_cell=target), FRAME, START, 2.0)


def test_an_answer_names_its_places_so_that_they_can_be_given_again(capsys: pytest.CaptureFixture[str]) -> None:
    show(answer())
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith("from cell:10,10 (xy:500210,5199790, latlon:46.9")
    assert second.startswith("to t3 at cell:8,13 (xy:500270,5199830, latlon:46.9")
    assert "30.0 s, proven to be at most 3.45% above the optimum" in second
    for line, cell in ((first, START), (second, GRID.cell(8, 13))):
        assert cell_of(line.partition("latlon:")[2].partition(")")[0], FRAME, "--from") == cell
    show(answer(RouteStatus.LETHAL_START))
    assert "the cell is lethal" in capsys.readouterr().out


def test_programs_get_the_way_in_metres_and_degrees(tmp_path: Path) -> None:
    told = json.loads(as_json(answer()))
    assert (told["crs"], told["to"]["row"], told["to"]["col"]) == ("EPSG:32632", 8, 13)
    assert told["path"]["x"] == [500_210, 500_230, 500_250, 500_270]
    assert told["path"]["y"] == [5_199_790, 5_199_810, 5_199_830, 5_199_830]
    degrees = FRAME.to_degrees(told["path"]["x"], told["path"]["y"])
    assert np.array([told["path"]["lat"], told["path"]["lon"]]) == pytest.approx(degrees, abs=1e-8)
    assert "path" not in json.loads(as_json(answer(RouteStatus.UNREACHABLE, None)))
    write(answer(), tmp_path / "way.csv")
    with (tmp_path / "way.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["row"], row["col"]) for row in rows] == [("10", "10"), ("9", "11"), ("8", "12"), ("8", "13")]
    assert rows[-1]["at_m"] == "76.57"
    assert "height_m" not in rows[0]
    with pytest.raises(TerrainError, match="there is no route"):
        write(answer(RouteStatus.UNREACHABLE), tmp_path / "none.csv")


def test_of_a_search_the_place_to_look_at_is_told_and_the_last_sighting(capsys: pytest.CaptureFixture[str]) -> None:
    seen = answer(RouteStatus.SEARCHING, GRID.cell(50, 70), **{**WAY, "lower_bound_s": 0.0})
    fields = json.loads(as_json(seen))
    assert fields["searching"] is True
    assert (fields["to"]["row"], fields["to"]["col"]) == (8, 13)
    assert (fields["last_seen"]["row"], fields["last_seen"]["col"]) == (50, 70)
    nowhere = answer(RouteStatus.SEARCHING, GRID.cell(50, 70))
    assert json.loads(as_json(nowhere))["to"] is None
    known = json.loads(as_json(answer()))
    assert (known["searching"], "last_seen" in known) == (False, False)
    show(seen)
    assert "t3 is unseen; cell:8,13" in capsys.readouterr().out


def test_a_route_that_leaves_the_terrain_is_a_fault_of_its_planner() -> None:
    with pytest.raises(BusError, match=r"the planner's route is none: "):
        show(answer(RouteStatus.SEARCHING, **{**WAY, "directions": bytes([0] * 60)}))


def test_the_frame_is_that_of_most_processes() -> None:
    def info(id: str, crs: str, rows: int = 60) -> RunInfo:
        return run_info(GridSpec(60, 80, 20.0, 500_000.0, 5_200_000.0, crs), id=id, rows=rows)

    frame = frame_of_members(
        [info("a", "local"), info("b", "EPSG:32632"), info("c", "EPSG:32632"), info("d", "x", 0)]
    )
    assert frame.grid == GRID
    assert frame_of_members([info("d", "x", 0)]) is None


# --- `swarm marks`: an export has every set, and the bands of a GeoTIFF show the winners --------------------------


PACE, LETHAL, CLEAR = MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR
SETS = [
    set_of("a1.1", 0, 3, {5: (LETHAL, 0, 10), 6: (PACE, 2.5, 11)}),
    set_of("a2.1", 0, 1, {6: (CLEAR, 0, 12)}),
    set_of("a2.1", 4, 9, {}),
]


def stored(path: Path, sets: list[MarkSet]) -> Path:
    with KeeperStore(path) as store:
        store.bind("fedcba9876543210", MARKED)
        store.save(sets)
    return path


def listed(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text())["sets"]


def test_every_set_is_exported_and_inspected_on_the_command_line(tmp_path: Path, swarm: Swarm) -> None:
    store, out = stored(tmp_path / "map.sqlite", SETS), tmp_path / "map.json"
    assert swarm("marks export", store, "--out", out)[0] == 0
    assert [(each["author"], each["tile"], each["seq"], each["marks"]) for each in listed(out)] == [
        ("a1.1", 0, 3 * SEQ_STEP, [[0, 5, "lethal", None, 10], [0, 6, "pace", 2.5, 11]]),
        ("a2.1", 0, SEQ_STEP, [[0, 6, "clear", None, 12]]),
        ("a2.1", 4, 9 * SEQ_STEP, []),
    ]
    found = json.loads(swarm("marks show --json", store)[1])
    assert (found["marks"], found["sets"], found["cells_with_marks"], found["cells_lethal"]) == (3, 3, 2, 1)
    assert found["authors"]["a2.1"] == {"sets": 2, "marks": 1, "tombstones": 1}
    assert "3 marks in 3 sets" in swarm("marks show", store)[1]


def test_marks_for_one_class_keep_its_name_in_an_export(tmp_path: Path, swarm: Swarm) -> None:
    store, out = tmp_path / "map.sqlite", tmp_path / "map.json"
    with KeeperStore(store) as kept:
        kept.bind("fedcba9876543210", MARKED, ["walker", "truck"])
        kept.save([set_of("a1.1", MARKED.tile_for(0, 2), 3, {5: (LETHAL, 0, 10)}), SETS[0]])
    assert swarm("marks export", store, "--out", out)[0] == 0
    assert json.loads(out.read_text())["classes"] == ["walker", "truck"]
    assert [each["tile"] for each in listed(out)] == [0, MARKED.tile_for(0, 2)]
    _, pixels, _ = swarm("marks export", store, "--out", tmp_path / "map.tif")
    assert "2 marks in 1 set; without 1 mark for one class alone, which .json has" in " ".join(pixels.split())


def test_a_geotiff_says_where_and_what(tmp_path: Path, swarm: Swarm) -> None:
    import rasterio

    store = stored(tmp_path / "map.sqlite", SETS)
    out = tmp_path / "map.tif"
    assert swarm("marks export", store, "--out", out)[0] == 0
    with rasterio.open(out) as tiff:
        assert (tiff.height, tiff.width, tiff.transform.a) == (MARKED.rows, MARKED.cols, MARKED.resolution_m)
        assert np.isinf(tiff.read(1)[0, 5])
        assert tiff.read(2)[0, 5:7].tolist() == [LETHAL, CLEAR]
        assert tiff.tags()["terrain"] == "fedcba9876543210"


def test_what_cannot_be_read_or_written_is_said_in_a_sentence(tmp_path: Path, swarm: Swarm) -> None:
    store = stored(tmp_path / "map.sqlite", SETS)
    assert (
        "found the ending '.gpx', expected .json or .tif"
        in swarm("marks export", store, "--out", tmp_path / "map.gpx")[2]
    )
    assert "cannot write" in swarm("marks export", store, "--out", tmp_path / "no" / "map.json")[2]


def learned_sets(author: str, *said: Measurement) -> list[MarkSet]:
    replica = MapReplica(MARKED, author=author)
    return replica.write_learned(dict(enumerate(said)), 1)


def test_what_is_learned_is_exported_and_shown_and_counts_as_no_mark(tmp_path: Path, swarm: Swarm) -> None:
    words = [
        *learned_sets("all.a1.1", Measurement(400, 72_000, 6_500)),
        *learned_sets("all.a2.1", Measurement(9, 70_000, 0), Measurement(1, 0, 7)),
    ]
    store, out = stored(tmp_path / "map.sqlite", [*SETS, *words]), tmp_path / "marks.json"
    told = swarm("marks export", store, "--out", out)[1]
    assert told.endswith("3 marks in 3 sets, and learned factors of 2 authors\n")
    assert [each["learned"] for each in listed(out) if each["tile"] == MARKED.tiles] == [
        [[0, "unknown 0-5", 400, 72_000, 6_500]],
        [[0, "unknown 0-5", 9, 70_000, 0], [1, "unknown 5-10", 1, 0, 7]],
    ]
    found = json.loads(swarm("marks show --json", store)[1])
    assert (found["sets"], found["marks"], list(found["authors"])) == (3, 3, ["a1.1", "a2.1"])
    assert found["authors_that_learned"] == ["all.a1.1", "all.a2.1"]
    (row, *_) = json.loads(swarm("marks factors --json", store)[1])["kinds"]
    assert (row["kind"], row["cells"], row["authors"]) == ("unknown 0-5", 409, 2)
    assert 2.5 < row["factor"] <= row["measured"] < 3.1
    assert "unknown 5-10" in swarm("marks factors", store)[1]
