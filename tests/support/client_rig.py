"""A program of the client library on a simulated network: the session that a live one has, without its thread."""

from support.makers import run_info
from support.swarm_model import SwarmModel

from swarm.bus.bus import Event
from swarm.client.connected_swarm import Swarm
from swarm.client.session import TICK_S, Session
from swarm.clock import NS_PER_S, Clock
from swarm.grid import GridSpec
from swarm.wire.messages.processes import RunInfo


def keeper_info(grid: GridSpec, run_id: str = "run") -> RunInfo:
    """The answer of a keeper of a run with two classes of vehicles."""
    return run_info(grid, run_id=run_id, role="keeper", id="0", classes=["walker", "truck"])


class SlowClock:
    """A clock that is behind another."""

    def __init__(self, clock: Clock, behind_ns: int) -> None:
        self._clock, self._behind_ns = clock, behind_ns

    def now_ns(self) -> int:
        return self._clock.now_ns() - self._behind_ns


class Program:
    """The view of a program (`swarm`), and the session behind it.

    slow_ns  its clock is behind that of all others by so much, which it learned when it connected
    """

    def __init__(self, world: SwarmModel, node: str = "program", slow_ns: int = 0) -> None:
        self.world = world
        self.bus = world.bus(node)
        clock = SlowClock(world.scheduler.clock, slow_ns)
        self.session = Session(self.bus, keeper_info(world.terrain.grid), clock, self._post, ahead_ns=slow_ns)
        self.swarm = Swarm(self.session)
        self.problems: list[str] = []
        self.swarm.on_problem(self.problems.append)
        self._tick()

    def _post(self, event: Event) -> None:
        if not self.bus.closed:
            self.session.on_session_event(event)

    def _tick(self) -> None:
        if not self.bus.closed:
            self.session.tick()
            self.world.scheduler.after(int(TICK_S * NS_PER_S), self._tick)
