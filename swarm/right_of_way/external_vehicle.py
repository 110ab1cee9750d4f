"""External vehicles in right of way: how such an external vehicle enters and reserves cells, and how an operator
removes it (docs/design/external-vehicles.md)."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

from swarm.clock import NS_PER_S
from swarm.right_of_way.holdings import MOST_AHEAD, CellRequest, SendState
from swarm.right_of_way.host import GENERATIONS_KEPT, AskKnown, Host
from swarm.right_of_way.shards import Shards
from swarm.wire.fields import MOST_IDS
from swarm.wire.messages.traffic import Known, Left

_QUERIES_ALONE = 5
"""Queries that only one agent answers before it is believed: another that runs answers one within seconds."""
_PATIENCE_NS = 3 * NS_PER_S
"""For this time it waits behind others that do not go on; then it gives its place behind them back."""
_OLDEST_MS = 1 << 31
"""Greatest age that is sent: half of the message's range, so that a push may still add to it."""


class Answers:
    """Agents' answers about a run which an external vehicle does not know: they name the agents and the side of
    shards.

    proven  certificates prove names: then one may lie, and counts only with a second that says the same, or if no
            other has answered several queries
    """

    def __init__(self, *, proven: bool) -> None:
        self._proven = proven
        self._known: dict[str, Known] = {}
        self._queries = 0

    def hear(self, known: Known) -> list[Known]:
        """Takes an answer. Returns those that count now: they agree, by the largest shards of which enough tell, as
        an agent does so only if this is so for the whole run."""
        if known.agent in known.agents and (known.agent in self._known or len(self._known) < MOST_IDS):
            self._known[known.agent] = known
        return self.agreed

    def end_query(self) -> list[Known]:
        """Notes that all replies to one query have arrived. Returns the replies that count."""
        self._queries += 1
        return self.agreed

    @property
    def agreed(self) -> list[Known]:
        by_run = defaultdict[tuple[int, tuple[str, ...]], list[Known]](list)
        for known in self._known.values():
            by_run[known.shard_cells, tuple(known.agents)].append(known)
        is_alone = len(self._known) == 1 and self._queries >= _QUERIES_ALONE
        enough = 2 if self._proven and not is_alone else 1
        return max(
            (of for of in by_run.values() if len(of) >= enough), key=lambda of: of[0].shard_cells, default=[]
        )


ExternalAction = AskKnown | SendState | Left


_ASIDE = 0.25
"""Sides of a cell by which a vehicle may be off the line of a diagonal step. It is then at least 0.45 of them from
the middles of the cells beside the step. Chosen, not measured."""


class ExternalVehicle:
    """One vehicle that speaks for itself. It has no seat among members; else it is a host as any other.

    Nothing is said before `enter`: what a new generation leaves out is given back, so it must not speak before it
    knows where its vehicle stands.

    name         of the external vehicle; its vehicle is called `name-00`
    generations  of it that are on the file which this process has locked: they have ended

    host              its part in right of way, which hears messages. If that is replaced, another process speaks
                      for the vehicle: it stands where it stands, and must not move
    needs_generation  whether it wants to enter and waits for `begin`
    """

    def __init__(self, shards: Shards, name: str, generations: Sequence[int] = ()) -> None:
        self.vehicle = f"{name}-00"
        self.host = Host(shards, name, [self.vehicle])
        self._generations = list(generations)
        self._cell: int | None = None
        """Its cell, or the one that it would enter; None while it is away."""
        self._path: tuple[int, ...] = ()
        self._aside: tuple[int, ...] = ()
        self._request = CellRequest()
        self._since_ns: int | None = None
        """Since when it has wanted to go somewhere; None while it does not."""
        self._waits_ns: tuple[int, int] | None = None
        """The cell behind others before which it waits, and since when."""

    # --- what its driver says -------------------------------------------------------------------------------

    @property
    def cells(self) -> tuple[int, ...]:
        """The cells that it may stand on and enter, in driving order, its own first."""
        return () if self.host.replaced else tuple(self.host.open(self.vehicle))

    def counted(self, cell: int, x_m: float, y_m: float) -> int:
        """The cell in which it counts at a place in `cell`. The line of a diagonal step passes a corner of two more
        cells: within `_ASIDE` of that line it is still in the cell that it leaves."""
        grid = self.host.shards.grid
        for tail, head in pairwise(self.cells) if cell not in self.cells else ():
            (x0_m, y0_m), (x1_m, y1_m) = grid.centre_m(tail), grid.centre_m(head)
            east_m, south_m = x1_m - x0_m, y1_m - y0_m
            step_m = math.hypot(east_m, south_m)
            along_m = ((x_m - x0_m) * east_m + (y_m - y0_m) * south_m) / step_m
            aside_m = abs((x_m - x0_m) * south_m - (y_m - y0_m) * east_m) / step_m
            if 0.0 <= along_m <= step_m and aside_m <= _ASIDE * grid.resolution_m:
                return tail
        return cell

    @property
    def gone(self) -> bool:
        """True if it holds and requests nothing, and every leader that it contacted knows."""
        return self._cell is None and (not self.host.generation or self.host.gone)

    @property
    def needs_generation(self) -> bool:
        return self._cell is not None and not self.host.generation

    def enter(self, cell: int) -> None:
        """Asks for the cell on which it stands, or wants to begin. Raises ValueError where it has one already, or
        there is none."""
        if self.cells:
            raise ValueError(f"it holds cell {self.cells[0]}: leave before it enters elsewhere")
        if self.host.shards.of(cell) < 0:
            raise ValueError(f"cell {cell} is outside the map of {self.host.shards.grid.cells} cells")
        self._cell = cell
        if self.host.generation and not self.host.replaced:
            self.host.enter(self.vehicle, cell)

    def want(self, path: Sequence[int], aside: Sequence[int] = ()) -> None:
        """States where it would go. Cells that it holds and that are not the beginning of this path are given back.

        path   cells, each next to the one before: the one on which it stands, then where it drives
        aside  neighbours to which it would also go, to let others pass, if it stands

        Raises ValueError if the path does not begin where it stands, or leaps, or it has not entered.
        """
        held = () if self.host.replaced else self.host.path(self.vehicle)
        if not held or not path or path[0] != held[0]:
            where = f"cell {held[0]}" if held else "no cell"
            raise ValueError(f"the path must begin at the vehicle's cell: it holds {where}")
        for tail, head in pairwise(path):
            if self.host.shards.of(head) < 0 or not self.host.shards.adjacent(tail, head):
                raise ValueError(f"cell {head} of the path is not next to cell {tail}")
        same = next(
            (n for n, (a, b) in enumerate(zip(held, path, strict=False)) if a != b), min(len(held), len(path))
        )
        if same < len(held):
            self.host.give_back(self.vehicle, same)
        self._path = tuple(path)
        self._aside = tuple(cell for cell in aside if self.host.shards.adjacent(held[0], cell))

    def left(self, cell: int) -> None:
        """It has driven out of a cell, into the next that it holds. Raises ValueError if it holds none after it."""
        held = self.cells
        if cell not in held[:-1]:
            raise ValueError(f"it cannot have left cell {cell}: it holds {list(held)}")
        self.host.moved(self.vehicle, held[held.index(cell) + 1])
        self._cell = self.cells[0]

    def leave(self) -> None:
        """It stands nowhere any more: its cells are free for others once leaders have heard."""
        self._cell = None
        self._path = self._aside = ()
        self.host.leave(self.vehicle)

    # --- messages -------------------------------------------------------------------------------------------

    @property
    def settled(self) -> bool:
        """True if no recovery query is pending."""
        return not self.needs_generation and self.host.informed

    def begin(self, chance: int) -> list[int]:
        """Begins a generation if one is needed, once all agents that could be asked have answered. Returns the
        generations to put on file before anything is said; empty if none has begun.

        chance  a random number
        """
        if not self.needs_generation:
            return []
        assert self._cell is not None
        self._generations = self.host.begin(self._generations, chance)
        self.host.enter(self.vehicle, self._cell)
        return self._generations

    def tick(self, now_ns: int) -> list[ExternalAction]:
        """Returns the messages to send in this tick."""
        if self.host.replaced:
            # Not that it has ended, as a host would: its vehicle still stands there.
            return [AskKnown()] if self.host.ended_alone(now_ns) and self._cell is not None else []
        self._wait(now_ns)
        host_states = self.host.host_states({self.vehicle: self._request_now(now_ns)}, now_ns)
        return [*self.host.lefts(now_ns), *host_states]

    def _wait(self, now_ns: int) -> None:
        """Gives back what it waits for in vain, so that no circle of waiting lasts."""
        held, free = self.host.path(self.vehicle), len(self.cells)
        before, self._waits_ns = self._waits_ns, None
        if len(held) > free:
            cell, since_ns = before if before and before[0] == held[free] else (held[free], now_ns)
            if now_ns - since_ns > _PATIENCE_NS:
                self.host.give_back(self.vehicle, free)
            else:
                self._waits_ns = cell, since_ns

    def _request_now(self, now_ns: int) -> CellRequest:
        held, path = self.host.path(self.vehicle), self._path
        after = path.index(held[-1]) + 1 if held and held[-1] in path else len(path)
        ahead = list(path[after : after + max(MOST_AHEAD + 1 - len(held), 0)])
        self._since_ns = (self._since_ns or now_ns) if ahead else None
        wants = list(dict.fromkeys((*ahead[:1], *self._aside))) if len(held) == 1 else []
        pushed = self.host.pushed.get(self.vehicle, 0)
        better = len(wants) if pushed else len(ahead[:1]) if wants else 0
        # In whole seconds, so that a request is the same object while nothing happens.
        age_s = (now_ns - self._since_ns) // NS_PER_S if self._since_ns is not None else 0
        request = CellRequest(ahead, wants[:8], min(better, 8), max(min(age_s * 1000, _OLDEST_MS), pushed))
        if request != self._request:
            self._request = request
        return self._request


class Removal:
    """An operator's removal of an external vehicle: neither it nor any process that represented it is in a cell any
    more.

    It is a new generation of the external vehicle, which proves by the operator's word that all before it have
    ended, and holds nothing. A process that still speaks for the external vehicle stops as soon as it hears of it.

    host  hears messages; if it is replaced, the external vehicle has begun a later generation meanwhile
    """

    def __init__(self, shards: Shards, name: str) -> None:
        self.host = Host(shards, name, None)
        self._generations: set[int] = set()

    @property
    def known(self) -> bool:
        """True if any reply knew this external vehicle."""
        return bool(self._generations)

    @property
    def done(self) -> bool:
        """True if every leader that had cells of the external vehicle has freed them."""
        return self.host.generation > 0 and self.host.gone and self.host.informed

    def hear_known(self, known: Known) -> None:
        self._generations.update(known.generations)
        self.host.hear_known(known)

    def begin(self, chance: int) -> None:
        """Once all agents that could be asked have answered."""
        generations = self.host.begin(sorted(self._generations)[1 - GENERATIONS_KEPT :], chance)
        self.host.begin_as(self.host.generation, generations)  # which has ended, too: no vehicle drives by it

    def tick(self, now_ns: int) -> list[SendState]:
        return [] if self.host.replaced else self.host.host_states({}, now_ns)
