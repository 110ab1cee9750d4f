"""Order of the tests: those of the network last and, with several workers, all on one."""

from __future__ import annotations

import pytest


# First, because xdist reads the groups in the same hook.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("network"):
            item.add_marker(pytest.mark.xdist_group("network"))
    items.sort(key=lambda item: item.get_closest_marker("network") is not None)
