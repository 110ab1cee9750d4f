"""The base map: pieces in any order make the same terrain, and no false piece is taken."""

import contextlib
import threading
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.height_models import written
from support.makers import run_info
from support.swarm_model import SwarmModel

from launch_scripts.launcher import fetched_terrain
from shared_map.keeper.base_map import LAYERS, NEEDED, BaseMapCopy, BaseMapServer, fetch_base_map
from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.store import load_prepared
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.bus.bus import Event, Post, Replied, Undecoded
from swarm.config.ground import CostConfig, TerrainConfig, ZoneConfig
from swarm.config.scenario import GroupConfig, Scenario
from swarm.errors import ProtocolError, TerrainError
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import BaseMap, BaseMapRequest, BaseMapTile
from swarm.wire.topics import BASE_MAP, BASE_TILES

SCENARIO = Scenario(
    terrain=TerrainConfig(source="synthetic", rows=300, cols=520, roads=2),
    groups=(GroupConfig(vehicles=1),),
    cost=CostConfig(vehicle_radius_m=40.0),
)
"""2 x 3 regions, those in the south and east cut off; ground and prior pace differ."""
TERRAIN = build_terrain(SCENARIO)
SERVER = BaseMapServer(TERRAIN, "0")
EVERY = tuple(LAYERS)


def copied(layers: tuple[str, ...] = EVERY) -> BaseMapCopy:
    return BaseMapCopy(SERVER.described, TERRAIN.digest, layers)


def complete(layers: tuple[str, ...]) -> BaseMapCopy:
    copy = copied(layers)
    for tile in pieces(layers):
        copy.take(tile)
    return copy


def pieces(layers: tuple[str, ...] = EVERY) -> list[BaseMapTile]:
    return [SERVER.pack(layer, region) for layer in layers for region in range(TERRAIN.grid.regions)]


def same(one: Terrain, other: Terrain) -> bool:
    arrays = ("elevation_m", "photo", "pace_s_per_m", "ground_s_per_m", "classes")
    return (one.grid, one.digest) == (other.grid, other.digest) and all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name == "elevation_m") for name in arrays
    )


@given(st.permutations(pieces()), st.integers(0, 5))
def test_a_terrain_in_pieces_in_any_order_and_twice_is_the_same_terrain(parts, again):
    copy = copied()
    for tile in parts:
        assert copy.take(tile)
    assert not copy.take(parts[again])
    assert copy.share == 1.0
    assert same(copy.terrain(SCENARIO.cost), TERRAIN)


def test_without_its_photo_the_terrain_is_as_good_to_drive_on() -> None:
    made = complete(NEEDED).terrain(SCENARIO.cost)
    assert made.digest == TERRAIN.digest
    assert not made.photo.any()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"data": b"not zlib"}, "does not unpack"),
        ({"data": zlib.compress(b"")}, "has 0 bytes or no end, expected 262144"),
        ({"data": zlib.compress(bytes(1 << 28))}, "has more than 262144 bytes, expected 262144"),
        ({"data": zlib.compress(bytes(262144))}, "is not as its digest says"),
        ({"data": SERVER.pack("ground", 0).data[:-9]}, "expected 262144"),
        ({"region": 6}, "unrequested: layer 'ground', region 6"),
        ({"layer": "gold"}, "unrequested: layer 'gold', region 0"),
        ({"region": 1}, "expected|digest"),
    ],
)
def test_a_false_piece_is_refused_in_a_sentence_and_the_true_one_still_taken(change, says):
    copy = copied()
    true = SERVER.pack("ground", 0)
    with pytest.raises(ProtocolError, match=says):
        copy.take(msgspec.structs.replace(true, **change))
    assert copy.take(true)


@given(st.binary(max_size=200))
def test_no_bytes_pass_for_a_piece(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        copied().take(BaseMapTile(layer="ground", region=0, data=data))


def test_a_description_of_another_terrain_or_of_too_much_is_refused() -> None:
    with pytest.raises(TerrainError, match=f"keeper 0 is terrain {TERRAIN.digest}, the run has fedcba"):
        BaseMapCopy(SERVER.described, "fedcba")
    with pytest.raises(ValueError, match="65536 x 65536 cells are more than 268435456"):
        msgspec.structs.replace(SERVER.described, rows=1 << 16, cols=1 << 16)
    with pytest.raises(TerrainError, match="lacks the layer ground: it has classes"):
        BaseMapCopy(msgspec.structs.replace(SERVER.described, digests={"classes": bytes(48)}), TERRAIN.digest)


def test_other_cost_rules_make_another_terrain_and_are_told_of() -> None:
    with pytest.raises(TerrainError, match=r"are the \[cost\] sections of the scenarios the same"):
        complete(NEEDED).terrain(CostConfig(vehicle_radius_m=40.0, max_slope_deg=20.0))


def test_where_a_mask_lies_makes_no_other_terrain(tmp_path: Path) -> None:
    digests = []
    for name in ("here", "there"):
        mask = tmp_path / name / "mask.tif"
        mask.parent.mkdir()
        written(mask, np.eye(300, 520), "uint8", crs=None, transform=None)
        cost = CostConfig(zones=(ZoneConfig(kind="rough", mask=str(mask)),))
        digests.append(build_terrain(msgspec.structs.replace(SCENARIO, cost=cost)).digest)
    assert digests[0] == digests[1]


# --- over a bus ---------------------------------------------------------------------------------------------


class Network:
    """A bus on which every question is answered at once by the servers, or not at all."""

    namespace = "swarm"

    def __init__(self, *servers: BaseMapServer) -> None:
        self.swarm = SwarmModel()
        for number, server in enumerate(servers):
            server.start(self.swarm.network.bus(f"server{number}"))
        self.bus = self.swarm.network.bus("asker")
        self.asked = 0

    def ask(self, *arguments: object, **named: object) -> None:
        self.asked += 1
        self.bus.ask(*arguments, **named)  # type: ignore[arg-type]
        self.swarm.run(5)


def fetched(network: Network, why: str = "no file", **named: Any) -> Terrain:
    bus: Any = network
    return fetch_base_map(bus, TERRAIN.digest, SCENARIO.cost, why, EVERY, **named)


def test_a_process_without_the_file_gets_the_terrain_of_the_run() -> None:
    network = Network(BaseMapServer(TERRAIN, "0"))
    told: list[tuple[str, float]] = []
    terrain = fetched(network, progress=lambda what, share: told.append((what, share)))
    assert same(terrain, TERRAIN)
    assert told[-1] == ("base map from keeper 0", 1.0)
    assert terrain.notes[-1].startswith("fetched from keeper 0")


def test_a_keeper_with_another_terrain_is_passed_over() -> None:
    other = build_terrain(msgspec.structs.replace(SCENARIO, seed=9))
    network = Network(BaseMapServer(other, "a"), BaseMapServer(TERRAIN, "b"))
    assert same(fetched(network), TERRAIN)


def test_no_one_there_is_one_sentence_within_the_deadline() -> None:
    with pytest.raises(TerrainError) as caught:
        fetched(Network(), why="there is no file ridge.tif", within_s=0.3)
    assert str(caught.value) == (
        "there is no file ridge.tif, and the base map cannot be fetched: no keeper in namespace swarm answered "
        "within 0.3 s; start one where the file is"
    )


class Liar(BaseMapServer):
    """Has the true description, and some pieces of its own making beside the true ones or instead."""

    def __init__(self, *, also: bool) -> None:
        super().__init__(TERRAIN, "0")
        self.also = also

    def pack(self, layer: str, region: int) -> BaseMapTile:
        true = super().pack(layer, region)
        return true if self.also and region % 2 else BaseMapTile(layer=layer, region=region, data=b"lies")


def test_who_lies_beside_the_keeper_only_costs_time() -> None:
    network = Network(Liar(also=True), BaseMapServer(TERRAIN, "0"))
    assert same(fetched(network), TERRAIN)


def test_a_keeper_that_only_lies_is_given_up_in_a_sentence() -> None:
    with pytest.raises(TerrainError, match=r"0% came, then nothing for 0.3 s; refused: .* does not unpack"):
        fetched(Network(Liar(also=False)), within_s=0.3)


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        (BaseMapRequest(layers=["gold"], regions=[0]), "there is no layer 'gold'; there are ground"),
        (BaseMapRequest(layers=["ground"], regions=[0, 6]), "region 6 is not in 0..5"),
        (BaseMapRequest(layers=["ground"], regions=[0] * 65), "at most 64 pieces"),
    ],
)
def test_a_keeper_refuses_what_is_no_piece_of_its_map(request_: BaseMapRequest, says: str) -> None:
    network, events = Network(BaseMapServer(TERRAIN, "0")), list[Event]()
    network.ask(BASE_TILES, request_, events.append, tag="t", keeper="0")
    (ended,) = events
    assert says in ended.failure


def test_every_keeper_answers_for_its_terrain() -> None:
    swarm = SwarmModel()
    for id in ("k1", "k2"):
        swarm.keeper(id, KeeperStore(":memory:"))
    events: list[Event] = []
    swarm.network.bus("asker").ask(BASE_MAP, Nothing(), events.append, tag="t")
    swarm.run(3)
    found = [event.message for event in events if isinstance(event, Replied)]
    assert sorted(each.keeper for each in found if isinstance(each, BaseMap)) == ["k1", "k2"]


def test_the_thread_that_answers_ends_with_the_service():
    """One that returned from Zenoh after the interpreter had ended would abort the process."""
    before, posts = set(threading.enumerate()), list[Post]()
    server = BaseMapServer(TERRAIN, "0")
    bus: Any = SimpleNamespace(serve=lambda topic, post, **fields: posts.append(post))
    server.start(bus)
    server.stop()  # it has no thread yet
    server = BaseMapServer(TERRAIN, "0")
    server.start(bus)
    answerer: Any = SimpleNamespace(timeout_s=60.0, size=0, waited_s=lambda: 0.0)
    posts[-1](Undecoded(BASE_MAP, answerer, lambda: None))
    [thread] = set(threading.enumerate()) - before
    server.stop()
    assert not thread.is_alive()


def test_a_fetched_terrain_which_the_disk_has_changed_is_fetched_again(tmp_path, monkeypatch):
    scenario = msgspec.structs.replace(SCENARIO, terrain=TerrainConfig(source="missing.tif"))
    fetched: list[str] = []

    def fetch(*_: object) -> Terrain:
        fetched.append("again")
        return TERRAIN

    monkeypatch.setattr(fetched_terrain, "open_bus", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr(fetched_terrain, "fetch_base_map", fetch)
    info = run_info(TERRAIN.grid, role="keeper", id="0", terrain=TERRAIN.digest)
    for changed, expected in ((False, 1), (False, 1), (True, 2)):
        if changed:
            whole = bytearray((tmp_path / "pace.npy").read_bytes())
            whole[-1] ^= 1
            (tmp_path / "pace.npy").write_bytes(whole)
        fetched_terrain.fetch_if_missing(scenario, tmp_path, [info], roles=["agent"])
        assert len(fetched) == expected
    found = load_prepared(tmp_path)
    assert np.array_equal(found.pace_s_per_m, TERRAIN.pace_s_per_m)
