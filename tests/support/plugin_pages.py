"""The examples of the pages about plug-ins, written where a scenario finds them."""

from __future__ import annotations

import re
from pathlib import Path

from swarm.config.plugin_names import PLUGIN_KINDS

PAGES = Path(__file__).parents[2] / "docs" / "plugins"
_PAGES_OF = {"walk": "motion", "cost_layer": "cost-layer"}
_BLOCK = re.compile(r'^```(\w+) title="([\w.]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)


def write_example(kind: str, folder: Path, more: str = "") -> Path:
    """Writes the files of a kind's page into a folder, and `more` in front of its scenario; returns that."""
    page = PAGES / f"{_PAGES_OF.get(kind, kind)}.md"
    for _, name, text in _BLOCK.findall(page.read_text(encoding="utf-8")):
        (folder / name).write_text(more + text if name == "scenario.toml" else text, encoding="utf-8")
    return folder / "scenario.toml"


def write_all_examples(folder: Path, more: str) -> Path:
    """Like `write_example` for all pages together: one scenario with a plug-in of every kind, after `more`."""
    arrays: list[str] = []
    tables: dict[str, list[str]] = {}
    for kind in PLUGIN_KINDS:
        text = write_example(kind, folder).read_text(encoding="utf-8")
        for header, body in re.findall(r"^(\[.+\])\n((?:[^\[\n].*\n)+)", text, re.MULTILINE):
            if header.startswith("[["):
                arrays.append(f"{header}\n{body}")
            else:
                tables.setdefault(header, []).append(body)
    merged = [f"{header}\n{''.join(bodies)}" for header, bodies in tables.items()]
    path = folder / "scenario.toml"
    path.write_text("\n".join([more, *merged, *arrays]), encoding="utf-8")
    return path
