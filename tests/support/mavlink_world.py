"""An adapter's core between a vehicle and a swarm that a test plays, on a clock that it moves."""

from dataclasses import dataclass, field

from launch_scripts.gateways.mavlink import mavlink_codec as codec
from launch_scripts.gateways.mavlink.adapter import Action, Adapter
from launch_scripts.gateways.mavlink.arming import ARDUPILOT, PX4
from launch_scripts.gateways.mavlink.guidance import Options, Way
from swarm.client import Frame
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec

GRID = GridSpec(60, 80, 30.0, 740_000.0, 4_030_000.0, "EPSG:32616")
FRAME = Frame(GRID)
ROVER, COPTER, PLANE = 10, 2, 1
MANUAL = 0
TICK_NS = NS_PER_S // 20
START = GRID.cell(40, 10)
TO_THE_EAST: Way = tuple(GRID.centre_m(GRID.cell(40, col)) for col in range(10, 40))
WITH_A_TURN: Way = (*TO_THE_EAST, *(GRID.centre_m(GRID.cell(row, 39)) for row in range(39, 20, -1)))
NOWHERE: Way = ()


@dataclass
class Autopilot:
    """Behaviour outside of the core's simulation: PX4 or ArduPilot as far as their protocols go.

    answers  it takes part in missions and obeys commands; a test may take that away
    """

    autopilot: int = ARDUPILOT
    type: int = ROVER
    answers: bool = True
    armed: bool = False
    mode: int = MANUAL
    cell: int = START
    height_m: float = 0.0
    missions: list[list[codec.MissionItem]] = field(default_factory=list)
    commands: list[codec.Command] = field(default_factory=list)
    _wanted: int = 0
    _items: list[codec.MissionItem] = field(default_factory=list)

    def beat(self) -> codec.Beat:
        return codec.Beat(self.autopilot, self.type, self.armed, self.mode)

    def position(self) -> codec.Position:
        return codec.Position(*FRAME.to_wgs84(*GRID.centre_m(self.cell)), self.height_m, 2.0, 1.0)

    def hear(self, action: Action) -> list[codec.Incoming]:
        """Its answers."""
        if isinstance(action, codec.Command):
            self.commands.append(action)
        if not self.answers:
            return []
        match action:
            case codec.MissionCount(items=items):
                self._wanted, self._items = items, []
                return [codec.ItemAsked(0)]
            case codec.MissionItem(seq=seq) if seq == len(self._items) and self._wanted:
                self._items.append(action)
                if len(self._items) < self._wanted:
                    return [codec.ItemAsked(len(self._items))]
                self._wanted = 0
                self.missions.append(self._items)
                return [codec.MissionAnswered(0)]
            case codec.Command(command=command, params=params):
                return [codec.CommandAnswered(command, self._obey(command, params))]
        return []

    def _obey(self, command: int, params: tuple[float, ...]) -> int:
        if command == codec.ARM_DISARM:
            self.armed = params[0] == 1
        elif command == codec.DO_SET_MODE and self.autopilot == PX4:
            self.mode = int(params[1]) << 16 | int(params[2]) << 24
        elif command == codec.DO_SET_MODE:
            self.mode = int(params[1])
        return 0


class World:
    """Ticks the core twenty times a second, with a heartbeat a second and ten positions while the vehicle speaks.

    sent  actions of the core, with their times
    """

    def __init__(self, options: Options, vehicle: Autopilot | None = None) -> None:
        self.vehicle = vehicle or Autopilot()
        self.adapter = Adapter(FRAME, options)
        self.options = options
        self.now_ns = 100 * NS_PER_S
        self.speaks = True
        self.sent: list[tuple[int, Action]] = []
        self._ticks = 0

    def run(self, seconds: float) -> list[Action]:
        """Messages meanwhile."""
        before = len(self.sent)
        for _ in range(round(seconds * NS_PER_S / TICK_NS)):
            self.tick()
        return [action for _, action in self.sent[before:]]

    def tick(self) -> list[Action]:
        if self.speaks and self._ticks % 20 == 0:
            self.hear(self.vehicle.beat())
        if self.speaks and self._ticks % 2 == 0:
            self.hear(self.vehicle.position())
        self._ticks += 1
        self.now_ns += TICK_NS
        actions = self.adapter.tick(self.now_ns)
        self.sent += [(self.now_ns, action) for action in actions]
        if self.speaks:
            for action in actions:
                for answer in self.vehicle.hear(action):
                    self.hear(answer)
        return actions

    def hear(self, message: codec.Incoming) -> None:
        self.adapter.on_message(message, self.now_ns)

    def sentences(self) -> list[str]:
        return [action for _, action in self.sent if isinstance(action, str)]
