"""Cells that the vehicles of one host hold: grants of leaders that are on file with a majority."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from itertools import chain, takewhile

import msgspec

from swarm.right_of_way.generations import FURTHEST_EPOCH, HEARTBEAT_NS, keep_last, was_just_sent
from swarm.right_of_way.host_entries import BEFORE_ALL, HostEntries
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import (
    Entry,
    Granted,
    Held,
    HostState,
    Left,
    Number,
    Stamp,
    Stand,
    Word,
    entries_of,
)

_UNHEARD_NS = 5 * HEARTBEAT_NS // 2
"""A host that has not heard a shard's leader for this time speaks to all members of the shard."""
_FURTHEST_SEQ = 1 << 32
"""Tables of one epoch: ten a second for thirteen years."""
STATES_KEPT = 32
"""Statements since which changes are sent: at ten a second more than are sent in a round trip."""
TABLES_KEPT = 16
"""Tables since which changes are sent, more than may be on the way at once: an older one is never asked for."""
MOST_AHEAD = 16
"""Cells ahead that one statement may request."""
_MOST_CELLS = 1 << 12
"""Cells whose shard is remembered: more than the vehicles of one host have near them."""


class CellRequest(msgspec.Struct, frozen=True):
    """Candidate cells of a vehicle, in order of preference.

    ahead   its next cells after all that it holds
    wants   where else it could go from its cell, the best first; the first `better` of them beat staying
    age_ms  how long it has waited
    """

    ahead: Sequence[int] = ()
    wants: Sequence[int] = ()
    better: int = 0
    age_ms: int = 0


_NO_REQUEST = CellRequest()


def part_of(generation: int, grants: Mapping[str, Held], waits: Mapping[str, Sequence[Entry]]) -> int:
    """Returns a digest of what a table grants to one generation of a host. 62 bits fit into a message, and an
    attacker has under a second to find other grants with the same digest."""
    table = msgspec.msgpack.encode((generation, sorted(grants.items()), sorted(waits.items())))
    return int.from_bytes(blake2b(table, digest_size=8).digest()) >> 2


@dataclass(frozen=True, slots=True)
class SendState:
    """Send a host state to these members of its shard."""

    members: tuple[str, ...]
    state: HostState


_StandNews = tuple[Stand, object]
"""A stand, and what of it is news."""


@dataclass(slots=True)
class _View:
    """State of one shard as a host knows it.

    leader    of the last grant, and the time when that was received
    heard     the newest host state of ours that the table in use takes into account
    seen      vehicle -> its entries in the table in use, and `waits` those of them that wait there
    followed  host -> entries of ours behind which its vehicles wait, by the same table; we may be that host
    left      other host -> those of these that are over, as we sent it last, and when
    pushed    vehicle -> the age with which it is to make way into another shard
    others    cells beside our vehicles that are granted to vehicles of other hosts, or to none
    quiet     the first host state from which on we want nothing here; None while we do
    words     member -> (epoch, digest) of its last word, where names are proven; a grant is its leader's word. An
              older one that comes late does no harm: no entry is taken that a used table could have granted
    pending   leader -> its last grant, until a majority has the same on file, and its digest
    stands    vehicle that has a place -> the last statement about it
    news      what was news of the last statement about our vehicles; `sent_ns` is its time
    same      whether the next statement is known to be the same
    sent      seq -> host state, the last ones since the leader's first grant: it has that which it has `heard`.
              Empty if leaders read no changes of ours
    used      stamp -> grant, the last ones that were acted on
    """

    leader: str = ""
    heard_ns: int = 0
    heard: int = 0
    seen: dict[str, Held] = field(default_factory=dict)
    waits: dict[str, list[Entry]] = field(default_factory=dict)
    followed: dict[str, list[Number]] = field(default_factory=dict)
    left: dict[str, tuple[list[Number], int]] = field(default_factory=dict)
    pushed: dict[str, int] = field(default_factory=dict)
    others: frozenset[int] = frozenset()
    quiet: int | None = None
    words: dict[str, tuple[int, int]] = field(default_factory=dict)
    pending: dict[str, tuple[Granted, int]] = field(default_factory=dict)
    stands: dict[str, _StandNews] = field(default_factory=dict)
    news: object = None
    sent_ns: int = 0
    same: bool = False
    sent: dict[int, HostState] = field(default_factory=dict)
    used: dict[Stamp, Granted] = field(default_factory=dict)


class _Statement(msgspec.Struct, frozen=True):
    """Statement about one vehicle, and the shards to which it was made."""

    request: CellRequest
    path: list[int]
    held: list[Number]
    shards: Set[int]


class Holdings:
    """The cells that the vehicles of one host hold, in one generation of it after the other (`Host`).

    name      of the host: an agent, or an external vehicle
    vehicles  those of the host; None for all that bear its name

    keeps       cells ahead that a vehicle keeps though others wait for them
    generation  which generation of the host this is; 0 before `begin_as`
    watched     shards that concern the host now: it speaks to their members and listens to their tables
    replaced    a later generation of this host has spoken: this one must end
    newest      the greatest generation of this host that a table in use names
    refused     sentences about impossible statements; the reader clears them
    """

    def __init__(self, shards: Shards, name: str, vehicles: Collection[str] | None) -> None:
        self.shards = shards
        self._shard_of = lru_cache(_MOST_CELLS)(shards.of)
        self.name = name
        self.keeps = MOST_AHEAD
        self.refused: list[str] = []
        self._vehicles = None if vehicles is None else frozenset(vehicles)
        self.end()

    def end(self) -> None:
        """Resets to the state before the first generation: holds nothing and knows nothing."""
        self.generation = self.newest = 0
        self.replaced = False
        self.watched: dict[int, None] = {}
        self._dead: list[int] = []
        self._entries = HostEntries(0, self._shard_of, self.shards.adjacent)
        self._paths: dict[str, list[int]] = {}
        """Vehicle that has a place -> the cells that it holds, in driving order; another list when they change."""
        self._pushed: dict[str, int] | None = None
        """Vehicle -> the age with which it is asked to make way; None: to be collected again, since a leader has
        spoken."""
        self._statements: dict[str, _Statement] = {}
        self._seen_anew: set[str] = set()
        """Vehicles to which another table grants other cells: their requests may change."""
        self._views: dict[int, _View] = {}
        self._followed: set[Number] = set()
        """Entries of ours behind which others wait."""
        self._seq = 0

    def begin_as(self, generation: int, dead: Sequence[int]) -> None:
        """Begins a generation; `dead` are earlier ones that are proved to have ended."""
        self.generation = self._entries.generation = generation
        self._dead = list(dead)

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
        """Vehicle -> the age with which it is asked to make way into another shard, of those that are."""
        if self._pushed is None:
            self._pushed = {}
            for view in self._views.values():
                for id, age in view.pushed.items():
                    self._pushed[id] = max(age, self._pushed.get(id, 0))
        return self._pushed

    def occupied(self) -> set[int]:
        """The cells that vehicles hold, of all to which one of ours at rest could go, as far as leaders tell."""
        occupied = set(chain.from_iterable(self._paths.values()))
        for shard in self.watched:
            occupied |= self._views[shard].others
        return occupied

    def may_enter(self, vehicle: str, cell: int) -> bool:
        """Returns True if a vehicle may drive into a cell of its path now: those before it have left."""
        return cell in self.open(vehicle)[1:]

    def awaits(self, vehicle: str) -> Entry | None:
        """Returns the next entry of a vehicle while others are before it; None if it may enter, or has none."""
        for entry in self._entries.paths.get(vehicle, ())[1:2]:
            if not self._entries.may_enter(entry):
                return entry
        return None

    def is_followed(self, vehicle: str) -> bool:
        """Returns True if another vehicle waits for the cell of this one."""
        return any(entry.number in self._followed for entry in self._entries.paths[vehicle][:1])

    def open(self, vehicle: str) -> Sequence[int]:
        """Returns the cells of a vehicle's path before the first one that it may not enter yet."""
        path, entries = self.path(vehicle), self._entries.paths.get(vehicle, [])
        if not any(entry.after for entry in entries):
            return path
        return path[: 1 + sum(1 for _ in takewhile(self._entries.may_enter, entries[1:]))]

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
        generation of ours held that cell, the vehicle takes it over and releases its other cells. The newest call
        counts."""
        if vehicle not in self._paths:
            self._entries.enter(vehicle, cell)
            self.watch([self.shards.of(cell)])

    def leave(self, vehicle: str) -> None:
        """It stands nowhere any more: give back all that it holds."""
        self._entries.leave(vehicle)
        self._paths.pop(vehicle, None)
        statement = self._statements.pop(vehicle, None)
        for shard in () if statement is None else statement.shards:
            del self._views[shard].stands[vehicle]
            self._views[shard].same = False

    @property
    def gone(self) -> bool:
        """True if no vehicle of ours holds or requests a cell, and all leaders that we contacted know it."""
        return not (self.watched or self._entries.paths or self._entries.bodies)

    def is_granted(self, vehicle: str) -> bool:
        """Returns True if a table in use grants cells to a vehicle, which may have left them."""
        return any(vehicle in view.seen for view in self._views.values())

    def is_pending(self, shard: int) -> bool:
        """Returns True if a grant of a shard waits for words of its members."""
        return shard in self._views and bool(self._views[shard].pending)

    # --- what leaders say -----------------------------------------------------------------------------------

    def watch(self, shards: Iterable[int]) -> None:
        """Makes these shards concern us, if they are shards of the layer, until they are seen to hold nothing of
        ours."""
        for shard in filter(self.shards.all.__contains__, shards):
            self.watched.setdefault(shard)
            self._views.setdefault(shard, _View())

    def hear_granted(self, granted: Granted | Word, now_ns: int) -> list[str]:
        """Acts on a leader's grant, if it is newer than what we know, or on a member's word on one. Returns the
        vehicles that have found their place."""
        if not self.generation or granted.shard not in self.shards.all:
            return []
        if isinstance(granted, Word):
            return self._hear_word(granted)
        if granted.shard not in self.watched:
            return []
        view, knows = self._views[granted.shard], self._entries.knows.get(granted.shard, BEFORE_ALL)
        if granted.epoch > knows[0] + FURTHEST_EPOCH or granted.seq > _FURTHEST_SEQ:
            self.refused.append(f"{granted.agent} names a table that is implausibly far ahead: {granted.stamp}")
            return []
        if granted.agent != self.shards.leader(granted.shard, granted.epoch) or granted.stamp < knows:
            return []
        view.leader, view.heard_ns = granted.agent, now_ns
        # One to another generation says nothing but that: a replaced one lacks the base, and has to learn of it.
        whole = granted.whole(view.used) if granted.generation == self.generation else granted
        if whole is None:
            return []
        if not self.shards.proven:
            return self._take(view, whole)
        part = part_of(whole.generation, whole.grants, whole.waits)
        view.words[whole.agent] = whole.epoch, part
        view.pending[whole.agent] = whole, part
        return self._take_agreed(view)

    def _hear_word(self, word: Word) -> list[str]:
        """A member has something on file for us. Returns the vehicles that have found their place."""
        knows = self._entries.knows.get(word.shard, BEFORE_ALL)
        if word.agent not in self.shards.members(word.shard) or word.epoch > knows[0] + FURTHEST_EPOCH:
            return []
        view = self._views.setdefault(word.shard, _View())
        view.words[word.agent] = word.epoch, word.part
        if word.asks:
            self.watch([word.shard])
            # A table may give a vehicle that is nowhere an entry to begin with, of which the grant is on its way.
            entries = self._entries
            begun = entries.paths.keys() | entries.bodies.keys() | entries.away
            if begun.issuperset(self._vehicles or ()):
                entries.disclaim(word.shard, word.agent, (word.epoch, word.seq), word.lacks)
            view.same, view.news = False, None
        return self._take_agreed(view)

    def _take_agreed(self, view: _View) -> list[str]:
        """Acts on the grants that a majority has on file."""
        placed: list[str] = []
        for leader, (granted, part) in sorted(view.pending.items(), key=lambda each: each[1][0].stamp):
            if list(view.words.values()).count((granted.epoch, part)) >= self.shards.majority:
                del view.pending[leader]
                placed += self._take(view, granted)
        return placed

    def _take(self, view: _View, granted: Granted) -> list[str]:
        """Acts on a grant that counts."""
        knows = self._entries.knows.get(granted.shard, BEFORE_ALL)
        if granted.stamp < knows:
            return []
        self.newest = max(self.newest, granted.generation)
        if granted.generation > self.generation and not self.replaced:
            self.replaced = True
            self._restate_all()
        if granted.stamp == knows or granted.generation != self.generation or self.replaced:
            return []  # what it grants was granted to another generation
        if granted.epoch != knows[0]:
            view.sent.clear()  # another leader has none of these
        keep_last(view.used, granted.stamp, granted, TABLES_KEPT)
        view.heard, view.same = granted.heard, False
        view.pushed = {id: age for id, age in granted.pushed.items() if id in self._paths}
        view.others = frozenset(granted.occupied)
        view.followed = granted.followed
        self._pushed = None
        shard, seen, waits = granted.shard, view.seen, view.waits
        view.waits = granted.waits
        view.seen = {
            id: held
            for id, held in granted.grants.items()
            if (self._vehicles is None or id in self._vehicles)
            and (seen.get(id) == held or {*map(self._shard_of, held.cells)} == {shard})
        }
        other = {id for id in seen.keys() | view.seen if seen.get(id) != view.seen.get(id)}
        other |= {id for id in waits.keys() | view.waits if waits.get(id) != view.waits.get(id)}
        listed = {id: entries_of(view.seen.get(id, ()), view.waits.get(id, ())) for id in sorted(other)}
        changed = self._entries.hear_granted(shard, granted.stamp, granted.generation, listed)
        self._seen_anew |= other
        for vehicle in changed & self._paths.keys():
            self._set_path(vehicle)
        self._followed = {number for view in self._views.values() for number in chain(*view.followed.values())}
        cells = {number[0] for number in self._followed if granted.followed}
        here = view.seen.keys() & self._paths.keys()
        for vehicle in [id for id in here if not cells.isdisjoint(self._paths[id])]:
            far = [entry.number for entry in self._entries.paths[vehicle][self.keeps + 1 :]]
            if not self._followed.isdisjoint(far):
                self.give_back(vehicle, self.keeps + 1 + [number in self._followed for number in far].index(True))
        return self._place()

    def hear_left(self, left: Left) -> list[str]:
        """Another host says what its vehicles have left. Returns the vehicles that have found their place."""
        if left.host != self.name or not self.generation or self.replaced:
            return []
        self._entries.hear_left(left.agent, left.entries)
        return self._place()

    def _place(self) -> list[str]:
        """Puts vehicles that are nowhere on the first cell of their paths, where they may."""
        entries = self._entries
        placed = [vehicle for vehicle in entries.paths if vehicle not in self._paths and entries.place(vehicle)]
        for vehicle in placed:
            entries.bodies.pop(vehicle, None)
            self._set_path(vehicle)
        return placed

    # --- what to say ----------------------------------------------------------------------------------------

    def host_states(self, requests: Mapping[str, CellRequest], now_ns: int) -> list[SendState]:
        """Returns the statements for each shard that concerns us, if they are new or the last one is a heartbeat
        old. Cells that a statement omits are released."""
        if not self.generation:
            return []
        self._seq += 1
        self._restate_changed(requests)
        concerned = {**self.watched, **{shard: None for shard, view in self._views.items() if view.stands}}
        by_shard = {shard: {**self._views[shard].stands} for shard in concerned}
        entries = self._entries
        for vehicle, cell in entries.bodies.items():
            if vehicle not in entries.paths:
                self._add_entering(
                    by_shard, self.shards.of(cell), Stand(vehicle, cell, cell, Held(), [cell], [], 0, 0)
                )
        for vehicle, path in entries.paths.items():
            if vehicle not in self._paths:
                cell, end = path[0].cell, path[-1].cell
                for shard, held in entries.of(vehicle).items():
                    self._add_entering(by_shard, shard, Stand(vehicle, cell, end, Held.of(held), [], [cell], 1, 0))
        self._forget_left(by_shard)
        return [
            self._host_state(shard, [stand for stand, _ in stands.values()], now_ns)
            for shard, stands in by_shard.items()
            if self._is_news(shard, stands, now_ns)
        ]

    def _add_entering(self, by_shard: dict[int, dict[str, _StandNews]], shard: int, stand: Stand) -> None:
        """Adds a vehicle which is in no cell yet to the statements for a shard."""
        by_shard.setdefault(shard, {})[stand.vehicle] = stand, stand
        self._views.setdefault(shard, _View()).same = False

    def lefts(self, now_ns: int) -> list[Left]:
        """Returns the `Left` messages for which vehicles of other hosts wait, if they are new or a heartbeat old. A
        replaced generation says none."""
        words: dict[str, list[Number]] = {}
        for shard, view in () if self.replaced else self._views.items():
            over = self._entries.over.get(shard, set())
            for host, numbers in view.followed.items():
                if host == self.name:
                    continue
                sent, sent_ns = view.left.get(host, (None, 0))
                left = [number for number in numbers if number in over]
                if left and not was_just_sent(left, sent, now_ns - sent_ns):
                    view.left[host] = left, now_ns
                    words.setdefault(host, []).extend(left)
        return [Left(agent=self.name, host=host, entries=numbers) for host, numbers in words.items()]

    def _restate_changed(self, requests: Mapping[str, CellRequest]) -> None:
        """Renews the statement about each placed vehicle whose path, request or granted cells have changed."""
        anew, self._seen_anew = self._seen_anew, set()
        for vehicle, path in self._paths.items():
            before, request = self._statements.get(vehicle), requests.get(vehicle, _NO_REQUEST)
            if (
                before is None
                or before.request is not request
                or not (before.path is path or self._is_no_news(before, path))
                or vehicle in anew
            ):
                statement = self._statements[vehicle] = self._state_vehicle(vehicle, path, request)
                before_at = set[int]() if before is None else before.shards
                if before_at != statement.shards:
                    self._restate_all()
                for shard in before_at - statement.shards:
                    del self._views[shard].stands[vehicle]

    def _is_no_news(self, statement: _Statement, path: list[int]) -> bool:
        """Returns True if a vehicle has only driven on, out of cells for which none waits, and has as many ahead as
        it keeps."""
        left = len(statement.path) - len(path)
        drove = left > 0 and len(path) > self.keeps and statement.path[left:] == path
        return drove and self._followed.isdisjoint(statement.held[:left])

    def _restate_all(self) -> None:
        """Statements of all shards may change."""
        for view in self._views.values():
            view.same = False

    def _host_state(self, shard: int, stands: list[Stand], now_ns: int) -> SendState:
        """Returns the statement about these, for one leader as changes since one that it has."""
        view, members = self._views[shard], self._listeners(shard, now_ns)
        state = HostState(
            shard=shard,
            agent=self.name,
            generation=self.generation,
            seq=self._seq,
            knows=self._entries.knows.get(shard, BEFORE_ALL),
            vehicles=stands,
            dead=self._dead,
            ended=self.replaced,
            never=sorted(self._entries.never(shard)),
        )
        base = view.sent.get(view.heard) if members == (view.leader,) else None
        if self.shards.reads_changes(self.name):
            keep_last(view.sent, self._seq, state, STATES_KEPT)
        return SendState(members, state if base is None else state.changes(base))

    def _listeners(self, shard: int, now_ns: int) -> tuple[str, ...]:
        view = self._views[shard]
        if not self.shards.proven and view.leader and 0 <= now_ns - view.heard_ns < _UNHEARD_NS:
            return (view.leader,)
        return self.shards.members(shard)

    def _is_news(self, shard: int, stands: Mapping[str, _StandNews], now_ns: int) -> bool:
        view = self._views[shard]
        lately = 0 <= now_ns - view.sent_ns < HEARTBEAT_NS
        if not view.same:
            # An entry that we do not hold is freed only if we state so, knowing that table.
            in_step = view.seen == {id: stand.holds for id, (stand, _) in stands.items() if stand.holds}
            stamp = self._entries.knows.get(shard, BEFORE_ALL)
            knows = stamp[0] if in_step else stamp
            news = (self.replaced, knows, [each for _, each in stands.values()])
            lately = lately and news == view.news
            view.news, view.same = news, True
        if lately:
            return False
        view.sent_ns = now_ns
        return True

    def _state_vehicle(self, vehicle: str, path: list[int], request: CellRequest) -> _Statement:
        """States a vehicle to each shard that it is near."""
        ahead, wants, better = [*request.ahead], list[int](), 0
        if len(path) == 1:
            wants, better = [*request.wants], request.better
        shard_of = self._shard_of
        concerned = [*path, *ahead[:1], *wants]
        near: Set[int] = {*map(shard_of, concerned)}
        if len(near) > 1:
            near = dict.fromkeys(shard for shard in map(shard_of, concerned) if shard >= 0).keys()
        held = [entry.number for entry in self._entries.paths[vehicle]]
        for shard in near:
            holds = Held.of(held if len(near) == 1 else [each for each in held if shard_of(each[0]) == shard])
            stand = Stand(vehicle, path[0], path[-1], holds, ahead, wants, better, request.age_ms, self.keeps)
            view = self._views.setdefault(shard, _View())
            view.same = False
            view.stands[vehicle] = stand, (vehicle, path[0], holds, ahead, better)
        return _Statement(request, path, held, near)

    def _forget_left(self, by_shard: Mapping[int, Mapping[str, _StandNews]]) -> None:
        """Leaves the shards where we hold and want nothing, once their tables show that they know it."""
        for shard, stands in by_shard.items():
            view = self._views.setdefault(shard, _View())
            if stands:
                view.quiet = None
            elif view.quiet is None:
                view.quiet = self._seq
        self.watched = {
            shard: None
            for shard in by_shard
            if (quiet := self._views[shard].quiet) is None
            or self._views[shard].heard < quiet
            or self._views[shard].seen
        }
