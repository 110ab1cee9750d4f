"""Newest message of every sender of a run: positions, counts, marks.

Pure: the launcher, the monitor and the simulation pass it what they heard on `RECORDED`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.report.results.counts import Counts
from launch_scripts.report.vehicle_columns import VehicleColumns, gathered
from swarm.grid import TILE_CELLS, GridSpec
from swarm.liveness import Peer
from swarm.ranks import HIGHEST_RANK, ranked_id, split_rank
from swarm.wire.fields import column
from swarm.wire.messages.base import Message
from swarm.wire.messages.marks import MarkSet
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import Beat, Stats
from swarm.wire.messages.targets import TargetPose
from swarm.wire.messages.vehicles import Fleet
from swarm.wire.statements import MarkKind


@dataclass(frozen=True, slots=True, eq=False)
class MarkedCells:
    """Newest statement per marked cell, over all authors."""

    cells: NDArray[np.int64]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]
    stamps_ns: NDArray[np.int64]


class Observed(Counts):
    """Keeps the newest message per sender, so that its memory does not grow with time."""

    def __init__(self, grid: GridSpec) -> None:
        super().__init__()
        self.grid = grid
        self.status: dict[str, PlannerStatus] = {}
        self.poses: dict[str, TargetPose] = {}
        self._messages_before: dict[tuple[str, str, int], int] = {}
        self._fleets: dict[tuple[str, int], Fleet] = {}
        self._vehicles: VehicleColumns | None = None
        """What `_fleets` say, once somebody has asked; None since the last that was new."""
        self._marks: dict[tuple[str, int], MarkSet] = {}
        self._ranks: dict[tuple[str, str], int] = {}
        """(role, job) -> rank of the process that leads, where there are standbys."""
        self._alive: dict[tuple[str, str], set[int]] = {}
        self._incarnations: dict[tuple[str, str], set[int]] = {}

    def heard(self, message: Message) -> None:
        """Take in a message; of poses those only that count."""
        match message:
            case Stats():
                key = self.count(message)
                self._messages_before.setdefault(key, message.counts.get("messages_out", 0))
                self._seen(message.role, message.id, message.incarnation)
            case PlannerStatus():
                # Only the planner that leads tells one, and a standby that takes over may be the older process.
                self.status[message.target] = message
            case Beat(leads=True):
                job, rank = split_rank(message.id)
                self._ranks[message.role, job] = rank
            case Fleet():
                fleet = self._fleets.get((message.author, message.region))
                if fleet is None or message.seq >= fleet.seq:
                    self._fleets[message.author, message.region] = message
                    self._vehicles = None
            case TargetPose():
                self.poses[message.target] = message
            case MarkSet():
                marks = self._marks.get((message.author, message.tile))
                if marks is None or (message.epoch, message.seq) > (marks.epoch, marks.seq):
                    self._marks[message.author, message.tile] = message

    def alive(self, peer: Peer, up: bool) -> None:
        """A liveliness token rose or fell."""
        incarnations = self._alive.setdefault((peer.role, peer.id), set())
        if up:
            incarnations.add(peer.incarnation)
            self._seen(peer.role, peer.id, peer.incarnation)
        else:
            incarnations.discard(peer.incarnation)

    def _seen(self, role: str, id: str, incarnation: int) -> None:
        self._incarnations.setdefault((role, id), set()).add(incarnation)

    # --- processes ------------------------------------------------------------------------------------------------

    def up(self) -> list[tuple[str, str]]:
        """(role, id) of all processes which are alive now."""
        return sorted(key for key, incarnations in self._alive.items() if incarnations)

    def is_up(self, role: str, job: str) -> bool:
        """Whether the process with this job or one of its standbys is alive."""
        return any(self._alive.get((role, ranked_id(job, rank))) for rank in range(HIGHEST_RANK + 1))

    def rank(self, role: str, job: str) -> int:
        """Rank of the process that leads."""
        return self._ranks.get((role, job), 0)

    @property
    def processes(self) -> int:
        """Number of processes so far, restarts not counted."""
        return len(self._incarnations)

    @property
    def restarts(self) -> int:
        """Later incarnations of processes that were there before."""
        return sum(len(incarnations) - 1 for incarnations in self._incarnations.values())

    # --- places ---------------------------------------------------------------------------------------------------

    def vehicles(self) -> VehicleColumns:
        """Last reported state of every vehicle."""
        if self._vehicles is None:
            self._vehicles = gathered(self._fleets.values())
        return self._vehicles

    def groups(self) -> dict[str, str]:
        """Vehicle -> its group."""
        return {id: fleet.group for fleet in self._fleets.values() for id in fleet.ids}

    def targets(self) -> dict[str, tuple[float, float]]:
        """(east, south) in metres of every target, in order of id."""
        return {id: self.place_m(pose) for id, pose in sorted(self.poses.items())}

    def place_m(self, pose: TargetPose) -> tuple[float, float]:
        """(east, south) from the north-west corner of the grid."""
        return pose.x_m - self.grid.west_m, self.grid.north_m - pose.y_m

    @property
    def any_marks(self) -> bool:
        return bool(self._marks)

    def marked(self) -> MarkedCells:
        """The newest statement per cell, ties by the larger author; cells cleared again are left out."""
        newest: dict[int, tuple[int, str, int, float]] = {}
        for (author, tile), marks in sorted(self._marks.items()):
            if tile >= self.grid.tiles:
                continue
            window = self.grid.tile_window(tile)
            columns = (column(marks.cells, "<u2"), column(marks.stamps_ns, "<i8"), column(marks.paces, "<f4"))
            rows = zip(*(values.tolist() for values in columns), marks.kinds, strict=True)
            for inside, stamp_ns, pace, kind in rows:
                row, col = window.row0 + inside // TILE_CELLS, window.col0 + inside % TILE_CELLS
                if row >= window.row1 or col >= window.col1:
                    continue
                cell = row * self.grid.cols + col
                if cell not in newest or (stamp_ns, author) > newest[cell][:2]:
                    newest[cell] = (stamp_ns, author, kind, pace)
        kept = [(cell, *told) for cell, told in sorted(newest.items()) if told[2] != MarkKind.CLEAR]
        return MarkedCells(
            np.array([cell for cell, _, _, _, _ in kept], np.int64),
            np.array([kind for _, _, _, kind, _ in kept], np.uint8),
            np.array([pace for _, _, _, _, pace in kept], np.float32),
            np.array([stamp_ns for _, stamp_ns, _, _, _ in kept], np.int64),
        )

    @property
    def messages(self) -> int:
        """Messages sent by all processes since each was first heard: grows evenly, even for a late observer."""
        return sum(
            stats.counts.get("messages_out", 0) - self._messages_before[key] for key, stats in self._stats.items()
        )
