"""What of others' marks a replica takes in: whose, by the policy of groups, and where, by its interest.

The group of an author stands in the author's id (`blue.a3.17f2`), and so in the key of everything that it writes:
access control can enforce the policy, and a digest, which names authors only, is read without asking for sets that
would be refused.
"""

from __future__ import annotations

from collections.abc import Sequence

from shared_map.replication.tiles import region_tiles
from swarm.config.scenario import Scenario
from swarm.grid import GridSpec


def author_of(group: str, name: str) -> str:
    """The id under which a process of a group writes: `name` is that of its incarnation."""
    return f"{group}.{name}"


def readable_groups(scenario: Scenario, group: str) -> frozenset[str] | None:
    """The groups whose marks and positions a group takes in: itself, and those that it reads and that write to it.
    None where that is everybody."""
    groups = {each.name: each for each in scenario.groups}
    mine = groups[group]
    heard = {
        other.name
        for other in scenario.groups
        if other.name == group or (_names(mine.reads, other.name) and _names(other.writes, group))
    }
    return None if heard == groups.keys() else frozenset(heard)


def readable_for_target(scenario: Scenario, target: str) -> frozenset[str] | None:
    """The groups whose marks the planner of a target takes in: all that any group reads that chases the target.

    So the routes of the least informed group are as good as those of the best: what goes over to it are routes, not
    marks. Groups that must not learn even that chase targets of their own.
    """
    heard: set[str] = set()
    for group in scenario.groups:
        if not group.targets or target in group.targets:
            readable = readable_groups(scenario, group.name)
            if readable is None:
                return None
            heard |= readable
    return frozenset(heard)


def _names(listed: Sequence[str], group: str) -> bool:
    return "*" in listed or group in listed


class MarkFilter:
    """Which sets a replica takes in, by author and by tile. Either limit may be absent.

    groups   whose statements count, by the id of their author and by what the set says; None: everybody's
    regions  about which regions; None: all
    """

    def __init__(self, grid: GridSpec, groups: frozenset[str] | None = None) -> None:
        self.groups = groups
        self.regions: frozenset[int] | None = None
        self._grid = grid
        self._prefixes = None if groups is None else tuple(f"{group}." for group in sorted(groups))
        self._tiles: frozenset[int] | None = None  # those of `regions`

    def limit_to(self, regions: frozenset[int]) -> None:
        """From now on accept only sets about these regions."""
        self.regions = regions
        self._tiles = frozenset(tile for region in regions for tile in region_tiles(self._grid, region))

    def accepts_author(self, author: str, group: str) -> bool:
        """Whether the policy of groups lets us read this author, which states to be of this group."""
        if self.groups is None:
            return True
        return group in self.groups and author.startswith(f"{group}.")

    def accepts_tile(self, tile: int) -> bool:
        """Whether a tile lies in the regions of interest."""
        return self._tiles is None or tile in self._tiles

    def accepted(self, sets: Sequence[tuple[str, list[int]]]) -> list[tuple[str, list[int]]]:
        """Of (author, tiles), those which would be taken in."""
        of_authors = sets
        if self._prefixes is not None:
            of_authors = [(author, tiles) for author, tiles in sets if author.startswith(self._prefixes)]
        if self._tiles is None:
            return list(of_authors)
        near = self._tiles
        inside = ((author, [tile for tile in tiles if tile in near]) for author, tiles in of_authors)
        return [(author, tiles) for author, tiles in inside if tiles]
