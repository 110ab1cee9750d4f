"""Rules of hosts that laws about right of way take out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest

from swarm.right_of_way.entries import BEFORE_ALL, HostEntries
from swarm.wire.messages.traffic import Entry, Stamp


def takes_what_an_older_table_added(patch: pytest.MonkeyPatch) -> None:
    """A host takes again what it gave back, passed over, or never knew."""
    hear = HostEntries.hear_granted

    def greedy(
        self: HostEntries, shard: int, stamp: Stamp, generation: int, grants: Mapping[str, Sequence[Entry]]
    ) -> set[str]:
        knows = self.knows.pop(shard, BEFORE_ALL)
        changed = hear(self, shard, stamp, generation, grants) if stamp > knows else set()
        self.knows[shard] = max(knows, self.knows.get(shard, knows))
        return changed

    patch.setattr(HostEntries, "hear_granted", greedy)
