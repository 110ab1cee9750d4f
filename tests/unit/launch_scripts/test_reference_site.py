"""The documentation builds: no dead link, no page outside of the navigation, nothing from other hosts."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mkdocs", reason="the documentation's packages (dependency group dev) are not installed")
pytest.importorskip("mkdocstrings", reason="the documentation's packages (dependency group dev) are not installed")

from docs.generate.site import as_markdown, packages

ROOT = Path(__file__).parents[3]


def test_rows_of_a_docstring_are_items_of_a_list_with_all_their_lines():
    said = """What it is:
    rows, cols  how many
    name        goes on
                and on

    More of it.
    """
    items = "- `rows`, `cols`: how many\n- `name`: goes on\n            and on"
    assert as_markdown(said) == f"What it is:\n\n{items}\n\nMore of it."


BUILD = """
import logging, sys
from mkdocs.commands.build import build
from mkdocs.config import load_config
logging.basicConfig(level=logging.WARNING)
config = load_config("mkdocs.yml", strict=True, site_dir=sys.argv[1])
options = config.plugins["mkdocstrings"].config.handlers["python"]["options"]
options |= {"members": False} if sys.argv[2] == "brief" else {}
config.plugins.on_startup(command="build", dirty=False)
build(config)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory, pytestconfig):
    """All pages, strictly. Those of the Python API have what is inside of a module with `--thorough` only, which
    takes most of the time."""
    folder = tmp_path_factory.mktemp("site")
    env = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-c", BUILD, folder, "whole" if pytestconfig.getoption("--thorough") else "brief"]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.thorough
def test_every_page_is_built_and_in_the_navigation(site):
    """Every page links to those of its section, and the home page to the first of each; so follow the menus."""
    found, waiting = set(), [site / "index.html"]
    while waiting:
        page = waiting.pop()
        if page in found or not page.is_file():
            continue
        found.add(page)
        menu = "".join(re.findall(r"<nav.*?</nav>", page.read_text(encoding="utf-8"), re.DOTALL))
        links = re.findall(r'href="([^"#:]+\.html)[^"]*"', menu)
        waiting += [(page.parent / link).resolve() for link in links]
    for page in (ROOT / "docs").rglob("*.md"):
        assert site / page.relative_to(ROOT / "docs").with_suffix(".html") in found


def test_a_page_of_the_python_api_stands_for_every_room(site):
    for package, modules in packages().items():
        page = (site / "reference" / "api" / f"{package}.html").read_text(encoding="utf-8")
        for module in modules:
            assert f'id="{module}"' in page


def test_programs_stand_on_the_pages_that_include_them(site):
    for page, program in (("join", "vehicle"), ("tracker", "target")):
        about = (ROOT / "docs" / "examples" / f"{program}.py").read_text(encoding="utf-8").split('"""')[1]
        assert about in (site / "vehicle" / f"{page}.html").read_text(encoding="utf-8")


def test_a_browser_loads_nothing_from_other_hosts(site):
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.findall(r'(?:src|srcset|poster)="(?:https?:)?//[^"]*"', text), page
        assert not re.findall(r'<link[^>]+href="(?:https?:)?//[^"]*"', text), page
    for sheet in site.rglob("*.css"):
        assert not re.findall(r"(?:url\(|@import )[\"']?(?:https?:)?//", sheet.read_text(encoding="utf-8")), sheet
