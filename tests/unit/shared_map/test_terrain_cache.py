"""Built-in terrains that are kept from run to run: the right one or none."""

import logging
import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from shared_map.terrain import store, terrain
from shared_map.terrain.store import prepare
from swarm.config.ground import CostConfig, HiddenConfig, TerrainConfig, ZoneConfig
from swarm.config.scenario import Scenario

SMALL = Scenario(terrain=TerrainConfig(source="synthetic", rows=40, cols=50, relief_m=50, roads=2), seed=3)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "terrain-swarm" / "terrain"


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[Scenario]:
    """Scenarios whose terrain was built."""
    made: list[Scenario] = []
    build = terrain.build_terrain

    def noted(scenario: Scenario, *rest: Any) -> Any:
        made.append(scenario)
        return build(scenario, *rest)

    monkeypatch.setattr(store, "build_terrain", noted)
    return made


def test_a_terrain_is_made_once_and_is_the_same_ever_after(tmp_path: Path, built: list[Scenario]) -> None:
    first, truth = prepare(tmp_path / "one", SMALL)
    again, truth_again = prepare(tmp_path / "two", SMALL)
    assert built == [SMALL]
    assert again.digest == first.digest
    for name in ("elevation_m", "photo", "pace_s_per_m", "classes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    np.testing.assert_array_equal(truth_again, truth)
    assert os.path.samefile(tmp_path / "one" / "pace.npy", tmp_path / "two" / "pace.npy")


OTHERS = {
    "seed": msgspec.structs.replace(SMALL, seed=4),
    "size": msgspec.structs.replace(SMALL, terrain=msgspec.structs.replace(SMALL.terrain, rows=41)),
    "cost": msgspec.structs.replace(SMALL, cost=CostConfig(max_slope_deg=20)),
    "hidden": msgspec.structs.replace(
        SMALL, terrain=msgspec.structs.replace(SMALL.terrain, hidden=HiddenConfig(rubble_fields=1))
    ),
}


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_the_terrain_of_another_scenario_is_never_taken(tmp_path, built, other):
    prepare(tmp_path / "one", SMALL)
    prepare(tmp_path / "two", other)
    assert built == [SMALL, other]


def test_the_terrain_of_other_code_is_never_taken(tmp_path, built, monkeypatch):
    prepare(tmp_path / "one", SMALL)
    monkeypatch.setattr(store, "source_digest", lambda *_: "another")
    prepare(tmp_path / "two", SMALL)
    assert built == [SMALL, SMALL]


def test_the_code_is_all_that_makes_terrain(tmp_path: Path) -> None:
    from shared_map.array_files import source_digest

    (tmp_path / "a.py").write_text("one")
    before = source_digest.__wrapped__(tmp_path)
    (tmp_path / "a.py").write_text("two")
    assert source_digest.__wrapped__(tmp_path) != before


@pytest.mark.parametrize("name", ["pace.npy", "homes.npy", "terrain.json"])
@pytest.mark.parametrize("damage", ["a byte", "cut", "gone", "not ours"])
def test_a_damaged_terrain_is_made_again_and_that_is_said(tmp_path, cache, built, caplog, name, damage):
    first, _ = prepare(tmp_path / "one", SMALL)
    digest = first.digest
    (folder,) = cache.iterdir()
    path = folder / name
    whole = path.read_bytes()
    path.unlink()  # a run's link to it stays whole
    match damage:
        case "a byte":
            path.write_bytes(whole[:-5] + bytes([whole[-5] ^ 1]) + whole[-4:])
        case "cut":
            path.write_bytes(whole[: len(whole) // 2])
        case "not ours":
            path.write_bytes(b"[1, 2]")
    with caplog.at_level(logging.WARNING):
        again, _ = prepare(tmp_path / "two", SMALL)
    assert built == [SMALL, SMALL]
    assert again.digest == digest
    assert "is damaged" in caplog.text
    prepare(tmp_path / "three", SMALL)
    assert len(built) == 2, "it is kept again"


def test_what_is_kept_is_bounded_and_the_longest_unused_goes_first(tmp_path, cache, monkeypatch):
    scenarios = [msgspec.structs.replace(SMALL, seed=seed) for seed in (1, 2, 3)]
    for age, scenario in zip((300, 200), scenarios, strict=False):
        prepare(tmp_path / str(scenario.seed), scenario)
        key = store.kept_key(scenario)
        assert key is not None
        os.utime(cache / key, (0, os.stat(cache / key).st_mtime - age))
    each = sum(path.stat().st_size for path in (cache / key).iterdir())
    prepare(tmp_path / "again", scenarios[0])  # used: the other one is older now
    monkeypatch.setattr(store, "MOST_BYTES", int(2.5 * each))
    prepare(tmp_path / "third", scenarios[2])
    assert {path.name for path in cache.iterdir()} == {
        store.kept_key(scenarios[0]),
        store.kept_key(scenarios[2]),
    }


def test_what_is_made_from_files_is_not_kept() -> None:
    mask = ZoneConfig(kind="road", mask="roads.png")
    for scenario in (
        Scenario(terrain=TerrainConfig(source="ridge.tif")),
        msgspec.structs.replace(SMALL, cost=CostConfig(zones=(mask,))),
        msgspec.structs.replace(SMALL, terrain=msgspec.structs.replace(SMALL.terrain, photo="photo.tif")),
    ):
        assert store.kept_key(scenario) is None


def test_where_nothing_can_be_kept_a_run_starts_all_the_same(tmp_path: Path, cache: Path) -> None:
    cache.parent.parent.mkdir(parents=True)
    cache.parent.write_text("a file where the folder would be")
    prepare(tmp_path / "one", SMALL)
    prepare(tmp_path / "two", SMALL)
