"""`gateway mavlink` under any events in any order: commands that are never sent to a vehicle, and those that always
are."""

from collections.abc import Callable
from typing import get_args

from hypothesis import given, settings
from hypothesis import strategies as st
from support import mavlink_world as mav
from support.effort import few

from launch_scripts.gateways.mavlink import mavlink_codec as codec
from launch_scripts.gateways.mavlink.adapter import Action, Follow, Report, Unfollow
from launch_scripts.gateways.mavlink.arming import ARDUPILOT, PX4, Arming, kind_of
from launch_scripts.gateways.mavlink.guidance import MOST_TRIES, RETRY_NS, Options, Way
from swarm.clock import NS_PER_S

OF_THE_WHEEL = (codec.ARM_DISARM, codec.DO_SET_MODE, codec.MISSION_START, codec.NAV_TAKEOFF)
TO_THE_VEHICLE = tuple(set(get_args(codec.Outgoing)) - {codec.Heartbeat})
LOST_S = 3.0

modes = st.sampled_from([mav.MANUAL, 3, 4, 10, 15, 4 << 16 | 4 << 24, 6 << 16, 4 << 16 | 3 << 24, 2**32 - 1])
kinds = st.sampled_from(
    [
        (PX4, mav.ROVER),
        (PX4, mav.COPTER),
        (ARDUPILOT, mav.ROVER),
        (ARDUPILOT, mav.COPTER),
        (ARDUPILOT, mav.PLANE),
        (0, 0),
    ]
)
places = st.sampled_from(
    [
        *(mav.FRAME.to_wgs84(*mav.GRID.centre_m(cell)) for cell in (0, mav.GRID.cell(40, 20), mav.GRID.cells - 1)),
        (36.4, -84.3), (0.0, 1.0), (90.0, 180.0), (-90.0, -180.0),
    ]
)  # fmt: skip
incoming = st.one_of(
    st.builds(
        codec.Beat,
        st.sampled_from([0, ARDUPILOT, PX4]),
        st.sampled_from([0, mav.ROVER, mav.COPTER]),
        st.booleans(),
        modes,
    ),
    places.map(lambda place: codec.Position(*place, 10.0, 400.0, None)),
    st.builds(codec.ItemAsked, st.integers(0, 70)),
    st.builds(codec.MissionAnswered, st.sampled_from([0, 1, 13, 15])),
    st.builds(codec.CommandAnswered, st.sampled_from([*OF_THE_WHEEL, 511]), st.integers(0, 6)),
    st.builds(codec.Warned, st.text(max_size=5)),
)
routes = st.sampled_from([mav.TO_THE_EAST, mav.WITH_A_TURN, mav.NOWHERE])


def became(**values: object) -> Callable[[mav.World], object]:
    """The vehicle or the world after a change from outside."""

    def become(world: mav.World) -> None:
        for name, value in values.items():
            setattr(world if name == "speaks" else world.vehicle, name, value)

    return become


steps = st.lists(
    st.tuples(
        st.one_of(
            incoming.map(lambda message: lambda world: world.hear(message)),
            routes.map(lambda way: lambda world: world.adapter.hear_way(way)),
            st.booleans().map(lambda up: lambda world: world.adapter.hear_swarm(up)),
            st.booleans().map(lambda speaks: became(speaks=speaks)),
            st.booleans().map(lambda answers: became(answers=answers)),
            modes.map(lambda mode: became(mode=mode)),
            st.booleans().map(lambda armed: became(armed=armed)),
        ),
        st.sampled_from([0, 1, 3, 20, 60, 130]),
    ),
    min_size=4,
    max_size=25,
)


@settings(max_examples=few(250), deadline=None)
@given(
    steps, kinds, st.sampled_from(["mission", "guided"]), st.booleans(), st.sampled_from([None, 30.0]),
    st.sampled_from([None, "t0", "t0", "t0"]), st.booleans(), routes,
)  # fmt: skip
def test_whatever_comes_the_vehicle_is_told_what_it_may_be_told_and_hears_us_each_second(
    steps: list[tuple[Callable[[mav.World], object], int]],
    kind: tuple[int, int],
    drive: str,
    arm: bool,
    altitude_m: float | None,
    target: str | None,
    answers: bool,
    way: Way,
) -> None:
    options = Options(target, drive, arm, altitude_m, lost_s=LOST_S)  # type: ignore[arg-type]
    world = mav.World(options, mav.Autopilot(*kind, answers=answers))
    laws = Laws(world)
    laws.run(20)
    world.adapter.hear_way(way)
    laws.run(20)
    for act, ticks in steps:
        act(world)
        laws.run(ticks)
    world.adapter.stop(world.now_ns)


class Laws:
    """Invariants after each tick, from messages in and out alone."""

    def __init__(self, world: mav.World) -> None:
        self.world = world
        self.heartbeat_ns = world.now_ns
        self.received_ns = {codec.Beat: -NS_PER_S * 1000, codec.Position: -NS_PER_S * 1000}
        self.answered_ns = -NS_PER_S
        self.asked_ns = -NS_PER_S
        self.spoken: Action | None = None
        """The last message of the mission in flight; None while there is none."""
        self.spoken_ns = 0
        self.items = self.asked = self.tries = 0
        """The mission in flight: its number of items, the number of requested items, the number of repetitions of
        `spoken`."""
        hear = world.adapter.on_message

        def listen(message: codec.Incoming, now_ns: int) -> None:
            if type(message) in self.received_ns:
                self.received_ns[type(message)] = now_ns
            # Any answer of the vehicle, and each refusal, may end an upload.
            if isinstance(message, codec.MissionAnswered):
                self.answered_ns = now_ns
            if isinstance(message, codec.ItemAsked):
                self.asked, self.asked_ns = self.asked + 1, now_ns
            hear(message, now_ns)

        world.adapter.on_message = listen  # type: ignore[method-assign]

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.hold(self.world.tick(), self.world.now_ns)

    def hold(self, actions: list[Action], now_ns: int) -> None:
        for action in actions:
            if isinstance(action, codec.Heartbeat):
                self.heartbeat_ns = now_ns
            if isinstance(action, codec.Command) and action.command in OF_THE_WHEEL:
                assert self.world.options.arm, "nobody has asked us to arm it, or to change its mode"
            if isinstance(action, (*TO_THE_VEHICLE, Follow)):
                lost = now_ns - min(self.received_ns.values()) > LOST_S * NS_PER_S
                asks = isinstance(action, codec.Command) and action.command == codec.SET_MESSAGE_INTERVAL
                assert not lost or asks, "it is left to its own fail-safe"
                assert self.world.options.target is not None or asks, "it is not ours to drive"
            if isinstance(action, codec.Setpoint | codec.MissionCount | codec.MissionItem):
                if isinstance(action, codec.Setpoint) and self.world.vehicle.autopilot == ARDUPILOT:
                    continue  # which holds at one
                assert self.world.adapter._swarm_up, "nobody avoids it now"
            self.one_mission(action, now_ns)
            if isinstance(action, Report):
                mav.FRAME.cell(action.x_m, action.y_m)
                assert 0 <= action.speed_m_per_s <= 340
        assert now_ns - self.heartbeat_ns <= NS_PER_S
        assert (
            sum(isinstance(action, codec.Setpoint | codec.MissionItem | codec.MissionCount) for action in actions)
            <= 1
        )

    def one_mission(self, action: Action, now_ns: int) -> None:
        """A mission is begun where none is in flight: the one before was answered, cancelled, given up after its
        last try, or asked for beyond measure."""
        match action:
            case codec.MissionCount(items=items):
                again = action == self.spoken and self.tries < MOST_TRIES
                given_up = self.tries == MOST_TRIES and now_ns - self.spoken_ns >= RETRY_NS
                ended = self.answered_ns >= self.spoken_ns or self.asked > 8 * self.items
                assert self.spoken is None or again or given_up or ended, "two missions in flight"
                if not again:
                    self.items, self.asked, self.tries = items, 0, 0
            case codec.MissionItem(seq=seq):
                assert self.spoken is not None, "nobody was told of a mission"
                assert seq < self.items
            case codec.MissionCancelled() | Unfollow():
                self.spoken = None
                return
            case _:
                return
        self.tries = self.tries + 1 if action == self.spoken and self.asked_ns < self.spoken_ns else 1
        self.spoken, self.spoken_ns = action, now_ns


beats = st.tuples(st.booleans(), modes, st.sampled_from(["drive", "hold"]), st.floats(0, 5), st.floats(0, 50))


@settings(max_examples=few(400), deadline=None)
@given(kinds, st.booleans(), st.lists(beats, max_size=40))
def test_another_driver_that_takes_the_wheel_keeps_it(
    kind: tuple[int, int], guided: bool, beats: list[tuple[bool, int, str, float, float]]
) -> None:
    made = kind_of(codec.Beat(*kind, armed=False, mode=mav.MANUAL))
    mode = None if made.modes is None else made.modes.guided if guided else made.modes.mission
    if guided and mode is None:
        return
    hold = None if made.modes is None else made.modes.hold
    wheel = Arming(made, mode, starts=not guided, takeoff_m=None)
    drove = held = taken_away = False
    now_s = 0.0
    for armed, at, wish, for_s, height_m in beats:
        now_s += for_s
        beat, now_ns = codec.Beat(*kind, armed, at), int(now_s * NS_PER_S)
        drives = armed and (mode is None or at == mode)
        drove = drove or drives
        foreign = drove and not drives and not (armed and held and at == hold)
        actions = wheel.drive(beat, height_m, now_ns) if wish == "drive" else wheel.hold(beat, now_ns)
        command = actions[0] if actions else None
        held = held or (command is not None and wish == "hold")
        assert not (foreign and command is not None), "somebody else has set this mode"
        taken_away = taken_away or (foreign and bool(wheel.why))
        assert not (taken_away and command is not None), "it was taken away for good"
        if command is not None and command.command == codec.ARM_DISARM:
            assert not armed
            assert not drove, "it is armed once"
