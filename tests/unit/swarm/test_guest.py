"""A guest's side of right of way, and the bounds that wardens set to guests."""

from __future__ import annotations

from pathlib import Path

import pytest

from swarm.errors import ConfigError, DamagedError, StoreError
from swarm.grid import GridSpec
from swarm.right_of_way.guest import Guest, Removal
from swarm.right_of_way.guest_session import GuestService
from swarm.right_of_way.holdings import Tell
from swarm.right_of_way.incarnations import LifeFile, MemoryLives
from swarm.right_of_way.lock_regions import Plots
from swarm.wire.codec import decode, encode
from swarm.wire.messages.traffic import Fence, Granted, Known, Stand, Standing, Table
from vehicle_agent.traffic import warden as wardens
from vehicle_agent.traffic.warden import Warden

GRID = GridSpec(64, 64, 1.0)
PLOTS = Plots(GRID, ["a0", "a1", "a2"])
FLEETS = {"a0": ["a0-00"], "a1": ["a1-00"], "a2": ["a2-00"]}


def warden_of(**of: object) -> Warden:
    fields: dict[str, object] = {"hosts": {}, "grants": {}, **of}
    table = Table(plot=0, agent="a0", epoch=3, seq=1, **fields)  # type: ignore[arg-type]
    return Warden(PLOTS, PLOTS.warden(0, 6), 6, table, FLEETS)


def entering(name: str, cell: int, seq: int = 1, ahead: list[int] | None = None, life: int = 1 << 32) -> Standing:
    stand = Stand(f"{name}-00", cell, cell, [], ahead or [cell], [], 0, 0)
    return Standing(plot=0, agent=name, life=life, seq=seq, knows=(0, 0), vehicles=[stand])


def entered(cell: int = 70) -> tuple[Guest, Warden]:
    guest, warden = Guest(PLOTS, "rover"), warden_of()
    guest.enter(cell)
    guest.begin(7)
    talk(guest, warden)
    assert guest.cells == (cell,)
    return guest, warden


def talk(guest: Guest, warden: Warden, now_ns: int = 0) -> None:
    """Passes messages between the guest and the warden as if they were on file."""
    for action in guest.tick(now_ns):
        assert isinstance(action, Tell)
        warden.take_standing(action.standing, now_ns)
    table = warden.tick(now_ns)
    if table is not None:
        for granted in warden.granted(table, now_ns):
            guest.hear_granted(granted, now_ns)


def test_it_enters_drives_on_what_it_is_granted_and_gives_back_what_it_does_not_want_any_more() -> None:
    guest, warden = entered()
    guest.want([70, 71, 72, 73])
    talk(guest, warden, 1)
    assert guest.cells == (70, 71, 72, 73)
    guest.left(70)
    assert guest.cells == (71, 72, 73)
    guest.want([71, 72, 136])
    assert guest.cells == (71, 72)
    guest.leave()
    assert guest.cells == ()
    assert not guest.gone
    for beat in range(1, 4):
        talk(guest, warden, beat * 300_000_000)
    assert guest.gone


def test_what_a_driver_says_wrong_is_one_sentence() -> None:
    guest = Guest(PLOTS, "rover")
    with pytest.raises(ValueError, match="cell 9999 is outside the map of 4096 cells"):
        guest.enter(9999)
    with pytest.raises(ValueError, match="it holds no cell"):
        guest.want([1, 2])
    guest, _ = entered()
    with pytest.raises(ValueError, match="it holds cell 70: leave before it enters elsewhere"):
        guest.enter(3)
    with pytest.raises(ValueError, match="must begin at the vehicle's cell: it holds cell 70"):
        guest.want([71])
    with pytest.raises(ValueError, match="cell 80 of the path is not next to cell 70"):
        guest.want([70, 80])
    with pytest.raises(ValueError, match="cannot have left cell 70"):
        guest.left(70)


def test_a_name_that_cannot_be_a_part_of_a_key_is_refused() -> None:
    with pytest.raises(ConfigError, match="guest 'my rover-00'"):
        GuestService("my rover", GRID, 1, MemoryLives(), None, print, print)  # type: ignore[arg-type]


def test_a_host_may_speak_for_vehicles_of_its_own_name_only() -> None:
    warden = warden_of()
    lie = entering("rover", 70)
    for vehicle in ("a1-00", "other-00", "rover2-00"):
        stand = Stand(vehicle, 70, 70, [], [70], [], 0, 0)
        warden.take_standing(
            Standing(plot=0, agent="rover", life=5, seq=lie.seq, knows=(0, 0), vehicles=[stand]), 0
        )
        table = warden.tick(0)
        assert table is None or not table.grants


def test_no_guest_and_not_all_together_take_all_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    warden = warden_of()
    warden.take_standing(entering("rover", 0), 0)
    warden.tick(0)
    for seq in range(2, 12):  # one vehicle that never moves and always wants more
        held = list(warden._orders.of["rover-00"])
        end = held[-1][0]
        ahead = list(range(end + 1, end + 13))
        stand = Stand("rover-00", 0, end, held, ahead, ahead[:1], 1, 0)
        warden.take_standing(
            Standing(plot=0, agent="rover", life=1 << 32, seq=seq, knows=(0, 0), vehicles=[stand]), 0
        )
        warden.tick(0)
    table = warden.tick(1 << 40)
    assert table is not None
    assert len(table.grants["rover-00"]) == 64
    decode(encode(table), Table)

    monkeypatch.setattr(wardens, "MOST_CELLS_OF_GUEST", 3)
    monkeypatch.setattr(wardens, "MOST_CELLS_OF_GUESTS", 5)
    warden = warden_of()
    for n in range(4):
        warden.take_standing(entering(f"r{n}", 8 * n, ahead=[8 * n, 8 * n + 1, 8 * n + 2, 8 * n + 3]), 0)
    table = warden.tick(0)
    assert table is not None
    held = sorted(len(numbers) for numbers in table.grants.values())
    assert sum(held) == 5
    assert held[-1] == 3


def test_a_plot_knows_so_many_guests_and_says_whom_it_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wardens, "MOST_GUESTS", 2)
    warden = warden_of(hosts={"a1": (1, 1), "r0": (1, 1)})
    for n in (1, 2, 0, 1):
        warden.take_standing(entering(f"r{n}", 8 * n, seq=n + 5), 0)
    assert warden.refused == ["plot 0 has known 2 guests: r2 cannot enter"]
    table = warden.tick(0)
    assert table is not None
    assert set(table.grants) == {"r0-00", "r1-00"}
    warden.take_standing(
        Standing(plot=0, agent="a2", life=1, seq=1, knows=(0, 0), vehicles=[]), 0
    )  # of the scenario
    assert len(warden.refused) == 1


def test_an_operator_frees_what_all_lives_of_a_guest_hold_and_its_next_life_enters_again() -> None:
    guest, warden = entered()
    warden._orders.fenced["rover", 77] = {"rover-00": [(90, 1, 1), (91, 1, 1)]}
    lives = [77, warden._orders.hosts["rover"][0]]
    removal = Removal(PLOTS, "rover")
    for agent in PLOTS.agents:
        known = Known(agent=agent, disk=0, life=lives[1], plots=[0], agents=list(PLOTS.agents), lives=lives)
        removal.hear_known(known)
    assert removal.known
    assert removal.settled
    removal.begin(3)
    for beat in range(1, 6):
        now_ns = beat * 300_000_000
        for told in removal.tick(now_ns):
            warden.take_standing(told.standing, now_ns)
        table = warden.tick(now_ns)
        assert table is not None
        for granted in warden.granted(table, now_ns):
            removal.hear_granted(granted, now_ns)
            guest.hear_granted(granted, now_ns)
    assert removal.done
    assert not table.grants
    assert not table.fences
    assert guest.replaced
    assert guest.cells == ()

    back = Guest(PLOTS, "rover", [lives[1]])
    for agent in PLOTS.agents:
        life, _ = warden._orders.hosts["rover"]
        back.hear_known(Known(agent=agent, disk=0, life=life, plots=[], agents=[], lives=[]))
    back.enter(90)
    back.begin(9)
    talk(back, warden, 2_000_000_000)
    assert back.cells == (90,)
    table = warden.tick(3_000_000_000)
    assert table is not None
    assert table.fences == []  # no vehicle drove by the operator's incarnation


def test_a_replaced_guest_says_nothing_and_takes_nothing() -> None:
    guest, _ = entered()
    told = Granted(plot=0, host="rover", agent=PLOTS.warden(0, 6), epoch=6, seq=50, life=1 << 40, heard=0)
    guest.hear_granted(told, 5)
    assert guest.replaced
    assert guest.tick(6) == []
    assert guest.cells == ()


def test_what_was_shut_for_a_guest_is_opened_only_by_a_life_that_counts_and_is_its_own_first() -> None:
    held = {"rover-00": [(70, 1, 1), (71, 1, 1)]}
    warden = warden_of(hosts={"rover": (1 << 40, 9)}, fences=[Fence("rover", 5, held)])
    older = entering("rover", 70, life=1 << 33)
    warden.take_standing(Standing(**{**fields_of(older), "dead": [5]}), 0)
    assert warden._orders.fenced == {("rover", 5): held}
    warden.take_standing(entering("a1", 71), 0)
    younger = entering("rover", 70, life=(1 << 40) + 1)
    warden.take_standing(Standing(**{**fields_of(younger), "dead": [5]}), 0)
    table = warden.tick(0)
    assert table is not None
    assert table.grants["rover-00"] == [(70, 1, 1)]


def fields_of(standing: Standing) -> dict[str, object]:
    return {name: getattr(standing, name) for name in standing.__struct_fields__}


def test_lives_are_on_file_before_they_speak_and_one_process_has_the_file(tmp_path: Path) -> None:
    lives = LifeFile(tmp_path / "deep" / "rover")
    lives.save([4, 9])
    with pytest.raises(StoreError, match="is in use"):
        LifeFile(tmp_path / "deep" / "rover")
    lives.close()
    again = LifeFile(tmp_path / "deep" / "rover")
    assert again.lives == [4, 9]
    again.close()
    older = tmp_path / "older"
    older.write_text("4\nnine\n")
    with pytest.raises(DamagedError, match="is damaged at byte 0: expected a seal of 'lives 1'"):
        LifeFile(older)
    older.write_text("4\n9\n")
    for _ in range(2):
        again = LifeFile(older)
        assert again.lives == [4, 9]
        again.close()
