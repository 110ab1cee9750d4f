"""The generated pages agree with the code; a setting without an explanation is refused."""

import doctest
import json
import re
import tomllib
from pathlib import Path
from typing import Annotated

import msgspec
import pytest

from docs.generate import scenario_page, wire_page
from docs.generate.__main__ import command_line
from launch_scripts import cli
from launch_scripts.typer_commands import Family
from swarm.config.explain import meanings
from swarm.config.scenario import Scenario
from swarm.wire.topics import TOPICS

ROOT = Path(__file__).parents[3]


class Explained(msgspec.Struct):
    """A section.

    width_m  how wide
             it is
    colour, shade  which
    """

    width_m: Annotated[float, msgspec.Meta(gt=0, le=5)] = 1.0
    colour: str = "red"
    shade: str = ""


class Unexplained(msgspec.Struct):
    """A section.

    width_m  how wide
    """

    width_m: float = 1.0
    depth_m: float = 1.0


def test_a_key_has_its_meaning_range_and_default_on_the_page():
    page = scenario_page.document(Explained)
    assert "- `width_m` (number >0 <=5; `1.0`): how wide it is\n" in page
    assert '- `shade` (text; `""`): which' in page


def test_a_key_without_a_row_is_refused_by_page_and_schema():
    for make in (scenario_page.document, scenario_page.schema):
        with pytest.raises(scenario_page.UndocumentedKeyError, match=r"Unexplained: no row .* for depth_m"):
            make(Unexplained)


def test_every_key_of_every_section_is_on_the_page():
    page = scenario_page.PATH.read_text(encoding="utf-8")
    for path, section in scenario_page._sections(Scenario):
        assert f"## `{path}`" in page or path == ""
        for key in section.__struct_encode_fields__:
            assert f"- `{key}` (" in page or f".{key}]" in page or f"[{key}]" in page


@pytest.mark.parametrize(
    "scenario", sorted((ROOT / "launch_scripts" / "scenarios").glob("*.toml")), ids=lambda p: p.stem
)
def test_the_schema_knows_every_key_of_a_shipped_scenario_and_no_other(scenario):
    schema = json.loads(scenario_page.SCHEMA_PATH.read_text(encoding="utf-8"))

    def check(value, kind):
        kind = schema["$defs"][kind["$ref"].rpartition("/")[2]] if "$ref" in kind else kind
        if isinstance(value, dict) and "properties" in kind:
            assert kind["additionalProperties"] is False
            for key, inner in value.items():
                assert kind["properties"][key]["description"]
                check(inner, kind["properties"][key])
        elif isinstance(value, list) and "items" in kind:
            for inner in value:
                check(inner, kind["items"])

    check(tomllib.loads(scenario.read_text(encoding="utf-8")), schema)


def test_every_command_and_option_of_the_command_line_is_on_the_page():
    page = command_line()
    for link, options in zip(("the swarm", "a process"), re.findall(r'" means (.*?)[;.]', page), strict=True):
        page = page.replace(f"[{link}](#shared-options)", options)
    for name, command in cli.command().commands.items():
        section = page.split(f"\n## `swarm {name}`\n")[1].partition("\n## `")[0]
        for param in (each for each in command.params if not getattr(each, "hidden", False)):
            assert any(name in section for name in (*param.opts, param.metavar or param.name.upper()))
        if isinstance(command, Family):
            assert all(f"### `swarm {name} {inner}`" in section for inner in command.group.commands)


def test_every_key_message_and_field_is_on_the_page():
    page = wire_page.document()
    assert all(f"- `{topic.key}` " in page for topic in TOPICS)
    for message in wire_page.messages():
        section = page.partition(f"\n### {message.__name__}\n")[2].partition("\n### ")[0]
        assert f'"{message.__struct_config__.tag}"' in section
        for field in message.__struct_fields__:
            assert re.search(rf"^    (\w+, )*{field}(, \w+)*  +\S", section, re.MULTILINE)
        for struct in (message, *wire_page.parts(message)):
            assert meanings(struct).keys() <= {*struct.__struct_fields__}


_FILE = re.compile(r"`((?:[\w.-]+/)+[\w-]+\.(?:py|toml|md|sh|yml|json))`")
_FOLDER = re.compile(
    r"`((?:swarm|shared_map|planner_service|vehicle_agent|launch_scripts|tests|docs)/(?:[\w-]+/)*)`"
)
_RUN = re.compile(r"(?:python|pytest) ((?:[\w-]+/)+[\w-]+\.py)")
_PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


@pytest.mark.parametrize("page", _PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_file_and_folder_that_a_page_names_exists(page):
    text = page.read_text(encoding="utf-8")
    found = (*_FILE.findall(text), *_FOLDER.findall(text), *_RUN.findall(text))
    named = [name for name in found if not name.startswith("runs/")]
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_python_of_the_tutorial_runs_as_it_says():
    failed, tried = doctest.testfile(str(ROOT / "docs" / "science" / "python.md"), module_relative=False)
    assert tried > 8
    assert failed == 0


@pytest.mark.parametrize("folder", ["operate", "gis", "behaviour"])
def test_every_scenario_of_the_pages_is_accepted(folder):
    pages = [page.read_text(encoding="utf-8") for page in _PAGES if page.parent.name == folder]
    blocks = re.findall(r"^```toml\n(.*?)^```", "\n".join(pages), re.M | re.S)
    assert [msgspec.convert(tomllib.loads(block), Scenario) for block in blocks]
