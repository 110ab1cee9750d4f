"""Cells closed by obstacles: obstacles that report their position, with a lease, and reserve no cells. Pure.

A report closes the cells that its disc touches, and those that it touches within `REACTION_S` if it keeps its
speed and heading. Until the next report it may have continued as stated, so the closed area grows with its age. A
cell is open again only if a newer report of the same obstacle no longer covers it, or the report's lease ends.
Leases count by the receiver's clock, from the receipt of a report; nothing depends on the sender's clock.

If reports contradict each other, all cells of both are closed: two senders under one id are two obstacles, and an
obstacle that leaps keeps its old position closed until that report's lease ends. A report is refused, and changes
nothing, if its id could then close more than half of the cells that all obstacles may close.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, ids_of
from swarm.errors import ConfigError
from swarm.grid import GridSpec, Window
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.vehicles import MOST_M_PER_S, MOST_RADIUS_M, Obstacle

_FAR_CELLS = 1 << 31
"""Cells from the grid: what lies further is as far."""
_STRAIGHT_CELLS = 1e-12
"""Cells to one side: less is straight."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """A disc that moves along a straight line: all points within `radius_m` of a line from (x_m, y_m).

    east_m, north_m  length of the line
    """

    x_m: float
    y_m: float
    east_m: float
    north_m: float
    radius_m: float

    def window(self, grid: GridSpec) -> Window:
        """The cells of the box around it, clipped to the grid; empty if it lies outside."""
        u0, v0, u1, v1, radius = self._in_cells(grid)
        row0, row1 = _clipped(min(v0, v1) - radius, max(v0, v1) + radius, grid.rows)
        col0, col1 = _clipped(min(u0, u1) - radius, max(u0, u1) + radius, grid.cols)
        return Window(row0, col0, row1, col1)

    def cells(self, grid: GridSpec) -> list[int]:
        """The cells whose square, border included, it touches."""
        window = self.window(grid)
        if window.empty:
            return []
        *line, radius = self._in_cells(grid)
        cols = np.arange(window.col0, window.col1, dtype=np.float64)[None, :]
        rows = np.arange(window.row0, window.row1, dtype=np.float64)[:, None]
        near = _from_squares(cols, rows, line)
        found_rows, found_cols = np.nonzero(near <= radius + 1e-9)
        flat: list[int] = ((found_rows + window.row0) * grid.cols + found_cols + window.col0).tolist()
        return flat

    def depth(self, grid: GridSpec, cell: int) -> float:
        """Returns how deep a cell's centre lies in the capsule, widened by half a cell's diagonal: 0 outside, 1 on
        its line."""
        u0, v0, u1, v1, radius = self._in_cells(grid)
        row, col = divmod(cell, grid.cols)
        u, v = col + 0.5, row + 0.5
        du, dv = u1 - u0, v1 - v0
        along = du * du + dv * dv
        t = 0.0 if along == 0.0 else min(max(((u - u0) * du + (v - v0) * dv) / along, 0.0), 1.0)
        wide = radius + math.sqrt(0.5)
        return max(1.0 - math.hypot(u - u0 - t * du, v - v0 - t * dv) / wide, 0.0)

    def _in_cells(self, grid: GridSpec) -> tuple[float, float, float, float, float]:
        """(column, row) of both ends of the line, and the radius, in cells."""
        side = grid.resolution_m
        u, v = (self.x_m - grid.west_m) / side, (grid.north_m - self.y_m) / side
        return u, v, u + self.east_m / side, v - self.north_m / side, self.radius_m / side


def _clipped(low: float, high: float, side: int) -> tuple[int, int]:
    """The first cell that an interval touches, and the one after the last."""
    # A point on a border touches the cells on both sides of it.
    first = max(math.ceil(min(max(low, -1.0), _FAR_CELLS)) - 1, 0)
    last = min(math.floor(max(min(high, side + 1.0), -1.0)) + 1, side)
    return first, max(last, first if first < side else last)


def _from_squares(
    cols: NDArray[np.float64], rows: NDArray[np.float64], line: Sequence[float]
) -> NDArray[np.float64]:
    """Distances of a line, from one (u, v) to another, from squares of side 1 whose north-west corners are these.

    Along a line the distance from a square is convex. It is least at an end, where the line passes a border of the
    square's row or column, or where it is nearest to a corner; so the least of all these is the distance.
    """
    u0, v0, u1, v1 = line
    du, dv = u1 - u0, v1 - v0
    shares: list[NDArray[np.float64]] = [np.zeros(1), np.ones(1)]
    along = du * du + dv * dv
    if along > 0.0:  # the square of a tiny length is 0
        shares += [((cols + e - u0) * du + (rows + s - v0) * dv) / along for e in (0, 1) for s in (0, 1)]
    for low, start, step in ((cols, u0, du), (rows, v0, dv)):
        if abs(step) > _STRAIGHT_CELLS:
            shares += [(low - start) / step, (low + 1.0 - start) / step]
    nearest = np.full((rows.size, cols.size), np.inf)
    for share in shares:
        t = share.clip(0.0, 1.0)
        u, v = u0 + t * du, v0 + t * dv
        east, south = np.maximum(cols - u, u - cols - 1.0), np.maximum(rows - v, v - rows - 1.0)
        np.minimum(nearest, np.hypot(east.clip(0.0), south.clip(0.0)), out=nearest)
    return nearest


REACTION_S = 0.5
"""Reports come ten times a second, take up to two ticks, and one or two of them may be lost."""
MAKE_WAY_S = 2.0
"""Vehicles at rest leave cells to which an obstacle comes within this time."""
STANDS_NS = NS_PER_S
"""An obstacle that has kept its place for this time is driven around, not waited for."""
MOST_OBSTACLES = 256
"""Ids that may report: bounds the time of a tick. Chosen, not measured."""
MOST_CELLS = 100_000
"""Limit for all obstacles together: bounds time and memory, and the effect of false reports."""
MOST_CELLS_OF_ONE = MOST_CELLS // 2
"""Limit for one id: all its senders, and the places that it has leapt from. A larger obstacle is refused."""
_FURTHEST_CELLS = 64
"""Largest number of cells ahead of an obstacle that are closed: a faster obstacle must look out itself."""
_LONGEST_PAUSE_NS = NS_PER_S // 4
"""Time between two ticks that counts for leases. A process that was stopped has not listened meanwhile."""
_DEAF_NS = NS_PER_S // 2
"""A pause between two ticks after which reports may have been lost: all obstacles are awaited again. Chosen, not
measured."""
LISTEN_NS = NS_PER_S
"""Each obstacle is published at least this often, so that a new subscriber knows it."""
_GHOSTS = 3
"""Places that an obstacle has leapt from and that are still closed, at most."""
_MOST_SENDERS = 4
"""Lives of one id, of which each may still be there: one that starts again, a second program by mistake."""
_MOST_COMPLAINTS = 1000
"""Complaints that are remembered, so that each is made once: bounds the memory. Chosen, not measured."""
_LEAP_M = 5.0
"""Distance beyond the one its speed explains: the error of satellite positions."""


_NOTHING = Window(0, 0, 0, 0)


def capsule_of(report: Obstacle, grid: GridSpec, ahead_m: float, margin_m: float = 0.0) -> Capsule:
    """Returns the area that an obstacle touches within `ahead_m` along its heading, or in any direction without
    one."""
    ahead_m = min(ahead_m, _FURTHEST_CELLS * grid.resolution_m)
    radius_m = report.radius_m + margin_m
    if report.heading_rad is None:
        return Capsule(report.x_m, report.y_m, 0.0, 0.0, radius_m + ahead_m)
    east_m, north_m = math.sin(report.heading_rad) * ahead_m, math.cos(report.heading_rad) * ahead_m
    return Capsule(report.x_m, report.y_m, east_m, north_m, radius_m)


@dataclass(slots=True, eq=False)
class _Known:
    """State of one report.

    heard_ns  when it was received, shifted by pauses in listening; `came_ns` is not shifted
    cells     closed now; `ahead_m` is the distance ahead for which they are computed
    coming    where it comes to within `MAKE_WAY_S`; None if it stands
    window    holds all that it closes or comes to
    charge    cells of the box that holds all that it can ever close
    since_ns  since when the obstacle has been near `anchor`
    """

    report: Obstacle
    came_ns: int
    heard_ns: int
    until_ns: int
    charge: int
    anchor: tuple[float, float]
    since_ns: int
    ahead_m: float = -1.0
    cells: frozenset[int] = frozenset()
    window: Window = _NOTHING
    coming: Capsule | None = None
    ghosts: list[_Known] = field(default_factory=list)


class Obstacles:
    """Obstacles and the cells that they close.

    Call `tick` before each use, and before the reports that have come since the last one: all answers are as of
    then.

    margin_m    added to each obstacle's radius: the radius of a vehicle
    complaints  a sentence for each id and kind of report that was changed or refused; the reader clears them
    refused     how many such reports there were
    """

    def __init__(self, grid: GridSpec, margin_m: float = 0.0) -> None:
        self.complaints: list[str] = []
        self.refused = 0
        self._grid = grid
        self._margin_m = margin_m
        self._known: dict[str, dict[int, _Known]] = {}
        """Id -> incarnation of a sender under it -> its newest report."""
        self._closed: Counter[int] = Counter()
        """Cell -> by how many reports it is closed."""
        self._charged = 0
        self._warned: set[tuple[str, str]] = set()
        self._standing: set[int] | None = set()
        self._changed: list[Window] = []
        self._ticked_ns: int | None = None
        self._listens_ns = 0
        """From when on all obstacles are known."""

    @property
    def closed(self) -> Container[int]:
        """The cells that no vehicle may enter: always the same object, which `take_report` and `tick` change."""
        return self._closed

    @property
    def any(self) -> bool:
        return bool(self._known)

    def take_changed(self) -> list[Window]:
        """Windows with all cells for which `closed` or `danger` may say something else than at the last call."""
        changed, self._changed = self._changed, []
        return changed

    # --- reports --------------------------------------------------------------------------------------------

    def take_report(self, report: Obstacle, now_ns: int) -> None:
        """Takes in a report, after `tick` at the same time. A report older than the last one of its sender changes
        nothing."""
        own = self._known.get(report.id, {})
        known = own.get(report.incarnation)
        if known is not None and report.seq <= known.report.seq:
            return
        if report.lease_s <= 0.0:
            if known is not None:
                self._forget(known)
            return
        leaps = known is not None and self._leaps(known.report, report, now_ns - known.came_ns)
        window = self._capsule(report, self._ahead_m(report, report.lease_s)).window(self._grid)
        charge = window.cells
        kind, wrong = self._wrong_with(
            report, charge, charge - (0 if known is None or leaps else known.charge), known is None, own.values()
        )
        if wrong:
            self._complain(kind, report.id, f"is not avoided: {wrong}")
            return
        for other in own.values():
            if known is not None and other.heard_ns > known.heard_ns:  # one that was started again does not return
                both = f"{other.report.incarnation} and {report.incarnation}"
                text = f"has two senders, of incarnations {both}: both places are closed"
                self._complain("twice", report.id, text)
                break
        x_m, y_m = report.x_m, report.y_m
        self._standing = None
        until_ns = now_ns + int(report.lease_s * NS_PER_S)
        made = _Known(report, now_ns, now_ns, until_ns, charge, (x_m, y_m), now_ns)
        self._charged += charge
        self._known.setdefault(report.id, {})[report.incarnation] = made
        self._cover(made, now_ns)
        if known is None:
            return
        near_m = max(self._grid.resolution_m, report.radius_m)
        if math.dist(known.anchor, made.anchor) <= near_m:
            made.anchor, made.since_ns = known.anchor, known.since_ns
        made.ghosts, known.ghosts = known.ghosts, []
        if leaps:
            made.ghosts.append(known)
            self._changed.append(known.window)  # nothing comes from there any more
            far_m = math.hypot(x_m - known.report.x_m, y_m - known.report.y_m)
            self._complain(
                "leaps", report.id, f"leaps {far_m:.0f} m: where it was stays closed until the lease of that ends"
            )
            if len(made.ghosts) > _GHOSTS:
                self._open(made.ghosts.pop(0))
        else:
            self._open(known)

    def _wrong_with(
        self, report: Obstacle, charge: int, more: int, is_new: bool, own: Collection[_Known]
    ) -> tuple[str, str]:
        """Returns why a report is refused, as the kind of a complaint and its text; both empty if it is not. An id
        has a share: it is counted over all its senders and the places that they have left by a leap, because
        certificates name ids.

        charge  the largest number of cells that it may close until its lease ends; `more` than are charged now
        own     reports of the same id
        """
        if report.radius_m > MOST_RADIUS_M:
            return "refused", f"its radius_m is {report.radius_m:g}, expected at most {MOST_RADIUS_M:g}"
        if report.speed_m_per_s > MOST_M_PER_S:
            return "refused", f"its speed_m_per_s is {report.speed_m_per_s:g}, expected at most {MOST_M_PER_S:g}"
        if not charge:
            grid, place = self._grid, f"x_m {report.x_m:.10g}, y_m {report.y_m:.10g}"
            east_m = grid.west_m + grid.cols * grid.resolution_m
            south_m = grid.north_m - grid.rows * grid.resolution_m
            return "refused", (
                f"{place} is outside the terrain, which has x_m {grid.west_m:.10g} ... {east_m:.10g} "
                f"and y_m {south_m:.10g} ... {grid.north_m:.10g}"
            )
        if is_new and len(self.reports) >= MOST_OBSTACLES:
            return "crowded", f"there are {MOST_OBSTACLES} others already, as many as there may be"
        if (charged := self._charged + more) > MOST_CELLS:
            return "crowded", f"with it, obstacles could close {charged} cells, expected at most {MOST_CELLS}"
        if is_new and len(own) >= _MOST_SENDERS:
            return "senders", f"{len(own)} senders have this id already"
        charged = more + sum(each.charge for one in own for each in (one, *one.ghosts))
        if charged > MOST_CELLS_OF_ONE:
            return "senders", f"with it, this id could close {charged} cells, expected at most {MOST_CELLS_OF_ONE}"
        return "", ""

    def _leaps(self, before: Obstacle, report: Obstacle, passed_ns: int) -> bool:
        speed = max(before.speed_m_per_s, report.speed_m_per_s)
        slack_m = _LEAP_M + self._grid.resolution_m + report.radius_m
        far_m = slack_m + 2.0 * speed * (passed_ns / NS_PER_S + REACTION_S)
        return math.hypot(report.x_m - before.x_m, report.y_m - before.y_m) > far_m

    def _complain(self, kind: str, id: str, text: str) -> None:
        self.refused += 1
        about = kind, "" if kind == "crowded" else id  # a crowd has as many ids as it likes
        if about not in self._warned and len(self._warned) < _MOST_COMPLAINTS:
            self._warned.add(about)
            self.complaints.append(f"obstacle {id} {text}")

    # --- time passes ----------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Ends expired leases, and moves obstacles on."""
        passed_ns = 0 if self._ticked_ns is None else now_ns - self._ticked_ns
        if passed_ns > _DEAF_NS and self._known:
            self._listens_ns = max(self._listens_ns, now_ns + 1)  # this tick
        self._ticked_ns = now_ns
        deaf_ns = max(passed_ns - _LONGEST_PAUSE_NS, 0)
        self._standing = None
        for known in self._newest():
            for each in (known, *known.ghosts):
                if deaf_ns and each.heard_ns < now_ns - deaf_ns:
                    each.heard_ns += deaf_ns
                    each.until_ns += deaf_ns
            for ghost in [ghost for ghost in known.ghosts if now_ns >= ghost.until_ns]:
                known.ghosts.remove(ghost)
                self._open(ghost)
            if now_ns >= known.until_ns:
                self._forget(known)
            elif known.report.speed_m_per_s > 0.0:
                self._cover(known, now_ns)

    @property
    def is_deaf(self) -> bool:
        """Returns True if there may be obstacles without a received report: the process has just started, or its
        last tick was so long ago that messages meanwhile may be unread. No vehicle drives then."""
        return self._ticked_ns is not None and self._ticked_ns < self._listens_ns

    def listen_anew(self, now_ns: int) -> None:
        """Starts listening again: for a second, in which every obstacle publishes its position, no vehicle
        drives."""
        self._listens_ns = now_ns + LISTEN_NS

    def _forget(self, known: _Known) -> None:
        self._standing, own = None, self._known[known.report.id]
        del own[known.report.incarnation]
        if not own:
            del self._known[known.report.id]
        for each in (known, *known.ghosts):
            self._open(each)

    def _open(self, known: _Known) -> None:
        self._charged -= known.charge
        self._close(known, frozenset(), _NOTHING)

    def _cover(self, known: _Known, now_ns: int) -> None:
        """Closes what the obstacle can reach by now and within the reaction time."""
        report = known.report
        age_s = max(now_ns - known.heard_ns, 0) / NS_PER_S
        ahead_m = self._ahead_m(report, age_s)
        if ahead_m == known.ahead_m:
            return
        known.ahead_m = ahead_m
        capsule = self._capsule(report, ahead_m)
        window = capsule.window(self._grid)
        if report.speed_m_per_s > 0.0:
            known.coming = self._capsule(report, report.speed_m_per_s * (age_s + MAKE_WAY_S))
            window = window.union(known.coming.window(self._grid))
        self._close(known, frozenset(capsule.cells(self._grid)), window)

    def _close(self, known: _Known, cells: frozenset[int], window: Window) -> None:
        closed = self._closed
        for cell in cells - known.cells:
            closed[cell] += 1
        for cell in known.cells - cells:
            if closed[cell] > 1:
                closed[cell] -= 1
            else:
                del closed[cell]
        self._changed.append(window.union(known.window))
        known.cells, known.window = cells, window

    def _ahead_m(self, report: Obstacle, age_s: float) -> float:
        """Returns the distance ahead of a report of this age that is closed. In steps of half a cell, so that it
        seldom changes; never less than the report says."""
        step_m = 0.5 * self._grid.resolution_m
        ahead_m = min(report.speed_m_per_s * (age_s + REACTION_S), _FURTHEST_CELLS * self._grid.resolution_m)
        return math.ceil(ahead_m / step_m) * step_m

    def _capsule(self, report: Obstacle, ahead_m: float) -> Capsule:
        return capsule_of(report, self._grid, ahead_m, self._margin_m)

    # --- what is asked --------------------------------------------------------------------------------------

    def danger(self, cell: int) -> float:
        """Returns an urgency score for a cell. 0 if no obstacle reaches it within `MAKE_WAY_S`; higher the closer
        an obstacle passes its centre."""
        known = (known for own in self._known.values() for known in own.values())
        comes = (each.coming for each in known if each.coming is not None)
        return max((coming.depth(self._grid, cell) for coming in comes), default=0.0)

    @property
    def standing(self) -> set[int]:
        """Cells closed by obstacles that keep their places."""
        if self._standing is None:
            now_ns = self._ticked_ns or 0
            known = (known for known in self._newest() if now_ns - known.since_ns >= STANDS_NS)
            self._standing = {cell for each in known for cell in each.cells}
        return self._standing

    @property
    def reports(self) -> list[Obstacle]:
        """The newest report of each obstacle, by each of its senders."""
        return [known.report for known in self._newest()]

    def _newest(self) -> list[_Known]:
        return [known for own in self._known.values() for known in own.values()]


# --- targets as obstacles ---

_LEASE_S = 2.0
"""A pose comes twice a second at least, and three of four may be lost."""
_LONGEST_NS = NS_PER_S
"""A pose that is older tells no speed."""
_CELLS_BETWEEN = 2
"""From the middle of a cell beside a closed one to what closes it, at most, rounded up."""


class TargetObstacles:
    """Makes obstacles of the poses of those targets that vehicles must not drive into, as the scenario says. A pose
    tells no heading and no speed: both are taken from the pose before.

    Raises ConfigError if a target's obstacle leaves no cell within capture range.
    """

    def __init__(self, scenario: Scenario, grid: GridSpec) -> None:
        self._radii_m: Mapping[str, float] = {
            id: each.obstacle_radius_m
            for each in scenario.targets
            if each.obstacle_radius_m is not None
            for id in ids_of(each)
        }
        self._last: dict[str, tuple[TargetPose, int, int]] = {}
        """Target -> its last pose, when that was heard, and the number of its obstacle's report."""
        for id, radius_m in self._radii_m.items():
            needed_m = radius_m + scenario.cost.vehicle_radius_m + _CELLS_BETWEEN * grid.resolution_m
            range_m = scenario.vehicles.capture_range_m
            if range_m < needed_m:
                raise ConfigError(
                    f"targets: {id}: with obstacle_radius_m = {radius_m:g} no vehicle comes near enough to capture "
                    f"it: vehicles.capture_range_m is {range_m:g}, expected at least {needed_m:g}"
                )

    def obstacles_of(self, pose: TargetPose, now_ns: int) -> list[Obstacle]:
        """Returns the obstacles in a pose: none for a target without an obstacle."""
        radius_m = self._radii_m.get(pose.target)
        if radius_m is None:
            return []
        before, heard_ns, seq = self._last.get(pose.target, (None, 0, 0))
        self._last[pose.target] = pose, now_ns, seq + 1
        obstacle = Obstacle(
            id=f"target.{pose.target}"[:64],
            incarnation=pose.jumps,
            seq=seq + 1,
            stamp_ns=pose.stamp_ns,
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=0.0,
            radius_m=radius_m,
            lease_s=_LEASE_S,
        )
        if before is None:
            return [obstacle]
        if before.jumps != pose.jumps:  # it is at its new place, and no more at its old one
            return [replace(obstacle, incarnation=before.jumps, lease_s=0.0), obstacle]
        passed_ns = now_ns - heard_ns
        if not 0 < passed_ns <= _LONGEST_NS:
            return [obstacle]
        east_m, north_m = pose.x_m - before.x_m, pose.y_m - before.y_m
        speed = min(math.hypot(east_m, north_m) * NS_PER_S / passed_ns, 1e6)
        return [replace(obstacle, heading_rad=math.atan2(east_m, north_m), speed_m_per_s=speed)]
