"""Made-up vehicles, routes, marks and a target, for observers of a swarm from outside."""

import time
from multiprocessing.connection import Connection
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from support.makers import fleet_of, run_info, target_pose

from shared_map.replication.mark_sets import Statements, mark_set
from swarm.bus.bus import Asked
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import NetworkConfig
from swarm.grid import GridSpec
from swarm.runtime.inbox import Inbox
from swarm.wire.fields import pack_column
from swarm.wire.messages import WIRE_VERSION
from swarm.wire.messages.map_data import MarkKind, MarkSet
from swarm.wire.messages.vehicles import Fleet, Followed
from swarm.wire.topics import FLEET, FOLLOWED, MARKS, POSE, RUN

GRID = GridSpec(2048, 2048, 10.0, 500_000.0, 5_300_000.0, "EPSG:32632")
Numbers = NDArray[Any]
_PER_AGENT = 25
_HZ = 10.0
_ROUTE_CELLS, _NEW_ROUTE_S = 200, 2.0
_MARK_SETS_A_TICK, _MARKS = 1, 20


def some_set(tile: int, seq: int, marks: int, author: str = "far.1") -> MarkSet:
    """A set of the given number of marks, spread over its tile."""
    cells = np.arange(marks, dtype=np.uint16) * (1024 // max(marks, 16))
    kinds = (np.arange(marks) % 2).astype(np.uint8)
    paces = np.where(kinds == MarkKind.PACE, np.float32(0.25), np.float32(0))
    return mark_set(author, "all", tile, 1, seq, Statements(cells, kinds, paces, np.full(marks, seq + 1, np.int64)))


def some_fleet(
    agent: str, region: int, seq: int, cells: Numbers, east_m: Numbers, south_m: Numbers, target: str
) -> Fleet:
    """An agent's vehicles, all of which drive east, after a target."""
    east = pack_column(np.full(len(cells), np.pi / 2), "<f4")
    return fleet_of(
        [f"{agent}-{n:02d}" for n in range(len(cells))], cells=list(cells), east_m=list(east_m),
        south_m=list(south_m), target=target, author=f"{agent}.1", region=region, seq=seq,
        stamp_ns=time.time_ns(), heading_rad=east,
    )  # fmt: skip


def swarm_peer(
    network: NetworkConfig, pipe: Connection, vehicles: int, seconds: float, run_id: str = "bench"
) -> None:
    """Agents whose vehicles drive east at 10 m/s, get a new route every two seconds and mark the map, and a target,
    for this time. Answers which run it is."""
    inbox, now_ns = Inbox(), time.time_ns()
    info = run_info(
        GRID, run_id=run_id, role="keeper", id="0", incarnation=now_ns, scenario="bench", terrain="none",
        started_ns=now_ns, wire_version=WIRE_VERSION,
    )  # fmt: skip
    with open_bus(network) as bus:
        bus.serve(RUN, inbox.post, role="keeper", id="0")
        pipe.send("ready")
        began_s = time.monotonic()
        tick = 0
        while time.monotonic() < began_s + seconds and not pipe.poll():
            tick += 1
            _tell(bus, tick, vehicles)
            target = target_pose("t0", 0, GRID, incarnation=now_ns, seq=tick, stamp_ns=time.time_ns())
            bus.publish(POSE, target, target="t0")
            while (event := inbox.take(max(0.0, began_s + tick / _HZ - time.monotonic()))) is not None:
                if isinstance(event, Asked):
                    event.answer(msgspec.structs.replace(info, now_ns=time.time_ns()), role="keeper", id="0")
                    event.end()


def _tell(bus: ZenohBus, tick: int, vehicles: int) -> None:
    for agent in range(vehicles // _PER_AGENT):
        author = f"a{agent}.1"
        numbers = np.arange(_PER_AGENT)
        east_m = 500.0 + 40.0 * numbers + tick * 10.0 / _HZ
        south_m = np.full(_PER_AGENT, 500.0 + 100.0 * agent)
        cells = (south_m // GRID.resolution_m).astype(int) * GRID.cols + (east_m // GRID.resolution_m).astype(int)
        ids = [f"a{agent}-{n:02d}" for n in numbers]
        fleet = some_fleet(f"a{agent}", agent, tick, cells, east_m, south_m, "t0")
        bus.publish(FLEET, fleet, region=agent, author=author)
        for n in range(tick % int(_NEW_ROUTE_S * _HZ), _PER_AGENT, int(_NEW_ROUTE_S * _HZ)):
            steps = bytes((np.arange(_ROUTE_CELLS) // 7 % 2 + 2).astype(np.uint8))  # east and south-east
            followed = Followed(
                vehicle=ids[n], target="t0", start=int(cells[n]), directions=steps, cost_s=1.0, lower_bound_s=1.0
            )
            bus.publish(FOLLOWED, followed, agent=f"a{agent}", vehicle=ids[n])
    for n in range(_MARK_SETS_A_TICK):
        tile = (tick * _MARK_SETS_A_TICK + n) % GRID.tiles
        marks = some_set(tile, tick, _MARKS, author="all.a0.1")
        bus.publish(MARKS, marks, region=GRID.region_of_tile(tile), tile=tile, author=marks.author)
