"""Fixtures which several live tests start."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.live_swarm import Hands, LiveSwarm, running

from swarm.client import Swarm, connect


@pytest.fixture
def hands(tmp_path: Path) -> Iterator[Hands]:
    hands = Hands(tmp_path)
    yield hands
    for child in hands.started:
        child.kill()


@pytest.fixture(scope="module")
def live(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveSwarm]:
    """One swarm for the tests of a module, with its `OPTIONS` of `swarm up` and its further sections, `ALSO`."""
    options, also = getattr(request.module, "OPTIONS", ()), getattr(request.module, "ALSO", "")
    with running(tmp_path_factory.mktemp("live"), *options, also=also) as live:
        yield live


@pytest.fixture
def swarm(live: LiveSwarm) -> Iterator[Swarm]:
    """A program of the client library in it."""
    with connect(live.endpoint) as swarm:
        yield swarm
