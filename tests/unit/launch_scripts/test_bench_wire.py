"""`swarm bench wire` runs small, and what must hold holds: nothing is lost, everything has its ratio."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from launch_scripts.bench.cli import app

pytestmark = pytest.mark.network


def test_the_wire_is_measured_beside_raw_zenoh_and_nothing_is_left_running() -> None:
    small = ["--marks", "20", "--sets", "500", "--rounds", "1", "--joins", "1", "--seconds", "1"]
    ran = CliRunner().invoke(app, ["wire", "--parts", "latency,flood,join", *small, "--json"])
    assert ran.exit_code == 0, ran.output
    report = json.loads(ran.stdout)
    assert report["latency"]["lost"] == 0
    assert report["flood"]["superseded_or_lost"] == 0
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
    assert "'speed' is not one of latency, flood" in str(ran.exception)
