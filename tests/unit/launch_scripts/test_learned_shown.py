"""Factors of learned ground are visible: in the live view, in figures, in the report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from support.makers import stats

from launch_scripts.observe import fact_table as facts
from launch_scripts.observe.palette import rgb
from launch_scripts.observe.recorder import Recorder
from launch_scripts.report.run_picture import QUICKER, SLOWER, learned_pixels
from launch_scripts.report.write_report import make_report, write_report
from shared_map.cost_map import CostMap
from shared_map.learning.learned_factors import LearnedGauges
from shared_map.learning.measurements import ONE, Measurement
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.config.load import parse_scenario
from swarm.config.scenario import Scenario
from swarm.runtime.stats import Counters
from swarm.wire.messages.map_data import MarkSet

FLAT, STEEP = 0, 5
"""Kinds of ground: the class is unknown."""


def half_steep() -> Terrain:
    pace, height = np.full((40, 50), 0.1, np.float32), np.zeros((40, 50), np.float32)
    height[:, 25:] = 10 * np.arange(25, dtype=np.float32)  # 45 degrees
    pace[:5, :5] = np.inf
    return terrain_of_pace(pace, 10.0, height)


GROUND = half_steep()


def said(times: float) -> Measurement:
    return Measurement(400, round(np.log(times) * ONE), ONE // 10)


def learned(**keys: float) -> tuple[CostMap, list[MarkSet]]:
    """A map that knows these factors of the flat and the steep part, and the sets that say so."""
    cost_map = CostMap(GROUND, learning=True)
    words = {FLAT: said(keys["flat"]), STEEP: said(keys["steep"])}
    sets = MapReplica(GROUND.grid, cost_map, author="all.a1.1").write_learned(words, 1)
    return cost_map, sets


def small() -> Scenario:
    return parse_scenario('name = "s"\nseconds = 5\n[[targets]]\nname = "t"\n[[groups]]\nvehicles = 1\n')


def test_the_picture_of_a_report_shows_factors_but_on_lethal_ground() -> None:
    cost_map, _ = learned(flat=3.0, steep=0.4)
    pixels = learned_pixels(GROUND, cost_map.factors)
    assert tuple(pixels[30, 10, :3]) == rgb(SLOWER)
    assert tuple(pixels[30, 40, :3]) == rgb(QUICKER)
    assert pixels[30, 10, 3] > pixels[30, 40, 3] > 100
    assert (pixels[:5, :5] == 0).all()


def test_a_planner_tells_the_mean_factor_of_a_class_until_its_prior_stands_again() -> None:
    cost_map, sets = learned(flat=3.0, steep=3.0)
    counters, teller = Counters(), CostMap(GROUND, learning=True)
    told = LearnedGauges(teller.keys, counters)
    told.tick(teller.factors)
    assert counters.gauges == {}
    teller.learn(sets)
    told.tick(teller.factors)
    assert 2.5 < counters.gauges["learned.unknown"] <= float(cost_map.factors.max()) + 1e-3
    teller.learn([])
    told.tick(teller.factors)
    assert counters.gauges == {}


def test_everybody_who_shows_a_run_says_what_was_learned_and_nothing_while_nothing_is() -> None:
    recorder = Recorder(small(), GROUND.grid)
    assert not any("learned" in line for line in facts.lines(recorder.summary(1)))
    recorder.heard(stats("planner", "t", gauges={"learned.grass": 2.853}), 1)
    assert "learned grass x 2.9" in facts.lines(recorder.summary(1))
    assert facts.for_report(recorder.summary(1))["learned"] == {"grass": 2.853}


def test_a_report_tells_each_kind_of_ground_and_has_a_picture(tmp_path: Path) -> None:
    _, sets = learned(flat=3.0, steep=1.0)
    recorder = Recorder(small(), GROUND.grid)
    for each in sets:
        recorder.heard(each, 1)
    write_report(tmp_path, make_report(recorder, GROUND), recorder, GROUND)
    flat, steep = json.loads((tmp_path / "report.json").read_text())["learned_kinds"]
    assert (flat["kind"], flat["cells"], flat["authors"]) == ("unknown 0-5", 400, 1)
    assert 2.5 < flat["factor"] < 3.5
    assert (steep["kind"], steep["factor"]) == ("unknown 25+", 1.0)
    assert (tmp_path / "learned.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "report.html").read_text()
    assert 'data-layer=".learned"' in page
    assert "unknown 25+" in page
