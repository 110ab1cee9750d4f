"""What an agent follows as its vehicles drive: whose reservations, and in which regions presence and marks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from shared_map.replication.interest import Interest
from swarm.config.scenario import Scenario
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import TerritoryReply, TerritoryRequest
from vehicle_agent.traffic.right_of_way import RightOfWay
from vehicle_agent.traffic.territory import PLOT_CELLS, Territory

K = TypeVar("K")

_LEAD_CELLS = 24
"""A plot is asked for so far ahead of the first reservation in it: the answers are there before a vehicle is."""


@dataclass(frozen=True, slots=True)
class Change(Generic[K]):
    """Which subscriptions to begin and which to end, in this order."""

    begin: Sequence[K]
    end: Sequence[K]


@dataclass(frozen=True, slots=True)
class Following:
    """What to do so that an agent follows what concerns it.

    map_regions   regions whose marks it follows, where marks are followed by region
    presence      regions whose vehicles it follows
    reservations  agents whose reservations it follows
    question      to ask of all agents now; None if nothing is open
    """

    map_regions: frozenset[int]
    presence: Change[int]
    reservations: Change[str]
    question: TerritoryRequest | None


class Neighbourhood:
    """Follows the places of an agent's vehicles with its territory and its subscriptions."""

    def __init__(self, grid: GridSpec, scenario: Scenario, rights: RightOfWay, territory: Territory) -> None:
        self._rights = rights
        self._territory = territory
        lead_cells = scenario.vehicles.reserve_cells + _LEAD_CELLS
        self._plots = Interest(grid, lead_cells, square_cells=PLOT_CELLS)
        self._presence = Interest(grid, lead_cells)
        # Wherever a vehicle writes marks, its agent has to know what others say of the same cells.
        reach_m = max(scenario.map.interest_m, 2 * scenario.vehicles.sense_range_m)
        self._map = Interest(grid, max(lead_cells, int(reach_m / grid.resolution_m)))
        self.listens_to: frozenset[str] = frozenset()
        """The agents whose reservations are subscribed to."""

    def follow(self, places: Sequence[int], now_ns: int) -> Following:
        """What changes now that the vehicles hold, or mean to hold, these cells."""
        territory = self._territory
        territory.set_plots(self._plots.update(places))
        before = self._presence.squares
        after = self._presence.update(places)
        question = territory.question(now_ns)
        self._rights.forget_far()
        before_heard, heard = self.listens_to, territory.heard_from
        self.listens_to = heard
        return Following(
            self._map.update(places),
            Change(sorted(after - before), sorted(before - after)),
            Change(sorted(heard - before_heard), sorted(before_heard - heard)),
            question,
        )

    def set_alive(self, agents: Mapping[str, int]) -> None:
        """Which agents live: agent -> incarnation."""
        self._territory.set_alive(agents)
        self._rights.set_alive(agents)

    def link_changed(self) -> None:
        self._territory.ask_anew()

    def answer(self, question: TerritoryRequest) -> TerritoryReply:
        """Our reply to another agent's question about its territory."""
        self._territory.hear(question)
        return self._territory.answer(self._rights.heard_of(question.silent))

    def answered(self, reply: TerritoryReply, seq: int) -> None:
        """Another agent's reply to our question number `seq`."""
        for reservations in reply.reservations:
            self._rights.hear(reservations)
        self._territory.answered(reply, seq)
