"""The order of the house: each fault has a sentence, and none is here."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[3] / ".ci"


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The check of a made-up tree in `tmp_path`, whose budget has a row for `swarm/bus` only."""
    monkeypatch.syspath_prepend(FOLDER)
    module = importlib.import_module("house")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(sys, "argv", ["house.py"])
    (tmp_path / "budget.toml").write_text(
        '[product]\nlines = 9\nfiles = 9\n[rooms]\n"swarm/bus" = { lines = 2, files = 3 }\n[beside]\n[docs]\n'
    )
    (tmp_path / "swarm" / "bus").mkdir(parents=True)
    return module


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("swarm/bus/long.py", "a = 1\nb = 2\nc = 3\n", "swarm/bus: 3 lines, of which budget.toml allows 2"),
        ("swarm/lost.py", "a = 1\n", "swarm/lost.py: no row of budget.toml covers it"),
        ("launch_scripts/ears.py", "bus.subscribe(TOPIC)\n", "launch_scripts/ears.py: subscribes"),
        ("swarm/bus/load.py", 'open("/proc/stat")\n', "swarm/bus/load.py: reads /proc"),
    ],
)
def test_a_fault_is_named(
    house: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, text: str, fault: str
) -> None:
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(text)
    assert house.main() == 1
    assert fault in capsys.readouterr().err
