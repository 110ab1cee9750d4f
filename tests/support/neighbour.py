"""The version before this one: `tests/live/neighbour_version.txt` names its commit, git has its tree."""

import io
import os
import re
import subprocess
import tarfile
from functools import cache
from pathlib import Path

import pytest

from swarm.wire.messages import WIRE_VERSION
from swarm.wire.versions import are_neighbours

ROOT = Path(__file__).parents[2]
NAMED_IN = ROOT / "tests" / "live" / "neighbour_version.txt"
"""Changed when a version is tagged, with the specimens of its messages (`tests/support/wire_specimens.py`)."""


@cache
def _archive(commit: str) -> bytes | None:
    command = ["git", "-C", str(ROOT), "archive", "--format=tar", commit]
    try:
        made = subprocess.run(command, capture_output=True, timeout=60, check=False)
    except OSError:
        return None
    return made.stdout if made.returncode == 0 else None


def neighbour_tree(folder: Path) -> Path:
    """The files of the version before, below `folder`. Skips the test where git has not got them, or the two share
    no run."""
    commit = NAMED_IN.read_text(encoding="ascii").strip()
    archive = _archive(commit)
    if archive is None:
        pytest.skip(f"git has no commit {commit[:8]} here: the version before this one cannot be run")
    tree = folder / f"tree-{commit[:8]}"
    with tarfile.open(fileobj=io.BytesIO(archive)) as files:
        files.extractall(tree, filter="data")
    messages = (tree / "swarm" / "wire" / "messages" / "__init__.py").read_text(encoding="utf-8")
    found = re.search(r"^WIRE_VERSION = (\d+)", messages, re.MULTILINE)
    if found is None or not are_neighbours(int(found[1]), WIRE_VERSION):
        pytest.skip("the version before this one shares no run with it")
    return tree


def environment_of(tree: Path) -> dict[str, str]:
    """Environment in which the interpreter of this test imports our packages from `tree`, whatever is installed."""
    return os.environ | {"PYTHONPATH": os.pathsep.join((str(tree), str(tree / "tests")))}
