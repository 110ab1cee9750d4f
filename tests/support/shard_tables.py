"""Messages of members, leaders and hosts of one shard in tests: shard 0 of a grid of 8 x 8 cells, and five
agents."""

from collections.abc import Mapping, Sequence

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.right_of_way.agent_core import OwnRecord, RightOfWay
from swarm.right_of_way.holdings import Holdings
from swarm.right_of_way.shard_member import RoundTrips
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Granted, Held, HostState, Number, Stand, Table

GRID = GridSpec(8, 8, 1.0)
AGENTS = [f"a{n}" for n in range(5)]
SHARDS = Shards(GRID, AGENTS)
MEMBERS = SHARDS.members(0)
S = NS_PER_S


def entries(epoch: int, seq: int, *cells: int) -> list[Number]:
    """Entries that one table added."""
    return [(cell, epoch, seq) for cell in cells]


def table_of(epoch: int, seq: int, **grants: list[int | Number]) -> Table:
    """Vehicles are named by their host: a0=[5] is the vehicle a0-00 on cell 5. A cell is an entry that the table
    (epoch, 1) added."""
    held = {
        f"{host}-00": Held.of([(cell, epoch, 1) if isinstance(cell, int) else cell for cell in cells])
        for host, cells in grants.items()
    }
    hosts = dict.fromkeys(grants, (1, seq))
    return Table(shard=0, agent=SHARDS.leader(0, epoch), epoch=epoch, seq=seq, hosts=hosts, grants=held)


def cells_of(table: Table | None, vehicle: str) -> list[int]:
    """The cells of a vehicle's entries."""
    assert table is not None
    return [*table.grants[vehicle].cells] if vehicle in table.grants else []


def host_state(
    host: str, holds: list[Number], seq: int, knows: tuple[int, int] = (0, 0), **more: object
) -> HostState:
    cells = [number[0] for number in holds]
    stand = Stand(f"{host}-00", cells[0], cells[-1], Held.of(holds), [], [], 0, 0)
    fields = {"generation": 1, "vehicles": [stand], **more}
    return HostState(shard=0, agent=host, seq=seq, knows=knows, **fields)  # type: ignore[arg-type]


def holdings_of(host: str = "a0", vehicles: Sequence[str] = ("a0-00",), shards: Shards = SHARDS) -> Holdings:
    """Holdings of a host's first generation, which has heard no grant yet."""
    holdings = Holdings(shards, host, list(vehicles))
    holdings.begin_as(1, [])
    holdings.watch([0])
    return holdings


def granted_of(table: Table, host: str = "a0") -> Granted:
    """The message of a table to one host."""
    generation, heard = table.hosts.get(host, (0, 0))
    grants = {vehicle: held for vehicle, held in table.grants.items() if vehicle.startswith(host)}
    return Granted(
        shard=table.shard, host=host, agent=table.agent, epoch=table.epoch, seq=table.seq, generation=generation,
        heard=heard, grants=grants,
    )  # fmt: skip


def granted_cells(holdings: Holdings, leader: str, seq: int, cells: Mapping[str, Sequence[int]]) -> Granted:
    """A leader's grant of cells to vehicles of a0: entries that they hold, and new ones of table (1, seq)."""
    paths = holdings._entries.paths
    held = {vehicle: {entry.cell: entry.number for entry in path} for vehicle, path in paths.items()}
    grants = {
        vehicle: Held.of([held.get(vehicle, {}).get(cell, (cell, 1, seq)) for cell in each])
        for vehicle, each in cells.items()
    }
    return Granted(shard=0, host="a0", agent=leader, epoch=1, seq=seq, generation=1, heard=seq, grants=grants)


def hear(holdings: Holdings, table: Table, now_ns: int = 0) -> None:
    holdings.hear_granted(granted_of(table), now_ns)


def rights_of(agent: str, saved: dict[int, tuple[int, Table]] | None = None) -> RightOfWay:
    spawns = {name: {f"{name}-00": n} for n, name in enumerate(AGENTS)}
    return RightOfWay(agent, SHARDS, spawns, OwnRecord(disk=7), saved or {})


def near_members() -> RoundTrips:
    """Round trips of a millisecond to all members."""
    trips = RoundTrips()
    for member in MEMBERS:
        trips.measure(member, S // 1000)
    return trips
