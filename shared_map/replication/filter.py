"""What of others' marks a replica takes in: whose, by the policy of groups, and where, by its interest.

The group of an author stands in the author's id (`blue.a3.17f2`), and so in the key of everything that it writes:
access control can enforce the policy, and a digest, which names authors only, is read without asking for sets that
would be refused.
"""

from __future__ import annotations

from collections.abc import Sequence

from shared_map.replication.marks import region_tiles
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


class Reading:
    """What a replica takes in. Two limits, each of which may be absent.

    groups  whose statements count, by the id of their author and what the set says itself; None is everybody's
    """

    def __init__(self, grid: GridSpec, groups: frozenset[str] | None = None) -> None:
        self.groups = groups
        self.regions: frozenset[int] | None = None
        self._grid = grid
        self._prefixes = None if groups is None else tuple(f"{group}." for group in sorted(groups))
        self._tiles: frozenset[int] | None = None

    def limit(self, regions: frozenset[int]) -> None:
        """From now on only what is said about these regions is of interest."""
        self.regions = regions
        self._tiles = frozenset(tile for region in regions for tile in region_tiles(self._grid, region))

    def hears(self, author: str, group: str) -> bool:
        """Whether the policy lets this author, who says to be of this group, speak to us."""
        if self._prefixes is None or self.groups is None:
            return True
        return group in self.groups and author.startswith(f"{group}.")

    def concerns(self, tile: int) -> bool:
        """Whether what is said about a tile is of interest."""
        return self._tiles is None or tile in self._tiles

    def wanted(self, missing: Sequence[tuple[str, list[int]]]) -> list[tuple[str, list[int]]]:
        """Of (author, tiles) that others have and we lack, what we would take in."""
        heard = missing
        if self._prefixes is not None:
            heard = [(author, tiles) for author, tiles in missing if author.startswith(self._prefixes)]
        if self._tiles is None:
            return list(heard)
        near = self._tiles
        inside = ((author, [tile for tile in tiles if tile in near]) for author, tiles in heard)
        return [(author, tiles) for author, tiles in inside if tiles]
