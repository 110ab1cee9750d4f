"""The cost of maps in agents and keepers: presence by the number of vehicles, and a keeper's store by
incarnations."""

from __future__ import annotations

import math
from statistics import median
from typing import Annotated, Any

import numpy as np
import typer
from support.made_up_swarm import some_fleet

from bench.harness import Seed, benchmark, cpu_ms, numbers_of, track
from shared_map.keeper.compaction import compact
from shared_map.keeper.mark_store import KeeperStore
from shared_map.replication.replica import MapReplica
from shared_map.vehicle_presence import Presence
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.codec import decode, encode
from swarm.wire.messages.vehicles import Fleet

_PER_AGENT = 25
_LEASE_NS = 2_000_000_000
SIDE_CELLS = 512
WRITES = 100
CELLS = 24
SPREAD = 40


def fleets(grid: GridSpec, count: int, seed: int) -> list[Fleet]:
    """`count` vehicles anywhere on the grid, of agents of 25."""
    rng = np.random.default_rng(seed)
    reports = []
    for agent in range(count // _PER_AGENT):
        rows, cols = rng.integers(0, grid.rows, _PER_AGENT), rng.integers(0, grid.cols, _PER_AGENT)
        east_m, south_m = (cols + 0.5) * grid.resolution_m, (rows + 0.5) * grid.resolution_m
        reports.append(some_fleet(f"a{agent}", 0, 1, rows * grid.cols + cols, east_m, south_m, []))
    return reports


def _presence_of(count: int, rounds: int) -> dict[str, float]:
    """CPU milliseconds of the parts of a tick in which all agents have reported."""
    grid = GridSpec(1024, 1024, 20.0)
    said = fleets(grid, count, seed=1)
    payloads = [encode(fleet) for fleet in said]
    presence = Presence(_LEASE_NS)
    seq = 0

    def receive() -> None:
        nonlocal seq
        seq += 1
        for fleet in said:
            presence.receive(_again(fleet, seq), seq)

    receive()
    parts = {
        "decode_ms": lambda: [decode(payload, Fleet) for payload in payloads],
        "receive_ms": receive,
        "columns_ms": presence.columns,
    }
    return {name: round(median(cpu_ms(part) for _ in range(rounds)), 3) for name, part in parts.items()}


def _again(fleet: Fleet, seq: int) -> Fleet:
    """A copy with another sequence number, as the network delivers it."""
    return Fleet(**{name: getattr(fleet, name) for name in fleet.__struct_fields__ if name != "seq"}, seq=seq)


@benchmark()
def presence(
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles, multiples of 25.")] = "1000,5000",
    rounds: Annotated[int, typer.Option(min=1, help="Ticks; the median counts.")] = 50,
) -> dict[str, Any]:
    """CPU time per tick that a searching planner spends on the positions of all other vehicles.

    \b
    ./launch_scripts/bench presence --vehicles 10000
    """
    counts = numbers_of(vehicles, "vehicles", 25)
    return {"rows": [{"vehicles": count, **_presence_of(count, rounds)} for count in track(counts)]}


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
