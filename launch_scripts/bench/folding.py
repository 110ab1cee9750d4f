"""What a keeper holds after many lives of an agent, with and without folding, on the memory bus.

python -m launch_scripts.bench.folding --lives 200 --json
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shared_map.folding import fold
from shared_map.keeper import KeeperStore
from shared_map.replica import MapReplica
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.messages import MarkKind

SIDE_CELLS = 512
WRITES = 40
CELLS = 24


def after_lives(lives: int, folds: bool, folder: Path, seed: int = 1) -> dict[str, float]:
    """Each life says something about places that it drives by, most of them where the lives before it were, and
    dies. The keeper folds after each, as if everybody had been dead for long enough."""
    grid = GridSpec(SIDE_CELLS, SIDE_CELLS, 10.0)
    chance = np.random.default_rng(seed)
    keeper = MapReplica(grid)
    path = folder / f"{'folded' if folds else 'whole'}.sqlite"
    with KeeperStore(path) as store:
        for life in range(lives):
            author = MapReplica(grid, author=f"a0.{life + 1:x}")
            places = np.clip(chance.normal(SIDE_CELLS / 2, 60, size=(WRITES, 2)), 0, SIDE_CELLS - CELLS - 1)
            for number, (row, col) in enumerate(places.astype(int).tolist()):
                start = grid.cell(row, col)
                kind = (MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR)[int(chance.integers(3))]
                pace = float(chance.uniform(0.5, 5.0))
                author.write(np.arange(start, start + CELLS), kind, pace, (life * WRITES + number) * NS_PER_S)
            said = [each for tile in author.tiles for each in author.sets(tile)]
            keeper.merge_many(said)
            store.save(said)
            if folds:
                gone = set(keeper.ledger.authors)
                tiles = {each.tile for each in said}
                new = [each for t in tiles for each in fold(keeper.sets(t), store.folded(t), gone, -(1 << 62))]
                store.save(new)
                keeper.merge_many(new)
        store.forget_folded(1)  # as when the time to keep it is over
        marked = sum(len(keeper.winners(tile).cells) for tile in keeper.tiles)
    digest_bytes = sum(len(rows) for rows in keeper.digest().values())
    with KeeperStore(path) as store:
        sets = list(store.load())
    return {
        "lives": lives,
        "cells_marked": marked,
        "authors": len(keeper.ledger.authors),
        "sets": len(sets),
        "marks": sum(len(each.kinds) for each in sets),
        "payload_kib": round(sum(15 * len(each.kinds) + 40 for each in sets) / 1024),
        "digest_kib": math.ceil(digest_bytes / 1024),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--lives", type=int, default=200)
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        found = {
            label: after_lives(chosen.lives, folds, Path(name))
            for label, folds in (("without", False), ("with", True))
        }
    if chosen.json:
        print(json.dumps(found))
    else:
        for label, figures in found.items():
            print(f"{label} folding: " + ", ".join(f"{value:,} {key}" for key, value in figures.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
