"""Newest message of every sender of a run: counters, liveliness, positions, marks.

Pure: time is an argument. The launcher, the live view, the simulation and the commands pass it what they heard on
`HEARD` or `RECORDED` (`run_observer.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.summed_counts import Counts, sum_of
from shared_map.replication.author_limits import Capacity
from shared_map.replication.held_sets import HeldSets
from shared_map.replication.mark_sets import is_tombstone
from shared_map.replication.merge import TileChange, new_winners
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, agent_of, crew_of
from swarm.grid import GridSpec
from swarm.peers import FOR_GOOD_NS, HIGHEST_RANK, Newest, Peer, Roster, ranked_id, split_rank
from swarm.runtime.order_book import OrderBook
from swarm.runtime.stats import ENDED
from swarm.runtime.tracker_ownership import Trackings
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkSet, owner_of
from swarm.wire.messages.orders import GoalState, GoalStates, Orders
from swarm.wire.messages.planning import PlannerStatus, TargetPose
from swarm.wire.messages.processes import Heartbeat, RunInfo, Stats
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, Obstacle, VehicleState
from swarm.wire.topics import POSE, STATS, STATUS, Topic

K = TypeVar("K")
V = TypeVar("V")

_VEHICLES_LAST_NS = 3 * NS_PER_S
"""A vehicle whose agent raises no liveliness token is there for this long after its last word."""
_MOST_NAMES = 1 << 14
"""Processes, targets and authors that are remembered, of each: on loopback any program may use any name."""
_ODD_POSES = ("poses_refused", "poses_outside")
"""Counts of planners: poses which do not count."""


@dataclass(frozen=True, slots=True)
class RunPlan:
    """Expected processes of a complete run.

    crew        (role, id) of the processes that it needs: no router, which belongs to no run, and no monitor
    vehicles    of the scenario; external vehicles come on top
    started_ns  when the run began; None: with the first that is heard of it
    """

    targets: tuple[str, ...]
    crew: tuple[tuple[str, str], ...]
    vehicles: int
    started_ns: int | None = None

    def targets_now(self, book: OrderBook) -> list[str]:
        """The targets after what operators have ordered."""
        targets = dict.fromkeys(self.targets)
        for order in book:
            if order.subject == "target":
                if order.off:
                    targets.pop(order.name, None)
                elif order.added:
                    targets[order.name] = None
        return list(targets)

    def crew_now(self, targets: Iterable[str]) -> list[tuple[str, str]]:
        """The processes that the run needs while it has these targets."""
        wanted = list(targets)
        kept = [each for each in self.crew if each[0] != "planner" or split_rank(each[1])[0] in wanted]
        planned = {split_rank(id)[0] for role, id in kept if role == "planner"}
        return [*kept, *(("planner", id) for id in wanted if id not in planned)]


def plan_of(scenario: Scenario, started_ns: int | None = None) -> RunPlan:
    """Returns the plan of a scenario."""
    return RunPlan(tuple(scenario.target_ids), tuple(crew_of(scenario)), scenario.vehicle_count, started_ns)


def run_of_most(found: Iterable[RunInfo]) -> tuple[str, str]:
    """Returns (run id, terrain digest) of most replies; empty texts if only routers reply, which have no run."""
    runs = Counter((info.run_id, info.terrain) for info in found if info.run_id)
    return runs.most_common(1)[0][0] if runs else ("", "")


def plan_of_members(members: Iterable[RunInfo]) -> RunPlan:
    """Returns the plan from the replies of the run's processes: the same as from its scenario."""
    infos = [info for info in members if info.run_id]
    crew = dict.fromkeys(
        (role, id) for info in infos for role, _, id in (name.partition("-") for name in info.crew) if id
    )
    targets = tuple(id for role, id in crew if role == "planner" and not split_rank(id)[1])
    began = [info.started_ns for info in infos if info.started_ns > 0]
    vehicles = max((info.vehicles for info in infos), default=0)
    return RunPlan(targets, tuple(crew), vehicles, min(began, default=None))


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
        """Returns the indices of the vehicles that chase a target."""
        if target not in self.target_ids:
            return np.empty(0, np.intp)
        return np.flatnonzero(self.targets == self.target_ids.index(target))

    def only(self, kept: NDArray[np.bool_]) -> VehicleColumns:
        """Returns a part of the vehicles; kept: bool (n,)."""
        ids = [self.ids[n] for n in np.flatnonzero(kept).tolist()]
        return VehicleColumns(
            ids, self.east_m[kept], self.south_m[kept], self.states[kept], self.targets[kept], self.target_ids
        )

    def count_states(self) -> dict[str, int]:
        """Number of vehicles in each VehicleState, by its name."""
        counts = np.bincount(self.states, minlength=len(VehicleState)).tolist()
        return {state.name.lower(): n for state, n in zip(VehicleState, counts, strict=True)}


def gathered(fleets: Iterable[Fleet]) -> VehicleColumns:
    """All vehicles of these messages. One that is in several, as when it crosses into another region, is where the
    newest puts it."""
    by_age = sorted(fleets, key=lambda fleet: (fleet.stamp_ns, fleet.seq))
    target_ids = sorted({target for fleet in by_age for target in fleet.target_ids})
    newest_row = {id: n for n, id in enumerate(id for fleet in by_age for id in fleet.ids)}
    ids = sorted(newest_row)
    rows = np.fromiter((newest_row[id] for id in ids), np.intp, len(ids))
    target_number = {target: n for n, target in enumerate(target_ids)}
    targets = np.full((len(by_age), NO_TARGET + 1), -1, np.int64)
    for n, fleet in enumerate(by_age):
        targets[n, : len(fleet.target_ids)] = [target_number[target] for target in fleet.target_ids]
    fleet_of_row = np.repeat(np.arange(len(by_age)), [len(fleet.ids) for fleet in by_age])
    chased = np.frombuffer(b"".join(fleet.targets for fleet in by_age), np.uint8)
    return VehicleColumns(
        ids,
        np.frombuffer(b"".join(fleet.east_m for fleet in by_age), "<f4")[rows],
        np.frombuffer(b"".join(fleet.south_m for fleet in by_age), "<f4")[rows],
        np.frombuffer(b"".join(fleet.states for fleet in by_age), np.uint8)[rows],
        targets[fleet_of_row, chased][rows],
        target_ids,
    )


class MarkedCells(NamedTuple):
    """Newest statement per marked cell, over all authors."""

    cells: NDArray[np.int64]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]
    stamps_ns: NDArray[np.int64]


def _remember(known: dict[K, V], key: K, value: V) -> None:
    """Keeps the newest value of a key. A new key is ignored once `_MOST_NAMES` are known."""
    if key in known or len(known) < _MOST_NAMES:
        known[key] = value


class LatestState(Counts):
    """The newest message per sender of a run, so that its memory does not grow with time.

    plan    what the run should be
    book    what operators have ordered
    status  target -> the newest status of the planner that leads
    leads   (role, id) -> whether the process leads, where there are standbys
    hears   topics that are heard as long as the run lasts, from all whom this is about: only they are evidence of
            an alarm
    """

    hears: Collection[Topic] = (STATS, STATUS, POSE)

    def __init__(self, plan: RunPlan, grid: GridSpec) -> None:
        super().__init__()
        self.plan = plan
        self.grid = grid
        self.book = OrderBook()
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        """Time when the first and the last message were heard; None before."""
        self.moved_ns = 0
        """Time when a vehicle or a target was last heard of. Later messages are those of a run that ends."""
        self.fleet_ns: int | None = None
        """Time when an agent last reported its vehicles; None before."""
        self.status: dict[str, PlannerStatus] = {}
        self.leads: dict[tuple[str, str], bool] = {}
        self._goals: dict[str, GoalState] = {}
        self._trackings = Trackings(grid)
        self._obstacles: dict[str, tuple[Obstacle, int]] = {}
        """Id -> its last report, and the time of its arrival."""
        self._fleets: dict[tuple[str, int], Fleet] = {}
        """(agent, region) -> its last report, of whichever generation."""
        self._reports = Newest(_MOST_NAMES)
        """Detection of reports that are newer than the last of an agent's vehicles in a region."""
        self._vehicles: VehicleColumns | None = None
        """The vehicles of `_fleets`, once asked for; None since the last news."""
        self._sets = HeldSets(grid, Capacity())
        """The statements of authors about cells, each until a keeper says that it is deleted."""
        self._ranks: dict[tuple[str, str], int] = {}
        """(role, job) -> rank of the process that leads, where there are standbys."""
        self._beats = Newest(silence_ns=FOR_GOOD_NS)
        """Detection of heartbeats which are newer than the last of their sender: copies change nothing."""
        self._alive = Roster()
        self._started: dict[tuple[str, str], set[int]] = {}
        """(role, id) -> incarnations of the processes that the observer itself has started: the newest, and the one
        whose token was up then."""
        self._seen_ns: dict[tuple[str, str], int] = {}
        """(role, id) -> time of the last counts or of the newest token, of a process that is or was alive; one that
        has ended is kept if it published counts, or if the observer started it."""
        self._fleet_ns: dict[str, int] = {}
        """Agent -> time of its last message about vehicles."""

    def on_message(self, message: Message, now_ns: int) -> Message | None:
        """Takes in a message; returns it, a pose with its cell, and None for a pose that does not count."""
        self.touch(now_ns)
        match message:
            case Stats():
                self.count(message)
                if (key := (message.role, message.id)) in self._seen_ns:
                    self._seen_ns[key] = now_ns
            case PlannerStatus():
                # Only the planner that leads tells one, and a standby that takes over may be the older process.
                _remember(self.status, message.target, message)
            case Heartbeat(role=role, id=id, leads=leads) if self._beats.is_news(
                (role, id), (message.incarnation, message.seq), now_ns
            ):
                _remember(self.leads, (role, id), leads)
                if leads:
                    job, rank = split_rank(id)
                    _remember(self._ranks, (role, job), rank)
            case Fleet():
                self.moved_ns = self.fleet_ns = max(self.moved_ns, now_ns)
                at = (owner_of(message.author), message.region)
                if self._reports.is_news(at, (message.stamp_ns, message.seq), now_ns):
                    _remember(self._fleets, at, message)
                    self._vehicles = None
                if message.ids:
                    _remember(self._fleet_ns, agent_of(message.ids[0]), now_ns)
            case Obstacle():
                _remember(self._obstacles, message.id, (message, now_ns))
            case TargetPose():
                self.moved_ns = max(self.moved_ns, now_ns)
                return self._trackings.counted(message, now_ns)
            case MarkSet() if not self._sets.off_grid(message):
                if self._sets.is_news(message, self._sets.get(message.tile, message.author)):
                    if is_tombstone(message):
                        self._sets.delete(message, now_ns)
                        self._sets.tombstones.expire(now_ns)
                    else:
                        self._sets.put(message)
            case GoalStates(states=states):
                for each in states:
                    _remember(self._goals, each.name, each)
            case Orders():
                self.book.merge(message.orders, now_ns)
        return message

    def started(self, peer: Peer) -> None:
        """Notes a generation that the observer itself has started. A token under the same name that is none of
        these is of another run, as at the port that all have by default."""
        key = (peer.role, peer.id)
        self._started[key] = {peer.incarnation, self._alive.alive(peer.role).get(peer.id, peer.incarnation)}

    def alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        """Notes that a liveliness token appeared (`up`) or ended."""
        self.touch(now_ns)
        key = (peer.role, peer.id)
        if not up:
            self._alive.gone(peer)
            if not self._alive.is_alive(*key) and key not in self._newest and key not in self._started:
                self._seen_ns.pop(key, None)  # of a stranger, whose names must not fill the place of others
        elif peer.incarnation in self._started.get(key, (peer.incarnation,)):
            self._alive.appeared(peer)
            _remember(self._seen_ns, key, now_ns)

    def touch(self, now_ns: int) -> None:
        """Notes the time of a message of the run, or of its end."""
        self.first_ns = now_ns if self.first_ns is None else self.first_ns
        self.last_ns = now_ns if self.last_ns is None else max(now_ns, self.last_ns)

    @property
    def began_ns(self) -> int | None:
        """Time when the run began; None before the first message of one whose beginning is not known."""
        return self.first_ns if self.plan.started_ns is None else self.plan.started_ns

    # --- processes ------------------------------------------------------------------------------------------------

    def up(self) -> list[tuple[str, str]]:
        """(role, id) of all processes which are alive now."""
        return self._alive.up()

    def is_up(self, role: str, job: str) -> bool:
        """Returns True if the process with this job or one of its standbys is alive."""
        return any(self._alive.is_alive(role, ranked_id(job, rank)) for rank in range(HIGHEST_RANK + 1))

    def was_up(self, role: str, id: str) -> bool:
        """Returns True if the process is or was alive; one that has ended is forgotten if it published nothing."""
        return (role, id) in self._seen_ns

    def knows(self, role: str, id: str) -> bool:
        """Returns True if the process has ever been seen alive, or its counts are known."""
        return self.was_up(role, id) or (role, id) in self._newest

    def planner_status(self, target: str) -> PlannerStatus | None:
        """Returns the state of the leading planner; None if there is none, or it has ended."""
        ids = [ranked_id(target, rank) for rank in range(HIGHEST_RANK + 1)]
        gone = any(self.knows("planner", id) for id in ids) and not any(self.is_well("planner", id) for id in ids)
        return None if gone else self.status.get(target)

    def is_well(self, role: str, id: str) -> bool:
        """Returns True if a process is in order: alive, or ended on request."""
        return self._alive.is_alive(role, id) or self.has_ended(role, id)

    def has_ended(self, role: str, id: str) -> bool:
        """Returns True if a process ended on request."""
        stats = self.newest_stats(role, id)
        return stats is not None and stats.gauges.get(ENDED, 0.0) > 0 and not self._alive.is_alive(role, id)

    def fills(self, role: str, id: str) -> bool:
        """Returns True if the job of this process is done in order: by itself, or by a keeper or a targets process
        of another name, as when it was started by hand."""
        if self.is_well(role, id) or role not in ("keeper", "targets") or split_rank(id)[1]:
            return self.is_well(role, id)
        known = {each for each_role, each in (*self._seen_ns, *self._newest) if each_role == role}
        return any(self.is_well(role, each) for each in known if not split_rank(each)[1])

    def silent(self, before_ns: int) -> list[tuple[str, str, int]]:
        """Returns (role, id, time of the last counts) of each process that is alive and published counts, but none
        after `before_ns`."""
        return [
            (*key, seen_ns)
            for key, seen_ns in sorted(self._seen_ns.items())
            if seen_ns < before_ns and self._alive.is_alive(*key) and key in self._newest
        ]

    def now_of(self, name: str) -> float | None:
        """A gauge, summed over the processes which are alive; None if none of them has published it."""
        return sum_of(stats.gauges.get(name) for key, stats in self.newest().items() if self._alive.is_alive(*key))

    def rank(self, role: str, job: str) -> int:
        """Rank of the process that leads."""
        return self._ranks.get((role, job), 0)

    def needed(self) -> list[tuple[str, str]]:
        """(role, id) of the processes that the run needs now."""
        return self.plan.crew_now(self.plan.targets_now(self.book))

    def missing(self) -> list[str]:
        """Processes that the run needs which are not alive, as `role id`."""
        return [f"{role} {id}" for role, id in self.needed() if not self.fills(role, id)]

    # --- trackers -------------------------------------------------------------------------------------------------

    @property
    def poses(self) -> dict[str, TargetPose]:
        """Target -> its newest pose that counts."""
        return self._trackings.poses()

    def lost(self, now_ns: int) -> set[str]:
        """Returns the targets that no tracker publishes now; those without a tracker according to their
        planners."""
        lost = {id for id, status in self.status.items() if status.tracker_lost and self._trackings.of(id) is None}
        return self._trackings.lost(now_ns) | lost

    def pose_age_s(self, target: str, now_ns: int) -> float | None:
        """Time since the target's last pose; None before the first."""
        tracking, status = self._trackings.of(target), self.status.get(target)
        if tracking is None:
            return None if status is None else status.pose_age_s
        age_ns = tracking.age_ns(now_ns)
        return None if age_ns is None else age_ns / NS_PER_S

    def tracking(self) -> dict[str, Any]:
        """Returns how often targets were lost, which still are, and anomalies of poses: for a report."""
        return {
            "lost": self.total("trackers_lost"),
            "lost_at_end": sorted(self.lost(self.moved_ns)),
            **{name: self.total(name) for name in _ODD_POSES},
        }

    # --- places ---------------------------------------------------------------------------------------------------

    def vehicles(self) -> VehicleColumns:
        """Last reported state of every vehicle."""
        if self._vehicles is None:
            self._vehicles = gathered(self._fleets.values())
        return self._vehicles

    def driven(self, crew: Collection[tuple[str, str]], now_ns: int) -> VehicleColumns:
        """Returns the vehicles that are driven: not those that have left, or whose agent has ended. The last report
        of an agent of the crew which ended on request stays valid."""
        vehicles = self.vehicles()
        agents = list(map(agent_of, vehicles.ids))
        drives = {agent: self._drives(agent, ("agent", agent) in crew, now_ns) for agent in set(agents)}
        if all(drives.values()):
            return vehicles
        return vehicles.only(np.array([drives[agent] for agent in agents], bool))

    def _drives(self, agent: str, of_crew: bool, now_ns: int) -> bool:
        if self._alive.is_alive("agent", agent):
            return True
        if self.knows("agent", agent):
            return of_crew and self.is_well("agent", agent)
        return now_ns - self._fleet_ns.get(agent, 0) <= _VEHICLES_LAST_NS  # it raises no token

    def knows_vehicles(self, agent: str) -> bool:
        """Returns True if the agent has published its vehicles, and the places of those which were sent there:
        they have no target, and are not idle."""
        fleets = [fleet for fleet in self._fleets.values() if fleet.ids and agent_of(fleet.ids[0]) == agent]
        rows = (row for fleet in fleets for row in zip(fleet.ids, fleet.targets, fleet.states, strict=True))
        sent = (id for id, target, state in rows if target == NO_TARGET and state != VehicleState.IDLE)
        return agent in self._fleet_ns and all(id in self._goals for id in sent)

    def external(self, now_ns: int) -> dict[str, Obstacle]:
        """Returns the external vehicles and other obstacles whose lease has not ended, in order of id."""
        reports = sorted(self._obstacles.items())
        return {id: each for id, (each, received_ns) in reports if now_ns - received_ns < each.lease_s * NS_PER_S}

    def external_seen(self) -> list[str]:
        """Returns the ids of all external vehicles and other obstacles that ever told their places, in order."""
        return sorted(self._obstacles)

    def goals(self) -> list[GoalState]:
        """Progress of the vehicles that were sent to places, without those that were recalled."""
        return [self._goals[id] for id in sorted(self._goals) if self._goals[id].state != "canceled"]

    def groups(self) -> dict[str, str]:
        """Vehicle -> its group."""
        return {id: fleet.group for fleet in self._fleets.values() for id in fleet.ids}

    def classes(self) -> dict[str, str]:
        """Vehicle -> the class that it belongs to."""
        return {id: fleet.vehicle_class for fleet in self._fleets.values() for id in fleet.ids}

    def targets(self) -> dict[str, tuple[float, float]]:
        """Target -> (east, south) in metres from the grid's north-west corner, in order of id."""
        return {id: self.place_m(pose) for id, pose in sorted(self.poses.items())}

    def place_m(self, pose: TargetPose) -> tuple[float, float]:
        """Returns (east, south) of a pose, in metres from the north-west corner of the grid."""
        return pose.x_m - self.grid.west_m, self.grid.north_m - pose.y_m

    def learned_words(self) -> list[MarkSet]:
        """Returns the measured factors of kinds of ground, by author. They are stored as one extra tile, after the
        map's last."""
        return self._sets.of_tile(self.grid.tiles)

    def marked(self) -> MarkedCells:
        """Returns the current mark of each cell, as the shared map merges it; cells cleared again are left out."""
        tiles = [tile for tile in self._sets.tiles if tile < self.grid.tiles]
        changes = [TileChange(tile, (), self._sets.of_tile(tile)) for tile in tiles]
        won = new_winners(self.grid, changes, 0, self.moved_ns)
        order = np.argsort(won.cells)
        cells = won.cells[order].astype(np.int64)
        return MarkedCells(cells, won.kinds[order], won.paces[order], won.stamps_ns[order])
