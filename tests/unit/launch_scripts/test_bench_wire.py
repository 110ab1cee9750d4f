"""`./launch_scripts/bench wire` runs small, and what must hold holds: nothing is lost, everything has its ratio."""

from __future__ import annotations

import json

import pytest
from bench.cli import app
from bench.wire import codec
from typer.testing import CliRunner

pytestmark = pytest.mark.network


def test_the_wire_is_measured_beside_raw_zenoh_and_nothing_is_left_running() -> None:
    small = ["--marks", "20", "--sets", "500", "--rounds", "1", "--joins", "1", "--seconds", "1"]
    ran = CliRunner().invoke(app, ["wire", "--parts", "latency,throughput,join", *small, "--json"])
    assert ran.exit_code == 0, ran.output
    report = json.loads(ran.stdout)
    assert report["latency"]["lost"] == 0
    assert report["throughput"]["superseded_or_lost"] == 0
    assert report["join"]["sets"] == 4000
    assert [row["what"].partition(", p")[0] for row in report["rows"]] == [
        "mark put -> applied elsewhere",
        "mark put -> applied elsewhere",
        "sets applied",
        "late join of 4,000 sets",
    ]
    assert all(row["ratio"] > 0 and row["wanted"] > 0 for row in report["rows"])


def test_a_part_that_there_is_not_is_named() -> None:
    ran = CliRunner().invoke(app, ["wire", "--parts", "latency,speed"])
    assert ran.exit_code != 0
    assert "'speed' is not one of latency, throughput" in str(ran.exception)


def test_the_codec_is_measured_beside_msgspec_alone_and_hostile_payloads_take_bounded_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(codec, "_SECONDS", 2)
    report = codec.run()
    assert {row["message"] for row in report["types"]} >= {"MarkSet", "TargetPose", "RouteReply", "Stats"}
    assert sum(row["share"] for row in report["types"]) == pytest.approx(1, abs=0.01)
    assert report["ratio_encode"] > 0
    assert report["ratio_decode"] > 0
    assert max(row["ours_mib"] for row in report["hostile"]) < 100
    assert len(list(codec.tables(report))) == 2
