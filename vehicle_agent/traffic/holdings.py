"""Which cells the vehicles of one host hold: what wardens granted, as far as it is on file with a majority."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

from swarm.wire.messages.traffic import Stamp, Stand, Standing, Stored, Table
from vehicle_agent.traffic.plots import Plots
from vehicle_agent.traffic.warden import BEAT_NS

_TABLES_KEPT = 16
_BEFORE_ALL: Stamp = (0, 0)


@dataclass(frozen=True, slots=True)
class Wish:
    """Where a vehicle would go.

    ahead   its next cells after all that it holds
    wants   where else it could go from its cell, the best first; `better` of them are better than to stay
    """

    ahead: Sequence[int] = ()
    wants: Sequence[int] = ()
    better: int = 0
    age_ms: int = 0


@dataclass(slots=True)
class _View:
    """What a host knows of one plot.

    tables   those heard that are newer than the one in use, by stamp
    stored   member -> the newest stamp that it has on file
    knows    stamp of the table in use; it never goes back, not even when the vehicles leave the plot and return
    heard    the newest standing of ours that the table in use takes into account
    seen     vehicle -> the cells that the table in use grants it
    pushed   vehicle -> the age with which it is to make way into another plot
    others   the cells that are granted to vehicles of other hosts, or to nobody
    quiet    the first standing from which on we want nothing here; None while we do
    told     what was last told of our vehicles, and when
    """

    tables: dict[Stamp, Table] = field(default_factory=dict)
    stored: dict[str, Stamp] = field(default_factory=dict)
    knows: Stamp = _BEFORE_ALL
    heard: int = 0
    seen: dict[str, list[int]] = field(default_factory=dict)
    pushed: dict[str, int] = field(default_factory=dict)
    others: frozenset[int] = frozenset()
    quiet: int | None = None
    told: object = None
    told_ns: int = 0


class Holdings:
    """The host's side of right of way.

    life      which life of the host this is; 0 before `begin`
    plots     those that concern the host now: it speaks to their members and listens to their tables
    replaced  a later life of this host has spoken: this one must end
    newest    the greatest life of this host that a table in use names
    """

    def __init__(self, plots: Plots, agent: str, vehicles: Collection[str]) -> None:
        self._plots = plots
        self._agent = agent
        self._vehicles = list(vehicles)
        self.end()

    def end(self) -> None:
        """Hold nothing and know nothing, as before the first life."""
        self.life = self.newest = 0
        self.replaced = False
        self.plots: dict[int, None] = {}
        self._dead: list[int] = []
        self._paths: dict[str, list[int]] = {}
        self._cells: set[int] | None = None
        """All cells of our paths; None when they have changed."""
        self._views: dict[int, _View] = {}
        self._seq = 0

    def begin(self, life: int, dead: Sequence[int]) -> None:
        """Begin a life; `dead` are earlier ones that are proved to have ended."""
        self.life = life
        self._dead = list(dead)

    # --- what is held ---------------------------------------------------------------------------------------

    def path(self, vehicle: str) -> Sequence[int]:
        """The cells that a vehicle may stand on or enter, its own first; empty of one that has no place yet."""
        return self._paths.get(vehicle, ())

    def pushed(self, vehicle: str) -> int:
        """The age with which it is asked to make way into another plot; 0 if it is not."""
        return max((view.pushed.get(vehicle, 0) for view in self._views.values()), default=0)

    def occupied(self, cell: int) -> bool:
        """Whether another vehicle holds a cell, as far as the tables in use tell."""
        if self._cells is None:
            self._cells = {cell for path in self._paths.values() for cell in path}
        return cell in self._cells or any(cell in self._views[plot].others for plot in self.plots)

    def moved(self, vehicle: str, cell: int) -> None:
        """It has come to the next cell of its path."""
        path = self._paths[vehicle]
        self._paths[vehicle] = path[path.index(cell) :]
        self._cells = None

    def give_back(self, vehicle: str, keep: int = 1) -> None:
        """Keep only the first cells of the path. The rest must not be entered any more."""
        self._paths[vehicle] = self._paths[vehicle][: max(keep, 1)]
        self._cells = None

    def waiting(self, plot: int) -> list[str]:
        """The vehicles that hold cells of a plot, as far as its table in use tells."""
        return list(self._views[plot].seen) if plot in self._views else []

    # --- what members say -----------------------------------------------------------------------------------

    def watch(self, plots: Collection[int]) -> None:
        """Let these plots concern us, until they are seen to hold nothing of ours."""
        for plot in plots:
            self.plots.setdefault(plot)
            self._views.setdefault(plot, _View())

    def hear_table(self, table: Table, place: Callable[[str, Sequence[int]], int]) -> list[str]:
        """Take in a warden's table. Returns the vehicles that have found their place.

        place  tells on which of the cells that it was granted a vehicle stands
        """
        view = self._views.setdefault(table.plot, _View())
        if table.agent != self._plots.warden(table.plot, table.epoch) or table.stamp <= view.knows:
            return []
        view.tables[table.stamp] = table
        if len(view.tables) > _TABLES_KEPT:
            del view.tables[min(view.tables)]
        return self._use(view, place)

    def hear_stored(self, stored: Stored, place: Callable[[str, Sequence[int]], int]) -> list[str]:
        if stored.agent not in self._plots.members(stored.plot):
            return []
        view = self._views.setdefault(stored.plot, _View())
        stamp = (stored.epoch, stored.seq)
        if stamp <= view.stored.get(stored.agent, _BEFORE_ALL):
            return []
        view.stored[stored.agent] = stamp
        return self._use(view, place)

    def _use(self, view: _View, place: Callable[[str, Sequence[int]], int]) -> list[str]:
        """Act on the newest table that a majority has stored, if it is newer than the one in use."""
        stamp = max((stamp for stamp, table in view.tables.items() if self._on_file(view, table)), default=None)
        if stamp is None:
            return []
        table = view.tables[stamp]
        life, heard = table.hosts.get(self._agent, (0, 0))
        self.newest = max(self.newest, life)
        self.replaced = self.replaced or life > self.life
        view.tables = {each: other for each, other in view.tables.items() if each > stamp}
        if life != self.life:
            return []  # what it grants was granted to another life
        view.knows, view.heard = stamp, heard
        self._cells = None
        view.pushed = {id: age for id, age in table.pushed.items() if id in self._paths}
        view.others = frozenset(
            cell
            for cells in (
                *(grant.cells for vehicle, grant in table.grants.items() if vehicle not in self._paths),
                *(shut.cells for shut in table.shut),
            )
            for cell in cells
        )
        placed = []
        for vehicle in self._vehicles:
            grant = table.grants.get(vehicle)
            seen = view.seen.pop(vehicle, [])
            if grant is None or any(self._plots.of(cell) != table.plot for cell in grant.cells):
                continue
            view.seen[vehicle] = grant.cells
            if vehicle in self._paths:
                self._extend(vehicle, grant.cells, seen)
            else:
                self._paths[vehicle] = [place(vehicle, grant.cells)]
                placed.append(vehicle)
        return placed

    def _on_file(self, view: _View, table: Table) -> bool:
        """Whether a majority has stored the table or a later one of its epoch; the warden has before it speaks."""
        have = {table.agent}
        have.update(
            member for member, (epoch, seq) in view.stored.items() if epoch == table.epoch and seq >= table.seq
        )
        return len(have) >= self._plots.majority

    def _extend(self, vehicle: str, cells: Sequence[int], seen: Sequence[int]) -> None:
        """Take the cells that are granted anew. One that does not follow the path is left, and so given back."""
        path = self._paths[vehicle]
        after = max((index for index, cell in enumerate(cells) if cell in path), default=-1)
        for cell in cells[after + 1 :]:
            if cell in seen or not self._plots.adjacent(path[-1], cell):
                return
            path.append(cell)

    # --- what to say ----------------------------------------------------------------------------------------

    def standings(self, wishes: Mapping[str, Wish], now_ns: int) -> list[Standing]:
        """What to tell the members of each plot that concerns us, where it is new or the last word is a beat old.
        Cells left out are given back."""
        self._seq += 1
        by_plot: dict[int, list[Stand]] = {plot: [] for plot in self.plots}
        for vehicle, path in self._paths.items():
            wish = self._askable(vehicle, path, wishes.get(vehicle, Wish()))
            near = [*path, *wish.ahead[:1], *wish.wants]
            for plot in dict.fromkeys(plot for plot in map(self._plots.of, near) if plot >= 0):
                by_plot.setdefault(plot, []).append(self._stand(vehicle, path, wish, plot))
        self._forget_left(by_plot)
        return [
            Standing(
                plot=plot,
                agent=self._agent,
                life=self.life,
                seq=self._seq,
                knows=self._views[plot].knows,
                vehicles=stands,
                dead=self._dead,
                ended=self.replaced,
            )
            for plot, stands in by_plot.items()
            if self._is_news(plot, stands, now_ns)
        ]

    def _is_news(self, plot: int, stands: Sequence[Stand], now_ns: int) -> bool:
        view = self._views[plot]
        # What a table grants and we do not hold is freed only if we say so, knowing that table.
        in_step = view.seen == {stand.vehicle: stand.holds for stand in stands if stand.holds}
        told = (
            self.replaced,
            view.knows[0] if in_step else view.knows,
            [(stand.vehicle, stand.cell, stand.holds, stand.ahead, stand.better) for stand in stands],
        )
        if told == view.told and 0 <= now_ns - view.told_ns < BEAT_NS:
            return False
        view.told, view.told_ns = told, now_ns
        return True

    def _askable(self, vehicle: str, path: Sequence[int], wish: Wish) -> Wish:
        """Without cells that were left or given back while a table still grants them: granted anew, such a cell
        could not be told from one that is about to be freed."""
        lapsed = {cell for plot in self.plots for cell in self._views[plot].seen.get(vehicle, ())}.difference(path)
        if lapsed.isdisjoint(wish.ahead) and lapsed.isdisjoint(wish.wants):
            return wish
        ahead = list(takewhile(lambda cell: cell not in lapsed, wish.ahead))
        better = sum(cell not in lapsed for cell in wish.wants[: wish.better])
        return Wish(ahead, [cell for cell in wish.wants if cell not in lapsed], better, wish.age_ms)

    def _stand(self, vehicle: str, path: Sequence[int], wish: Wish, plot: int) -> Stand:
        still = len(path) == 1
        return Stand(
            vehicle=vehicle,
            cell=path[0],
            end=path[-1],
            holds=[cell for cell in path if self._plots.of(cell) == plot],
            ahead=list(wish.ahead),
            wants=list(wish.wants) if still else [],
            better=wish.better if still else 0,
            age_ms=wish.age_ms,
        )

    def _forget_left(self, by_plot: dict[int, list[Stand]]) -> None:
        """Leave the plots where we hold and want nothing, once their tables show that they know it."""
        for plot, stands in by_plot.items():
            view = self._views.setdefault(plot, _View())
            if stands:
                view.quiet = None
            elif view.quiet is None:
                view.quiet = self._seq
        self.plots = {
            plot: None
            for plot in by_plot
            if (quiet := self._views[plot].quiet) is None
            or self._views[plot].heard < quiet
            or self._views[plot].seen
        }
