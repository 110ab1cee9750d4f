"""Hooks of MkDocs beyond mkdocs.yml: the pages of the Python API, the design pages, the listings of docstrings.

MkDocs loads this file twice: as a hook, and as an extension of griffe, which reads the docstrings.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
PACKAGES = ("planner_service", "shared_map", "swarm", "vehicle_agent")
_NUMPY = re.compile(r"^ *(Parameters|Returns|Raises)\n *-+$", re.MULTILINE)
"""A section of a docstring as NumPy's documentation has them."""
_ROW = re.compile(r"(?P<names>[A-Za-z_][\w.`]*(?:, [A-Za-z_][\w.`]*)*) {2,}(?P<meaning>\S.*)")


class Listings(griffe.Extension):
    """Makes Markdown lists of the rows `name  meaning`, which Markdown would run together."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        if obj.docstring is None:
            return
        if _NUMPY.search(obj.docstring.value):
            obj.docstring.parser = griffe.Parser.numpy
            obj.docstring.parser_options = {"warnings": False}  # how a docstring is laid out breaks no build
        else:
            obj.docstring.value = as_markdown(obj.docstring.value)


def as_markdown(docstring: str) -> str:
    """Returns a docstring whose rows `name  meaning` are items of a list.

    Lines which continue a row are indented, and so belong to its item.
    """
    lines: list[str] = []
    for line in inspect.cleandoc(docstring).splitlines():
        if row := _ROW.fullmatch(line):
            if lines and lines[-1] and not lines[-1].startswith(("- ", " ")):
                lines.append("")  # a list begins a paragraph
            names = ", ".join(f"`{name.strip('`')}`" for name in row["names"].split(", "))
            line = f"- {names}: {row['meaning']}"
        lines.append(line)
    return "\n".join(lines)


def packages() -> dict[str, list[str]]:
    """Modules by the package that holds them; the package itself comes first where it declares names."""
    found: dict[str, list[str]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            package = ".".join(path.parent.relative_to(ROOT).parts)
            if path.name != "__init__.py":
                found.setdefault(package, []).append(f"{package}.{path.stem}")
            elif "import" in path.read_text(encoding="utf-8"):
                found.setdefault(package, []).insert(0, package)
    return dict(sorted(found.items()))


def api_page(package: str, modules: list[str]) -> str:
    """The Markdown of one page of the API reference."""
    return "\n\n".join([f"# {package}", *(f"::: {module}" for module in modules)]) + "\n"


def on_config(config: Any) -> Any:
    """Puts the generated pages and the design pages where mkdocs.yml names their sections."""
    design = sorted(f"design/{path.name}" for path in (ROOT / "docs" / "design").glob("*.md"))
    inside = {
        "Python API": [{package: _api_path(package)} for package in packages()],
        "Design": sorted(design, key=lambda name: name != "design/index.md"),
    }
    for section in config.nav:
        for entries in section.values():
            for entry in entries if isinstance(entries, list) else ():
                if isinstance(entry, dict):
                    entry.update({name: pages for name, pages in inside.items() if name in entry})
    return config


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages of the API."""
    for package, modules in packages().items():
        files.append(File.generated(config, _api_path(package), content=api_page(package, modules)))
    return files


def _api_path(package: str) -> str:
    return f"reference/api/{package}.md"
