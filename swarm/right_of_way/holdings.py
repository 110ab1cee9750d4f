"""Cells that the vehicles of one host hold: grants of wardens that are on file with a majority."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from itertools import chain, takewhile

import msgspec

from swarm.right_of_way.entries import BEFORE_ALL, HostEntries
from swarm.right_of_way.incarnations import BEAT_NS, FURTHEST_EPOCH
from swarm.right_of_way.lock_regions import Plots
from swarm.wire.messages.traffic import Entry, Granted, Left, Number, Stand, Standing, Word

_UNHEARD_NS = 5 * BEAT_NS // 2
"""A host that has not heard a plot's warden for so long speaks to all members of the plot."""
_FURTHEST_SEQ = 1 << 32
"""Tables of one epoch: ten a second for thirteen years."""
_MOST_CELLS = 1 << 12
"""Cells whose plot is remembered: more than the vehicles of one host have near them."""


class Wish(msgspec.Struct, frozen=True):
    """Candidate cells of a vehicle, in order of preference.

    ahead   its next cells after all that it holds
    wants   where else it could go from its cell, the best first; `better` of them are better than to stay
    """

    ahead: Sequence[int] = ()
    wants: Sequence[int] = ()
    better: int = 0
    age_ms: int = 0


_NO_WISH = Wish()
_NO_STANDS: Mapping[str, _Told] = {}


def part_of(life: int, grants: Mapping[str, Sequence[Entry]]) -> int:
    """Returns a digest of what a table grants to one life of a host. 62 bits fit into a message, and a thief of a
    name has a fraction of a second to find other grants with the same digest."""
    said = msgspec.msgpack.encode((life, sorted(grants.items())))
    return int.from_bytes(blake2b(said, digest_size=8).digest()) >> 2


@dataclass(frozen=True, slots=True)
class Tell:
    """Send a standing to these members of its plot."""

    members: tuple[str, ...]
    standing: Standing


@dataclass(slots=True)
class _View:
    """State of one plot as a host knows it.

    warden   of the last grant, and the time when that was received
    heard    the newest standing of ours that the table in use takes into account
    seen     vehicle -> its entries in the table in use
    followed  other host -> entries of ours behind which its vehicles wait, by the same table
    left     other host -> those of these that are over, as we told it last, and when
    pushed   vehicle -> the age with which it is to make way into another plot
    others   cells beside our vehicles that are granted to vehicles of other hosts, or to none
    quiet    the first standing from which on we want nothing here; None while we do
    words    member -> (epoch, digest) of its last word, where names are proven; a grant is its warden's word. An
             older one that comes late does no harm: no entry is taken that a used table could have granted
    pending  warden -> its last grant, until a majority has the same on file, and its digest
    told     the last statement about our vehicles, and its time
    same     whether the next statement is known to be the same
    """

    warden: str = ""
    heard_ns: int = 0
    heard: int = 0
    seen: dict[str, list[Number]] = field(default_factory=dict)
    followed: dict[str, list[Number]] = field(default_factory=dict)
    left: dict[str, tuple[list[Number], int]] = field(default_factory=dict)
    pushed: dict[str, int] = field(default_factory=dict)
    others: frozenset[int] = frozenset()
    quiet: int | None = None
    words: dict[str, tuple[int, int]] = field(default_factory=dict)
    pending: dict[str, tuple[Granted, int]] = field(default_factory=dict)
    told: object = None
    told_ns: int = 0
    same: bool = False


_Told = tuple[Stand, object]
"""A stand, and what of it is news."""


class _Said(msgspec.Struct, frozen=True):
    """Statement about one vehicle while nothing about it changes: a stand per plot."""

    wish: Wish
    path: list[int]
    stands: dict[int, _Told]


class Holdings:
    """The host's side of right of way.

    vehicles  those of the host; None for all that bear its name

    life      which life of the host this is; 0 before `begin`
    plots     those that concern the host now: it speaks to their members and listens to their tables
    replaced  a later life of this host has spoken: this one must end
    newest    the greatest life of this host that a table in use names
    refused   sentences about impossible statements; the reader clears them
    """

    def __init__(self, plots: Plots, agent: str, vehicles: Collection[str] | None) -> None:
        self._plots = plots
        self._plot_of = lru_cache(_MOST_CELLS)(plots.of)
        self._agent = agent
        self.refused: list[str] = []
        self._vehicles = None if vehicles is None else frozenset(vehicles)
        self.end()

    def end(self) -> None:
        """Holds nothing and know nothing, as before the first life."""
        self.life = self.newest = 0
        self.replaced = False
        self.plots: dict[int, None] = {}
        self._dead: list[int] = []
        self._entries = HostEntries(0, self._plot_of, self._plots.adjacent)
        self._paths: dict[str, list[int]] = {}
        """Vehicle that has a place -> the cells that it holds, in driving order; another list when they change."""
        self._pushed: dict[str, int] | None = None
        """Vehicle -> the age with which it is asked to make way; None when a warden has spoken."""
        self._said: dict[str, _Said] = {}
        self._seen_anew: set[str] = set()
        """Vehicles to which another table grants other cells: their requests may change."""
        self._stands: dict[int, dict[str, _Told]] = {}
        """Plot -> vehicle -> statement about it, in the order of `_paths`; follows `_said`."""
        self._views: dict[int, _View] = {}
        self._seq = 0

    def begin(self, life: int, dead: Sequence[int]) -> None:
        """Begins a life; `dead` are earlier ones that are proved to have ended."""
        self.life = self._entries.life = life
        self._dead = list(dead)

    def end_at_once(self) -> None:
        """States that no vehicle drives by this life: it only releases the cells of those before it."""
        self._dead.append(self.life)

    # --- what is held ---------------------------------------------------------------------------------------

    def path(self, vehicle: str) -> Sequence[int]:
        """The cells that a vehicle may stand on or enter, its own first; empty of one that has no place yet. The
        same object for as long as nothing has changed."""
        return self._paths.get(vehicle, ())

    @property
    def paths(self) -> Mapping[str, Sequence[int]]:
        """Vehicle -> its path, of all that have a place."""
        return self._paths

    @property
    def pushed(self) -> Mapping[str, int]:
        """Vehicle -> the age with which it is asked to make way into another plot, of those that are."""
        if self._pushed is None:
            self._pushed = {}
            for view in self._views.values():
                for id, age in view.pushed.items():
                    self._pushed[id] = max(age, self._pushed.get(id, 0))
        return self._pushed

    def occupied(self) -> set[int]:
        """The cells that vehicles hold, of all to which one of ours at rest could go, as far as wardens tell."""
        occupied = set(chain.from_iterable(self._paths.values()))
        for plot in self.plots:
            occupied |= self._views[plot].others
        return occupied

    def may_enter(self, vehicle: str, cell: int) -> bool:
        """Returns True if a vehicle may drive into a cell of its path now: those before it have left."""
        path = self._entries.paths[vehicle]
        for entry in path[1:]:
            if not self._entries.may_enter(entry):
                return False
            if entry.cell == cell:
                return True
        return False

    def awaits(self, vehicle: str) -> Entry | None:
        """Returns the next entry of a vehicle while others are before it; None if it may enter, or has none."""
        for entry in self._entries.paths.get(vehicle, ())[1:2]:
            if not self._entries.may_enter(entry):
                return entry
        return None

    def open(self, vehicle: str) -> Sequence[int]:
        """The first cells of a path, up to the first that the vehicle may not enter yet."""
        path = self.path(vehicle)
        if not any(entry.after for entry in self._entries.paths.get(vehicle, ())):
            return path
        return [*path[:1], *takewhile(lambda cell: self.may_enter(vehicle, cell), path[1:])]

    @property
    def waits(self) -> bool:
        """True if a vehicle of ours waits for another."""
        return any(entry.after for path in self._entries.paths.values() for entry in path)

    def moved(self, vehicle: str, cell: int) -> None:
        """It has come to a later cell of its path. Raises ValueError if it must not be there."""
        while self._paths[vehicle][0] != cell:
            if not self._entries.enter_next(vehicle):
                raise ValueError(f"{vehicle} must not enter cell {cell}: it holds {self._paths[vehicle]}")
            self._set_path(vehicle)

    def give_back(self, vehicle: str, keep: int = 1) -> None:
        """Keeps only the first cells of the path. The rest must not be entered any more."""
        keep = max(keep, 1)
        if len(self._paths[vehicle]) > keep:
            self._entries.give_back(vehicle, keep)
            self._set_path(vehicle)

    def _set_path(self, vehicle: str) -> None:
        self._paths[vehicle] = [entry.cell for entry in self._entries.paths[vehicle]]

    def enter(self, vehicle: str, cell: int) -> None:
        """States the cell of a vehicle that has no place: its body is there, or it would enter there. If an earlier
        life of ours held it, it takes it, and releases all others. The newest call counts."""
        if vehicle not in self._paths:
            self._entries.enter(vehicle, cell)
            self.watch([self._plots.of(cell)])

    def leave(self, vehicle: str) -> None:
        """It stands nowhere any more: give back all that it holds."""
        self._entries.leave(vehicle)
        self._paths.pop(vehicle, None)
        said = self._said.pop(vehicle, None)
        for plot in () if said is None else said.stands:
            del self._stands[plot][vehicle]
            self._views[plot].same = False

    @property
    def gone(self) -> bool:
        """True if no vehicle of ours holds or requests a cell, and all wardens that we contacted know it."""
        return not (self.plots or self._entries.paths or self._entries.bodies)

    @property
    def answered(self) -> bool:
        """Returns True if a table of each plot that concerns us takes this life into account."""
        return self.life > 0 and not self.replaced and all(self._views[plot].heard for plot in self.plots)

    def is_granted(self, vehicle: str) -> bool:
        """Returns True if a table in use grants cells to a vehicle, which may have left them."""
        return any(vehicle in view.seen for view in self._views.values())

    def waiting(self, plot: int) -> list[str]:
        """The vehicles that have entries in a plot, as far as its table in use tells."""
        return list(self._views[plot].seen) if plot in self._views else []

    def is_pending(self, plot: int) -> bool:
        """Returns True if a grant of a plot waits for words of its members."""
        return plot in self._views and bool(self._views[plot].pending)

    def heard_ns(self, plot: int) -> int:
        """Time when a plot's warden was heard last; 0 if none was."""
        return self._views[plot].heard_ns if plot in self._views else 0

    # --- what wardens say -----------------------------------------------------------------------------------

    def watch(self, plots: Collection[int]) -> None:
        """Makes these plots concern us, until they are seen to hold nothing of ours."""
        for plot in plots:
            self.plots.setdefault(plot)
            self._views.setdefault(plot, _View())

    def hear_granted(self, granted: Granted, now_ns: int) -> list[str]:
        """Act on what a warden says to us, if it is newer than what we know. Returns the vehicles that have found
        their place."""
        view = self._views.setdefault(granted.plot, _View())
        knows = self._entries.knows.get(granted.plot, BEFORE_ALL)
        if granted.epoch > knows[0] + FURTHEST_EPOCH or granted.seq > _FURTHEST_SEQ:
            self.refused.append(f"{granted.agent} names a table that is implausibly far ahead: {granted.stamp}")
            return []
        if granted.agent != self._plots.warden(granted.plot, granted.epoch) or granted.stamp < knows:
            return []
        view.warden, view.heard_ns = granted.agent, now_ns
        if not self._plots.proven:
            return self._take(view, granted)
        part = part_of(granted.life, granted.grants)
        view.words[granted.agent] = granted.epoch, part
        view.pending[granted.agent] = granted, part
        return self._take_agreed(view)

    def hear_word(self, word: Word) -> list[str]:
        """A member has something on file for us. Returns the vehicles that have found their place."""
        if word.agent not in self._plots.members(word.plot):
            return []
        view = self._views.setdefault(word.plot, _View())
        view.words[word.agent] = word.epoch, word.part
        if word.asks:
            self.watch([word.plot])
            self._entries.disclaim(word.plot, word.lacks)
            view.same, view.told = False, None
        return self._take_agreed(view)

    def _take_agreed(self, view: _View) -> list[str]:
        """Acts on the grants that a majority has on file."""
        placed: list[str] = []
        for warden, (granted, part) in sorted(view.pending.items(), key=lambda each: each[1][0].stamp):
            if list(view.words.values()).count((granted.epoch, part)) >= self._plots.majority:
                del view.pending[warden]
                placed += self._take(view, granted)
        return placed

    def _take(self, view: _View, granted: Granted) -> list[str]:
        """Acts on a grant that counts."""
        knows = self._entries.knows.get(granted.plot, BEFORE_ALL)
        if granted.stamp < knows:
            return []
        self.newest = max(self.newest, granted.life)
        if granted.life > self.life and not self.replaced:
            self.replaced = True
            self._say_all_again()
        if granted.stamp == knows or granted.life != self.life or self.replaced:
            return []  # what it grants was granted to another life
        view.heard, view.same = granted.heard, False
        view.pushed = {id: age for id, age in granted.pushed.items() if id in self._paths}
        view.others = frozenset(granted.occupied)
        view.followed = granted.followed
        self._pushed = None
        ours = {
            id: entries
            for id, entries in granted.grants.items()
            if (self._vehicles is None or id in self._vehicles)
            and {self._plot_of(entry.cell) for entry in entries} == {granted.plot}
        }
        before, view.seen = view.seen, {id: [entry.number for entry in entries] for id, entries in ours.items()}
        changed = self._entries.hear_granted(granted.plot, granted.stamp, granted.life, ours)
        self._seen_anew.update(changed, [id for id in before if before[id] != view.seen.get(id)])
        for vehicle in changed & self._paths.keys():
            self._set_path(vehicle)
        return self._place()

    def hear_left(self, left: Left) -> list[str]:
        """Another host says what its vehicles have left. Returns the vehicles that have found their place."""
        self._entries.hear_left(left.agent, left.entries)
        return self._place()

    def _place(self) -> list[str]:
        """Puts vehicles that are nowhere on the first cell of their paths, where they may."""
        entries = self._entries
        for vehicle in entries.paths.keys() - self._paths.keys():
            entries.place(vehicle)
        placed = [vehicle for vehicle in entries.paths if vehicle in entries.placed and vehicle not in self._paths]
        for vehicle in placed:
            entries.bodies.pop(vehicle, None)
            self._set_path(vehicle)
        return placed

    # --- what to say ----------------------------------------------------------------------------------------

    def standings(self, wishes: Mapping[str, Wish], now_ns: int) -> list[Tell]:
        """Returns the statements for each plot that concerns us, if they are new or the last one is a beat old.
        Cells that a statement omits are released."""
        self._seq += 1
        self._say_changed(wishes)
        by_plot = {plot: self._stands.get(plot, _NO_STANDS) for plot in self.plots}
        by_plot.update((plot, stands) for plot, stands in self._stands.items() if stands)
        entries = self._entries
        for vehicle, cell in entries.bodies.items():
            if vehicle not in entries.paths:
                self._say_entering(by_plot, self._plots.of(cell), Stand(vehicle, cell, cell, [], [cell], [], 0, 0))
        for vehicle, path in entries.paths.items():
            if vehicle not in self._paths:
                cell, end = path[0].cell, path[-1].cell
                for plot, held in entries.of(vehicle).items():
                    self._say_entering(by_plot, plot, Stand(vehicle, cell, end, held, [], [cell], 1, 0))
        self._forget_left(by_plot)
        return [
            Tell(self._listeners(plot, now_ns), self._standing(plot, [stand for stand, _ in stands.values()]))
            for plot, stands in by_plot.items()
            if self._is_news(plot, stands, now_ns)
        ]

    def _say_entering(self, by_plot: dict[int, Mapping[str, _Told]], plot: int, stand: Stand) -> None:
        """States what a vehicle that is nowhere has and wants of a plot."""
        by_plot[plot] = {**by_plot.get(plot, _NO_STANDS), stand.vehicle: (stand, stand)}
        self._views.setdefault(plot, _View()).same = False

    def lefts(self, now_ns: int) -> list[Left]:
        """Returns the words of ours for which vehicles of other hosts wait, if they are new or a beat old."""
        words: dict[str, list[Number]] = {}
        for plot, view in self._views.items():
            over = self._entries.over.get(plot, set())
            for host, numbers in view.followed.items():
                told, told_ns = view.left.get(host, (None, 0))
                left = [number for number in numbers if number in over]
                if left and (left != told or not 0 <= now_ns - told_ns < BEAT_NS):
                    view.left[host] = left, now_ns
                    words.setdefault(host, []).extend(left)
        return [Left(agent=self._agent, host=host, entries=numbers) for host, numbers in words.items()]

    def _say_changed(self, wishes: Mapping[str, Wish]) -> None:
        """Rebuilds the statements about vehicles of which path, wish or granted cells have changed."""
        anew, known, moved = self._seen_anew, self._said, False
        for vehicle, path in self._paths.items():
            before, wish = known.get(vehicle), wishes.get(vehicle, _NO_WISH)
            if (
                before is not None
                and before.wish is wish
                and before.path is path
                and not (anew and vehicle in anew)
            ):
                continue
            said = known[vehicle] = self._say(vehicle, path, wish)
            moved = moved or before is None or before.stands.keys() != said.stands.keys()
            for plot, told in said.stands.items():
                self._views.setdefault(plot, _View()).same = False
                if not moved:
                    self._stands[plot][vehicle] = told
        anew.clear()
        if moved:
            self._say_all_again()
            self._stands = {}
            for vehicle in self._paths:
                for plot, told in known[vehicle].stands.items():
                    self._stands.setdefault(plot, {})[vehicle] = told

    def _say_all_again(self) -> None:
        """Statements of all plots may change."""
        for view in self._views.values():
            view.same = False

    def _standing(self, plot: int, stands: list[Stand]) -> Standing:
        return Standing(
            plot=plot,
            agent=self._agent,
            life=self.life,
            seq=self._seq,
            knows=self._entries.knows.get(plot, BEFORE_ALL),
            vehicles=stands,
            dead=self._dead,
            ended=self.replaced,
            never=sorted(self._entries.disclaimed.get(plot, ())),
        )

    def _listeners(self, plot: int, now_ns: int) -> tuple[str, ...]:
        view = self._views[plot]
        if not self._plots.proven and view.warden and 0 <= now_ns - view.heard_ns < _UNHEARD_NS:
            return (view.warden,)
        return self._plots.members(plot)

    def _is_news(self, plot: int, stands: Mapping[str, _Told], now_ns: int) -> bool:
        view = self._views[plot]
        lately = 0 <= now_ns - view.told_ns < BEAT_NS
        if not view.same:
            # An entry that we do not hold is freed only if we state so, knowing that table.
            in_step = view.seen == {id: stand.holds for id, (stand, _) in stands.items() if stand.holds}
            stamp = self._entries.knows.get(plot, BEFORE_ALL)
            knows = stamp[0] if in_step else stamp
            told = (self.replaced, knows, [news for _, news in stands.values()])
            lately = lately and told == view.told
            view.told, view.same = told, True
        if lately:
            return False
        view.told_ns = now_ns
        return True

    def _say(self, vehicle: str, path: list[int], wish: Wish) -> _Said:
        ahead, wants, better = [*wish.ahead], list[int](), 0
        if len(path) == 1:
            wants, better = [*wish.wants], wish.better
        plot_of = self._plot_of
        concerned = [*path, *ahead[:1], *wants]
        near: Collection[int] = {*map(plot_of, concerned)}
        if len(near) > 1:
            near = dict.fromkeys(plot for plot in map(plot_of, concerned) if plot >= 0)
        stands: dict[int, _Told] = {}
        held = [entry.number for entry in self._entries.paths[vehicle]]
        for plot in near:
            holds = held if len(near) == 1 else [number for number in held if plot_of(number[0]) == plot]
            stand = Stand(vehicle, path[0], path[-1], holds, ahead, wants, better, wish.age_ms)
            stands[plot] = stand, (vehicle, path[0], holds, ahead, better)
        return _Said(wish, path, stands)

    def _forget_left(self, by_plot: Mapping[int, Mapping[str, _Told]]) -> None:
        """Leaves the plots where we hold and want nothing, once their tables show that they know it."""
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
