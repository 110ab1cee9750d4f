"""Writes every generated page of the reference.

python -m docs.generate            writes them
python -m docs.generate --check    exit code 1 if a file is not what the code says
"""

from __future__ import annotations

import inspect
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from docs.generate import scenario_page, wire_page
from docs.generate.templates import filled
from launch_scripts import cli
from launch_scripts.gateways.ros2 import gateway_settings
from launch_scripts.gateways.ros2.gateway_settings import Settings
from launch_scripts.typer_commands import Family
from shared_map.importers.cover.land_cover import TABLES
from shared_map.importers.zones.zone_features import BUILT_IN, COLUMNS

_DOCS = Path(__file__).parents[1]
_REFERENCE, _DESIGN = _DOCS / "reference", _DOCS / "design"
_PROGRAM = re.compile(r"(\[`docs/(examples/\w+\.py)`\].*\n\n(?:<!--.*-->\n\n)?```python\n)(?:.*\n)*?(?=```)")
_MEASUREMENTS = tomllib.loads(Path(__file__).with_name("measurements.toml").read_text(encoding="utf-8"))
_EXAMPLES = re.compile(r"^swarm .*(?:\n+swarm .*)*$", re.MULTILINE)


def command_line() -> str:
    """Returns the page of the command `swarm`; an option which commands share is explained once."""
    commands = [(words, _about(each), _rows(each)) for words, each in _commands("swarm", cli.command())]
    times = Counter(row for _, _, rows in commands for row in rows)
    first = {f"{about}{rows}": words for words, about, rows in reversed(commands)}
    shared = sorted(row for row in times if times[row] > 1)
    return filled("cli", commands=commands, first=first, shared=shared)


def _commands(words: str, group: Any) -> Iterator[tuple[str, Any]]:
    """Yields the words of each command, and the command; a group before its own."""
    for name, each in group.commands.items():
        command = each.group if isinstance(each, Family) else each
        if not command.hidden:
            yield f"{words} {name}", command
            yield from _commands(f"{words} {name}", command) if hasattr(command, "commands") else ()


def _about(command: Any) -> str:
    """Returns the prose of a command, with its examples as code."""
    text = inspect.cleandoc(command.help or "")
    return _EXAMPLES.sub(lambda found: re.sub(r"^|\n+", lambda end: end[0][:1] + "    ", found[0]), text)


def _rows(command: Any) -> list[tuple[str, str, str]]:
    """Returns name, name with its type, and meaning of each argument and option."""
    found, ctx = [], typer.Context(command)
    for label, text in filter(None, (each.get_help_record(ctx) for each in command.params if each.name != "help")):
        value = r"=\1" if label.startswith("-") else ""
        label = re.sub(r"(?<=[\w.\]]) <?([^<>]+?)(?: range)?>?$", value, label)
        text = text.replace("  [required]", "").replace("  [default: ", " [")
        found.append((re.findall(r"--[\w-]+|^\S+", label)[-1], label, text))
    return found


def ros2() -> str:
    """Returns the page of what `swarm gateway ros2` forwards and of its settings."""
    return filled("ros2", table=gateway_settings, settings=scenario_page.settings(Settings))


def design() -> str:
    """Returns the index of the design pages: a row per page, whose title states the choice."""
    pages = {path.name: path.read_text(encoding="utf-8") for path in sorted(_DESIGN.glob("*.md"))}
    pages.pop("index.md", None)
    titles = {name: text.partition("\n")[0].removeprefix("# ") for name, text in pages.items()}
    return filled("design", titles=titles)


def with_programs(page: Path) -> str:
    """Returns a page with the current text of the programs which it shows below a link to their file."""
    text = page.read_text(encoding="utf-8").removesuffix("\n")
    return _PROGRAM.sub(lambda found: found[1] + (_DOCS / found[2]).read_text(encoding="utf-8"), text)


PAGES: dict[Path, Callable[[], str]] = {
    wire_page.PATH: wire_page.document,
    wire_page.JSON_PATH: wire_page.json_document,
    scenario_page.PATH: scenario_page.document,
    scenario_page.SCHEMA_PATH: scenario_page.schema,
    _REFERENCE / "cli.md": command_line,
    _REFERENCE / "land-cover.md": lambda: filled("land-cover", tables=TABLES.values()),
    _REFERENCE / "ways.md": lambda: filled("ways", kinds=BUILT_IN, columns=COLUMNS),
    _REFERENCE.with_name("method") / "measurements.md": lambda: filled("measurements", **_MEASUREMENTS),
    _REFERENCE / "ros2.md": ros2,
    _DESIGN / "index.md": design,
    **{page: partial(with_programs, page) for page in _DOCS.glob("*/*.md") if _PROGRAM.search(page.read_text())},
}
"""File -> what makes its text, without the line end at its end."""


def main(
    check: Annotated[bool, typer.Option("--check", help="Only tell whether the files are current.")] = False,
) -> None:
    """Writes the pages of the reference. With --check, exit code 1 if a file is not what the code says."""
    stale = 0
    for path, make in PAGES.items():
        text = make() + "\n"
        if not check:
            path.write_text(text, encoding="utf-8")
        elif not path.is_file() or path.read_text(encoding="utf-8") != text:
            print(f"{path} is not current: run `python -m docs.generate`", file=sys.stderr)
            stale = 1
    raise typer.Exit(stale)


if __name__ == "__main__":
    typer.run(main)
