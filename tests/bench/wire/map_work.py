"""The size of a keeper's store by incarnations of an agent."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
import typer

from bench.harness import Seed, benchmark, track
from shared_map.keeper.compaction import compact
from shared_map.keeper.mark_store import KeeperStore
from shared_map.replication.replica import MapReplica
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec

SIDE_CELLS = 512
WRITES = 100
CELLS = 24
SPREAD = 40


def after_lives(lives: int, compacts: bool, seed: int = 1) -> dict[str, float]:
    """Sizes of a keeper's store after many lives of one agent, which mark mostly the same places.

    compacts  the keeper compacts after each life, as if all earlier authors had been dead for long enough
    """
    grid = GridSpec(SIDE_CELLS, SIDE_CELLS, 10.0)
    chance = np.random.default_rng(seed)
    keeper = MapReplica(grid)
    with KeeperStore(":memory:") as store:
        for life in range(lives):
            author = MapReplica(grid, author=f"a0.{life + 1:x}")
            north_west = np.clip(chance.normal(SIDE_CELLS / 2, SPREAD, size=(WRITES, 2)), 0, SIDE_CELLS - CELLS)
            starts = north_west.astype(np.int64) @ [SIDE_CELLS, 1]
            cells = np.unique(starts[:, None] + np.arange(CELLS))
            kinds = chance.integers(3, size=len(cells), dtype=np.uint8)
            author.write(cells, kinds, chance.uniform(0.5, 5.0, size=len(cells)), (life + 1) * NS_PER_S)
            said = [each for tile in author.held.tiles for each in author.held.of_tile(tile)]
            keeper.merge(said)
            store.save(said)
            if compacts:
                gone = set(keeper.held.ledger.authors)
                tiles = {each.tile for each in said}
                new = [each for t in tiles for each in compact(keeper.held.of_tile(t), {}, gone, -(1 << 62))]
                store.save(new)
                keeper.merge(new)
        aside = [each for tile in store.tiles_set_aside() for each in store.set_aside(tile).values()]
        marked = sum(len(keeper.winners(tile).cells) for tile in keeper.held.tiles)
        sets = list(store.load())
    digest_bytes = sum(len(rows) for rows in keeper.held.ledger.held().values())
    return {
        "cells_marked": marked,
        "authors": len(keeper.held.ledger.authors),
        "sets": len(sets),
        "marks": sum(len(each.kinds) for each in sets),
        "aside": sum(len(each.kinds) for each in aside),
        "sets_kib": round(sum(15 * len(each.kinds) + 40 for each in sets) / 1024),
        "digest_kib": math.ceil(digest_bytes / 1024),
    }


@benchmark()
def compaction(
    lives: Annotated[int, typer.Option(min=1, help="Lives of one agent, each with 100 writes.")] = 200,
    seed: Seed = 1,
) -> dict[str, Any]:
    """Size of a keeper's store after many lives of an agent, with and without compaction of dead authors.

    \b
    ./launch_scripts/bench compaction --lives 1000
    """
    rows = [{"compact": word, **after_lives(lives, word == "yes", seed)} for word in track(("no", "yes"))]
    return {"lives": lives, "rows": rows}
