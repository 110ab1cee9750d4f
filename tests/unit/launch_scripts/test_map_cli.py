"""`swarm marks`: an export has every set, and the bands of a GeoTIFF show the winners."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from support.command import Swarm
from support.map_strategies import GRID, set_of

from shared_map.keeper.mark_store import KeeperStore
from shared_map.pace_measurements import Measurement
from shared_map.replication.replica import MapReplica
from swarm.wire.messages.map_data import SEQ_STEP, MarkKind, MarkSet

PACE, LETHAL, CLEAR = MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR
SETS = [
    set_of("a1.1", 0, 3, {5: (LETHAL, 0, 10), 6: (PACE, 2.5, 11)}),
    set_of("a2.1", 0, 1, {6: (CLEAR, 0, 12)}),
    set_of("a2.1", 4, 9, {}),
]


def stored(path: Path, sets: list[MarkSet]) -> Path:
    with KeeperStore(path) as store:
        store.bind("fedcba9876543210", GRID)
        store.save(sets)
    return path


def listed(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text())["sets"]


def test_every_set_is_exported_and_inspected_on_the_command_line(tmp_path: Path, swarm: Swarm) -> None:
    store, out = stored(tmp_path / "map.sqlite", SETS), tmp_path / "map.json"
    assert swarm("marks export", store, "--out", out)[0] == 0
    assert [(each["author"], each["tile"], each["seq"], each["marks"]) for each in listed(out)] == [
        ("a1.1", 0, 3 * SEQ_STEP, [[0, 5, "lethal", None, 10], [0, 6, "pace", 2.5, 11]]),
        ("a2.1", 0, SEQ_STEP, [[0, 6, "clear", None, 12]]),
        ("a2.1", 4, 9 * SEQ_STEP, []),
    ]
    found = json.loads(swarm("marks show --json", store)[1])
    assert (found["marks"], found["sets"], found["cells_with_marks"], found["cells_lethal"]) == (3, 3, 2, 1)
    assert found["authors"]["a2.1"] == {"sets": 2, "marks": 1, "tombstones": 1}
    assert "3 marks in 3 sets" in swarm("marks show", store)[1]


def test_marks_for_one_class_keep_its_name_in_an_export(tmp_path: Path, swarm: Swarm) -> None:
    store, out = tmp_path / "map.sqlite", tmp_path / "map.json"
    with KeeperStore(store) as kept:
        kept.bind("fedcba9876543210", GRID, ["walker", "truck"])
        kept.save([set_of("a1.1", GRID.tile_for(0, 2), 3, {5: (LETHAL, 0, 10)}), SETS[0]])
    assert swarm("marks export", store, "--out", out)[0] == 0
    assert json.loads(out.read_text())["classes"] == ["walker", "truck"]
    assert [each["tile"] for each in listed(out)] == [0, GRID.tile_for(0, 2)]
    _, pixels, _ = swarm("marks export", store, "--out", tmp_path / "map.tif")
    assert "2 marks in 1 set; without 1 mark for one class alone, which .json has" in " ".join(pixels.split())


def test_a_geotiff_says_where_and_what(tmp_path: Path, swarm: Swarm) -> None:
    import rasterio

    store = stored(tmp_path / "map.sqlite", SETS)
    out = tmp_path / "map.tif"
    assert swarm("marks export", store, "--out", out)[0] == 0
    with rasterio.open(out) as tiff:
        assert (tiff.height, tiff.width, tiff.transform.a) == (GRID.rows, GRID.cols, GRID.resolution_m)
        assert np.isinf(tiff.read(1)[0, 5])
        assert tiff.read(2)[0, 5:7].tolist() == [LETHAL, CLEAR]
        assert tiff.tags()["terrain"] == "fedcba9876543210"


def test_what_cannot_be_read_or_written_is_said_in_a_sentence(tmp_path: Path, swarm: Swarm) -> None:
    store = stored(tmp_path / "map.sqlite", SETS)
    assert (
        "found the ending '.gpx', expected .json or .tif"
        in swarm("marks export", store, "--out", tmp_path / "map.gpx")[2]
    )
    assert "cannot write" in swarm("marks export", store, "--out", tmp_path / "no" / "map.json")[2]


def learned_sets(author: str, *said: Measurement) -> list[MarkSet]:
    replica = MapReplica(GRID, author=author)
    return replica.write_learned(dict(enumerate(said)), 1)


def test_what_is_learned_is_exported_and_shown_and_counts_as_no_mark(tmp_path: Path, swarm: Swarm) -> None:
    words = [
        *learned_sets("all.a1.1", Measurement(400, 72_000, 6_500)),
        *learned_sets("all.a2.1", Measurement(9, 70_000, 0), Measurement(1, 0, 7)),
    ]
    store, out = stored(tmp_path / "map.sqlite", [*SETS, *words]), tmp_path / "marks.json"
    told = swarm("marks export", store, "--out", out)[1]
    assert told.endswith("3 marks in 3 sets, and learned factors of 2 authors\n")
    assert [each["learned"] for each in listed(out) if each["tile"] == GRID.tiles] == [
        [[0, "unknown 0-5", 400, 72_000, 6_500]],
        [[0, "unknown 0-5", 9, 70_000, 0], [1, "unknown 5-10", 1, 0, 7]],
    ]
    found = json.loads(swarm("marks show --json", store)[1])
    assert (found["sets"], found["marks"], list(found["authors"])) == (3, 3, ["a1.1", "a2.1"])
    assert found["authors_that_learned"] == ["all.a1.1", "all.a2.1"]
    (row, *_) = json.loads(swarm("marks factors --json", store)[1])["kinds"]
    assert (row["kind"], row["cells"], row["authors"]) == ("unknown 0-5", 409, 2)
    assert 2.5 < row["factor"] <= row["measured"] < 3.1
    assert "unknown 5-10" in swarm("marks factors", store)[1]
