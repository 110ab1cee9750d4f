"""Files that a build leaves on disk and reads there: run with the PYTHONPATH of any version.

    PYTHONPATH=TREE:TREE/tests python tests/support/stored_by.py write FOLDER
    PYTHONPATH=TREE:TREE/tests python tests/support/stored_by.py read FOLDER

`read` writes what it has found to standard output, a JSON object a line.
"""

import sys
from pathlib import Path
from typing import Any

from msgspec.json import encode
from support.wire_strategies import EXAMPLES

from swarm.grid import GridSpec
from swarm.right_of_way.promise_store import FilePromiseStore

try:
    from shared_map.keeper.mark_store import KeeperStore
    from swarm.right_of_way.agent_core import OwnRecord
except ModuleNotFoundError:  # a build from before these modules had a name of their own
    from shared_map.keeper.store import KeeperStore
    from vehicle_agent.traffic.right_of_way import OwnRecord

_GRID = GridSpec(64, 96, 30.0)


def _examples(name: str) -> list[Any]:
    """The examples of a type of messages."""
    return [each for each in EXAMPLES if type(each).__name__ == name]


def write(folder: Path) -> None:
    """Leaves a keeper's store and an agent's promises."""
    # By name, as the modules of messages differ between versions.
    [marks], [sighted], [table] = map(_examples, ("MarkSet", "Sighted", "Table"))
    orders = [order for each in _examples("Orders") for order in each.orders]
    with KeeperStore(folder / "map.sqlite") as store:
        store.bind("terrain", _GRID)
        store.save([marks])
        store.save_sightings([sighted])
        store.save_orders(orders)
    promises = FilePromiseStore(folder / "promises-a0")
    promises.save_own(OwnRecord(disk=7, generations=[1, 1 << 32], noted={"a1": 5}, noted_by=["a2"]))
    promises.save(4, table)
    promises.close()


def read(folder: Path) -> str:
    """The content of the files."""
    with KeeperStore(folder / "map.sqlite") as store:
        store.bind("terrain", _GRID)
        kept = [*store.load(), *store.sightings(), *store.orders()]
    promises = FilePromiseStore(folder / "promises-a0")
    [(shard, (promised, table))] = promises.saved.items()
    kept += [promises.own, table]
    return "\n".join([f'{{"shard": {shard}, "promised": {promised}}}', *(encode(each).decode() for each in kept)])


if __name__ == "__main__":
    what, name = sys.argv[1:]
    if what == "write":
        write(Path(name))
    else:
        sys.stdout.write(read(Path(name)))
