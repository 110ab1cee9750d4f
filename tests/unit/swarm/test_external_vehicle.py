"""An external vehicle's side of right of way, and the bounds that leaders set to external vehicles."""

import math
from unittest.mock import MagicMock

import numpy as np
import pytest

from swarm.errors import BusError, ConfigError, StoreError
from swarm.grid import GridSpec
from swarm.right_of_way import external_on_bus
from swarm.right_of_way import shard_leader as leaders
from swarm.right_of_way.external_on_bus import ExternalService, ExternalSession
from swarm.right_of_way.external_vehicle import ExternalVehicle
from swarm.right_of_way.generations import MemoryGenerations
from swarm.right_of_way.shard_leader import Leader
from swarm.right_of_way.shards import Shards
from swarm.wire.codec import decode, encode
from swarm.wire.messages.traffic import Held, HostState, Stand, Table

GRID = GridSpec(64, 64, 1.0)
SHARDS = Shards(GRID, ["a0", "a1", "a2"])


def leader_of(**of: object) -> Leader:
    fields: dict[str, object] = {"hosts": {}, "grants": {}, **of}
    table = Table(shard=0, agent="a0", epoch=3, seq=1, **fields)  # type: ignore[arg-type]
    return Leader(SHARDS, SHARDS.leader(0, 6), 6, table, {"a0": ["a0-00"], "a1": ["a1-00"], "a2": ["a2-00"]})


def entering(name, cell, seq=1, ahead=None, generation=1 << 32):
    stand = Stand(f"{name}-00", cell, cell, Held(), ahead or [cell], [], 0, 0)
    return state_of(name, [stand], seq, generation)


def state_of(host: str, stands: list[Stand], seq: int, generation: int = 1 << 32) -> HostState:
    return HostState(shard=0, agent=host, generation=generation, seq=seq, knows=(0, 0), vehicles=stands)


def entered(cell: int = 70) -> tuple[ExternalVehicle, Leader]:
    external, leader = ExternalVehicle(SHARDS, "rover"), leader_of()
    external.enter(cell)
    external.begin(7)
    talk(external, leader)
    assert external.cells == (cell,)
    return external, leader


def talk(external: ExternalVehicle, leader: Leader, now_ns: int = 0) -> None:
    """Passes messages between the external vehicle and the leader as if they were on file."""
    for action in external.tick(now_ns):
        leader.take_host_state(action.state, now_ns)
    table = leader.tick(now_ns)
    if table is not None:
        for granted in leader.granted(table, now_ns):
            external.host.hear_granted(granted, now_ns)


def test_it_enters_drives_on_what_it_is_granted_and_gives_back_what_it_does_not_want_any_more() -> None:
    external, leader = entered()
    external.want([70, 71, 72, 73])
    talk(external, leader, 1)
    assert external.cells == (70, 71, 72, 73)
    external.left(70)
    assert external.cells == (71, 72, 73)
    external.want([71, 72, 136])
    assert external.cells == (71, 72)
    external.leave()
    assert external.cells == ()
    assert not external.gone
    for heartbeat in range(1, 4):
        talk(external, leader, heartbeat * 300_000_000)
    assert external.gone


@pytest.mark.parametrize("beside", [1, GRID.cols, -GRID.cols], ids=["straight", "down", "up"])
def test_on_a_diagonal_step_it_may_clip_the_cells_beside_it_and_no_others(beside: int) -> None:
    """The middle of the step is a corner of four cells."""
    external, leader = entered(700)
    goal = 701 if beside == 1 else 701 + beside
    external.want([700, goal])
    talk(external, leader, 1)
    assert external.cells == (700, goal)
    (x0_m, y0_m), (x1_m, y1_m) = GRID.centre_m(700), GRID.centre_m(goal)
    step_m = math.hypot(x1_m - x0_m, y1_m - y0_m)
    for along in np.linspace(0, 1, 41):
        for aside_m in (-0.6, -0.24, 0.0, 0.24, 0.6):
            x_m = x0_m + along * (x1_m - x0_m) + aside_m * (y1_m - y0_m) / step_m
            y_m = y0_m + along * (y1_m - y0_m) - aside_m * (x1_m - x0_m) / step_m
            cell = GRID.cell_at(x_m, y_m)
            counted = external.counted(cell, x_m, y_m)
            if cell in external.cells:
                assert counted == cell
            else:
                assert counted == (700 if abs(aside_m) < 0.25 else cell)
    away_m = GRID.centre_m(710)
    assert external.counted(710, *away_m) == 710


def test_what_a_driver_says_wrong_is_one_sentence() -> None:
    external = ExternalVehicle(SHARDS, "rover")
    with pytest.raises(ValueError, match="cell 9999 is outside the map of 4096 cells"):
        external.enter(9999)
    with pytest.raises(ValueError, match="it holds no cell"):
        external.want([1, 2])
    external, _ = entered()
    with pytest.raises(ValueError, match="it holds cell 70: leave before it enters elsewhere"):
        external.enter(3)
    with pytest.raises(ValueError, match="must begin at the vehicle's cell: it holds cell 70"):
        external.want([71])
    with pytest.raises(ValueError, match="cell 80 of the path is not next to cell 70"):
        external.want([70, 80])
    with pytest.raises(ValueError, match="cannot have left cell 70"):
        external.left(70)


def test_a_name_that_cannot_be_a_part_of_a_key_is_refused() -> None:
    with pytest.raises(ConfigError, match="external vehicle 'my rover-00'"):
        ExternalService("my rover", GRID, 1, MemoryGenerations(), None, print, print)  # type: ignore[arg-type]


def test_who_drives_on_before_it_is_let_in_asks_for_where_it_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(external_on_bus, "_ENTER_S", 0.01)
    bus, file = MagicMock(proves_names=False), MagicMock(generations=[])
    with ExternalSession("rover", GRID, bus, file) as session:
        for cell in (70, 71):
            assert not session.stands(cell)
            assert session._service._cell == cell


def test_a_session_whose_thread_has_failed_says_so_and_is_closed_all_the_same() -> None:
    bus, file = MagicMock(proves_names=False), MagicMock(generations=[])
    session = ExternalSession("rover", GRID, bus, file)
    session._inbox.fail(StoreError("the disk is full"))
    with pytest.raises(BusError, match="right of way has ended: the disk is full"):
        session.may_enter(70, timeout_s=5.0)
    session.close()
    assert (bus.close.called, file.close.called) == (True, True)


def test_a_host_may_speak_for_vehicles_of_its_own_name_only() -> None:
    leader = leader_of()
    for vehicle in ("a1-00", "other-00", "rover2-00"):
        stand = Stand(vehicle, 70, 70, Held(), [70], [], 0, 0)
        leader.take_host_state(state_of("rover", [stand], seq=1, generation=5), 0)
        table = leader.tick(0)
        assert table is None or not table.grants


def test_no_external_vehicle_and_not_all_together_take_all_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    leader = leader_of()
    leader.take_host_state(entering("rover", 0), 0)
    leader.tick(0)
    for seq in range(2, 12):  # one vehicle that never moves and always wants more
        held = list(leader._orders.of["rover-00"])
        end = held[-1][0]
        ahead = list(range(end + 1, end + 13))
        stand = Stand("rover-00", 0, end, Held.of(held), ahead, ahead[:1], 1, 0)
        leader.take_host_state(state_of("rover", [stand], seq), 0)
        leader.tick(0)
    table = leader.tick(1 << 40)
    assert len(table.grants["rover-00"]) == leaders.MOST_CELLS
    decode(encode(table), Table)

    monkeypatch.setattr(leaders, "MOST_CELLS_OF_EXTERNAL", 3)
    monkeypatch.setattr(leaders, "MOST_CELLS_OF_EXTERNALS", 5)
    leader = leader_of()
    for n in range(4):
        leader.take_host_state(entering(f"r{n}", 8 * n, ahead=[8 * n, 8 * n + 1, 8 * n + 2, 8 * n + 3]), 0)
    table = leader.tick(0)
    held = sorted(len(numbers) for numbers in table.grants.values())
    assert sum(held) == 5
    assert held[-1] == 3


def test_a_shard_knows_a_bounded_number_of_external_vehicles_and_says_which_it_refuses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(leaders, "MOST_EXTERNALS", 2)
    leader = leader_of(hosts={"a1": (1, 1), "r0": (1, 1)})
    for n in (1, 2, 0, 1):
        leader.take_host_state(entering(f"r{n}", 8 * n, seq=n + 5), 0)
    assert leader.refused == ["shard 0 has known 2 external vehicles: r2 cannot enter"]
    table = leader.tick(0)
    assert set(table.grants) == {"r0-00", "r1-00"}
    leader.take_host_state(state_of("a2", [], seq=1, generation=1), 0)  # of the scenario
    assert len(leader.refused) == 1
