"""The harness of benchmarks: each command is listed, and answers bad input with a sentence."""

import json
import re
from typing import Any

import pytest
import typer
from bench import harness
from bench.harness import benchmark
from bench.isolated import isolated
from support.benchmarks import bench, run

from swarm.errors import ConfigError, SwarmError

ROWS = [
    {"size": size, "many": many, "kind": kind, "took_ms": size * many, "left_out": 1}
    for kind in ("a", "b")
    for size, many in ((1, 10), (2, 10), (1, 20))
]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command group of one benchmark, `made`."""
    monkeypatch.setattr(harness, "app", typer.Typer())
    harness.app.callback()(lambda: None)

    @benchmark("made", columns=("kind", "took_ms"), fails=("wrong",))
    def made(wrong: int = 0) -> dict[str, Any]:
        """Nothing."""
        rows = list(harness.track(ROWS))
        return {"rows": rows, "share": 0.123456789, "wrong": wrong, "notes": ["A note."]}


def test_a_report_is_one_object_with_its_machine_or_tables_with_the_chosen_columns(made: None) -> None:
    report = json.loads(run("made", "--json").stdout)
    assert report["rows"] == ROWS
    assert {"cores", "machine", "python", "load"} <= report.keys()
    text = run("made").output
    assert "took" in text
    assert "left" not in text
    assert "0.12346" in text
    assert "A note." in text


def test_a_figure_that_must_be_nothing_is_the_exit_code(made: None) -> None:
    assert run("made").exit_code == 0
    assert run("made", "--wrong", "1").exit_code == 1


def test_help_has_the_bounds_of_a_number_once_and_in_words() -> None:
    said = run("peers", "--help").output
    assert {"INTEGER", "[at"} <= set(said.split())
    assert not {"range", "<int", "x>=1"}.intersection(re.split(r"[\s\]>]", said))


def fail() -> None:
    raise ValueError("a reason")


def test_a_process_that_fails_is_told_in_a_sentence() -> None:
    with pytest.raises(SwarmError, match=r"fail failed with exit code 1: .*"):
        isolated(fail)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("peers --field moon", "field 'moon' is neither of terrain, uniform, maze nor a file"),
        ("gap --walk fly", "--walk: 'fly' is not one of random, waypoints, evade"),
        ("gap --strategies best", "--strategies: 'best' is not one of auto, exact, full"),
        ("gap --strategies ,", "--strategies is ','"),
        ("scale --sizes 16 --vehicles 999", "--vehicles is 999; the field has"),
        ("wire --parts latency,speed", "'speed' is not one of latency, throughput"),
        ("crowd --worlds open,sea", "--worlds: 'sea' is not one of open, doors, corridor, maze"),
        ("crowd --seeds 5", "--seeds: '5' is not A:B"),
        ("crowd --vehicles 4 --agents 5", "--agents is 5, expected at most as many as --vehicles, 4"),
        ("crowd --vehicles 401", "--vehicles is 401, expected at most a quarter of 40 x 40 cells"),
        ("swarm --vehicles 0", "--vehicles is '0', expected numbers of at least 1"),
        ("swarm --vehicles 100001", "--vehicles is 100001, expected 1 to 100000"),
        ("swarm --targets 0", "--targets is 0, expected 1 to 1000"),
        ("swarm --vehicles 1000 --size 40", "--size is 40, expected 64 to 16384"),
    ],
)
def test_bad_input_is_one_sentence(words: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        bench(*words.split())
    assert complaint in str(caught.value)
    assert caught.value.exit_code == 2
