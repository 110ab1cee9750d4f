"""Shards, the squares of the map in which right of way is decided, and the agents that decide it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from hashlib import blake2s

from swarm.errors import ConfigError
from swarm.grid import MOST_SHARD_REGIONS, MOST_SHARDS, REGION_CELLS, GridSpec

MOST_SHARDS_AN_AGENT = 8
"""With few shards for each agent some are leaders of much more than others; many cost messages."""
_LAYERS = 2
"""The ground and the air."""
FEWEST_FOR_MAJORITY = 3
"""Members of a shard; a layer of fewer agents has one for each shard."""
_FEWEST_FOR_A_LIAR = 4
"""Members of a shard of which one may lie: any two groups of three share two, and one of these is honest."""


def fitting_regions(rows: int, cols: int, agents: int) -> int:
    """Returns the least side of a shard, in regions, at which a grid has no more shards than these agents can
    use."""
    regions = 1
    while (
        _count(rows, cols, regions * REGION_CELLS) > MOST_SHARDS_AN_AGENT * agents and regions < MOST_SHARD_REGIONS
    ):
        regions += 1
    return regions


def _count(rows: int, cols: int, side: int) -> int:
    """Returns the number of squares of a side that cover a grid."""
    return -(-rows // side) * -(-cols // side)


class Shards:
    """The shards of a grid and their members. Both follow from the grid, the agents and the side alone, so
    processes with the same side agree.

    The members of a shard are the first three agents by rendezvous hashing (Thaler and Ravishankar, 1998). With
    fewer than three agents there is one member: a majority of two would need both to be alive. Where names are
    proven there are four, if the layer has four agents: then one of them may lie (docs/design/right-of-way.md).

    Ground and air are two layers, with shards and agents of their own: no vehicle in one requests, holds or waits
    for anything in the other.

    agents  those of the layer
    side    side of a shard in cells: `map.shard_regions` times 256. Each shard has its own messages, so smaller
            shards mean more messages
    layer   0 is the ground, 1 the air
    others  the agents of the other layer: no external vehicle may take their names
    proven  certificates prove who sends a message; all processes of a run agree on it

    majority  members that have to have a table on file before it counts
    liars     members of a shard that may lie without harm
    all       the numbers of the layer's shards. Shards of different sizes have different numbers, so a statement
              about a shard of another size is ignored and cannot release cells
    spare     how many agents may use another shard size while agents with this size act as members (for shards
              larger than a region, see `has_quorum`)

    Raises ConfigError where the numbers of so narrow a grid do not fit into a message.
    """

    def __init__(
        self,
        grid: GridSpec,
        agents: Sequence[str],
        side: int = REGION_CELLS,
        layer: int = 0,
        others: Collection[str] = (),
        *,
        proven: bool = False,
    ) -> None:
        self.grid = grid
        self.proven = proven
        self.agents = tuple(agents)
        self.side = side
        self._cells, self._cols = grid.cells, grid.cols
        self._across = -(-grid.cols // side)
        self._members: dict[int, tuple[str, ...]] = {}
        self.count = _count(grid.rows, grid.cols, side)
        self.layer = layer
        self.others = frozenset(others)
        smaller = sum(_count(grid.rows, grid.cols, n * REGION_CELLS) for n in range(1, side // REGION_CELLS))
        self._first = _LAYERS * smaller + layer * self.count
        self.all = range(self._first, self._first + self.count)
        if smaller and self.all.stop > MOST_SHARDS:
            raise ConfigError(
                f"map.shard_regions is {side // REGION_CELLS}: a grid of {grid.rows} x {grid.cols} cells is too"
                " narrow for shards larger than a region"
            )
        self._seats = FEWEST_FOR_MAJORITY if len(self.agents) >= FEWEST_FOR_MAJORITY else 1
        if proven and len(self.agents) >= _FEWEST_FOR_A_LIAR:
            self._seats = _FEWEST_FOR_A_LIAR
        self.majority = self._seats // 2 + 1
        self.liars = int(self._seats == _FEWEST_FOR_A_LIAR)
        self.spare = FEWEST_FOR_MAJORITY - 1 if self.majority > 1 else 0

    def of(self, cell: int) -> int:
        """The shard of a cell; -1 of a cell outside the grid."""
        if not 0 <= cell < self._cells:
            return -1
        cols, side = self._cols, self.side
        return self._first + cell // cols // side * self._across + cell % cols // side

    def reads_changes(self, host: str) -> bool:
        """Returns True if leaders keep the last statements of a host, to read changes since them: not those of
        strangers, nor where an agent may lie. So these cost them little memory."""
        return not self.proven and host in self.agents

    def has_quorum(self, agents: Collection[str]) -> bool:
        """Returns True if no other layout can have seats, given that these agents use this one.

        Three agents make a seat in a shard of one region, independent of the others. Larger shards therefore need
        enough agents that fewer than three are left, or all agents if one makes a seat by itself.
        """
        return self.side <= REGION_CELLS or len(set(self.agents).difference(agents)) <= self.spare

    def members(self, shard: int) -> tuple[str, ...]:
        members = self._members.get(shard)
        if members is None:
            by_hash = sorted(self.agents, key=lambda agent: blake2s(f"{shard}/{agent}".encode()).digest())
            members = self._members[shard] = tuple(by_hash[: self._seats])
        return members

    def leader(self, shard: int, epoch: int) -> str:
        """The only member that may be leader in an epoch."""
        members = self.members(shard)
        return members[epoch % len(members)]

    def adjacent(self, one: int, other: int) -> bool:
        """Returns True if one step leads from one cell to the other."""
        cols = self._cols
        south, east = one // cols - other // cols, one % cols - other % cols
        return -1 <= south <= 1 and -1 <= east <= 1 and one != other
