"""The examples of the pages about plug-ins, written where a scenario finds them."""

from __future__ import annotations

import re
from pathlib import Path

PAGES = Path(__file__).parents[2] / "docs" / "plugins"
_BLOCK = re.compile(r'^```(\w+) title="([\w.]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)


def write_example(page: str, folder: Path, more: str = "") -> Path:
    """Write the files of a page into a folder, and `more` in front of its scenario; returns that."""
    for _, name, text in _BLOCK.findall((PAGES / f"{page}.md").read_text(encoding="utf-8")):
        (folder / name).write_text(more + text if name == "scenario.toml" else text, encoding="utf-8")
    return folder / "scenario.toml"
