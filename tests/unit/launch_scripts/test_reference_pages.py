"""The generated pages agree with the code; a setting without an explanation is refused."""

import doctest
import json
import math
import re
import tomllib
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import pytest

from docs.generate import method_pictures, route_pictures, scenario_page, wire_page
from docs.generate.__main__ import command_line
from docs.generate.printed import lattice_route, printed_costs, printed_range
from launch_scripts import cli
from launch_scripts.typer_commands import Family
from planner_service.target_tree import TargetTree
from swarm.config.explain import meanings
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.grid import GridSpec
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


# --- the statements of docs/method/paper.md about the paper's printed rules hold ----------------------------------


def test_the_printed_condition_never_widens_the_window_of_a_target_that_moves_along_an_axis():
    assert {printed_range(n, 0, k_min=2) for n in range(-300, 300)} == {9}
    assert {printed_range(0, n, k_min=2) for n in range(-300, 300)} == {9}


@pytest.mark.parametrize("n", range(1, 33))
def test_on_a_diagonal_from_the_corner_of_a_block_printed_condition_and_blocks_agree(n):
    grid = GridSpec(257, 257, 1.0)
    tree = TargetTree(grid, PlannerConfig(strategy="variable_range", k_min=2))
    pace = np.ones((257, 257), np.float32)
    tree.update(pace, grid.cell(128 + n - 1, 128 + n - 1), [], 0)
    window = tree.update(pace, grid.cell(128 + n, 128 + n), [], 0).window
    assert window.row1 - window.row0 == printed_range(n, n, k_min=2)


def test_grown_along_the_edges_a_unit_route_costs_the_vehicles_cell_instead_of_the_targets():
    pace = np.array([[3.0, 1.0, 1.0, 7.0]], np.float32)
    assert printed_costs(pace, (0, 3))[0, 0] == 1 + 1 + 3
    grid = GridSpec(1, 4, 1.0)
    tree = TargetTree(grid, PlannerConfig(strategy="full"))
    tree.update(pace, 3, [], 0)
    assert tree.cost_to_go_at([0])[0] == 1 + 1 + 7


def test_strides_jump_over_a_wall_thinner_than_a_stride():
    pace = np.ones((9, 9), np.float32)
    pace[:, 5] = np.inf
    route = lattice_route(pace, (4, 0), (4, 8), stride=4)
    assert route.tolist() == [[4, 0], [4, 4], [4, 8]]
    grid = GridSpec(9, 9, 1.0)
    tree = TargetTree(grid, PlannerConfig(strategy="full"))
    tree.update(pace, grid.cell(4, 8), [], 0)
    assert math.isinf(tree.cost_to_go_at([grid.cell(4, 0)])[0])


@pytest.mark.parametrize("name", [*method_pictures.PICTURES, *route_pictures.PICTURES])
def test_a_picture_is_there_small_and_shown_on_a_page(name):
    images = method_pictures.IMAGES
    assert (images / f"{name}.png").stat().st_size < 160_000
    assert any(f"images/{name}.png" in page.read_text(encoding="utf-8") for page in images.parent.rglob("*.md"))
