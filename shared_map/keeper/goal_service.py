"""The keeper's book of goals: an acknowledged order that sends a vehicle is on its disk, and told to the agent."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from msgspec.structs import replace

from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Asked, Bus, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of, plan_agents
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND
from swarm.errors import ConfigError, StoreError
from swarm.places import cell_of
from swarm.runtime.order_book import MOST_SENT, GoalBook, fault_of_vehicle
from swarm.wire.messages import Nothing
from swarm.wire.messages.orders import Goals, GoalStates, SendVehicle, VehicleGoals
from swarm.wire.topics import GOAL_STATES, GOALS, SEND_VEHICLE

_TELL_NS = NS_PER_S
_TAG = "goals"


class KeptGoals:
    """Takes in where operators send vehicles and what these have reached, and tells each agent its own.

    vehicles  the vehicles that may be meant by a name: all that are known, with that one if it is among them

    book  the goals; those of the store from the start
    """

    def __init__(
        self,
        id: str,
        scenario: Scenario,
        terrain: Terrain,
        store: KeeperStore,
        bus: Bus,
        post: Post,
        vehicles: Callable[[str], Sequence[str]],
    ) -> None:
        self.book = GoalBook()
        self._id, self._terrain, self._store, self._bus, self._post = id, terrain, store, bus, post
        self._vehicles = vehicles
        self._on_ground = {plan.id for plan in plan_agents(scenario) if plan.group.vehicle_class == GROUND}
        """Agents whose vehicles find the terrain's own lethal cells lethal."""
        self._unsaved: list[VehicleGoals] = []
        """News of other keepers and agents that is not on our disk yet."""
        self._due_ns = 0

    def start(self, now_ns: int) -> None:
        self.book.merge(self._store.goals(), now_ns)
        self._bus.serve(SEND_VEHICLE, self._post, keeper=self._id)
        self._bus.serve(GOALS, self._post, id=self._id)
        self._bus.subscribe(GOALS, self._post)
        self._bus.subscribe(GOAL_STATES, self._post)
        self._bus.ask(GOALS, Nothing(), self._post, tag=_TAG)  # a store may be new while the swarm is old

    def take_goal_event(self, event: Event, now_ns: int) -> VehicleGoals | str | bool:
        """Returns True if the event was about goals and needs no other handler; for a given order also the goals,
        or the reason for refusing it."""
        match event:
            case Heard(message=Goals(id=id)) if id == self._id:
                return True
            case Heard(message=Goals() as told) | Replied(message=Goals() as told):
                self._unsaved += self.book.merge(told.goals, now_ns)
            case Heard(message=GoalStates() as reached):
                held = ((self.book.get(each.name), each) for each in reached.states)
                news = [
                    replace(goals, done=new.done) for goals, new in held if goals and goals.stamp_ns == new.stamp_ns
                ]
                self._unsaved += self.book.merge(news, now_ns)
            case Asked(topic=topic, fields=fields) if topic is GOALS:
                known = {agent_of(each.name) for each in self.book}
                for agent in sorted(known) if fields["agent"] == "*" else [fields["agent"]]:
                    event.answer(self._goals(agent), agent=agent)
                event.end()
            case Asked(request=SendVehicle() as given):
                goals = self._take(given, now_ns) if given.changes else None
                if isinstance(goals, str):
                    event.refuse(goals)
                    event.end()
                    return goals
                if goals is not None:
                    self._tell(agent_of(goals.name))
                event.answer(Goals(id=self._id, goals=list(self.book), given=goals), keeper=self._id)
                event.end()
                return goals or True
            case _:
                return False
        return True

    def tick(self, now_ns: int) -> None:
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + _TELL_NS
        try:
            self._store.save_goals(self._unsaved)
            self._unsaved = []
        except StoreError:
            return  # as for orders: what is told is on the disk
        for agent in sorted({agent_of(goals.name) for goals in self.book}):
            self._tell(agent)

    def _tell(self, agent: str) -> None:
        self._bus.publish(GOALS, self._goals(agent), id=self._id, agent=agent)

    def _goals(self, agent: str) -> Goals:
        ours = [goals for goals in self.book if agent_of(goals.name) == agent]
        return Goals(id=self._id, agent=agent, goals=ours, shared=shared_by(self.book, ours))

    def _take(self, given: SendVehicle, now_ns: int) -> VehicleGoals | str:
        vehicle, grid = given.vehicle, self._terrain.grid
        if (fault := fault_of_vehicle(vehicle, self._vehicles(vehicle))) is not None:
            return fault
        if len(self.book) >= MOST_SENT and self.book.get(vehicle) is None:
            return f"vehicle {vehicle}: {MOST_SENT} vehicles have been sent already, which is the limit"
        try:
            cells = [cell_of(place, MapFrame(grid), "place") for place in given.places]
            if (fault := self._fault_of(given, cells)) is not None:
                return f"vehicle {vehicle}: {fault}"
            goals = VehicleGoals(
                name=vehicle, stamp_ns=self.book.stamp_after(vehicle, now_ns), off=given.off, cells=cells,
                then=given.then,
            )  # fmt: skip
            self._store.save_goals([goals])
        except ConfigError as error:
            return f"vehicle {vehicle}: {error}"
        except StoreError as error:
            return str(error)
        self.book.merge([goals], now_ns)
        return goals

    def _fault_of(self, given: SendVehicle, cells: Sequence[int]) -> str | None:
        """Reason why the vehicle cannot go to these cells. Planners know what is lethal for other classes."""
        if given.then == "repeat" and len(set(cells)) < 2:
            return "to repeat, expected two different places or more"
        if agent_of(given.vehicle) not in self._on_ground:
            return None
        pace = self._terrain.pace_s_per_m.reshape(-1)
        lethal = next((cell for cell in cells if not float(pace[cell]) < float("inf")), None)
        return None if lethal is None else f"place {list(divmod(lethal, self._terrain.grid.cols))} is lethal"


def shared_by(all: Iterable[VehicleGoals], ours: Iterable[VehicleGoals]) -> list[tuple[int, int]]:
    """(cell, how many vehicles were sent there) of each of our cells to which more than one was."""
    sent = Counter(cell for goals in all for cell in set(goals.cells))
    return [
        (cell, sent[cell]) for cell in sorted({cell for goals in ours for cell in goals.cells}) if sent[cell] > 1
    ]
