"""The package as a stranger installs it: a wheel, an environment for each extra, and its first command."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_string
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name
from support.installed import EXTRAS, PROJECT, ROOT, environment, files_of, megabytes, packages

from swarm.errors import EXTRAS as EXTRA_OF

pytestmark = [pytest.mark.network, pytest.mark.slow]

ROWS = re.findall(
    r"^\| [^|]+ \| `\.(?:\[(\w+)\])?` \| (\d+) \| `([^`]+)` \|$", (ROOT / "docs/start/install.md").read_text(), re.M
)
"""(extra, MB, command) of the page."""
OURS = ("swarm", "shared_map", "planner_service", "vehicle_agent", "launch_scripts")
PUBLIC = """import importlib, pkgutil, sys
for package in ("swarm", "shared_map", "planner_service", "vehicle_agent", "launch_scripts.check"):
    try:
        found = importlib.import_module(package)
        for each in pkgutil.walk_packages(getattr(found, "__path__", ()), package + ".", lambda name: None):
            if not each.name.endswith("__main__"):
                importlib.import_module(each.name)
    except ImportError as error:
        print(error)
"""


def run(env: Path, line: str, *, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    around = {"PATH": f"{env}/bin:{os.environ['PATH']}", "HOME": str(env)}
    return subprocess.run(["sh", "-c", line], cwd=cwd, env=around, capture_output=True, text=True, timeout=120)


LACKED = {
    "demo": "view", "up demo": "view", "up demo -d": "view", "simulate jacksboro": "roles",
    "simulate --seeds 0:1": "roles", "metrics": "roles", "deploy certs certs a": "roles", "study run laws": "sweep",
    "terrain reach jacksboro --to cell:9,9 --out a.gpkg": "vectors",
}  # fmt: skip
"""Command -> the extra that it names where the packages of neither roles nor vectors are installed."""


def says_what_it_lacks(env: Path, words: str, extra: str) -> None:
    done = run(env, f"swarm {words}", cwd=env)
    assert (done.returncode, done.stdout) == (2, "")
    said = rf"swarm: (this|the command) needs \w+, which is not .* extra '{extra}' \(.*\)\n"
    assert re.fullmatch(said, done.stderr), f"{words}\n{done.stderr}"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", folder], cwd=ROOT, check=True, timeout=60)
    return folder


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    return next(built.glob("*.whl"))


def test_what_the_wheel_says_of_itself_is_true(built: Path, wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        about = message_from_string(archive.read(next(n for n in names if n.endswith("METADATA"))).decode())
    commit = subprocess.run(["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True).stdout[:12]
    assert about["Version"].partition("+g")[2] == commit
    assert set(about.get_all("Provides-Extra", ())) == EXTRAS.keys() == {extra for extra, _, _ in ROWS if extra}
    pythons = {each.rpartition(" :: ")[2] for each in about.get_all("Classifier", ()) if "Python ::" in each}
    assert about["Requires-Python"] == f">={min(pythons, key=lambda each: int(each[2:]))}"
    # No index and no address has it yet; both would be wrong somewhere else too.
    assert {"Home-page", "Author", "Author-email", "Project-URL"}.isdisjoint(about.keys())
    assert {name.partition("/")[0] for name in names} == {*OURS, names[-1].partition("/")[0]}
    # Scripts of a checkout are not in it.
    assert {"demo", "test", "docs", "bench"}.isdisjoint(
        Path(n).name for n in names if n.startswith("launch_scripts/")
    )
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        inside = {each.partition("/")[2] for each in archive.getnames()}
    links = re.findall(r"\]\((?!https?:)([^)#]+)", str(about.get_payload()))
    assert links
    assert set(links) <= inside


def test_each_package_names_the_smallest_extra_which_brings_it() -> None:
    found: set[str] = set()
    for path in (path for folder in OURS for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {each.name.partition(".")[0] for each in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module.partition(".")[0])
    base = {"msgpack", "msgspec", "zenoh"}
    assert found - {*OURS} - sys.stdlib_module_names - base == EXTRA_OF.keys()
    brings = {extra: packages(extra).keys() for extra in EXTRAS}
    names = packages_distributions()
    for module, extra in EXTRA_OF.items():
        (name,) = {canonicalize_name(each) for each in names[module]}
        smaller = re.findall(
            r"\w+", " ".join(line[13:] for line in EXTRAS[extra] if line.startswith(PROJECT["name"]))
        )
        assert [each for each in (*smaller, extra) if name in brings[each]] == [extra], module


def test_the_command_and_every_public_import_say_in_a_bare_install_what_to_add(wheel: Path, tmp_path: Path) -> None:
    env = tmp_path / "env"
    subprocess.run([sys.executable, "-m", "venv", env], check=True, timeout=60)
    done = run(env, f"pip install --no-index --no-deps {wheel}")
    assert done.returncode == 0, done.stderr
    for words, extra in {**LACKED, "": "terrain", "status": "terrain"}.items():
        says_what_it_lacks(env, words, extra if words.startswith(("demo", "up", "sim")) else "terrain")
    for name, each in packages().items():
        (tmp_path / name).mkdir()
        for top in {file.parts[0] for file in each.files or ()} - {".."}:
            (next(env.glob("lib/*/site-packages")) / top).symlink_to(str(each.locate_file(top)))
    done = run(env, f"python -c '{PUBLIC}'")
    assert done.stdout.count("install the extra 'planner'") == len(done.stdout.splitlines()) > 0, done.stdout
    assert done.stderr == ""


@pytest.mark.parametrize(("extra", "most", "line"), ROWS)
def test_an_extra_is_as_small_as_its_row_says_and_runs_its_line(
    wheel: Path, tmp_path: Path, extra: str, most: str, line: str
) -> None:
    extras = (extra,) if extra else ()
    site = environment(tmp_path, *extras)
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
        product = [site / name for name in archive.namelist()]
    assert 0.85 * int(most) < megabytes([*files_of(packages(*extras)), *product]) <= int(most)
    # Kernels are compiled by other tests: here they would be compiled for the folder of this environment.
    done = run(tmp_path, f"NUMBA_DISABLE_JIT=1 {line}" if extra == "planner" else line)
    assert done.returncode == 0, done.stdout + done.stderr
    found = packages(*extras)
    for words, lacked in LACKED.items() if "typer" in found and "cryptography" not in found else ():
        if lacked != extra:
            says_what_it_lacks(tmp_path, words, lacked)


@pytest.mark.parametrize("minor", [each[-2:] for each in PROJECT["classifiers"] if "Python :: 3." in each])
def test_the_wheel_runs_on_each_python_that_it_names(wheel: Path, tmp_path: Path, minor: str) -> None:
    """On those which are here. Their packages are not, so this is the syntax and the first sentence."""
    pyenv = sorted(Path.home().glob(f".pyenv/versions/3.{minor}.*/bin/python"))
    python = pyenv[-1] if pyenv else shutil.which(f"python3.{minor}")
    if python is None:
        pytest.skip(f"there is no Python 3.{minor}")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    subprocess.run([python, "-W", "error", "-m", "compileall", "-q", tmp_path], check=True, timeout=120)
    code = "from launch_scripts.entry import main; raise SystemExit(main())"
    done = subprocess.run([python, "-c", code, "demo"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
