"""The warden of a plot: it grants cells to vehicles, and frees them only by their host's own word.

No cell is in two vehicles' grants; a grant is never revoked. The vehicle with a table that a majority has stored is
therefore alone on its cells (see docs/design/right-of-way.md for the proof).
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain
from zlib import crc32

from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of
from swarm.right_of_way.incarnations import BEAT_NS, is_far_ahead
from swarm.right_of_way.lock_regions import Plots
from swarm.wire.messages.traffic import Granted, Shut, Stamp, Stand, Standing, Table
from vehicle_agent.traffic.grants import Grants, cells_beside
from vehicle_agent.traffic.pibt import Mover, Round

SILENT_NS = NS_PER_S
"""Vehicles of a host that is silent for this time are obstacles: no vehicle waits for them or pushes them."""
_AGE_BITS = 12
"""Ages are compared in steps of 4 s: two wardens hear the same two at different times, and have to agree which is
the older most of the time, or each lets its own wait for the other (docs/design/right-of-way.md)."""
_TOLD_AGAIN_NS = 3 * BEAT_NS // 4
"""Interval at which an unchanged grant is repeated: somewhat less than a beat, so that a beat carries it."""
MOST_GUESTS = 256
"""Guests that one plot has ever known: their lives stay in its table, as those of all hosts
(docs/design/external-vehicles.md)."""
MOST_CELLS_OF_GUEST = 1024
"""Cells of one plot that one guest holds (docs/design/external-vehicles.md)."""
MOST_CELLS_OF_GUESTS = 1 << 14
"""Cells of one plot that all guests together hold: a quarter of one as large as a region
(docs/design/external-vehicles.md)."""
_NO_CELLS: Sequence[int] = []
_NO_GRANTS: Mapping[str, list[int]] = {}
_MOST_CELLS = 64
"""Limit for one vehicle: the largest `Grant`."""


def _turn(stand: Stand) -> tuple[int, int, str]:
    """Returns the priority: the older first; of one age, another one in each step of it. By name, those of the last
    agent would always give way where many are of one age, as all are who began the run together."""
    step = stand.age_ms >> _AGE_BITS
    return -step, _lot(stand.vehicle, step), stand.vehicle


def _is_entering(stand: Stand) -> bool:
    """Returns True if the vehicle holds no cell and requests its first."""
    return not stand.holds and stand.ahead[:1] == [stand.cell]


@lru_cache(maxsize=1 << 14)
def _lot(vehicle: str, step: int) -> int:
    return crc32(f"{vehicle}/{step}".encode())


def _rests(stand: Stand, cells: Sequence[int]) -> bool:
    """Returns True if a vehicle is at rest, with nothing granted to it but its cell."""
    return stand.cell == stand.end and (not cells or cells == [stand.cell])


@dataclass(slots=True)
class _Host:
    """Known state of a host.

    standing  the newest of its newest life, and when it came; None if none counts
    stands    of that, vehicle -> its stand, for vehicles that the host may speak for
    asking    those of them that are at rest, or request more than they are granted; other vehicles under way
              request nothing now
    spoke_ns  time of the last message, of any of its lives: a replaced one is informed
    told      the last grant to it, and its time
    """

    spoke_ns: int
    standing: Standing | None = None
    stands: dict[str, Stand] = field(default_factory=dict)
    asking: Sequence[Stand] = ()
    heard_ns: int = 0
    told: object = None
    told_ns: int = 0


class Warden:
    """Holds one plot's table in one epoch. Every `tick` may make a new one, which counts once a majority stored it.

    fleets  agent -> its vehicles, all of the scenario's. Any other host is a guest
    (docs/design/external-vehicles.md): its vehicles are
            those that bear its name
    """

    def __init__(
        self, plots: Plots, me: str, epoch: int, table: Table, fleets: Mapping[str, Collection[str]]
    ) -> None:
        self.epoch = epoch
        self.seq = 0
        self.refused: list[str] = []
        self._plots = plots
        self._plot = table.plot
        self._me = me
        self._fleets = fleets
        self._lives = dict(table.hosts)  # agent -> (life, seq) of the newest standing that counts
        self._grants = Grants(table.grants)
        self._shut = {(each.agent, each.life): list(each.cells) for each in table.shut}
        self._hosts: dict[str, _Host] = {}
        self._pushed: dict[str, int] = {}
        self._before: dict[str, Sequence[int]] = {}
        """Vehicle -> what it was granted before the plan that is being made has granted it more."""
        self._granted = True  # since the last table: something that a host waits for
        self._changed = False  # or anything else
        self._told: Table | None = None
        self._told_ns = 0
        self._said_of: Table | None = None
        self._said_ns = 0

    @property
    def _next_stamp(self) -> Stamp:
        return self.epoch, self.seq + 1

    # --- what hosts say -------------------------------------------------------------------------------------

    def take_standing(self, standing: Standing, now_ns: int) -> None:
        host = standing.agent
        if not self._is_welcome(host):
            self.refused.append(f"plot {self._plot} has known {MOST_GUESTS} guests: {host} cannot enter")
            return
        known = self._hosts.setdefault(host, _Host(now_ns))
        known.spoke_ns = now_ns
        life, seq = self._lives.get(host, (0, 0))
        if standing.ended:
            self._open(standing)
            self._ended(host, standing.life, life)
            return
        if (standing.life, standing.seq) <= (life, seq):
            return
        if is_far_ahead(standing.life, life):
            self.refused.append(f"{host} names a life that is implausibly far ahead: {standing.life}")
            return
        if standing.life != life:
            self._succeed(host, life)
        self._lives[host] = (standing.life, standing.seq)
        if not standing.vehicles and (known.standing is None or known.standing.vehicles):
            self._changed = True  # it leaves the plot as soon as a table counts this
        stands = self._stands_of(standing)
        for vehicle, cells in list(self._grants.by_host.get(host, _NO_GRANTS).items()):
            stand = stands.get(vehicle)
            if stand is None or stand.holds != cells:
                self._free(vehicle, _NO_CELLS if stand is None else stand.holds, standing.knows)
        known.standing, known.stands, known.heard_ns = standing, stands, now_ns
        known.asking = [stand for stand in stands.values() if stand.ahead or stand.cell == stand.end]
        # Only now: a life that is itself replaced and has not stopped must not open what a vehicle may stand on.
        self._enter_again(standing, self._open(standing))
        if standing.life in standing.dead:
            self._shut[host, standing.life] = []  # no host has acted on it: no need to wait

    def _open(self, standing: Standing) -> set[int]:
        """Opens cells that are shut for lives that are proved to have ended. Returns the cells."""
        opened: set[int] = set()
        for dead in standing.dead:
            cells = self._shut.pop((standing.agent, dead), None)
            if cells is not None:
                opened.update(cells)
                self._granted = self._granted or dead != standing.life
        return opened

    def _enter_again(self, standing: Standing, opened: set[int]) -> None:
        """A guest that stands on a cell which was shut for an earlier life of it gets it before all others."""
        if not opened:
            return
        opened.difference_update(cell for grant in self._grants.of.values() for cell in grant.cells)
        for (host, _), cells in self._shut.items():
            if host != standing.agent:
                opened.difference_update(cells)
        for stand in standing.vehicles:
            before = self._grants.cells_of(stand.vehicle)
            ours = self._is_of(stand.vehicle, standing.agent)
            if ours and _is_entering(stand) and stand.cell in opened and len(before) < _MOST_CELLS:
                self._grants.set(stand.vehicle, [*before, stand.cell], self._next_stamp)
                self._granted = True

    def _is_welcome(self, host: str) -> bool:
        """Returns True if there is room for this host: for each of the scenario, and for a number of guests."""
        if host in self._fleets or host in self._lives or host in self._hosts:
            return True
        known = self._lives.keys() | self._hosts.keys()
        return len(known - self._fleets.keys()) < MOST_GUESTS

    def _is_of(self, vehicle: str, host: str) -> bool:
        """Returns True if the host may speak for a vehicle."""
        return vehicle in self._fleets[host] if host in self._fleets else agent_of(vehicle) == host

    def _stands_of(self, standing: Standing) -> dict[str, Stand]:
        """Returns vehicle -> its stand, for vehicles that the host may speak for."""
        fleet = self._fleets.get(standing.agent)
        if fleet is None:
            return {each.vehicle: each for each in standing.vehicles if agent_of(each.vehicle) == standing.agent}
        return {each.vehicle: each for each in standing.vehicles if each.vehicle in fleet}

    def _granted_to(self, host: str) -> list[str]:
        """The vehicles of a host that are granted cells."""
        vehicles = self._fleets[host] if host in self._fleets else self._grants.by_host.get(host, ())
        return [vehicle for vehicle in vehicles if vehicle in self._grants.of]

    def _ended(self, host: str, ended: int, life: int) -> None:
        """A life's own word that it drives no more."""
        if (host, ended) in self._shut:
            self._granted = self._granted or bool(self._shut[host, ended])
            if ended == life:
                return
            del self._shut[host, ended]
        elif ended == life:
            self._shut[host, ended] = []  # its successor need not wait for it
            self._granted = True

    def _succeed(self, host: str, before: int) -> None:
        """A new life of a host speaks. Cells granted to the life before it stay shut until that is known to have
        ended; the new one is granted the same cells, and has to see that before it can release any."""
        mine = self._granted_to(host)
        if (host, before) in self._shut:
            del self._shut[host, before]
        elif before and mine:
            self._shut[host, before] = [cell for vehicle in mine for cell in self._grants.cells_of(vehicle)]
        for vehicle in mine:
            self._grants.set(vehicle, self._grants.of[vehicle].cells, self._next_stamp)
        self._hosts[host].standing = self._hosts[host].told = None
        self._granted = True

    def _free(self, vehicle: str, holds: Sequence[int], knows: Stamp) -> None:
        """Drops what a vehicle has left behind; if its host knew of the last grant, all that it does not hold."""
        cells, stamp = self._grants.of[vehicle].cells, self._grants.of[vehicle].stamp
        if knows >= stamp:
            kept = [cell for cell in cells if cell in holds]
        elif holds and holds[0] in cells:
            kept = cells[cells.index(holds[0]) :]
        else:
            return
        if len(kept) < len(cells):
            self._changed = True
            self._grants.set(vehicle, kept, stamp)

    # --- what is granted ------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> Table | None:
        """Grants all possible requests. Returns the table if a host waits for a change in it, or once in a beat:
        the same as before if it is unchanged."""
        self._plan(now_ns)
        if not self._granted and now_ns - self._told_ns < BEAT_NS:
            return None
        if self._told is None or self._granted or self._changed:
            self.seq += 1
            self._told = self._table()
        self._changed = self._granted = False
        self._told_ns = now_ns
        return self._told

    def _table(self) -> Table:
        return Table(
            plot=self._plot,
            agent=self._me,
            epoch=self.epoch,
            seq=self.seq,
            hosts=dict(self._lives),
            grants=dict(self._grants.of),
            shut=[Shut(host, life, list(cells)) for (host, life), cells in self._shut.items()],
            pushed=dict(self._pushed),
        )

    def granted(self, table: Table, now_ns: int) -> Iterator[Granted]:
        """Returns the table's content for each host that has spoken lately, if it is new or the last message is a
        beat old."""
        if table is self._said_of and 0 <= now_ns - self._said_ns < _TOLD_AGAIN_NS:
            return
        self._said_of, self._said_ns = table, now_ns
        current = table is self._told and not (self._granted or self._changed)
        grants_of = self._grants if current else Grants(table.grants)
        shut = {cell for shut in table.shut for cell in shut.cells}
        held, cols = shut.union(*grants_of.cells.values()), self._plots.grid.cols
        for name, host in self._hosts.items():
            if now_ns - host.spoke_ns > SILENT_NS:
                continue
            life, heard = table.hosts.get(name, (0, 0))
            grants = dict(grants_of.by_host.get(name, _NO_GRANTS))
            # Also around those under way: their requests once they come to rest depend on the cells around.
            stands = () if host.standing is None else host.standing.vehicles
            others = held.difference(grants_of.cells.get(name, ())) | shut
            near = [around for stand in stands if not others.isdisjoint(around := cells_beside(stand.end, cols))]
            occupied = sorted(others.intersection(chain.from_iterable(near)))
            pushed = {vehicle: age for vehicle, age in table.pushed.items() if vehicle in grants}
            says = (life, grants, pushed, occupied, 0 if stands else heard)
            if says == host.told and 0 <= now_ns - host.told_ns < _TOLD_AGAIN_NS:
                continue
            host.told, host.told_ns = says, now_ns
            yield Granted(
                plot=table.plot,
                host=name,
                agent=table.agent,
                epoch=table.epoch,
                seq=table.seq,
                life=life,
                heard=heard,
                grants=grants,
                pushed=pushed,
                occupied=occupied,
            )

    def _plan(self, now_ns: int) -> None:
        hosts = [
            host
            for host in self._hosts.values()
            if host.standing is not None and now_ns - host.heard_ns <= SILENT_NS
        ]
        # The vehicle that has been on its way for longest goes first.
        asking = sorted(chain.from_iterable([host.asking for host in hosts]), key=_turn)
        shut = {cell for cells in self._shut.values() for cell in cells}
        held = ChainMap(self._grants.holders, dict.fromkeys(shut, ""))
        self._before.clear()
        movers: dict[str, Mover] = {}
        for stand in asking:
            cells = self._grants.cells_of(stand.vehicle)
            if not cells and _is_entering(stand):
                continue  # no vehicle makes way for it
            if _rests(stand, cells):
                movers[stand.vehicle] = Mover(
                    stand.vehicle, stand.cell, stand.wants, stand.better, stand.age_ms, outside=not cells
                )
        stands: Mapping[str, Stand] = ChainMap(*[host.stands for host in hosts])
        round = Round(
            list(movers.values()),
            lambda cell: cell in shut or self._stays(cell, stands),
            lambda cell: self._plots.of(cell) == self._plot,
        )
        for stand in asking:
            mover = movers.get(stand.vehicle)
            if mover is not None:
                round.plan(mover)
            elif stand.ahead:
                self._grant(stand, self._next_ahead(stand), held, round.taken)
        for stand in asking:
            to = round.to.get(stand.vehicle)
            if to is not None and to != stand.cell:
                ahead = stand.ahead if stand.ahead[:1] == [to] else [to]
                self._grant(stand, ahead, held, round.taken)
        if round.pushed != self._pushed:
            self._pushed = round.pushed
            self._granted = True

    def _stays(self, cell: int, stands: Mapping[str, Stand]) -> bool:
        """Returns True if a cell stays occupied under any plan. A vehicle may wait for a cell that another under
        way will leave; one at rest can be pushed.

        stands  vehicle -> its stand, by the hosts that have spoken lately
        """
        vehicle = self._grants.holders.get(cell)
        if vehicle is None:
            return False
        stand = stands.get(vehicle)
        if stand is None:
            return True
        cells = self._before.get(vehicle) or self._grants.cells_of(vehicle)
        return cell == cells[-1] and stand.end in cells and not _rests(stand, cells)

    def _next_ahead(self, stand: Stand) -> Sequence[int]:
        """The cells ahead of one that is under way, from where all that it has been granted ends."""
        cells = self._grants.cells_of(stand.vehicle)
        if not cells or cells[-1] == stand.end or stand.end not in cells:
            return stand.ahead if not cells or stand.end in cells else []
        last = cells[-1]
        return stand.ahead[stand.ahead.index(last) + 1 :] if last in stand.ahead else []

    def _grant(self, stand: Stand, ahead: Sequence[int], held: Container[int], taken: dict[int, str]) -> None:
        """Append free cells, up to the first that is not."""
        for cell in ahead:
            mine = taken.setdefault(cell, stand.vehicle) == stand.vehicle
            if not mine or cell in held or self._plots.of(cell) != self._plot:
                return
            cells = self._grants.cells_of(stand.vehicle)
            if len(cells) >= _MOST_CELLS or not self._guest_may_hold_more(stand.vehicle):
                return
            self._before.setdefault(stand.vehicle, cells)
            self._grants.set(stand.vehicle, [*cells, cell], self._next_stamp)
            self._granted = True

    def _guest_may_hold_more(self, vehicle: str) -> bool:
        """Returns True if neither this guest nor all together hold their share; true of vehicles of the
        scenario."""
        host = agent_of(vehicle)
        if host in self._fleets:
            return True
        held, fleets = self._grants.by_host, self._fleets
        if sum(map(len, held.get(host, _NO_GRANTS).values())) >= MOST_CELLS_OF_GUEST:
            return False
        together = sum(sum(map(len, cells.values())) for guest, cells in held.items() if guest not in fleets)
        return together < MOST_CELLS_OF_GUESTS
