"""The recipe of the image: linted, built from files that exist, no process is root, and its compiled kernels are
found."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from dockerfile_parse import DockerfileParser

ROOT = Path(__file__).parents[3]
RECIPE = ROOT / "Containerfile"


class Step(NamedTuple):
    """An instruction, of the stage of that number."""

    stage: int
    instruction: str
    value: str


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> list[Step]:
    copy = tmp_path_factory.mktemp("recipe") / "Dockerfile"
    copy.write_bytes(RECIPE.read_bytes())  # the parser writes into the folder of the file
    stage, found = 0, []
    for part in DockerfileParser(str(copy)).structure:
        if part["instruction"] == "FROM":
            stage += 1
        if part["instruction"] != "COMMENT":
            found.append(Step(stage, part["instruction"], part["value"]))
    return found


def values(steps: list[Step], instruction: str, stage: int) -> list[str]:
    return [step.value for step in steps if step.instruction == instruction and step.stage == stage]


def settings_of(steps: list[Step], stage: int) -> dict[str, str]:
    pairs = re.findall(r"(\w+)=(\S+)", " ".join(values(steps, "ENV", stage)))
    return dict(pairs)


def test_the_recipe_passes_hadolint() -> None:
    hadolint = shutil.which("hadolint", path=str(Path(sys.executable).parent)) or shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is not installed; the group dev has it")
    done = subprocess.run([hadolint, "--no-color", str(RECIPE)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout


def test_the_image_runs_as_no_one_and_compiles_nothing(steps: list[Step]) -> None:
    assert values(steps, "USER", 2) == ["10001:10001"]
    assert values(steps, "ENTRYPOINT", 2) == ['["swarm"]']
    (probe,) = values(steps, "HEALTHCHECK", 2)
    assert '"swarm", "health"' in probe
    last = " ".join(values(steps, "RUN", 2))
    assert "--mode=1777 /var/lib/swarm" in last, (
        "runc gives a tmpfs there the mode of the folder, but not its owner"
    )
    assert not re.search(r"gcc|build-essential|pip |uv ", last)
    assert all(value.startswith("--from=build /opt/") for value in values(steps, "COPY", 2))


def test_both_stages_look_for_kernels_in_one_place_and_for_one_processor(steps: list[Step]) -> None:
    for name in ("NUMBA_CACHE_DIR", "NUMBA_CPU_NAME"):
        assert settings_of(steps, 1)[name] == settings_of(steps, 2)[name]
    assert settings_of(steps, 1)["UV_PROJECT_ENVIRONMENT"] == "/opt/swarm"
    copied = [value.split()[1:] for value in values(steps, "COPY", 2)]
    # A kernel's folder is named by the path of its source.
    assert all(source == place for source, place in copied)
    assert {settings_of(steps, 1)["NUMBA_CACHE_DIR"], "/opt/swarm"} == {source for source, _ in copied}


def test_what_the_recipe_copies_is_there_and_let_through(steps: list[Step]) -> None:
    let_through = {
        line[1:]
        for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
        if line.startswith("!")
    }
    copied = {source for value in values(steps, "COPY", 1) for source in value.split()[:-1]}
    assert {source.partition("/")[0] for source in copied} == let_through
    assert all((ROOT / source).exists() for source in copied)
