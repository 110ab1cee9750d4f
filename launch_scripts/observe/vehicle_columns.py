"""Where all vehicles of a run are, in columns."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm.wire.messages.vehicles import NO_TARGET, Fleet, VehicleState


@dataclass(frozen=True, slots=True, eq=False)
class VehicleColumns:
    """Last reported places of vehicles, in order of id.

    east_m      float32, from the grid's west border; south_m from its north border
    states      uint8, VehicleState
    targets     int64, index into `target_ids`, -1 for none
    target_ids  in order
    """

    ids: list[str]
    east_m: NDArray[np.float32]
    south_m: NDArray[np.float32]
    states: NDArray[np.uint8]
    targets: NDArray[np.int64]
    target_ids: list[str]

    def __len__(self) -> int:
        return len(self.ids)

    def chasing(self, target: str) -> NDArray[np.intp]:
        """Which of them go for a target."""
        if target not in self.target_ids:
            return np.empty(0, np.intp)
        return np.flatnonzero(self.targets == self.target_ids.index(target))

    def only(self, kept: NDArray[np.bool_]) -> VehicleColumns:
        """Some of them."""
        ids = [self.ids[n] for n in np.flatnonzero(kept).tolist()]
        return VehicleColumns(
            ids, self.east_m[kept], self.south_m[kept], self.states[kept], self.targets[kept], self.target_ids
        )

    def count_states(self) -> tuple[int, ...]:
        """Number of vehicles in each VehicleState, in its order."""
        return tuple(np.bincount(self.states, minlength=len(VehicleState)).tolist())


def gathered(fleets: Iterable[Fleet]) -> VehicleColumns:
    """All vehicles of these messages. One that is in several, as when it crosses into another region, is where the
    newest puts it."""
    told = sorted(fleets, key=lambda fleet: (fleet.stamp_ns, fleet.seq))
    target_ids = sorted({target for fleet in told for target in fleet.target_ids})
    last = {id: n for n, id in enumerate(id for fleet in told for id in fleet.ids)}
    ids = sorted(last)
    rows = np.fromiter((last[id] for id in ids), np.intp, len(ids))
    place = {target: n for n, target in enumerate(target_ids)}
    targets = np.full((len(told), NO_TARGET + 1), -1, np.int64)
    for n, fleet in enumerate(told):
        targets[n, : len(fleet.target_ids)] = [place[target] for target in fleet.target_ids]
    of = np.repeat(np.arange(len(told)), [len(fleet.ids) for fleet in told])
    chased = np.frombuffer(b"".join(fleet.targets for fleet in told), np.uint8)
    return VehicleColumns(
        ids,
        np.frombuffer(b"".join(fleet.east_m for fleet in told), "<f4")[rows],
        np.frombuffer(b"".join(fleet.south_m for fleet in told), "<f4")[rows],
        np.frombuffer(b"".join(fleet.states for fleet in told), np.uint8)[rows],
        targets[of, chased][rows],
        target_ids,
    )
