"""Arguments of a process: the same for every role, live or simulated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from msgspec import UNSET

from swarm.config.scenario import AddedAgent, Scenario, crew_of, shard_side, traffic_grid
from swarm.config.vehicle_classes import class_numbers
from swarm.grid import GridSpec
from swarm.runtime.loop_health import Health
from swarm.wire.fields import MOST_IDS
from swarm.wire.messages import WIRE_VERSION
from swarm.wire.messages.map_data import KEEPERS
from swarm.wire.messages.processes import RunInfo, Stats


@dataclass(frozen=True, slots=True)
class RoleSetup:
    """One process of a run.

    incarnation    nanoseconds at its start: a later start of the same (role, id) has a larger one
    started_ns     start of the run
    run_dir        where this machine keeps the run: prepared terrain, the keeper's store, logs; None if nowhere
    added          vehicles of an agent that the scenario does not name
    restarts       how often it was started before in this run
    before         counts of its earlier generations; None if they are not known
    anew           True if this is its first start in the run
    takes_over     True if the generation before it may still run on this machine, and ends soon
    record_inputs  True if all messages to it are written into `run_dir`, so that it can be replayed
    health         receives the health of its loop; None: no reports
    """

    scenario: Scenario
    run_id: str
    role: str
    id: str
    incarnation: int
    started_ns: int
    run_dir: Path | None = None
    added: AddedAgent | None = None
    restarts: int = 0
    before: Stats | None = None
    record_inputs: bool = False
    anew: bool = False
    takes_over: bool = False
    health: Health | None = None

    def info(self, grid: GridSpec, terrain_digest: str) -> RunInfo:
        """Returns this process's reply to the question which run it belongs to."""
        traffic = traffic_grid(self.scenario, grid)
        return RunInfo(
            run_id=self.run_id,
            role=self.role,
            id=self.id,
            incarnation=self.incarnation,
            scenario=self.scenario.name,
            terrain=terrain_digest,
            rows=grid.rows,
            cols=grid.cols,
            resolution_m=grid.resolution_m,
            started_ns=self.started_ns,
            west_m=grid.west_m,
            north_m=grid.north_m,
            crs=grid.crs,
            vehicles=self.scenario.vehicle_count,
            crew=[f"{role}-{id}" for role, id in crew_of(self.scenario)][:MOST_IDS],
            restarts=self.restarts,
            classes=list(class_numbers(self.scenario)),
            wire_version=WIRE_VERSION,
            shard_cells=shard_side(self.scenario, traffic),
            traffic_parts=traffic.parts if traffic.parts > 1 else UNSET,
        )

    @property
    def author(self) -> str:
        """Name under which this incarnation writes marks. No other process or incarnation has the same."""
        name = f"{self.id}.{self.incarnation:x}"
        return f"{KEEPERS}.{name}" if self.role == "keeper" else name
