"""Vehicles of an added agent enter the map on free cells: no obstacle, and no zone."""

from swarm.clock import NS_PER_S
from vehicle_agent.start_cells import Spawning


class Held:
    """Holdings of which leaders grant nothing by themselves."""

    def __init__(self) -> None:
        self.generation, self.replaced = 1, False
        self.asked: list[tuple[str, int]] = []
        self.paths: dict[str, list[int]] = {}

    def path(self, vehicle: str) -> list[int]:
        return self.paths.get(vehicle, [])

    def enter(self, vehicle: str, cell: int) -> None:
        self.asked.append((vehicle, cell))


def entering(closed: set[int], at_s: float = 2.0) -> tuple[Spawning, Held]:
    held = Held()
    made = Spawning(["v"], [1, 2, 3], held, lambda cell: cell not in closed)  # type: ignore[arg-type]
    made.tick(False, 0)
    made.tick(True, int(at_s * NS_PER_S))
    return made, held


def test_closed_cells_are_not_asked_for() -> None:
    closed = {1, 2, 3}
    made, held = entering(closed)
    assert held.asked == []
    closed.remove(2)
    made.tick(True, 3 * NS_PER_S)
    assert held.asked == [("v", 2)]


def test_a_cell_that_is_closed_while_it_is_asked_for_is_not_taken_and_another_is_asked_for_at_once() -> None:
    closed: set[int] = set()
    made, held = entering(closed)
    closed.add(1)
    assert not made.may_stand("v", 1)
    made.tick(True, 2 * NS_PER_S + 1)
    assert held.asked == [("v", 1), ("v", 2)]
    assert made.may_stand("v", 2)


def test_who_is_found_where_an_earlier_generation_left_it_stands_there_whatever_closes_the_cell() -> None:
    made, _ = entering({7}, at_s=0.0)
    assert made.may_stand("v", 7)
