"""Commands and programs of the pages, run in order, in a folder and an environment of the page.

The environment has the extras which the page installs, or `all`. A comment before a block says why it is not run,
or what it needs: `<!-- not run: two machines -->`, `<!-- beside: swarm demo -->`. A comment before the title is for
all blocks of the page.
"""

import os
import re
import shlex
import subprocess
from functools import partial
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from support.installed import ROOT, environment
from support.processes import Child, eventually

from launch_scripts.cli import command
from launch_scripts.launcher.run_options import scenario_path

pytestmark = [pytest.mark.network, pytest.mark.slow]

ELSEWHERE = {ROOT / "docs" / folder for folder in ("design", "reference", "plugins")}
"""Folders of pages which are generated, are about the code, or whose programs other tests run."""
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = [page for page in PAGES if ELSEWHERE.isdisjoint(page.parents)]
PROGRAMS = "swarm|pip|python|source|ssh|podman|kubectl|tar|cargo|curl|dask|kill|grep|journalctl|zenohd|uv|git"
_COMMAND = re.compile(rf"(machine |another\$|\./launch_scripts/|\.venv/bin/|\w+=\S* |({PROGRAMS}) )")
_SAID = re.compile(r"<!-- (not run: .+|beside: swarm demo) -->")
_HEAVY = re.compile(r"swarm (up|demo|runs|simulate|study)\b")
SHELL = ("sh", "bash", "console")
_SYNTH = "swarm terrain generate --rows 200 --cols 240 --out dem.tif --photo photo.tif"


class Block(NamedTuple):
    """Commands or a file of a page, with the comment before it."""

    line: int
    language: str
    text: str
    said: str


def blocks(page: Path) -> list[Block]:
    """Fenced blocks, and indented ones which begin with a command."""
    lines = [*page.read_text(encoding="utf-8").split("\n"), ""]
    whole = _SAID.fullmatch(lines[0])
    found, said, n = [], None, 0
    while n < len(lines):
        begins = n
        language, body = "", lines[n].strip()
        if fence := re.match(r" *```(\w*)", lines[n]):
            language = fence[1]
            n = next(k for k in range(n + 1, len(lines)) if lines[k].strip().startswith("```"))
            body = "\n".join(line.removeprefix(fence[0][: fence[0].index("`")]) for line in lines[begins + 1 : n])
        elif lines[n].startswith("    ") and not lines[n - 1].strip() and _COMMAND.match(body):
            language = "sh"
            n = next(k for k in range(n, len(lines)) if not lines[k].startswith("    ")) - 1
            body = "\n".join(line[4:] for line in lines[begins : n + 1])
        if language:
            comment = said or whole
            found.append(Block(begins + 1, language, body, comment[1] if comment else ""))
        if body or language:
            said = _SAID.fullmatch(body)
        n += 1
    return found


def commands(page: Path) -> list[Block]:
    """Blocks of a page to run: commands, and Python which is a whole program."""
    return [
        each
        for each in blocks(page)
        if each.language in SHELL or (each.language == "python" and re.search(r"^(import|from) ", each.text, re.M))
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_has_the_name_and_the_options_of_one(page: Path) -> None:
    text = "\n".join(each.text for each in blocks(page) if each.language in SHELL).replace("\\\n", " ")
    for line in re.findall(r"(?:^|[\s$]|\.venv/bin/)swarm (.*?)(?:&& |\| |$)", re.sub(" +# .*", "", text), re.M):
        group: Any = command()
        for word in shlex.split(line):
            if word.startswith("-"):
                known = {name for param in group.params for name in (*param.opts, *param.secondary_opts)}
                assert word.partition("=")[0] in known | {"-h", "--help"}, line
            elif hasattr(group, "list_commands"):
                group = group.get_command(None, word)
                assert group is not None, line


class Bench:
    """A folder with an environment, in which blocks of a page are run."""

    def __init__(self, folder: Path, *extras: str) -> None:
        site = environment(folder / ".venv", *extras)
        about = next(file for file in distribution("terrain-swarm").files or () if file.name == "METADATA").locate()
        (site / Path(str(about)).parent.name).symlink_to(Path(str(about)).parent)
        (folder / "docs").symlink_to(ROOT / "docs")
        self.folder = folder
        self.around = {"PATH": f"{folder}/.venv/bin:{os.environ['PATH']}", "HOME": str(folder)}
        self.around |= {"PYTHONPATH": str(ROOT)}  # with the kernels which it has compiled

    def run(self, text: str, *begin: str) -> None:
        done = subprocess.run(
            [*(begin or ("bash", "-ec")), text], cwd=self.folder, env=self.around, text=True, timeout=120,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        assert done.returncode == 0, f"{text}\n{done.stdout}"


@pytest.fixture
def beside(tmp_path: Path) -> Any:
    """The demo, of fewer vehicles and targets, for all blocks beside it. It is the newest swarm of its folder, so
    commands find it."""
    bench, demo = Bench(tmp_path, "all"), scenario_path("demo").read_text(encoding="utf-8")
    fewer = demo.replace("vehicles = 99", "vehicles = 9").replace("count = 9", "count = 4")
    (tmp_path / "demo.toml").write_text(fewer, encoding="utf-8")
    words = ("swarm", "up", "demo.toml", "--port", "0", "--seconds", "600", "--no-live")
    there: dict[str, Any] = {"cwd": bench.folder, "env": bench.around}
    with Child(tmp_path / "demo.log", *words, **there, start_new_session=True, stdin=subprocess.DEVNULL):
        asks = partial(subprocess.run, ["swarm", "status"], **there, capture_output=True)
        eventually(lambda: asks().returncode == 0, 60, "the demo")
        yield bench


def test_each_block_runs_beside_the_demo_which_says_so(beside: Bench) -> None:
    for page in PAGES:
        for block in (each for each in commands(page) if each.said.startswith("beside")):
            beside.run(re.sub(r"swarm top\b", r"\g<0> --once", block.text))


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if any(not each.said for each in commands(page))],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_each_block_of_a_page_runs_in_its_order(page: Path, tmp_path: Path, pytestconfig: pytest.Config) -> None:
    """Runs of swarms only with `--thorough`, but those of the README."""
    everything = pytestconfig.getoption("--thorough") or page.name == "README.md"
    todo = [each for each in commands(page) if not each.said and (everything or not _HEAVY.search(each.text))]
    if not todo:
        pytest.skip("runs of swarms only, for --thorough")
    text = page.read_text(encoding="utf-8")
    extras = {each for names in re.findall(r"pip install '\.\[([\w,]+)\]'", text) for each in names.split(",")}
    bench = Bench(tmp_path, *(extras or {"all"}))
    if "dem.tif" in text and _SYNTH not in text:
        bench.run(_SYNTH)
    for block in blocks(page):
        if named := re.match(r"# ([\w.-]+\.\w+)\n", block.text):
            (tmp_path / named[1]).write_text(block.text, encoding="utf-8")
        elif block in todo and block.language == "python":
            bench.run(block.text, "python", "-c")
        elif block in todo:
            # The environment is what `pip` makes; a run is as short as shows that it starts and ends in order.
            lines = (line for line in block.text.split("\n") if not line.startswith(("pip ", "source ")))
            bench.run(re.sub(r"swarm (up|demo)\b[^\n#]*", r"\g<0> --seconds 2 --port 0 ", "\n".join(lines)))
