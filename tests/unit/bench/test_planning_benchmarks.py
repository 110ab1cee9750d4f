"""Benchmarks of planning run small, and their figures keep what must hold."""

from dataclasses import replace

import numpy as np
import pytest
from bench.planning import peers as rivals
from bench.planning.chase import BROKEN, Tally
from support.benchmarks import bench
from support.fields import FIELDS
from support.tree_lives import LAWS

from swarm.wire.route_columns import Route, RouteBatch, RouteStatus

STRATEGIES = ("auto", "exact", "full", "variable_range", "multi_resolution", "variable_range+multi_resolution")


# --- peers -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("field", FIELDS)
def test_peers_agree_with_ours_and_every_ratio_is_that_of_the_times(field: str) -> None:
    report = bench("peers", "--size", "96", "--field", field, "--repeats", "3", "--no-memory")
    rows = {row["library"]: row for row in report["rows"]}
    peers = set(rivals.present_peers())
    assert {"scipy.csgraph.dijkstra", "skimage.graph.MCP"} <= peers
    assert set(rows) == {"ours", "breadth_first", *peers}
    for name in peers:
        assert rows[name]["over_ours"] == pytest.approx(rows[name]["cpu_ms"] / rows["ours"]["cpu_ms"], rel=0.05)
        assert rows[name]["differs_from_ours"] < (1e-3 if name.startswith("tcod") else 1e-5), name


@pytest.mark.parametrize("field", FIELDS)
def test_searches_for_one_path_cost_what_our_tree_says(field: str) -> None:
    report = bench("pursuit", "--size", "64", "--moves", "60", "--field", field)
    ours, *others = report["rows"]
    assert [each["by"] for each in others] == ["A*", "MT-D* Lite"]
    assert ours["over_ours"] == 1


def test_places_grow_as_far_as_their_askers() -> None:
    report = bench("places", "--size", "256", "--goals", "20")
    near, *_, anywhere = report["rows"]
    assert near["no_growth"] > anywhere["no_growth"]
    assert [each["trees_kept"] for each in report["many"]] == [181, 201]
    assert all(each["routes_per_s"] > 0 for each in report["many"])


# --- chases ------------------------------------------------------------------------------------------------------


def test_full_growths_have_no_gap_and_no_strategy_heartbeats_the_optimum() -> None:
    report = bench("gap", "--dem", "uniform", "--frames", "6", "--runs", "1", "--walk", "random,evade")
    assert [(row["walk"], row["strategy"]) for row in report["rows"]] == [
        (walk, strategy) for walk in ("random", "evade") for strategy in STRATEGIES
    ]
    for row in report["rows"]:
        assert row["frames"] == 6
        assert row["routes_judged"] > 6 * 190
        assert 1 <= row["gap_p50"] <= row["gap_p95"] <= row["gap_max"]
        assert row["gap_mean"] <= row["gap_max"]
        assert 0 < row["frame_ms_p50"] <= row["frame_ms_max"]
        if row["strategy"] == "full":
            assert row["gap_max"] < 1 + 1e-5
            assert row["updates"] == {"bounded": 6}
        if row["strategy"] == "variable_range":
            assert row["gap_max"] > 1.001, "a window cannot have kept the whole tree exact"


def test_certificates_are_checked_by_a_command() -> None:
    report = bench("certificates", "--checks", "2000", "--seed", "3")
    assert report["checks"] >= 2000
    assert report["violations"] == 0
    assert [row["law"] for row in report["laws"]] == list(LAWS)


def test_a_violation_is_counted_and_clips_no_figure() -> None:
    tally = Tally(frame_ms=[1.0])
    one = RouteBatch.of([Route(status=RouteStatus.OK, start=0, cost_s=3.0, lower_bound_s=3.3)])
    tally.judge(one, np.array([3.1]), replace(one, cost_s=np.array([3.2]), lower_bound_s=np.array([3.15])))
    row = tally.row()
    assert row["violations"] == dict.fromkeys(BROKEN, 1)
    assert row["gap_max"] == round(3.0 / 3.2, 5)
    assert row["proven_p95"] == round(3.0 / 3.3, 5)


# --- the map and its fleets --------------------------------------------------------------------------------------


def test_compaction_leaves_the_marked_cells_and_drops_what_was_said_twice() -> None:
    without, compacted = bench("compaction", "--lives", "8")["rows"]
    assert (without["compact"], compacted["compact"]) == ("no", "yes")
    assert compacted["cells_marked"] == without["cells_marked"] == compacted["marks"] < without["marks"]


def test_flights_are_measured_beside_a_stack_of_levels_and_keep_their_clearance() -> None:
    report = bench("air", "--cells", "24", "--routes", "1000")
    assert report["clearance_broken"] == 0
    assert report["lowest_m"] >= report["clearance_m"]
    assert 1.0 <= report["over_stack_mean"] <= report["over_stack_p95"] < 2


@pytest.mark.parametrize("field", ["terrain", "maze"])
def test_kernels_are_measured_and_a_repair_gives_way_to_a_growth_at_most(field: str) -> None:
    report = bench("kernels", "--size", "96", "--field", field, "--repeats", "2", "--side", "5")
    assert report["size"] == [96, 96]
    assert {row["change"] for row in report["repairs"]} == {
        *("x 0.7", "x 1.5", "x 3", "lethal", "mark", "lethal mark")
    }
    for row in report["repairs"]:
        assert 0 < row["p50_us"] <= row["p95_us"] <= row["max_us"]
        assert row["given_way"] is None or 0 <= row["given_way"] <= 1
    one, *_, thousand = report["routes"]
    assert (one["at_once"], thousand["at_once"]) == (1, 1000)
    assert 0 < thousand["us_each"] < one["us_each"]
