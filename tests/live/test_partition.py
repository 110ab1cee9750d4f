"""Two machines, played by network namespaces, lose each other and find each other again."""

from __future__ import annotations

from pathlib import Path

import pytest
from bench.wire.partition import partitions
from support.machines import why_not

pytestmark = [pytest.mark.network, pytest.mark.slow]


def test_replicas_on_both_sides_of_a_partition_are_soon_equal_again(tmp_path: Path) -> None:
    reason = why_not()
    if reason is not None:
        pytest.skip(reason)
    (figures,) = partitions(1, 5.0, tmp_path)
    assert figures["digests_apart"] >= 2
    assert figures["equal_after_s"] < 5.0
