"""Presence: the newest word of each author and region, for as long as its lease lasts; who is near whom."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.agent_world import AgentWorld, pace_of

from shared_map.presence import Presence
from shared_map.replication.filter import MarkFilter
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.fields import pack_column
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, VehicleState

GRID = GridSpec(600, 600, 10.0)
LEASE_NS = 2 * NS_PER_S
Place = tuple[str, float, float]


def fleet(
    *vehicles: Place, author: str = "a0.1", seq: int = 1, region: int = 0, group: str = "all",
    state: VehicleState = VehicleState.FOLLOWING, stamp_ns: int = 5,
) -> Fleet:  # fmt: skip
    cells = [int(south // 10) * GRID.cols + int(east // 10) for _, east, south in vehicles]
    return Fleet(
        author=author,
        group=group,
        region=region,
        seq=seq,
        stamp_ns=stamp_ns,
        ids=[id for id, _, _ in vehicles],
        target_ids=[],
        cells=pack_column(cells, "<u4"),
        east_m=pack_column([east for _, east, _ in vehicles], "<f4"),
        south_m=pack_column([south for _, _, south in vehicles], "<f4"),
        heading_rad=pack_column([0.0] * len(vehicles), "<f4"),
        states=bytes([state] * len(vehicles)),
        targets=bytes([NO_TARGET] * len(vehicles)),
    )


def presence(**options: object) -> Presence:
    return Presence(GRID, LEASE_NS, 40.0, **options)  # type: ignore[arg-type]


def test_the_newest_word_of_an_author_about_a_region_replaces_the_older() -> None:
    here = presence()
    here.hear(fleet(("u", 5, 5), ("v", 15, 5), seq=2), 0)
    here.hear(fleet(("u", 95, 5), seq=1), 0)
    assert here.vehicles.ids == ["u", "v"]
    here.hear(fleet(("u", 25, 5), seq=3), 0)
    assert here.vehicles.ids == ["u"]
    assert here.vehicles.cells.tolist() == [2]
    here.hear(fleet(seq=4), 0)  # it has left the region
    assert here.count == 0


def test_what_is_not_said_again_ends_with_its_lease() -> None:
    here = presence()
    here.hear(fleet(("u", 5, 5)), 0)
    here.hear(fleet(("v", 5, 5), author="a1.1"), NS_PER_S)
    here.expire(LEASE_NS)
    assert here.count == 2
    here.expire(LEASE_NS + 1)
    assert here.vehicles.ids == ["v"]
    assert here.near(5, 5, 100).ids == ["v"]


def test_a_vehicle_between_two_regions_is_where_it_was_last_seen() -> None:
    here = presence()
    here.hear(fleet(("u", 5, 5), region=0, stamp_ns=7), 0)
    here.hear(fleet(("u", 95, 5), region=1, stamp_ns=8, seq=2), 0)
    assert here.vehicles.ids == ["u"]
    assert here.vehicles.east_m.tolist() == [95.0]


def test_only_the_groups_that_are_read_are_there() -> None:
    here = presence(filter=MarkFilter(GRID, frozenset({"blue"})))
    here.hear(fleet(("u", 5, 5), group="red", author="red.a0.1"), 0)
    here.hear(fleet(("w", 5, 5), group="blue", author="red.a0.1"), 0)  # says so
    here.hear(fleet(("v", 5, 5), group="blue", author="blue.a1.1"), 0)
    assert here.vehicles.ids == ["v"]
    assert here.vehicles.groups == ["blue"]


def test_who_is_parked_stands_on_its_cell_until_it_says_otherwise() -> None:
    here = presence()
    here.hear(fleet(("u", 5, 5), state=VehicleState.ARRIVED), 0)
    assert here.parked_on(0) == "u"
    here.hear(fleet(("u", 5, 5), seq=2), 0)
    assert here.parked_on(0) is None


places = st.lists(st.tuples(st.floats(0, 5999, width=32), st.floats(0, 5999, width=32)), max_size=60)


@given(places, st.floats(-100, 6100), st.floats(-100, 6100), st.floats(0, 7000), st.floats(5, 900))
def test_near_is_what_looking_at_everybody_finds(
    found: list[tuple[float, float]], east_m: float, south_m: float, radius_m: float, bucket_m: float
) -> None:
    here = Presence(GRID, LEASE_NS, bucket_m)
    here.hear(fleet(*((f"v{n}", east, south) for n, (east, south) in enumerate(found))), 0)
    distances = [math.hypot(np.float32(e) - east_m, np.float32(s) - south_m) for e, s in found]
    near = here.near(east_m, south_m, radius_m)
    assert {f"v{n}" for n, d in enumerate(distances) if d < radius_m - 0.01} <= set(near.ids)
    assert set(near.ids) <= {f"v{n}" for n, d in enumerate(distances) if d < radius_m + 0.01}
    order = [distances[int(id[1:])] for id in near.ids]
    assert order == pytest.approx(sorted(order), abs=0.01)


# --- what vehicles make of it -------------------------------------------------------------------------------

CORRIDOR = ["." * 24] * 5
SCENARIO = """
[[targets]]
name = "t"
walk = "still"
[[groups]]
name = "chasers"
targets = ["t"]
vehicles = 1
cells = [[2, 0]]
[[groups]]
name = "parked"
vehicles = 1
targets = ["s"]
cells = [[2, 12]]
[[targets]]
name = "s"
walk = "still"
[vehicles]
per_agent = 1
sense_range_m = 30.0
capture_range_m = 10.0
"""


def test_a_parked_vehicle_is_driven_around_without_a_stop() -> None:
    world = AgentWorld(SCENARIO, pace_of(CORRIDOR))
    world.put_target("t", 2, 22)
    world.put_target("s", 2, 12)  # the other has arrived before it begins
    world.start_all()
    world.run(3.0)
    assert world.states()["a1-00"] is VehicleState.ARRIVED
    took_s = world.until(lambda: world.states()["a0-00"] is VehicleState.ARRIVED, within_s=60)
    # 21 cells of a second each, two of them diagonal, the first of which it has driven: nobody waits five seconds.
    assert took_s <= 20.5
    assert world.where()["a1-00"] == (2, 12)
    world.assert_lawful()
