"""Builds the parts of an agent process from the scenario, the terrain and the file of promises. `AgentService`
carries messages between them and the bus."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from shared_map.replication.interest import Interest, MarkFilter
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.store import load_homes
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import class_grounds
from swarm.bus.bus import Bus, Post
from swarm.clock import NS_PER_S
from swarm.config.plugin_names import assignment_key
from swarm.config.scenario import AgentPlan, plan_agents, readable_groups, shard_side, traffic_grid
from swarm.config.vehicle_classes import GROUND, class_named, class_numbers, flies, of_class
from swarm.errors import ConfigError
from swarm.plugins import named_plugin
from swarm.right_of_way.agent_core import RightOfWay
from swarm.right_of_way.agent_on_bus import RightOfWaySync
from swarm.right_of_way.promise_store import PromiseStore
from swarm.right_of_way.shards import Shards
from swarm.runtime.membership import Member
from swarm.runtime.role_setup import RoleSetup
from vehicle_agent.agent import Agent
from vehicle_agent.agent_maps import AgentMaps, ZonesAround
from vehicle_agent.assignment import AssignmentWorld, assigner_of, shares_costs
from vehicle_agent.driving.dynamics import DynamicsWorld, dynamics_of, own_dynamics
from vehicle_agent.position_reports import ChasersReport, FleetReport
from vehicle_agent.sensing.sensor import SensorWorld, sensor_of
from vehicle_agent.sensing.target_detector import TargetDetector
from vehicle_agent.start_cells import Spawning, entry_cells, spawn_cells
from vehicle_agent.target_choice import GroupCosts
from vehicle_agent.traffic.next_cells import FAR_CELLS
from vehicle_agent.traffic.obstacles import Obstacles, TargetObstacles

_ACTS = 10
"""Number of times that an agent acts on right of way while a vehicle crosses the fastest cell, at its ticks or
between them. Those behind wait for a moment each time: 5 cost a twentieth of the flow (`bench crowd --worlds
corridor --seeds 1:2`)."""
_LEAD_CELLS = 24
"""Marks are followed so far ahead of the vehicles at least, so that they are there before a vehicle is."""


class AgentParts:
    """Parts of an agent process; each part is made once, from `setup`'s settings for the agent that it names.

    truth  float32 (rows, cols), s/m, the pace at which vehicles of "ground" really drive
    warn   as of `RightOfWaySync`

    author      under which it writes marks and reports
    flies       True if its vehicles are in the air, where no obstacles are
    near_marks  which tiles of the map concern the vehicles
    costs       costs that the group's agents exchange; None if the assigner does not use them
    spawning    lets the vehicles of an added agent enter; None for an agent of the scenario
    faults      faults of plug-ins that are not reported yet

    Raises ConfigError if the scenario has no such agent, or too few free cells for its vehicles.
    """

    def __init__(
        self,
        setup: RoleSetup,
        terrain: Terrain,
        truth: NDArray[np.float32],
        bus: Bus,
        post: Post,
        store: PromiseStore,
        warn: Callable[[str, str], None],
    ) -> None:
        scenario, grid = setup.scenario, terrain.grid
        traffic = traffic_grid(scenario, grid)
        plan = _plan_of(setup) if setup.added is None else setup.added.plan
        group, class_name = plan.group.name, plan.group.vehicle_class
        self.author, self.faults = f"{group}.{setup.author}", list[str]()
        grounds = class_grounds(scenario, terrain, truth, load_homes(setup, terrain, truth))
        own, as_class = grounds[class_name], of_class(scenario, class_name)
        self.flies = flies(scenario, class_name)
        range_m = as_class.vehicles.sense_range_m
        self.member = Member(setup.info(grid, terrain.digest), bus, post, setup.before)

        # The map.
        number = class_numbers(scenario).get(class_name, 0)
        self.maps = AgentMaps(grounds[GROUND], own, learning=scenario.map.learning, class_number=number)
        reads = MarkFilter(grid, readable_groups(scenario, group))
        self.replica = MapReplica(grid, self.maps.sink, author=self.author, group=group, filter=reads)
        near = scenario.map.interest == "near"
        self.sync = MapSync(self.replica, bus, post, scenario.map, setup.role, near=near)
        self.zones = ZonesAround(self.replica, self.maps)
        lead_cells = max(scenario.vehicles.reserve_cells, FAR_CELLS) + FAR_CELLS + _LEAD_CELLS
        # Wherever a vehicle writes marks, its agent has to know what others say of the same cells.
        reach_m = max(scenario.map.interest_m, 2 * range_m)
        self.near_marks = Interest(grid, max(lead_cells, int(reach_m / grid.resolution_m)))

        # Right of way.
        spawns = spawn_cells(scenario, grid, grounds)
        layers = {each.id: flies(scenario, each.group.vehicle_class) for each in plan_agents(scenario)}
        beside = {agent: cells for agent, cells in spawns.items() if layers[agent] is self.flies}
        side = shard_side(scenario, traffic)
        others, proven = spawns.keys() - beside.keys(), scenario.network.tls is not None
        shards = Shards(traffic, list(beside), side, layer=int(self.flies), others=others, proven=proven)
        tick_ns = int(NS_PER_S / scenario.vehicles.tick_hz)
        core = RightOfWay(
            setup.id, shards, beside, store.own, store.saved, vehicles=plan.vehicle_ids, tick_ns=tick_ns
        )
        cell_s = self.maps.local.cell_s(0.0) / traffic.parts
        self.act_ns = int(cell_s / scenario.time_scale / _ACTS * NS_PER_S)
        self.right_of_way = RightOfWaySync(core, setup, store, bus, post, warn, acts=self.act_ns < tick_ns)

        # The vehicles.
        seen = SensorWorld(grid, truth, range_m, setup.id, scenario.seed)
        sensor = sensor_of(named_plugin(scenario, "vehicles.sensor"), seen, self.faults.append)
        targets = plan.group.targets or tuple(scenario.target_ids)
        assigned = AssignmentWorld(setup.id, group, targets, scenario.seed, plan.group.pursuers)
        assigner = assigner_of(
            named_plugin(scenario, assignment_key(scenario, group)), assigned, self.faults.append
        )
        self.costs = GroupCosts(self.author, group, setup.id) if shares_costs(assigner) else None
        driven = DynamicsWorld(setup.id, traffic, scenario.seed)
        dynamics = own_dynamics(class_named(scenario, class_name), driven) or dynamics_of(
            named_plugin(scenario, "vehicles.dynamics"), driven, self.faults.append
        )
        obstacles = Obstacles(traffic, as_class.cost.vehicle_radius_m)
        self.agent = Agent(
            plan, as_class, self.maps.local, sensor, core.host, obstacles, assigner, dynamics, self.costs
        )
        self.spawning: Spawning | None = None
        if setup.added is not None:
            cells = map(traffic.middle, entry_cells(setup.added, grid, own.homes, setup.incarnation))
            self.spawning = Spawning(plan.vehicle_ids, list(cells), core.host, self.agent.is_open)

        # The targets, and messages to vehicles.
        self.detector = TargetDetector(grid, self.author, group, range_m, reads, scenario.untracked)
        self.target_obstacles = TargetObstacles(scenario, traffic)
        self.fleet = FleetReport(self.author, group, class_name)
        self.chasers = ChasersReport(self.author, class_name)


def _plan_of(setup: RoleSetup) -> AgentPlan:
    plans = plan_agents(setup.scenario)
    plan = next((plan for plan in plans if plan.id == setup.id), None)
    if plan is None:
        ids = ", ".join(plan.id for plan in plans[:20])
        raise ConfigError(f"scenario {setup.scenario.name} has no agent {setup.id}; it has {ids}")
    return plan
