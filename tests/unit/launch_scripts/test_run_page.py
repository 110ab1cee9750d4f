"""`report.html`: the page that a run leaves; and the comparison of runs."""

from __future__ import annotations

import html.parser
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.command import Swarm
from support.fake_run import leave, little_scenario, played

from launch_scripts.observe.summed_counts import percent
from shared_map.terrain.terrain import terrain_of_pace
from swarm.config.write import scenario_text
from swarm.wire.messages.processes import Note

HOSTILE = "<script>alert(1)</script>\"'><img src=http://example.org/x onerror=alert(2)>"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder with a name in its notes, and in its scenario, that would rather be a script."""
    folder = tmp_path_factory.mktemp("runs") / "r1"
    folder.mkdir()
    zone = "[[cost.zones]]\nkind = 'forbidden'\npolygon_m = [[100, 100], [400, 100], [400, 300], [100, 300]]\n"
    scenario = little_scenario(vehicles=4, time_scale=20, more=zone)
    pace = np.full((24, 32), 0.1, np.float32)
    pace[4:12, 4:16] = np.inf
    terrain = terrain_of_pace(pace, 25.0)
    truth = np.array(pace)
    truth[14:20, 4:30] = np.inf
    recorder = played(terrain, truth, scenario)
    note = Note(role="agent", id="a0", stamp_ns=1, kind="odd", text=HOSTILE, cell=None, target=None)
    recorder.heard(note, recorder.observed.last_ns or 0)
    (folder / "scenario.toml").write_text(f"# {HOSTILE}\n" + scenario_text(scenario, folder))
    leave(folder, recorder, terrain, truth)
    return folder


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
    assert np.nansum((told - 1) * begun) / begun.sum() == pytest.approx(whole["mean"] - 1, rel=1e-3)


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


def test_a_comparison_says_first_what_makes_runs_unlike(run: Path, tmp_path: Path, swarm: Swarm) -> None:
    for name, changes in (("r1", {}), ("r2", {"seed": 9}), ("r3", {"terrain": {"digest": "0" * 16}})):
        (tmp_path / name).mkdir()
        report = json.loads((run / "report.json").read_text()) | changes
        (tmp_path / name / "report.json").write_text(json.dumps(report))
        shutil.copy(run / "scenario.toml", tmp_path / name)
    code, told, _ = swarm("runs compare r1 r2 r3 --runs", tmp_path)
    assert code == 0
    assert "The terrains differ" in told
    assert "The seeds differ (3, 9, 3)" in told
    (tmp_path / "r2" / "report.json").write_text('{"seed": "\\u001b[31m"}')
    code, told, _ = swarm("runs compare r1 r2 --runs", tmp_path)
    assert (code, "\x1b" in told) == (0, False)
    assert json.loads(swarm("runs compare r1 r1 --json --runs", tmp_path)[1])["remarks"] == []
