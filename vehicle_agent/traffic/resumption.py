"""How an agent starts: it learns where all vehicles stand, and only then places its own.

An agent that starts may continue the life of one that died. The vehicles of the dead one stand where it left
them, and all others keep these cells closed. So the newcomer asks all agents for their reservations and for the
newest that they have heard of every agent that is silent, its own earlier incarnation among them, until each live
agent has answered.

An answer is recognised by its author and incarnation, so reservations of a live agent that another relays count
as its answer, too. Reservations of live agents are relayed only where two agents disagree about who is alive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Reservations
from vehicle_agent.traffic.right_of_way import RightOfWay, stamp_of

_SETTLE_NS = NS_PER_S // 5
"""Delay before the first question. The others learn of the newcomer in this time; from then on they wait for its
echo before they enter any cell."""
_ASK_AGAIN_NS = NS_PER_S // 10
_ASK_AGAIN_AT_LAST_NS = NS_PER_S
"""The delay doubles with each try, up to this: when many agents start on one slow machine, each asks all others."""
_FIRST_START_NS = 5 * NS_PER_S
_ALONE_NS = 30 * NS_PER_S
"""An agent that starts later in a run than `_FIRST_START_NS` and sees no other is more likely cut off than alone:
its vehicles may not stand where they first started. It waits so long for others."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the vehicles of an agent stand when it starts to drive them.

    cells         vehicle -> its cell, on which no other vehicle can be
    unplaced      vehicle -> the cell near which it should stand; it takes the nearest free cell (`Unplaced`)
    reservations  the newest known of every agent, those of our earlier incarnation last
    resumed       whether an earlier incarnation of ours is known
    """

    cells: Mapping[str, int]
    unplaced: Mapping[str, int]
    reservations: tuple[Reservations, ...]
    resumed: bool


class Resumption:
    """Decides when a starting agent asks, when it has heard enough, and where its vehicles are placed.

    agent          our id
    spawns         agent -> vehicle -> cell, of the whole run: where vehicles stand when an agent first starts
    cells          number of cells in the grid
    since_run_ns   how long after the start of the run this process started
    """

    def __init__(
        self, agent: str, spawns: Mapping[str, Mapping[str, int]], cells: int, since_run_ns: int = 0
    ) -> None:
        self._agent = agent
        self._spawns = spawns
        self._cells = cells
        self._expects_others = since_run_ns > _FIRST_START_NS and len(spawns) > 1
        self._alone_ns = 0
        self._ask_due_ns: int | None = None
        """When to ask; None while a question is open."""
        self._tries = 0
        self._newest: dict[str, Reservations] = {}
        """The newest reservations of each agent, whoever told them; never those with seq 0, which tell nothing."""
        self._answered: dict[str, Reservations] = {}
        """The newest reservations of each agent that came as its own answer or in the answer of another."""

    # --- when to ask ----------------------------------------------------------------------------------------

    def start(self, now_ns: int) -> None:
        self._ask_due_ns = now_ns + _SETTLE_NS
        self._alone_ns = now_ns + _ALONE_NS

    def ask_now(self, now_ns: int) -> bool:
        """Whether to ask all agents now. After True, not again before `question_ended`."""
        if self._ask_due_ns is None or now_ns < self._ask_due_ns:
            return False
        self._ask_due_ns = None
        return True

    def agent_appeared(self, now_ns: int) -> None:
        """Another agent is there: where we asked in vain, the next question may succeed."""
        if self._ask_due_ns is not None and self._tries:
            self._tries = 0
            self._ask_due_ns = min(self._ask_due_ns, now_ns + _ASK_AGAIN_NS)

    def question_ended(self, alive: Mapping[str, int], now_ns: int) -> Placement | None:
        """Where to place the vehicles; None to wait and ask again.

        alive  agent -> incarnation of the live agents, as far as we see them
        """
        cut_off = not alive and self._expects_others and now_ns < self._alone_ns
        if not cut_off and self.complete(alive):
            return self.placement(alive)
        self._ask_due_ns = now_ns + min(_ASK_AGAIN_NS << self._tries, _ASK_AGAIN_AT_LAST_NS)
        self._tries += 1
        return None

    # --- what is known --------------------------------------------------------------------------------------

    def answered(self, reservations: Reservations) -> None:
        """Take in one reply. Replies may come late, repeated and in any order: the newest of each agent count."""
        known = self._newest.get(reservations.agent)
        if reservations.seq and (known is None or stamp_of(reservations) > stamp_of(known)):
            self._newest[reservations.agent] = reservations
        answered = self._answered.get(reservations.agent)
        if answered is None or stamp_of(reservations) >= stamp_of(answered):
            self._answered[reservations.agent] = reservations

    def complete(self, alive: Mapping[str, int]) -> bool:
        """Whether every live agent has answered in its present incarnation, and the reservations which any of
        them has seen of an agent that cannot answer for itself have reached us."""
        for agent, incarnation in alive.items():
            if agent == self._agent:
                continue
            answer = self._answered.get(agent)
            if answer is None or answer.incarnation != incarnation:
                return False
            for other, seen in answer.seen.items():
                silent = other == self._agent or alive.get(other) != seen[0]
                if silent and (other not in self._newest or stamp_of(self._newest[other]) < tuple(seen)):
                    return False
        return True

    def placement(self, alive: Mapping[str, int]) -> Placement:
        """Each vehicle where it last stood, or on its spawn cell if no earlier incarnation of ours is known."""
        last = self._newest.get(self._agent)
        taken = self._taken(alive)
        cells: dict[str, int] = {}
        unplaced: dict[str, int] = {}
        for vehicle, spawn in self._spawns[self._agent].items():
            cell, certain = spawn, last is None
            if last is not None and last.held.get(vehicle):
                cell, certain = last.held[vehicle][0], True
            # An earlier incarnation that did not hold a cell for this vehicle had found none: others may be there.
            if certain and 0 <= cell < self._cells and cell not in taken:
                cells[vehicle] = cell
                taken.add(cell)
            else:
                unplaced[vehicle] = min(cell, self._cells - 1)
        others = [each for agent, each in self._newest.items() if agent != self._agent]
        known = (*others, last) if last is not None else tuple(others)
        return Placement(cells, unplaced, known, resumed=last is not None)

    def _taken(self, alive: Mapping[str, int]) -> set[int]:
        """Cells on which a vehicle of another agent may be: held, requested by an agent that died since, or the
        spawn cell of an agent that no agent has heard of."""
        taken: set[int] = set()
        for agent, spawns in self._spawns.items():
            if agent != self._agent and agent not in self._newest:
                taken.update(spawns.values())
        for agent, reservations in self._newest.items():
            if agent != self._agent:
                taken.update(cell for held in reservations.held.values() for cell in held)
                if alive.get(agent) != reservations.incarnation:
                    taken.update(request.cell for request in reservations.requested)
        return taken


class Unplaced:
    """Vehicles that stand nowhere yet. Each requests the nearest free cell until it holds one.

    closed  whether a cell is lethal
    """

    def __init__(self, grid: GridSpec, rights: RightOfWay, closed: Callable[[int], bool]) -> None:
        self._grid = grid
        self._rights = rights
        self._closed = closed
        self._near: dict[str, int] = {}

    @property
    def cells(self) -> list[int]:
        """Near which cells they should stand."""
        return list(self._near.values())

    def add(self, unplaced: Mapping[str, int]) -> None:
        self._near.update(unplaced)

    def settle(self) -> list[tuple[str, int]]:
        """(vehicle, cell) of those that hold a cell now; the others request one."""
        settled: list[tuple[str, int]] = []
        for vehicle, near in list(self._near.items()):
            held = self._rights.held(vehicle)
            if held:
                del self._near[vehicle]
                settled.append((vehicle, held[0]))
                continue
            requested = self._rights.requested(vehicle)
            if requested and self._rights.holder(requested[0]) is None:
                continue
            free = nearest_free(self._grid, near, self._is_free)
            if free is not None:
                self._rights.request(vehicle, [free])
        return settled

    def _is_free(self, cell: int) -> bool:
        return not self._closed(cell) and self._rights.holder(cell) is None


def nearest_free(grid: GridSpec, near: int, is_free: Callable[[int], bool], reach: int = 8) -> int | None:
    """The free cell with the smallest Chebyshev distance to `near`; None if there is none within `reach` cells."""
    for half in range(reach + 1):
        around = grid.around(near, half)
        for row in range(around.row0, around.row1):
            for cell in range(row * grid.cols + around.col0, row * grid.cols + around.col1):
                if grid.distance_cells(near, cell) == half and is_free(cell):
                    return cell
    return None
