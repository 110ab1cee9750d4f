"""Newest message of every sender of a run: positions, counts, marks.

Pure: the launcher, the monitor and the simulation pass it what they heard on `RECORDED`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.counts import Counts
from launch_scripts.observe.vehicle_columns import VehicleColumns, gathered
from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of
from swarm.grid import TILE_CELLS, GridSpec
from swarm.liveness import HIGHEST_RANK, Peer, ranked_id, split_rank
from swarm.runtime.stats import ENDED
from swarm.wire.fields import column
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkKind, MarkSet
from swarm.wire.messages.planning import PlannerStatus, TargetPose
from swarm.wire.messages.processes import Beat, Stats
from swarm.wire.messages.vehicles import Fleet

_VEHICLES_LAST_NS = 3 * NS_PER_S
"""Vehicles of whoever raises no liveliness token are there for so long after the last word."""


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
        self._fleets: dict[tuple[str, int], Fleet] = {}
        self._vehicles: VehicleColumns | None = None
        """What `_fleets` say, once somebody has asked; None since the last that was new."""
        self._marks: dict[tuple[str, int], MarkSet] = {}
        self._ranks: dict[tuple[str, str], int] = {}
        """(role, job) -> rank of the process that leads, where there are standbys."""
        self._alive: dict[tuple[str, str], set[int]] = {}
        """(role, id) of every process that has ever been seen alive -> incarnations whose token is up."""
        self._told_ns: dict[tuple[str, str], int] = {}
        """(role, id) -> when the process told its counts last, or appeared."""
        self._fleet_told_ns: dict[str, int] = {}
        """Agent -> when it told of vehicles last."""

    def heard(self, message: Message, now_ns: int) -> None:
        """Take in a message; of poses those only that count."""
        match message:
            case Stats():
                self.count(message)
                self._told_ns[message.role, message.id] = now_ns
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
                if message.ids:
                    self._fleet_told_ns[agent_of(message.ids[0])] = now_ns
            case TargetPose():
                self.poses[message.target] = message
            case MarkSet():
                marks = self._marks.get((message.author, message.tile))
                if marks is None or (message.epoch, message.seq) > (marks.epoch, marks.seq):
                    self._marks[message.author, message.tile] = message

    def alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        """A liveliness token rose or fell."""
        key = (peer.role, peer.id)
        if up:
            self._alive.setdefault(key, set()).add(peer.incarnation)
            self._told_ns[key] = now_ns
        elif key in self._alive:
            self._alive[key].discard(peer.incarnation)

    # --- processes ------------------------------------------------------------------------------------------------

    def up(self) -> list[tuple[str, str]]:
        """(role, id) of all processes which are alive now."""
        return sorted(key for key, incarnations in self._alive.items() if incarnations)

    def is_up(self, role: str, job: str) -> bool:
        """Whether the process with this job or one of its standbys is alive."""
        return any(self._alive.get((role, ranked_id(job, rank))) for rank in range(HIGHEST_RANK + 1))

    def was_up(self, role: str, id: str) -> bool:
        """Whether the process has ever been seen alive."""
        return (role, id) in self._alive

    def knows(self, role: str, id: str) -> bool:
        """Whether the process has ever been seen alive, or what it counted is known."""
        return self.was_up(role, id) or (role, id) in self._newest

    def told_by_planner(self, target: str) -> PlannerStatus | None:
        """What the planner that leads says; None if there is none, or it is gone and says nothing any more."""
        ids = [ranked_id(target, rank) for rank in range(HIGHEST_RANK + 1)]
        gone = any(self.knows("planner", id) for id in ids) and not any(self.is_well("planner", id) for id in ids)
        return None if gone else self.status.get(target)

    def ids_up(self, role: str) -> list[str]:
        """Ids of the processes of a role which are alive."""
        return [id for each, id in self.up() if each == role]

    def is_well(self, role: str, id: str) -> bool:
        """Whether a process is as it should be: alive, or ended because it was asked to."""
        if self._alive.get((role, id)):
            return True
        stats = self.newest_stats(role, id)
        return stats is not None and stats.gauges.get(ENDED, 0.0) > 0

    def fills(self, role: str, id: str) -> bool:
        """Whether somebody does what this process is for, as it should: itself, or a keeper or a targets process of
        another name, as when it was started by hand."""
        if self.is_well(role, id) or role not in ("keeper", "targets") or split_rank(id)[1]:
            return self.is_well(role, id)
        known = {each for each_role, each in (*self._alive, *self._newest) if each_role == role}
        return any(self.is_well(role, each) for each in known if not split_rank(each)[1])

    def silent(self, before_ns: int) -> list[tuple[str, str, int]]:
        """(role, id, when) of processes that are alive and have not told their counts since then, though they did
        before."""
        return [
            (*key, told_ns)
            for key, told_ns in sorted(self._told_ns.items())
            if told_ns < before_ns and self._alive.get(key) and key in self._newest
        ]

    def now_of(self, name: str) -> float | None:
        """A gauge, summed over the processes which are alive; None if none of them has published it."""
        told = [
            stats.gauges[name]
            for key, stats in self.newest().items()
            if name in stats.gauges and self._alive.get(key)
        ]
        return sum(told) if told else None

    def rank(self, role: str, job: str) -> int:
        """Rank of the process that leads."""
        return self._ranks.get((role, job), 0)

    # --- places ---------------------------------------------------------------------------------------------------

    def vehicles(self) -> VehicleColumns:
        """Last reported state of every vehicle."""
        if self._vehicles is None:
            self._vehicles = gathered(self._fleets.values())
        return self._vehicles

    def driven(self, crew: Collection[tuple[str, str]], now_ns: int) -> VehicleColumns:
        """The vehicles that somebody drives: not those that have left, or whose agent is gone. An agent of the crew
        which ended because it was asked to has said its last words, and they stand."""
        vehicles = self.vehicles()
        agents = list(map(agent_of, vehicles.ids))
        drives = {agent: self._drives(agent, ("agent", agent) in crew, now_ns) for agent in set(agents)}
        if all(drives.values()):
            return vehicles
        return vehicles.only(np.array([drives[agent] for agent in agents], bool))

    def _drives(self, agent: str, of_crew: bool, now_ns: int) -> bool:
        if self._alive.get(("agent", agent)):
            return True
        if self.newest_stats("agent", agent) is not None or self.was_up("agent", agent):
            return of_crew and self.is_well("agent", agent)
        return now_ns - self._fleet_told_ns.get(agent, 0) <= _VEHICLES_LAST_NS  # it raises no token

    def groups(self) -> dict[str, str]:
        """Vehicle -> its group."""
        return {id: fleet.group for fleet in self._fleets.values() for id in fleet.ids}

    def classes(self) -> dict[str, str]:
        """Vehicle -> the class that it belongs to."""
        return {id: fleet.vehicle_class for fleet in self._fleets.values() for id in fleet.ids}

    def targets(self) -> dict[str, tuple[float, float]]:
        """(east, south) in metres of every target, in order of id."""
        return {id: self.place_m(pose) for id, pose in sorted(self.poses.items())}

    def place_m(self, pose: TargetPose) -> tuple[float, float]:
        """(east, south) from the north-west corner of the grid."""
        return pose.x_m - self.grid.west_m, self.grid.north_m - pose.y_m

    @property
    def any_vehicles(self) -> bool:
        return bool(self._fleets)

    @property
    def any_marks(self) -> bool:
        return bool(self._marks)

    def learned_words(self) -> list[MarkSet]:
        """What each author has learned of kinds of ground: sets about the tile beyond the map."""
        return [marks for (_, tile), marks in sorted(self._marks.items()) if tile == self.grid.tiles]

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
