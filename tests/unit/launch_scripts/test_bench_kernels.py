"""`./launch_scripts/bench kernels` runs small, and what it prints fits and makes sense."""

from __future__ import annotations

import json

import pytest
from bench.cli import app
from typer.testing import CliRunner


@pytest.mark.parametrize("field", ["terrain", "maze"])
def test_kernels_are_measured_and_a_repair_gives_way_to_a_growth_at_most(field: str) -> None:
    words = ["kernels", "--size", "96", "--field", field, "--repeats", "2", "--side", "5", "--json"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
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


def test_its_tables_fit() -> None:
    done = CliRunner().invoke(app, ["kernels", "--size", "64", "--repeats", "1"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert max(len(line.rstrip()) for line in done.output.splitlines()) <= 80
    assert "Repair of a patch" in done.output
