"""Order of the tests: those of the network last. `--seeds` lets tests that replay seeded histories run others;
`--thorough` adds those of which the others show enough for each commit."""

from __future__ import annotations

import pytest
from hypothesis import settings

COMMIT_EXAMPLES = 40
"""Examples of a property for each commit, where it names no number of its own; with `--thorough` there are 100."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--seeds", metavar="A:B", help="these histories instead of the ones that tests name")
    parser.addoption("--thorough", action="store_true", help="also the tests marked thorough")


def pytest_configure(config: pytest.Config) -> None:
    # No deadline: on a busy machine a test is not to fail for taking long.
    settings.register_profile("commit", max_examples=COMMIT_EXAMPLES, deadline=None)
    settings.register_profile("thorough", deadline=None)
    settings.load_profile("thorough" if config.getoption("--thorough") else "commit")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    marker = metafunc.definition.get_closest_marker("seeds")
    if marker is not None:
        named = metafunc.config.getoption("--seeds")
        first, _, end = (named or f"0:{marker.args[0]}").partition(":")
        if not (first.isdecimal() and end.isdecimal() and int(first) < int(end)):
            raise pytest.UsageError(f"--seeds {named}: expected two numbers A:B with A < B, as in 0:2000")
        metafunc.parametrize("seed", range(int(first), int(end)))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    left = [] if config.getoption("--thorough") else [each for each in items if each.get_closest_marker("thorough")]
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = [each for each in items if each not in set(left)]
    items.sort(key=lambda item: item.get_closest_marker("network") is not None)
