"""Writes every generated page of the reference.

python -m docs.generate            writes them
python -m docs.generate --check    exit code 1 if a file is not what the code says
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer
from typer.cli import get_docs_for_click

from docs.generate import scenario_page, wire_page
from docs.generate.templates import filled
from launch_scripts import cli
from launch_scripts.command_line.declaring import Family
from launch_scripts.gateways.ros2.gateway_settings import EXAMPLE, Settings, incoming_rows
from launch_scripts.gateways.ros2.topic_table import TABLE
from shared_map.importers.cover.cover_codes import TABLES
from shared_map.importers.zones.way_classes import BUILT_IN, COLUMNS

_REFERENCE = Path(__file__).parents[1] / "reference"
_DESIGN = Path(__file__).parents[1] / "design"
_MEASUREMENTS = Path(__file__).with_name("measurements.toml")
_QOS = {
    "DEFAULT": "reliable, volatile, last 10",
    "LATCHED": "reliable, transient local, last 1",
    "SENSOR": "best effort, volatile, last 5",
    "TRANSFORMS": "reliable, volatile, last 100",
}
_EXAMPLES = re.compile(r"^swarm .*(?:\n+swarm .*)*$", re.MULTILINE)
_OPTION = re.compile(r"^\* `.*", re.MULTILINE)
_OPTIONS = re.compile(r"(?:^\* `.*\n)+", re.MULTILINE)
SWARM = "`--tls-dir`, `--tls-ca`, `--tls-cert`, `--tls-key`, `--connect`, `--namespace`, `--run`, `--runs`"
"""The options by which a command finds the swarm."""
_SHARED = 2
"""An option with one text in this number of commands is explained once."""
_LEFT_OUT = re.compile(r"\*\*(?:Usage|Commands)\*\*:\n\n(?:```[^`]*```\n|(?:\* .*\n)+)\n?")
"""Parts of Typer's text which say nothing that the examples and the next sections do not say."""
_OF_EVERY_COMMAND = re.compile(r"^(?:\*\*Options\*\*:\n\n)?\* `(?:-h, )?--help`.*\n", re.MULTILINE)


def command_line() -> str:
    """Returns the page of the command `swarm`: what Typer writes, with the examples of a command as code."""
    root = cli.command()
    _load(root)
    text = get_docs_for_click(obj=root, ctx=typer.Context(root, info_name="swarm"), name="swarm")
    text = _OF_EVERY_COMMAND.sub("", _LEFT_OUT.sub("", text.partition("\n")[2]))
    text = re.sub(r"(?<=[a-z]) range(?=>)|  \[required\]|\n\*\*\w+\*\*:\n(?=\n\* )", "", text)
    text = re.sub(r"(\n\* .*\n)\n+(?=\* )", r"\1", text)
    text = re.sub(r"(?<=\n\* `)([^-`]\S*) <.*?>`", r"\1`", text)
    text = _EXAMPLES.sub(lambda found: "```sh\n" + re.sub(r"\n+", "\n", found[0]) + "\n```", text)
    shared, text = _shared_once(text.strip())
    return filled("cli", commands=text, shared=shared)


def _load(group: Any) -> None:
    """Puts the groups themselves in place of families, which are loaded when one is called."""
    for name, each in group.commands.items():
        if isinstance(each, Family):
            each.group.name = name
            group.commands[name] = each.group
            _load(each.group)


def _shared_once(text: str) -> tuple[list[str], str]:
    """Returns the rows of options that many commands share, and the page with names in place of these rows."""
    times = Counter(_OPTION.findall(text))
    usual = {_name(row): row for row, _ in reversed(times.most_common())}
    shared = sorted(row for row in usual.values() if times[row] >= _SHARED)

    def named(block: re.Match[str]) -> str:
        rows = block[0].splitlines()
        names = [_name(row) for row in rows if row in shared]
        told = ", ".join(f"`{name}`" for name in names).replace(SWARM, "[the swarm](#shared-options)")
        link = [f"* {told}"] if names else []
        return "\n".join([*(row for row in rows if row not in shared), *link]) + "\n"

    return shared, _OPTIONS.sub(named, text)


def _name(row: str) -> str:
    """Returns the long name of an option."""
    return re.sub(r"^-\w, ", "", row.split("`")[1]).partition(" ")[0]


def measurements() -> str:
    """Returns the page of measurements."""
    return filled("measurements", **tomllib.loads(_MEASUREMENTS.read_text(encoding="utf-8")))


def ros2() -> str:
    """Returns the page of what `swarm gateway ros2` forwards and of its settings."""
    incoming = incoming_rows(EXAMPLE, has_map=True)
    settings = scenario_page.settings(Settings)
    return filled("ros2", outgoing=TABLE, incoming=incoming, qos=_QOS, settings=settings)


def design() -> str:
    """Returns the index of the design pages: a row per page, whose title states the choice."""
    pages = {path.name: path.read_text(encoding="utf-8") for path in sorted(_DESIGN.glob("*.md"))}
    pages.pop("index.md", None)
    titles = {name: text.partition("\n")[0].removeprefix("# ") for name, text in pages.items()}
    return filled("design", titles=titles)


PAGES: dict[Path, Callable[[], str]] = {
    wire_page.PATH: wire_page.document,
    wire_page.JSON_PATH: wire_page.json_document,
    scenario_page.PATH: scenario_page.document,
    scenario_page.SCHEMA_PATH: scenario_page.schema,
    _REFERENCE / "cli.md": command_line,
    _REFERENCE / "land-cover.md": lambda: filled("land-cover", tables=TABLES.values()),
    _REFERENCE / "ways.md": lambda: filled("ways", kinds=BUILT_IN, columns=COLUMNS),
    _REFERENCE.with_name("method") / "measurements.md": measurements,
    _REFERENCE / "ros2.md": ros2,
    _DESIGN / "index.md": design,
}
"""File -> what makes its text, without the line end at its end."""


def main() -> int:
    """Writes or checks the pages; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.generate", description="Write the generated pages of the reference."
    )
    parser.add_argument("--check", action="store_true", help="only tell whether the files are current")
    check = parser.parse_args().check
    stale = 0
    for path, make in PAGES.items():
        text = make() + "\n"
        if not check:
            path.write_text(text, encoding="utf-8")
        elif not path.is_file() or path.read_text(encoding="utf-8") != text:
            print(f"{path} is not current: run `python -m docs.generate`", file=sys.stderr)
            stale = 1
    return stale


if __name__ == "__main__":
    sys.exit(main())
