"""What several live tests start."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.live_swarm import Hands


@pytest.fixture
def hands(tmp_path: Path) -> Iterator[Hands]:
    hands = Hands(tmp_path)
    yield hands
    for process in hands.started:
        process.kill()
        process.wait(10)
