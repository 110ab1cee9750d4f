"""The referee: finds collisions and lethal entries in what vehicles report. Pure.

A report of a vehicle holds from its stamp until the vehicle's next report. If reports between two are missing (the
sequence number jumps) and the vehicle moved meanwhile, the older one is known to hold at its timestamp only.

A report of an obstacle holds from when it was heard until the next one or the end of its lease. Vehicles tell when
they were on a cell by their agents' clocks, obstacles are timed by the referee's: overlaps which late messages
explain do not count."""

from __future__ import annotations

import math
from collections.abc import Collection, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.config.vehicle_classes import GROUND
from swarm.grid import GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.vehicles import MOST_M_PER_S, MOST_RADIUS_M, Fleet, Obstacle
from swarm.wire.topics import FLEET, OBSTACLE
from vehicle_agent.traffic.obstacles import MOST_OBSTACLES, REACTION_S, capsule_of

_SKEW_NS = NS_PER_S // 200
"""Shorter overlaps are no collision: the clocks of two processes may differ by as much."""
_REMEMBER_NS = 5 * NS_PER_S
"""Stays and obstacles that ended longer ago are forgotten, which bounds memory and the time of a look. It is more
than twice the 2 s after which a silent link counts as gone, so late reports find what they are compared with."""
_APART_NS = 2 * NS_PER_S
"""Two that meet again within this time are counted once: a vehicle takes about a second to cross a cell, and
several reports state one encounter."""


ALARMS = {
    "collisions": "collision",
    "driven_into": "obstacle-collision",
    "hit_by_obstacles": "obstacle-collision",
    "lethal_entries": "lethal-entry",
}
"""Count of broken laws -> kind of the alarm about each."""


@dataclass(frozen=True, slots=True)
class Broken:
    """Two on one cell at one time, or a vehicle on a cell which is lethal in truth to its class. An encounter is
    reported once.

    count     a key of `ALARMS`: vehicles that met, that drove into an obstacle which had closed the cell in time,
              that an obstacle hit by its own fault, or that entered a lethal cell
    vehicles  one, or two with a blank between them
    cell      of the terrain
    found     the finding in words
    evidence  the stays which prove it
    """

    count: str
    vehicles: str
    cell: int
    stamp_ns: int
    found: str
    evidence: tuple[Stay, ...] = field(compare=False)

    def sentence(self, began_ns: int) -> str:
        """Returns the finding and its proof: when each vehicle or obstacle was on the cell, in seconds since the
        run began, and the key and numbers of its reports, by which they are found in a recording of the run."""

        def on_cell(each: Stay) -> str:
            begin_s, end_s = ((at_ns - began_ns) / NS_PER_S for at_ns in (each.begin_ns, each.end_ns))
            reports = f"reports {each.first_seq} to {each.seq} on {each.key}"
            return f"{each.who} from {begin_s:.3f} to {end_s:.3f} s ({reports})"

        return f"{self.found}: {' and '.join(map(on_cell, self.evidence))}"


@dataclass(slots=True, eq=False)
class Stay:
    """A vehicle or an obstacle on a cell, from the first to the last time at which it is known to be there.

    who       a vehicle, or "obstacle ID"
    end_ns    of an obstacle which is there the end of its lease
    since_ns  the earliest time at which a vehicle may have come there; since when an obstacle has closed the cell
    key       of the reports, below the namespace
    author    of the last report of it, which has the number `seq`; the first has `first_seq`
    """

    who: str
    cell: int
    begin_ns: int
    end_ns: int
    since_ns: int
    key: str
    author: str
    seq: int
    first_seq: int


def _started_ns(author: str) -> int:
    """Start time (ns) in an author's name; 0 if it has none.

    The simulated vehicle of a process which has ended stays where it is until the next process of its name starts,
    and is nowhere until that one has a place for it. Others may drive over the cell meanwhile. Where the next
    process reports another cell, the earlier one may have driven on unheard: nothing is known after its last
    report.
    """
    try:
        return int(author.rpartition(".")[2], 16)
    except ValueError:
        return 0


Encounters = dict[tuple[str, str], int]
"""Pair -> the last time at which both are known to have been on one cell."""


def _meetings(
    stay: Stay, others: Iterable[Stay], encounters: Encounters, tolerance_ns: int
) -> Iterator[tuple[Stay, int]]:
    """Yields the others that were on a cell together with a stay for longer than a tolerance, each with the end of
    that time, unless they were so a moment ago already. Notes the encounters."""
    for other in others:
        until_ns = min(stay.end_ns, other.end_ns)
        if other.who == stay.who or until_ns - max(stay.begin_ns, other.begin_ns) <= tolerance_ns:
            continue
        pair = min(stay.who, other.who), max(stay.who, other.who)
        last_ns = encounters.get(pair)
        encounters[pair] = until_ns if last_ns is None else max(until_ns, last_ns)
        if last_ns is None or until_ns - last_ns > _APART_NS:
            yield other, until_ns


class Referee:
    """Turns reports into broken laws. Repeated and late reports change nothing.

    truths  class of vehicles -> float32 (rows, cols), s/m; inf is lethal. One that is not there is as "ground"
    grid    the cells of right of way
    aloft   classes that fly: they meet each other, and nothing that drives
    """

    def __init__(
        self, truths: Mapping[str, NDArray[np.float32]], grid: GridSpec, aloft: Collection[str] = ()
    ) -> None:
        self._aloft = frozenset(aloft)
        self._air = Referee(truths, grid) if aloft else None
        self._truths = {name: truth.reshape(-1) for name, truth in truths.items()}
        self._grid, self._cells = grid, grid.cells
        self._vehicles: dict[str, Stay] = {}
        """Vehicle -> where it is: its newest stay, which ends with its newest report."""
        self._stays: dict[int, list[Stay]] = {}
        self._left: list[Stay] = []
        """Stays of vehicles that have gone on since."""
        self._encounters: Encounters = {}
        self._swept_ns = 0
        self._obstacles = ObstacleReferee(grid)

    @property
    def cells(self) -> NDArray[np.int64]:
        """Last known cell of the terrain of every vehicle."""
        own = self._grid.terrain_cell(np.array([stay.cell for stay in self._vehicles.values()], np.int64))
        return own if self._air is None else np.concatenate((own, self._air.cells))

    def hear_obstacle(self, obstacle: Obstacle, now_ns: int) -> None:
        """Takes in where an obstacle is."""
        self._obstacles.on_obstacle(obstacle, now_ns)

    def on_fleet(self, fleet: Fleet) -> list[Broken]:
        """Returns the laws that a report proves broken. Cells outside the grid are ignored."""
        if self._air is not None and fleet.vehicle_class in self._aloft:
            return self._air.on_fleet(fleet)
        broken: list[Broken] = []
        author, seq, stamp_ns = fleet.author, fleet.seq, fleet.stamp_ns
        key = FLEET.below({"region": str(fleet.region), "author": author})
        vehicles, stays, covered = self._vehicles, self._stays, self._obstacles.covered
        # In one loop: each vehicle reports in every tick, and all that most of them have to say is that they are
        # still where they were.
        for id, cell in zip(fleet.ids, column(fleet.cells, "<u4").tolist(), strict=True):
            if cell >= self._cells:
                continue
            stay = vehicles.get(id)
            if stay is None:
                broken += self._enter(id, cell, 0, key, fleet)
                continue
            before_ns = stay.end_ns
            if stamp_ns <= before_ns:
                continue
            same = author == stay.author
            until_ns = stamp_ns if same else min(max(_started_ns(author), before_ns), stamp_ns)
            gapless = same and seq <= stay.seq + 1
            if same:
                stay.seq = seq
            stands = cell == stay.cell
            if stands or gapless:
                stay.end_ns = until_ns
                if stay.cell in covered or len(stays[stay.cell]) > 1:
                    broken += self._met(stay)
            if not (stands and same):
                since_ns = before_ns if same and not gapless else until_ns
                broken += self._enter(id, cell, since_ns, key, fleet)
        if stamp_ns - self._swept_ns > NS_PER_S:
            self._sweep(stamp_ns)
        return broken

    def _enter(self, id: str, cell: int, since_ns: int, key: str, fleet: Fleet) -> Iterator[Broken]:
        """A vehicle comes onto a cell, as a report under this key says."""
        author, seq, stamp_ns = fleet.author, fleet.seq, fleet.stamp_ns
        entered = Stay(id, cell, stamp_ns, stamp_ns, since_ns, key, author, seq, seq)
        self._stays.setdefault(cell, []).append(entered)
        if (left := self._vehicles.get(id)) is not None:
            self._left.append(left)
        self._vehicles[id] = entered
        truth = self._truths.get(fleet.vehicle_class, self._truths[GROUND])
        on = self._grid.terrain_cell(cell)
        if not truth.item(on) < math.inf:
            yield Broken("lethal_entries", id, on, stamp_ns, f"{id} entered a lethal cell", (replace(entered),))

    def _met(self, stay: Stay) -> Iterator[Broken]:
        """The laws that a vehicle's stay on a cell proves broken, by an obstacle or another vehicle there."""
        yield from self._obstacles.check(stay)
        for other, until_ns in _meetings(stay, self._stays[stay.cell], self._encounters, _SKEW_NS):
            first, second = sorted((stay, other), key=lambda each: each.who)
            evidence, text = (replace(first), replace(second)), f"{first.who} and {second.who} on one cell"
            on = self._grid.terrain_cell(stay.cell)
            yield Broken("collisions", f"{first.who} {second.who}", on, until_ns, text, evidence)

    def _sweep(self, now_ns: int) -> None:
        """Forgets stays that ended long ago. A vehicle's last stay is kept: it still stands there."""
        self._swept_ns = now_ns
        ended = [stay for stay in self._left if now_ns - stay.end_ns > _REMEMBER_NS]
        for stay in ended:
            self._stays[stay.cell].remove(stay)
            if not self._stays[stay.cell]:
                del self._stays[stay.cell]
        if ended:
            self._left = [stay for stay in self._left if now_ns - stay.end_ns <= _REMEMBER_NS]


IN_TIME_NS = NS_PER_S // 5
"""Two ticks of an agent: a cell that an obstacle has closed for this time is closed to every vehicle."""
_LATE_NS = 3 * NS_PER_S // 20
"""Shorter overlaps are no hit: the referee and an agent may hear of the same report this time after each other."""


class _Record(NamedTuple):
    """The newest report of an obstacle.

    covers     cell -> its stay, of the cells on which it is
    closed_ns  cell -> since when it has been closed, of those that the report closes
    """

    seq: int
    until_ns: int
    covers: dict[int, Stay]
    closed_ns: dict[int, int]


class ObstacleReferee:
    """Finds vehicles and obstacles on one cell."""

    def __init__(self, grid: GridSpec) -> None:
        self._grid = grid
        self._records: dict[tuple[str, int], _Record] = {}
        self._covers: dict[int, list[Stay]] = {}
        self._encounters: Encounters = {}
        self._swept_ns = 0

    def on_obstacle(self, obstacle: Obstacle, now_ns: int) -> None:
        """Takes in a report; one that is no news, or that no agent would avoid, changes nothing."""
        key, seq = (obstacle.id, obstacle.incarnation), obstacle.seq
        known = self._records.get(key)
        if known is None and len(self._records) >= MOST_OBSTACLES:
            return
        before = known or _Record(-1, 0, {}, {})
        lasts = now_ns < before.until_ns
        if (
            (lasts and seq <= before.seq)
            or obstacle.radius_m > MOST_RADIUS_M
            or obstacle.speed_m_per_s > MOST_M_PER_S
        ):
            return
        left = before.covers
        record = self._records[key] = _Record(seq, now_ns + int(obstacle.lease_s * NS_PER_S), {}, {})
        if obstacle.lease_s > 0.0:
            who, below = f"obstacle {obstacle.id}", OBSTACLE.below({"id": obstacle.id})
            for cell in capsule_of(obstacle, self._grid, obstacle.speed_m_per_s * REACTION_S).cells(self._grid):
                record.closed_ns[cell] = before.closed_ns.get(cell, now_ns) if lasts else now_ns
            for cell in capsule_of(obstacle, self._grid, 0.0).cells(self._grid):
                cover = left.pop(cell, None) if lasts else None
                if cover is None:
                    since_ns = record.closed_ns.get(cell, now_ns)
                    cover = Stay(who, cell, now_ns, 0, since_ns, below, obstacle.id, seq, seq)
                    self._covers.setdefault(cell, []).append(cover)
                cover.end_ns, cover.seq = record.until_ns, seq
                record.covers[cell] = cover
        for cover in left.values():
            cover.end_ns = min(now_ns, before.until_ns)
        if not 0 <= now_ns - self._swept_ns < NS_PER_S:
            self._sweep(now_ns)

    @property
    def covered(self) -> Container[int]:
        """The cells on which an obstacle was lately: a live view."""
        return self._covers

    def check(self, stay: Stay) -> Iterator[Broken]:
        """Returns violations proven by a vehicle's stay on a cell."""
        covers = self._covers.get(stay.cell, ())
        for cover, until_ns in _meetings(stay, covers, self._encounters, _LATE_NS):
            closed_ns, count = stay.since_ns - cover.since_ns, "hit_by_obstacles"
            closed_s, obstacle, vehicle = closed_ns / NS_PER_S, cover.who, stay.who
            if closed_ns >= IN_TIME_NS:
                count, found = "driven_into", f"{vehicle} drove into {obstacle}, known for {closed_s:.1f} s"
            elif closed_ns < 0:
                found = f"{obstacle} drove into {vehicle}, which was there first"
            else:
                found = f"{obstacle} met {vehicle} {closed_s:.2f} s after its first report"
            on = self._grid.terrain_cell(stay.cell)
            yield Broken(count, vehicle, on, until_ns, found, (replace(stay), replace(cover)))

    def _sweep(self, now_ns: int) -> None:
        """Forgets what ended long ago."""
        self._swept_ns = now_ns
        for cell, covers in list(self._covers.items()):
            lasting = [cover for cover in covers if now_ns - cover.end_ns <= _REMEMBER_NS]
            self._covers[cell] = lasting
            if not lasting:
                del self._covers[cell]
        for key in [key for key, record in self._records.items() if now_ns - record.until_ns > _REMEMBER_NS]:
            del self._records[key]
        for pair in [pair for pair, met_ns in self._encounters.items() if now_ns - met_ns > 2 * _REMEMBER_NS]:
            del self._encounters[pair]
