"""Filter of other authors' marks: by author (the policy of groups) and by tile (its interest).

An author's id begins with its group (`blue.a3.17f2`), and so do the keys of all that it writes. Access control can
therefore enforce the policy; and no set is requested of a digest, which names only authors, that would be refused.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from shared_map.replication.tiles import beyond_tile, of_all_classes, region_tiles
from swarm.config.agents import readable_groups
from swarm.config.scenario import Scenario
from swarm.config.setting_types import RESERVED_GROUP
from swarm.grid import GridSpec


def author_of(group: str, name: str) -> str:
    """The author id of a process of a group.

    name  of the process and its incarnation
    """
    return f"{group}.{name}"


def readable_for_target(
    scenario: Scenario, target: str, chased_by: Callable[[str], Collection[str]] | None = None
) -> frozenset[str] | None:
    """The groups whose marks the planner of a target takes in: all that any group reads which chases the target.
    None if that is all groups.

    The least informed of these groups therefore gets routes as good as the best informed one, but not the marks
    behind them. Groups which must not learn even that much have to chase targets of their own.

    chased_by  the targets of a group, where operators may have ordered others than the scenario says
    """
    heard: set[str] = set()
    for group in scenario.groups:
        targets = group.targets if chased_by is None else chased_by(group.name)
        if target in targets or (chased_by is None and not targets):
            readable = readable_groups(scenario, group.name)
            if readable is None:
                return None
            heard |= readable
    return frozenset(heard)


class MarkFilter:
    """Filter of sets by author and by tile. Either limit may be absent. Zones of operators concern
    every group.

    groups   only sets of these groups are accepted; both the author's id and the set's `group` must match. None:
             all groups
    regions  about which regions; None: all
    """

    def __init__(self, grid: GridSpec, groups: frozenset[str] | None = None) -> None:
        self.regions: frozenset[int] | None = None
        self._grid = grid
        self._tiles: frozenset[int] | None = None  # those of `regions`
        self.read_groups(groups)

    def read_groups(self, groups: frozenset[str] | None) -> None:
        """From now on accept the sets of these groups only; of all if None."""
        self.groups = None if groups is None else groups | {RESERVED_GROUP}
        self._prefixes = None if self.groups is None else tuple(f"{group}." for group in sorted(self.groups))

    def limit_to(self, regions: frozenset[int]) -> None:
        """From now on accept only sets about these regions."""
        self.regions = regions
        tiles = [tile for region in regions for tile in region_tiles(self._grid, region)]
        self._tiles = frozenset([beyond_tile(self._grid), *of_all_classes(self._grid, tiles)])

    def accepts_author(self, author: str, group: str) -> bool:
        """Returns True if the policy of groups lets us read this author, which states to be of this group."""
        if self.groups is None:
            return True
        return group in self.groups and author.startswith(f"{group}.")

    def accepts_tile(self, tile: int) -> bool:
        """Returns True if a tile is in the regions of interest, or beyond the map: measurements concern all."""
        return self._tiles is None or tile in self._tiles

    def accepted(self, sets: Sequence[tuple[str, list[int]]]) -> list[tuple[str, list[int]]]:
        """Returns those of (author, tiles) which would be accepted."""
        of_authors = sets
        if self._prefixes is not None:
            of_authors = [(author, tiles) for author, tiles in sets if author.startswith(self._prefixes)]
        if self._tiles is None:
            return list(of_authors)
        near = self._tiles
        inside = ((author, [tile for tile in tiles if tile in near]) for author, tiles in of_authors)
        return [(author, tiles) for author, tiles in inside if tiles]
