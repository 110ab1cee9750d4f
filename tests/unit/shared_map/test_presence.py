"""Presence: the newest word of each author and region, for as long as its lease lasts."""

from support.agent_world import AgentWorld, pace_of
from support.makers import fleet_of

from shared_map.replication.interest import MarkFilter
from shared_map.sightings import Presence
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import VehicleState

GRID = GridSpec(600, 600, 10.0)
LEASE_NS = 2 * NS_PER_S
Place = tuple[str, float, float]


def fleet(*vehicles, author="a0.1", seq=1, region=0, group="all", state=VehicleState.FOLLOWING, stamp_ns=5):
    cells = [int(south // 10) * GRID.cols + int(east // 10) for _, east, south in vehicles]
    return fleet_of(
        [id for id, _, _ in vehicles], cells=cells, east_m=[east for _, east, _ in vehicles],
        south_m=[south for _, _, south in vehicles], author=author, group=group, region=region, seq=seq,
        stamp_ns=stamp_ns, state=state,
    )  # fmt: skip


def presence(**options: object) -> Presence:
    return Presence(LEASE_NS, **options)  # type: ignore[arg-type]


def test_the_newest_word_of_an_author_about_a_region_replaces_the_older() -> None:
    here = presence()
    here.receive(fleet(("u", 5, 5), ("v", 15, 5), seq=2), 0)
    here.receive(fleet(("u", 95, 5), seq=1), 0)
    assert list(here.places()) == ["u", "v"]
    here.receive(fleet(("u", 25, 5), seq=3), 0)
    assert list(here.places()) == ["u"]
    assert here.places() == {"u": (25, 5)}
    here.receive(fleet(seq=4), 0)  # it has left the region
    assert not here.places()


def test_what_is_not_said_again_ends_with_its_lease() -> None:
    here = presence()
    here.receive(fleet(("u", 5, 5)), 0)
    here.receive(fleet(("v", 5, 5), author="a1.1"), NS_PER_S)
    here.expire(LEASE_NS)
    assert len(here.places()) == 2
    here.expire(LEASE_NS + 1)
    assert list(here.places()) == ["v"]


def test_a_vehicle_between_two_regions_is_where_it_was_last_seen() -> None:
    here = presence()
    here.receive(fleet(("u", 5, 5), region=0, stamp_ns=7), 0)
    here.receive(fleet(("u", 95, 5), region=1, stamp_ns=8, seq=2), 0)
    assert list(here.places()) == ["u"]
    assert [column.tolist() for column in here.columns()] == [[95], [5]]


def test_only_the_groups_that_are_read_are_there() -> None:
    here = presence(filter=MarkFilter(GRID, frozenset({"blue"})))
    here.receive(fleet(("u", 5, 5), group="red", author="red.a0.1"), 0)
    here.receive(fleet(("w", 5, 5), group="blue", author="red.a0.1"), 0)  # says so
    here.receive(fleet(("v", 5, 5), group="blue", author="blue.a1.1"), 0)
    assert list(here.places()) == ["v"]


# --- what vehicles make of it -------------------------------------------------------------------------------

CORRIDOR = ["." * 24] * 5
SCENARIO = """
targets = [{ name = "t", walk = "still" }, { name = "s", walk = "still" }]
groups = [
    { name = "chasers", targets = ["t"], vehicles = 1, cells = [[2, 0]] },
    { name = "parked", targets = ["s"], vehicles = 1, cells = [[2, 12]] },
]
vehicles = { per_agent = 1, sense_range_m = 30.0, capture_range_m = 10.0 }
"""


def test_a_parked_vehicle_is_driven_around_without_a_stop() -> None:
    # The other has arrived before it begins.
    world = AgentWorld(SCENARIO, pace_of(CORRIDOR)).begin(t=(2, 22), s=(2, 12))
    world.run(3.0)
    assert world.states()["a1-00"] is VehicleState.ARRIVED
    took_s = world.until(lambda: world.states()["a0-00"] is VehicleState.ARRIVED, within_s=60)
    # 21 cells of a second each, two of them diagonal, the first of which it has driven: there is no wait of five
    # seconds.
    assert took_s <= 20.5
    assert world.where()["a1-00"] == (2, 12)
    world.assert_lawful()
