"""The order and the English of the house: each fault has a sentence, and none is here."""

import importlib
import sys
from pathlib import Path

import pytest

BUDGET = """
[product]
lines = 9
files = 9
[rooms]
"swarm/bus" = { lines = 2, files = 3 }
[beside]
[docs]
"pages" = { words = 6 }
[words]
"swarm" = 0
"pages" = 1
"""


@pytest.mark.parametrize(
    ("check", "name", "text", "fault"),
    [
        ("house", "swarm/bus/long.py", "a = 1\nb = 2\n", "swarm/bus: 3 lines, of which"),
        ("house", "swarm/lost.py", "a = 1\n", "swarm/lost.py: no row of budget.toml covers it"),
        ("house", "launch_scripts/ears.py", "bus.subscribe(TOPIC)\n", "launch_scripts/ears.py: subscribes"),
        ("house", "swarm/bus/load.py", 'open("/proc/stat")\n', "swarm/bus/load.py: reads /proc"),
        ("house", "swarm/bus/ear.py", "a = 1\n", "swarm/bus/ear.py: shorter than 60 lines, and only one.py"),
        ("house", "swarm/bus/far/one.py", "a = 1\n", "one.py occurs 2 times: swarm/bus/far/one.py"),
        ("house", "pages/short.md", "one two\n| a|b |\n-", ""),
        ("house", "pages/long.md", "one two\n| a|b |\n-\nseven", "pages: 7 words, of which budget.toml allows 6"),
        ("words", "swarm/ask.py", '"""Whether it ends."""\n', 'swarm/ask.py:1: a docstring begins with "Whether"'),
        ("words", "swarm/say.py", "a = 1\nb = 2  # Dear cells\n", 'swarm/say.py:2: "Dear": there is a plain term'),
        ("words", "swarm/field.py", 'a = 1\n"""Told to so many."""\n', 'swarm/field.py:2: "so many"'),
        ("words", "swarm/code.py", '"""Returns `anew`."""\ndear = "all"\n', ""),
        ("words", "swarm/text.py", 'a = 1\nb = f"{a} is told to nobody"\n', 'swarm/text.py:2: "nobody"'),
        ("words", "pages/one.md", "The tree is mended.\n```\nso many\n```\n", ""),
        ("words", "pages/two.md", "Nobody\n\nis `dear`, but\nanew", "pages: 2 faults, of which"),
    ],
)  # fmt: skip
def test_a_fault_is_named_and_all_else_is_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    check: str, name: str, text: str, fault: str,
) -> None:  # fmt: skip
    monkeypatch.syspath_prepend(Path(__file__).parents[3] / ".ci")
    module = importlib.import_module(check)
    for each in {module, importlib.import_module("house")}:
        monkeypatch.setattr(each, "ROOT", tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{check}.py"])
    for path, written in (("budget.toml", BUDGET), ("swarm/bus/one.py", "import swarm.bus.ear\n"), (name, text)):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(written)
    assert module.main() == bool(fault)
    assert fault in capsys.readouterr().err
