"""The set-up that all processes which plan routes share: the network, who leads, orders, the map of each class.

The cell costs of a map are shared by its planners on one machine, in a file of the run's folder. Each planner
computes them, which takes less time than a digest, and uses the file in place of its own if the two are equal.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from planner_service.tree.cost_grid import NO_COSTS, CostGrid
from shared_map.array_files import Floats, open_array, private_copy, save_array
from shared_map.cost_map import CostMap
from shared_map.learned_factors import LearnedGauges
from shared_map.replication.interest import MarkFilter
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import ClassMaps, class_terrains
from swarm.bus.bus import Asked, Bus, Event, Post, Worker
from swarm.config.explain import choice
from swarm.config.scenario import PlannerConfig, agent_of
from swarm.config.vehicle_classes import GROUND, class_numbers, first_classes
from swarm.errors import StoreError
from swarm.peers import job_of
from swarm.runtime.election import Candidacy
from swarm.runtime.membership import Member, MemberService
from swarm.runtime.order_book import OrderClient
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import PushedRoute
from swarm.wire.topics import PUSHED_ROUTE, Topic

log = logging.getLogger(__name__)


def shared_costs(folder: Path | None, terrain: Terrain, config: PlannerConfig) -> Floats | None:
    """Returns the cell costs before any mark, which a `CostGrid` can share: float32, padded, s; mapped read-only.

    A file with other costs, those of another map or damaged ones, is replaced. Returns None where there is no
    folder or it cannot be written: then a planner keeps its own.
    """
    if folder is None:
        return None
    path = folder / "cell-costs.npy"
    try:
        # One at a time: each maps the file of the first, and there is memory for one more array only.
        with (folder / "cell-costs.lock").open("wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            own = CostGrid(terrain.grid, config, terrain.climb)
            own.load(private_copy(terrain.pace_s_per_m))  # kernels know arrays that may be written only
            found: Floats = NO_COSTS
            with contextlib.suppress(OSError, ValueError):
                found = open_array(path)
            if found.dtype != own.time_cost.dtype or not np.array_equal(found, own.time_cost):
                log.info("writing the cell costs of this map to %s", path)
                save_array(path, own.time_cost)
                found = open_array(path)
            return found
    except (OSError, StoreError) as error:
        log.warning("cannot share cell costs in %s: %s", folder, error)
        return None


@dataclass(frozen=True, slots=True)
class Planning:
    """Surroundings of a process that plans, live or simulated."""

    setup: RoleSetup
    terrain: Terrain
    bus: Bus
    post: Post
    worker: Worker


class PlanningProcess(MemberService):
    """One of several processes with the same job; their leader serves.

    groups         those whose marks it may know; None if all
    served         topics that the leader serves, and the fields of their keys
    all_kernels    whether all kernels are ready, not only those for whole trees of `first_classes`; default: yes
    """

    def __init__(
        self,
        planning: Planning,
        groups: frozenset[str] | None,
        served: Mapping[Topic, dict[str, str]],
        all_kernels: Callable[[], bool] | None,
    ) -> None:
        setup, terrain, bus, post = planning.setup, planning.terrain, planning.bus, planning.post
        scenario = setup.scenario
        self._scenario, self._job, self._incarnation = scenario, job_of(setup.id), setup.incarnation
        self._bus, self._post, self._worker = bus, post, planning.worker
        self._served_topics = served
        self._all_kernels = all_kernels or (lambda: True)
        self._first_classes = first_classes(scenario)
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post, setup.before)
        self._candidacy = Candidacy(setup, scenario.standbys.planner, scenario.planner.tick_hz, bus, post)
        cost_map = CostMap(terrain, learning=scenario.map.learning)
        self._mark_filter = MarkFilter(terrain.grid, groups)
        self._maps = ClassMaps(cost_map, class_terrains(scenario, terrain), class_numbers(scenario))
        self._cost_maps = {GROUND: cost_map} | self._maps.of
        self._replica = MapReplica(terrain.grid, self._maps, filter=self._mark_filter)
        self._sync = MapSync(self._replica, bus, post, scenario.map, setup.role)
        self._learned = LearnedGauges(cost_map.keys, self.counters)
        self._order_client = OrderClient(setup, bus, post, self._obeys)
        self._leads = False
        self._now_ns = 0
        self._member.needs("the shared map", lambda: self._sync.joined)

    def _obeys(self, order: Obey) -> bool:
        """Returns True if all that the process answers follows this order."""
        raise NotImplementedError

    def _has_kernels(self, name: str) -> bool:
        """Returns True if the trees of a class can be grown. The kernels of "ground" are always among the first."""
        return name == GROUND or name in self._first_classes or self._all_kernels()

    def _fault_of(self, name: str) -> str | None:
        """Reason why nothing can be asked for a class; None if something can."""
        if name not in self._cost_maps:
            return f"there is no class {name!r}{choice(name, [*self._cost_maps], ' there are ')}"
        return None if self._has_kernels(name) else f"the kernels for class {name} are still being compiled"

    def start(self, now_ns: int) -> None:
        self._member.join()
        self._sync.start(now_ns)
        self._order_client.start(now_ns)
        self._candidacy.start()
        self._lead(self._candidacy.leads, now_ns)

    def handle(self, event: Event, now_ns: int) -> None:
        """Gives an event to the one part that takes it."""
        if not self._member.on_member_event(event):
            handlers = (
                self._sync.on_map_event,
                self._candidacy.on_election_event,
                self._order_client.on_order_event,
            )
            any(takes(event, now_ns) for takes in handlers)

    def _take_map(self, now_ns: int) -> None:
        """Begins a tick: takes what others say about the map."""
        self._now_ns = now_ns
        self._sync.tick(now_ns)
        self._learned.tick(self._cost_maps[GROUND].factors)

    def _lead(self, leads: bool, now_ns: int) -> None:
        """Serves, or leaves that to another. A query which comes meanwhile is answered all the same."""
        if leads == self._leads:
            return
        self._leads = leads
        for topic, fields in self._served_topics.items():
            if leads:
                self._bus.serve(topic, self._post, **fields)
            else:
                self._bus.unserve(topic, **fields)
        self._candidacy.note_lead(self._member, now_ns)

    def _push(self, route: PushedRoute) -> None:
        self._bus.publish(PUSHED_ROUTE, route, agent=agent_of(route.vehicle), vehicle=route.vehicle)

    def _refuse(self, event: Asked, reason: str) -> None:
        event.refuse(reason)
        event.end()
