"""Order of the tests: those of the network last; `--network` leaves these out, or all others. `--seeds` lets tests
that replay seeded histories run others; `--thorough` adds those of which the others show enough for each commit.
Properties are tried with the same examples in every run, so that a gate answers the same twice; `--random` looks
for new ones."""

import os
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from support.effort import few, try_all

from swarm.runtime import loop_health

TESTS = Path(__file__).parent
# Processes that a test starts find this checkout and the support modules, whatever their folder.
os.environ["PYTHONPATH"] = os.pathsep.join((str(TESTS.parent), str(TESTS)))
# No variable of a user says where a command looks, and no run of a test is registered among a user's runs.
for name in [name for name in os.environ if name.startswith("SWARM_")]:
    del os.environ[name]
_STATE = tempfile.TemporaryDirectory(prefix="swarm-state-")
os.environ["SWARM_STATE"] = _STATE.name

EXAMPLES = 100
"""Number of examples of a property that names none, with `--thorough`; each commit tries a share
(support.effort)."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--seeds", metavar="A:B", help="these histories instead of the ones that tests name")
    parser.addoption("--network", choices=("none", "only"), help="no test of the network, or nothing else")
    parser.addoption(
        "--random", action="store_true", help="properties from a new seed, which is printed on failure"
    )
    parser.addoption("--thorough", action="store_true", help="also the tests marked thorough")


def pytest_configure(config: pytest.Config) -> None:
    loop_health.refused = True
    if config.getoption("--thorough"):
        try_all()
    random: dict[str, Any] = {"print_blob": True}
    fixed: dict[str, Any] = {"derandomize": True, "database": None}
    # On a busy machine a test is not to fail for taking long.
    patient = settings(max_examples=few(EXAMPLES), deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.register_profile("ours", patient, **(random if config.getoption("--random") else fixed))
    settings.load_profile("ours")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    marker = metafunc.definition.get_closest_marker("seeds")
    if marker is not None:
        named = metafunc.config.getoption("--seeds")
        first, _, end = (named or f"0:{few(marker.args[0])}").partition(":")
        if not (first.isdecimal() and end.isdecimal() and int(first) < int(end)):
            raise pytest.UsageError(f"--seeds {named}: expected two numbers A:B with A < B, as in 0:2000")
        metafunc.parametrize("seed", range(int(first), int(end)))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Importing all files takes seconds, and most have no test of the network."""
    if config.getoption("--network") != "only" or collection_path.suffix != ".py":
        return None
    return "mark.network" not in collection_path.read_text(encoding="utf-8") or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    thorough, network = config.getoption("--thorough"), config.getoption("--network")

    def is_left(item: pytest.Item) -> bool:
        if item.get_closest_marker("thorough") and not thorough:
            return True
        return network is not None and (item.get_closest_marker("network") is None) == (network == "only")

    left = [item for item in items if is_left(item)]
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = [each for each in items if each not in set(left)]
    items.sort(key=lambda item: item.get_closest_marker("network") is not None)
