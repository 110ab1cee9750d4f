"""The core of an agent: drives its vehicles, and decides what to ask of planners."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import chain, islice, zip_longest

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.slope_and_climb import may_be_pulled
from swarm.clock import NS_PER_S
from swarm.config.scenario import AgentPlan, Scenario
from swarm.grid import Window, joined, walk
from swarm.right_of_way.holdings import CellRequest, Holdings
from swarm.runtime.tracker_ownership import Trackings
from swarm.wire.messages.orders import GoalState
from swarm.wire.messages.planning import PlaceRouteReply, PushedRoute, RouteReply, TargetPose
from swarm.wire.messages.vehicles import Followed, SharedCosts
from swarm.wire.route_columns import Route, RouteStatus
from vehicle_agent.agent_maps import LocalMap, meet
from vehicle_agent.assignment import Assigner, Spread
from vehicle_agent.driving.driven_vehicle import PLACES, GivenRoute, Reason, Vehicle, goal_name, goal_of
from vehicle_agent.driving.driver import Driver
from vehicle_agent.driving.dynamics import PluginDynamics
from vehicle_agent.goal_queues import REASONS, GoalQueues
from vehicle_agent.sensing.sensor import Findings, Sensor, compare
from vehicle_agent.sensing.target_detector import EmptyPlaces
from vehicle_agent.target_choice import AskCosts, Assignment, GroupCosts
from vehicle_agent.traffic.detours import Detours
from vehicle_agent.traffic.next_cells import FAR_CELLS, CellRequests, Steering
from vehicle_agent.traffic.obstacles import Obstacles

_MANY_WAIT = 0.025
"""Share of the vehicles. In free traffic fewer wait, and a third of the CPU time of 1,000 vehicles went into acts
between ticks; in crowds more do (`bench crowd`). Up to 40 vehicles are so few that one may always wait."""
_LONGEST_STEP_S = 0.5
"""Time that counts between two ticks at most: after a pause vehicles drive on from where they were, without a leap.
Chosen, not measured."""
_PATIENCE, _PATIENCE_S = 8.0, 1.0
"""Longest wait behind vehicles that do not go on: in times of a cell, and in seconds; the longer counts."""
_STALE_CELLS = 8
"""A route that ends so far from the newest pose of the target is of an older tree: ask again."""


@dataclass(frozen=True, slots=True)
class AskRoutes:
    """One request to one target's planner, for all vehicles that need a route now."""

    request: int
    target: str
    vehicles: tuple[str, ...]
    cells: tuple[int, ...]
    force: bool
    reroutes: int


AgentAction = AskRoutes | AskCosts


class Agent:
    """The vehicles of one agent process.

    Call `place` as soon as a vehicle's place is known. In each tick call `begin_drive`, `drive` until it returns
    None, writing each result into the map, and `decide`.

    plan       which vehicles, of which group
    local_map  the agent's map
    holdings   the cells that the vehicles may stand on and enter
    obstacles  what they must avoid and has no part in right of way
    assigner   which target each vehicle goes for; evenly spread if not given
    dynamics   how fast vehicles drive; as the ground allows if not given
    group      costs published by the other agents of the group, if the assigner asks for them

    grid        the cells of right of way
    stopped     whether an operator has stopped a vehicle
    assignment  asks for costs, and gives vehicles their targets
    """

    def __init__(
        self,
        plan: AgentPlan,
        scenario: Scenario,
        local_map: LocalMap,
        sensor: Sensor,
        holdings: Holdings,
        obstacles: Obstacles | None = None,
        assigner: Assigner | None = None,
        dynamics: PluginDynamics | None = None,
        group: GroupCosts | None = None,
    ) -> None:
        self.plan = plan
        self.vehicles: dict[str, Vehicle] = {}
        self.targets = list(plan.group.targets) or scenario.target_ids
        self.holdings = holdings
        self.blocked_ticks = 0
        self.stopped: Callable[[str], bool] = lambda vehicle: False
        self._config = scenario.vehicles
        self._map = local_map
        self.grid = grid = holdings.shards.grid
        self.obstacles = obstacles or Obstacles(grid)
        self._sensor = sensor
        chance = random.Random(f"{scenario.seed}/{plan.id}/{plan.first}")
        config = scenario.vehicles
        pace, climb = local_map.pace, local_map.climb
        self._steering = Steering(grid, pace, scenario.planner, config.reserve_cells, self.obstacles, climb)
        holdings.keeps = config.reserve_cells
        reach_cells = max(config.reserve_cells, FAR_CELLS) + FAR_CELLS
        near, seed = reach_cells + 2, f"{scenario.seed}/{plan.id}"
        self._cell_requests = CellRequests(self._steering, holdings, near, self._target_cell, self._in_reach, seed)
        self._pulled = scenario.planner.routes == "pulled" and may_be_pulled(climb)
        self._driver = Driver(
            local_map,
            holdings,
            self._steering.passable,
            dynamics,
            pulled=self._pulled,
            measures=scenario.map.learning,
        )
        self.goals = GoalQueues(lambda cell: self._steering.steps(cell) if cell < grid.cells else (), grid.middle)
        self._goals_taken = -1
        """Version of the goals by which the vehicles go."""
        self._forget_due_ns = 0
        self.detours = Detours(grid, pace, self._steering.steps, self.obstacles, climb)
        self._planners: dict[str, int] = {}
        self._poses: dict[str | None, TargetPose] = {}
        self._trackings = Trackings(local_map.grid)
        self._empty = EmptyPlaces(self._trackings)
        self._lost: set[str] = set()
        """Targets that had no position at the last `decide`."""
        self._unseen: set[str] = set()
        """Unseen targets: their planners name places to search."""
        self._requests = 0
        self._route_requests: dict[int, AskRoutes] = {}
        assigner, stagger = assigner or Spread(), chance.random()
        self.assignment = Assignment(self.vehicles, self.targets, assigner, config.reassign_s, stagger, group)
        self.set_pace(scenario.time_scale, config.reassign_s)
        self._unassigned = False
        """True if vehicles have been placed that have no assignment yet."""
        sense_cells = (int(config.sense_range_m / local_map.grid.resolution_m) + 1) * grid.parts
        self._sight_cells = max(sense_cells, reach_cells + 1)
        """Changes so near concern a vehicle, whatever its route: it looks there, or may hold a cell there."""
        self.seen_lethal: set[int] = set()
        """Cells in zones which vehicles saw are truly lethal: no way out crosses them."""
        self._driven_ns: int | None = None
        self._bounds: list[tuple[int, int, int, int]] = []
        """Bounds of the vehicles' routes, and these as an array, a cell wider on each side."""
        self._route_boxes: NDArray[np.int64] = np.empty((0, 4), np.int64)

    # --- what operators order ---------------------------------------------------------------------------------

    def set_targets(self, targets: Sequence[str], now_ns: int) -> None:
        """Sets the targets that vehicles may chase from now on. A vehicle without one of them gets one."""
        if list(targets) == self.targets:
            return
        self.targets = list(targets)
        self.assignment.targets = self.targets
        for vehicle in self.vehicles.values():
            if vehicle.target is not None and vehicle.goal is None and vehicle.target not in self.targets:
                vehicle.release()
                self._driver.stop_soon(vehicle)
        self.assignment.ask_soon(now_ns)

    def follow_goals(self, shared: Mapping[int, int], now_ns: int) -> None:
        """Sends vehicles to their places in the book of `goals`, and recalls those which have none there any more.
        Called in each tick.

        shared  cell -> how many vehicles of all agents were sent there, as in `GoalQueues`
        """
        goals = self.goals
        if shared != goals.shared or now_ns >= self._forget_due_ns:
            self._forget_due_ns = now_ns + NS_PER_S
            goals.shared = shared
            goals.forget_arrivals()
        if not self.goals_taken:
            self._goals_taken = goals.book.version
            for vehicle in self.vehicles.values():
                self._send(vehicle, now_ns)

    @property
    def goals_taken(self) -> bool:
        """True if the vehicles go by the book of goals as it is."""
        return self._goals_taken == self.goals.book.version

    @property
    def many_wait(self) -> bool:
        """Returns True if enough vehicles wait to enter a cell for acts between ticks to help them."""
        return len(self._steering.waiting_ns) + 1 >= _MANY_WAIT * len(self.vehicles)

    def goal_states(self, left: Collection[str]) -> list[GoalState]:
        """The state of each vehicle that was sent somewhere.

        left  vehicles that have left the map
        """
        return self.goals.states(self.vehicles, left, self.stopped, self._steering.waiting_ns)

    def _send(self, vehicle: Vehicle, now_ns: int) -> None:
        cell = self.goals.cell(vehicle.id)
        if cell == vehicle.goal:
            return
        vehicle.release()
        self.goals.refused.pop(vehicle.id, None)
        self._driver.stop_soon(vehicle)
        if cell is None:
            self.assignment.ask_soon(now_ns)
            return
        vehicle.assign(goal_name(cell), now_ns)
        if PLACES not in self._planners:
            vehicle.lose_planner(now_ns)

    def set_pace(self, time_scale: float, reassign_s: float) -> None:
        """Sets terrain seconds per second of the clock, and how often vehicles ask for the cheapest target."""
        self._time_scale = time_scale
        cell_s = self._map.cell_s(0.5) / self.grid.parts
        self._driver.patience_ns = int(max(_PATIENCE_S, _PATIENCE * cell_s / time_scale) * NS_PER_S)
        self.assignment.set_period(reassign_s)

    # --- where vehicles start -------------------------------------------------------------------------------

    def place(self, vehicles: Sequence[str]) -> None:
        """Adds vehicles whose places are known."""
        for id in vehicles:
            cell = self.holdings.path(id)[0]
            self.vehicles[id] = Vehicle(id, self.grid, cell)
            self._driver.entered[cell] = None
            self._unassigned = True
            self._goals_taken = -1

    def is_open(self, cell: int) -> bool:
        """Returns True if a vehicle may enter the map on a cell: it is not lethal, and no obstacle closes it, as
        far as all obstacles are known."""
        return not (self.obstacles.is_deaf or self._steering.closed(cell))

    def remove(self, vehicles: Sequence[str]) -> None:
        """Removes vehicles from the map: their cells are given back."""
        for id in vehicles:
            self.holdings.leave(id)
            self.vehicles.pop(id, None)
            self._cell_requests.forget(id)

    def stand_down(self) -> None:
        """Stops driving for ever, because another process drives the vehicles."""
        for id in list(self.vehicles):
            del self.vehicles[id]
            self._cell_requests.forget(id)

    @property
    def shut_in(self) -> Set[str]:
        """Vehicles which obstacles keep from driving anywhere."""
        return self._steering.shut_in & self.vehicles.keys()

    def set_exit_steps(self, exit_steps: Mapping[int, int]) -> None:
        """Takes the terrain's cells closed only by an operator's zone, with the number of steps from each to its
        edge."""
        self.seen_lethal.intersection_update(exit_steps)
        self._go_out(exit_steps)

    def _go_out(self, exit_steps: Mapping[int, int]) -> None:
        exit_steps = {cell: steps for cell, steps in exit_steps.items() if cell not in self.seen_lethal}
        if exit_steps == self._steering.exit_steps:
            return
        self._steering.exit_steps = exit_steps
        self._cell_requests.make_anew()
        for vehicle in self.vehicles.values():
            if vehicle.terrain_cell in exit_steps:  # a step along the way before this one is not allowed any more
                self._driver.end_path(vehicle)

    @property
    def cell_requests(self) -> Mapping[str, CellRequest]:
        """Vehicle -> the cells that it requests from leaders, as of the last `decide`."""
        return self._cell_requests.of

    @property
    def places(self) -> list[int]:
        """The cells of the terrain with cells that our vehicles hold."""
        held = chain.from_iterable(map(self.holdings.paths.__getitem__, self.vehicles))
        return list(map(self.grid.terrain_cell, held))

    @property
    def shut_ground(self) -> set[int]:
        """The cells of the terrain over which no way out leads: obstacles stand there, or vehicles have seen that
        they are lethal."""
        return self.seen_lethal.union(map(self.grid.terrain_cell, self.obstacles.standing))

    # --- driving --------------------------------------------------------------------------------------------

    def begin_drive(self, now_ns: int) -> None:
        """Begins a step: each vehicle may drive for the time since the last step, at most `_LONGEST_STEP_S`; not at
        all while obstacles are not received."""
        elapsed_s = 0.0 if self._driven_ns is None else (now_ns - self._driven_ns) / NS_PER_S
        if self.obstacles.is_deaf:
            elapsed_s = 0.0
        self._driven_ns = now_ns
        self._driver.begin(self.vehicles, min(elapsed_s, _LONGEST_STEP_S) * self._time_scale)

    def drive(self) -> Findings | None:
        """Makes vehicles drive until they come to another cell; returns what they find there, to be written into
        the map before they drive on. None when their time is over."""
        self._driver.drive(self.stopped)
        if not self._driver.entered:
            return None
        sight = self._sensor.look(list(dict.fromkeys(map(self.grid.terrain_cell, self._driver.entered))))
        self._driver.entered = {}
        if exit_steps := self._steering.exit_steps:
            # In a zone all is lethal by the map, so it cannot say which cells are so in truth.
            lethal = set(self._map.lethal(sight.cells, sight.paces).tolist())
            if seen := lethal.intersection(exit_steps):
                self.seen_lethal |= seen
                self._go_out(exit_steps)
        return compare(sight, self._map.ground, self._map.prior)

    def take_driven(self) -> list[tuple[int, float]]:
        """(cell, s/m) of each step that was driven freely since the last call (see `Driver`); none if nothing is
        learned."""
        driven, self._driver.driven = self._driver.driven, []
        return driven

    def map_changed(self, changed: Sequence[Window], now_ns: int, *, by_others: bool = False) -> None:
        """Cuts routes before newly lethal cells, and paths also before diagonal steps past one.

        changed    the windows with all cells of the terrain that have changed
        by_others  others may have changed the map: compare the view with it again
        """
        changed = list(map(self.grid.finer, changed))
        self._cell_requests.ground_changed(changed)
        if not changed or not self.vehicles:
            return
        vehicles = list(self.vehicles.values())
        cols, sight, pace = self.grid.cols, self._sight_cells, self._map.pace.reshape(-1)
        rows, east = np.divmod(np.array([vehicle.motion.cell for vehicle in vehicles], np.int64), cols)
        places = np.stack((rows - sight, east - sight, rows + sight, east + sight), 1)
        # A cell wider on each side: a diagonal step ends where a cell beside it is closed.
        bounds = [vehicle.route.bounds(cols) for vehicle in vehicles]
        if bounds != self._bounds:  # most calls of a tick find the routes as they were
            self._bounds, self._route_boxes = bounds, np.array(bounds, np.int64) + np.array((-1, -1, 1, 1))
        on_route, in_sight = meet(np.concatenate((self._route_boxes, places)), changed).reshape(2, -1)
        for index in np.flatnonzero(on_route | in_sight).tolist():
            vehicle = vehicles[index]
            ahead = self.grid.terrain_cell(np.array(vehicle.route.ahead(), np.int64))
            if np.isinf(pace[ahead]).any() and vehicle.route.cut(self._steering.passable_steps):
                vehicle.cut_route(now_ns)
            self._driver.end_path(vehicle)
            if by_others:
                self._driver.entered[vehicle.cell] = None

    def obstacles_moved(self) -> None:
        """Makes vehicles stop before cells that obstacles close, or turn back. Called before they drive: cells
        granted since the last time may be closed, too."""
        if self.obstacles.any:
            for vehicle in self.vehicles.values():
                self._driver.end_path(vehicle)

    # --- deciding -------------------------------------------------------------------------------------------

    def decide(self, now_ns: int) -> list[AgentAction]:
        """Decides what each vehicle needs next. Returns the requests to planners."""
        actions: list[AgentAction] = []
        asks: dict[tuple[str, bool], list[tuple[str, int, Reason]]] = {}
        self.blocked_ticks = 0
        if self._empty.find_gone(
            (each.target for each in self.vehicles.values() if each.target and each.in_reach), now_ns
        ):
            self.assignment.ask_soon(now_ns)
        lost = self._trackings.lost(now_ns) | self._empty.of
        for target in self._empty.unseen(lost) - self._unseen:
            self._unseen.add(target)
            del self._poses[target]
        self.detours.tick(self.vehicles.values(), self.holdings.path, now_ns)
        if lost != self._lost:
            self._lost = lost
            self.decide_anew()
        driven: list[Vehicle] = []
        paths, pushed, cell_requests = self.holdings.paths, self.holdings.pushed, self._cell_requests
        waiting = self._steering.waiting_ns
        cell_requests.drop_near_changes(list(self.vehicles.values()))
        for vehicle in self.vehicles.values():
            path, decided = paths[vehicle.id], vehicle.decided
            same = decided is not None and decided[0] is path and decided[1] == vehicle.route.version
            if same and vehicle.id not in pushed and cell_requests.is_kept(vehicle.id, now_ns):
                continue
            if vehicle.tracked == (vehicle.target in lost):
                vehicle.set_tracked(not vehicle.tracked)
            self._check_reach(vehicle)
            if vehicle.in_reach and vehicle.goal is not None and vehicle.motion.at_rest:
                self.goals.reached(vehicle.id, vehicle.goal, now_ns)
            stopped = self.stopped(vehicle.id)
            if stopped:
                self._driver.stop_soon(vehicle)
            waits = self._driver.waits(vehicle, now_ns)
            path = paths[vehicle.id]
            if len(path) > 1 and vehicle.motion.at_rest:
                # Late grants may be closed by now, and would be held for ever.
                self._driver.end_path(vehicle)
                path = paths[vehicle.id]
            reason = vehicle.route_request(now_ns)
            if reason is not None and vehicle.target is not None:
                key = vehicle.target, reason is Reason.RAN_OUT
                start = self.grid.terrain_cell(path[: self.holdings.keeps + 1][-1])
                asks.setdefault(key, []).append((vehicle.id, start, reason))
            if stopped:
                self._cell_requests.stay(vehicle.id)
                continue
            driven.append(vehicle)
            if len(path) == 1:
                self.blocked_ticks += self._steering.blocked(vehicle, now_ns)
            else:
                waiting.pop(vehicle.id, None)
                if not waits and not vehicle.motion.at_rest and vehicle.needs_nothing:
                    vehicle.decided = path, vehicle.route.version
        cell_requests.make(driven, now_ns)
        for (target_id, force), batch in asks.items():
            self._requests += 1
            ids, cells, reasons = zip(*batch, strict=True)
            reroutes = sum(reason.is_reroute for reason in reasons)
            request = AskRoutes(self._requests, target_id, ids, cells, force, reroutes)
            self._route_requests[request.request] = request
            actions.append(request)
        if self._unassigned:
            # A new generation learns its vehicles' places one after the other, from several shards.
            self._unassigned = False
            self.assignment.ask_soon(now_ns)
        if self.vehicles and self.assignment.due(now_ns):
            self._requests += 1
            actions.append(self.assignment.ask(self._requests, now_ns))
        return actions

    def decide_anew(self, target: str | None = None) -> None:
        """Notes that an input of `decide` has changed, for all vehicles or those with a target."""
        for vehicle in self.vehicles.values():
            if target is None or vehicle.target == target:
                vehicle.decided = None

    def _target_cell(self, target: str | None) -> int | None:
        if (goal := goal_of(target)) is not None:
            return goal
        pose = self._poses.get(target)
        return None if pose is None else pose.cell

    def _in_reach(self, vehicle: Vehicle, cell: int) -> bool:
        if vehicle.goal is not None:
            return self.goals.is_at(vehicle.id, vehicle.goal, cell)
        pose = self._poses.get(vehicle.target)
        if pose is None:
            return False
        cols, resolution_m, at = self.grid.cols, self.grid.resolution_m, self.grid.middle(pose.cell)
        south, range_m = cell // cols - at // cols, self._config.capture_range_m
        if abs(south) * resolution_m > range_m:  # nearly always: asked of each vehicle in each tick
            return False
        return math.hypot(south, cell % cols - at % cols) * resolution_m <= range_m

    def _check_reach(self, vehicle: Vehicle) -> None:
        near = self._in_reach(vehicle, vehicle.cell)
        if near != vehicle.in_reach:
            vehicle.set_in_reach(near)
            if near:
                self._driver.stop_soon(vehicle, 1 + self.holdings.is_followed(vehicle.id))

    # --- what is heard --------------------------------------------------------------------------------------

    def take_pose(self, pose: TargetPose, now_ns: int) -> TargetPose | None:
        """Takes a tracker's pose of a target; returns it, with its cell, if it counts."""
        counts = self._trackings.counted(pose, now_ns)
        if counts is not None:
            self._empty.placed(pose.target, by_sight=False)
            self._moved(counts, now_ns)
        return counts

    def lost(self, now_ns: int) -> set[str]:
        """Targets whose position is unknown."""
        return self._trackings.lost(now_ns)

    def see_target(self, pose: TargetPose, now_ns: int) -> None:
        """Position of a target without a tracker, by the best sighting of it. A pose outside the grid is
        ignored."""
        if 0 <= pose.cell < self._map.grid.cells:
            if pose != self._poses.get(pose.target):
                self._empty.placed(pose.target, by_sight=True)
            self._trackings.place(pose, now_ns)
            self._moved(pose, now_ns)

    def _moved(self, pose: TargetPose, now_ns: int) -> None:
        known = self._poses.get(pose.target)
        self._poses[pose.target] = pose
        if known is None or known.cell != pose.cell:
            self.decide_anew(pose.target)
        found = pose.target in self._unseen
        self._unseen.discard(pose.target)
        if found or (known is not None and pose.jumps != known.jumps):
            for vehicle in self.vehicles.values():
                if vehicle.target == pose.target:
                    self._check_reach(vehicle)
                    vehicle.target_jumped(now_ns)
            self.assignment.target_jumped(now_ns)

    def set_planners(self, alive: Mapping[str, int], now_ns: int) -> None:
        """Takes which planners live: target, or PLACES, -> incarnation."""
        before, self._planners = self._planners, dict(alive)
        for vehicle in self.vehicles.values():
            target = vehicle.target if vehicle.goal is None else PLACES
            if target is None:
                continue
            if target not in alive and not vehicle.planner_gone:
                vehicle.lose_planner(now_ns)
            elif target in alive and (vehicle.planner_gone or before.get(target) != alive[target]):
                vehicle.regain_planner(now_ns)
        if any(target not in before for target in alive):
            self.assignment.ask_soon(now_ns)

    def routes_given(self, request: int, reply: RouteReply | PlaceRouteReply, now_ns: int) -> list[Followed]:
        """A planner's answer to `AskRoutes`; returns the routes that vehicles have begun."""
        asked = self._route_requests.pop(request, None)
        if asked is None:
            return []
        begun: list[Followed] = []
        pose = self._poses.get(asked.target)
        stale = (
            pose is not None
            and isinstance(reply, RouteReply)
            and reply.target_cell is not None
            and 0 <= reply.target_cell < self._map.grid.cells
            and self._map.grid.distance_cells(pose.cell, reply.target_cell) > _STALE_CELLS
        )
        for id, route in zip_longest(asked.vehicles, islice(reply.routes, len(asked.vehicles))):
            vehicle = self.vehicles.get(id)
            if vehicle is None:
                continue
            if route is None or stale:
                vehicle.no_answer(now_ns)
            else:
                begun += self._take(vehicle, asked.target, route, now_ns, pushed=False)
                if isinstance(reply, PlaceRouteReply) and reply.status in REASONS:
                    self.goals.refused[id] = self._why(reply)
        return begun

    def _why(self, reply: PlaceRouteReply) -> str:
        """The reason why no route leads to a place, or the status which says that."""
        near, grid = reply.nearest_cell, self._map.grid
        if near is None or near >= grid.cells:
            return reply.status
        return "{}; the nearest open cell is cell:{},{}".format(REASONS[reply.status], *grid.row_col(near))

    def routes_ended(self, request: int, now_ns: int) -> None:
        """Ends an `AskRoutes`, to which no more replies will come."""
        asked = self._route_requests.pop(request, None)
        for id in asked.vehicles if asked is not None else ():
            if id in self.vehicles:
                self.vehicles[id].no_answer(now_ns)

    def route_pushed(self, pushed: PushedRoute, now_ns: int) -> list[Followed]:
        """A newer route from a planner, unasked; returns it if the vehicle has begun it."""
        vehicle = self.vehicles.get(pushed.vehicle)
        if vehicle is None:
            return []
        target = goal_name(pushed.target_cell) if pushed.target is None else pushed.target
        return self._take(vehicle, target, pushed.route, now_ns, pushed=True)

    def _take(self, vehicle: Vehicle, target: str, route: Route, now_ns: int, pushed: bool) -> list[Followed]:
        searching = route.status is RouteStatus.SEARCHING
        if route.status is not RouteStatus.OK and not searching:
            if not pushed:
                self.goals.refused[vehicle.id] = route.status
                vehicle.refuse_route(target, route.status, now_ns)
            return []
        path = self.holdings.path(vehicle.id)
        try:
            given_cells = walk(self._map.grid, route.start, route.directions)
            cells, turns = joined(self.grid, given_cells, route.turns if self._pulled else (), path)
        except ValueError:
            cells = []
        if not cells or (searching and not math.isfinite(route.cost_s)):
            if not pushed:
                vehicle.no_answer(now_ns)
            return []
        if searching and target not in self._unseen and target in self.lost(now_ns):
            self._unseen.add(target)
            self._poses.pop(target, None)
        partial = route.remaining_s > 0.0
        given = GivenRoute(
            target, tuple(cells), route.cost_s, route.lower_bound_s, partial, pushed, searching, tuple(turns)
        )
        begun = vehicle.give_route(given, path, now_ns)
        if begun is None:
            return []
        if vehicle.route.cut(self._steering.passable_steps):
            vehicle.cut_route(now_ns)
        if path[-1] not in cells:  # it was granted cells along another route
            kept = max(index + 1 for index, cell in enumerate(path) if cell in cells)
            self._driver.stop_soon(vehicle, max(kept, 1 + self.holdings.is_followed(vehicle.id)))
        return [begun]

    # --- which target ---------------------------------------------------------------------------------------

    def costs_given(self, request: int, target: str, costs_s: NDArray[np.float32]) -> bool:
        """A planner's answer to `AskCosts`. Returns True if every living planner has answered."""
        self.assignment.costs_given(request, target, costs_s)
        return self.assignment.all_given(self._planners)

    def costs_ended(self, request: int, now_ns: int) -> SharedCosts | None:
        """No more answers to `AskCosts` will come; returns what to tell the other agents of the group."""
        standing = list(filter(self.stopped, self.vehicles))
        return self.assignment.costs_ended(request, self._planners, now_ns, self._empty.of, standing)
