"""`swarm marks`: an export comes back unchanged, and the bands of a GeoTIFF show the winners."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.map_strategies import GRID, mark_sets, set_of
from typer.testing import CliRunner

from launch_scripts.commands.map_commands import app
from shared_map.keeper.export import from_json, to_json
from shared_map.keeper.mark_store import KeeperStore
from shared_map.learning.measurements import Measurement
from shared_map.replication.replica import MapReplica
from swarm.errors import StoreError, SwarmError
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


@given(st.lists(mark_sets(), max_size=6, unique_by=lambda each: (each.tile, each.author)))
def test_a_map_comes_out_of_json_as_it_went_in(sets: list[MarkSet]) -> None:
    terrain, grid, read, _ = from_json(to_json("t", GRID, sets))
    assert (terrain, grid) == ("t", GRID)

    def bare(each: MarkSet) -> MarkSet:  # a pace means something in a PACE mark only
        plain = set_of(
            each.author,
            each.tile,
            each.seq // SEQ_STEP,
            {
                cell: (kind, pace if kind == PACE else 0.0, stamp)
                for cell, kind, pace, stamp in zip(
                    np.frombuffer(each.cells, "<u2").tolist(),
                    each.kinds,
                    np.frombuffer(each.paces, "<f4").tolist(),
                    np.frombuffer(each.stamps_ns, "<i8").tolist(),
                    strict=True,
                )
            },
            epoch=each.epoch,
        )
        return msgspec.structs.replace(plain, group=each.group)

    assert read == [bare(each) for each in sorted(sets, key=lambda each: (each.tile, each.author))]


def test_export_import_and_inspect_on_the_command_line(tmp_path: Path) -> None:
    store = stored(tmp_path / "map.sqlite", SETS)
    out, again = tmp_path / "map.json", tmp_path / "again.sqlite"
    assert CliRunner().invoke(app, ["export", str(store), str(out)]).exit_code == 0
    assert CliRunner().invoke(app, ["import", str(out), str(again)]).exit_code == 0
    with KeeperStore(again) as copy:
        assert sorted(copy.load(), key=lambda each: (each.tile, each.author)) == SETS
    found = json.loads(CliRunner().invoke(app, ["show", str(again), "--json"]).output)
    assert (found["marks"], found["sets"], found["cells_with_marks"], found["cells_lethal"]) == (3, 3, 2, 1)
    assert found["authors"]["a2.1"] == {"sets": 2, "marks": 1, "tombstones": 1}
    assert "3 marks in 3 sets" in CliRunner().invoke(app, ["show", str(again)]).output


def test_marks_for_one_class_keep_its_name_in_an_export(tmp_path: Path) -> None:
    store, out, again = tmp_path / "map.sqlite", tmp_path / "map.json", tmp_path / "again.sqlite"
    for_truck = set_of("a1.1", GRID.tile_for(0, 2), 3, {5: (LETHAL, 0, 10)})
    with KeeperStore(store) as kept:
        kept.bind("fedcba9876543210", GRID, ["walker", "truck"])
        kept.save([for_truck, SETS[0]])
    assert CliRunner().invoke(app, ["export", str(store), str(out)]).exit_code == 0
    assert CliRunner().invoke(app, ["import", str(out), str(again)]).exit_code == 0
    with KeeperStore(again) as copy:
        assert copy.classes == ["walker", "truck"]
        assert sorted(copy.load(), key=lambda each: each.tile) == [SETS[0], for_truck]
        with pytest.raises(StoreError, match="marks for truck alone"):
            copy.bind("fedcba9876543210", GRID, ["truck", "walker"])
    pixels = CliRunner().invoke(app, ["export", str(store), str(tmp_path / "map.tif")]).output
    assert "2 marks in 1 sets; 1 marks for one class alone are left out, .json has them" in pixels.replace(
        "\n", " "
    )


def test_a_geotiff_says_where_and_what(tmp_path: Path) -> None:
    import rasterio

    store = stored(tmp_path / "map.sqlite", SETS)
    out = tmp_path / "map.tif"
    assert CliRunner().invoke(app, ["export", str(store), str(out)]).exit_code == 0
    with rasterio.open(out) as tiff:
        assert (tiff.height, tiff.width, tiff.transform.a) == (GRID.rows, GRID.cols, GRID.resolution_m)
        assert np.isinf(tiff.read(1)[0, 5])
        assert tiff.read(2)[0, 5:7].tolist() == [LETHAL, CLEAR]
        assert tiff.tags()["terrain"] == "fedcba9876543210"


SET = {"author": "a1.1", "group": "all", "tile": 0, "epoch": 1, "seq": 16}


def complaint(arguments: list[str]) -> str:
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, SwarmError), result.output
    return str(result.exception)


def test_what_cannot_be_read_or_written_is_said_in_a_sentence(tmp_path: Path) -> None:
    store = stored(tmp_path / "map.sqlite", SETS)
    assert "write .json or .tif" in complaint(["export", str(store), str(tmp_path / "map.txt")])
    assert "cannot write" in complaint(["export", str(store), str(tmp_path / "no" / "map.json")])
    junk = tmp_path / "junk"
    junk.write_text("no map")
    assert "not an exported map: file" in complaint(["import", str(junk), str(tmp_path / "x.sqlite")])


def learned_sets(author: str, *said: Measurement) -> list[MarkSet]:
    replica = MapReplica(GRID, author=author)
    return replica.write_learned(dict(enumerate(said)), 1)


def test_what_is_learned_counts_as_no_mark(tmp_path: Path) -> None:
    store = stored(tmp_path / "map.sqlite", [*SETS, *learned_sets("all.a1.1", Measurement(400, 72_000, 6_500))])
    found = json.loads(CliRunner().invoke(app, ["show", str(store), "--json"]).stdout)
    assert (found["sets"], found["marks"], list(found["authors"])) == (3, 3, ["a1.1", "a2.1"])
    assert found["authors_that_learned"] == ["all.a1.1"]
    told = CliRunner().invoke(app, ["export", str(store), str(tmp_path / "marks.json")]).stdout
    assert told.endswith("3 marks in 3 sets, and what 1 authors have learned\n")


def test_what_is_learned_is_imported_as_it_was_exported(tmp_path: Path) -> None:
    words = [
        *learned_sets("all.a1.1", Measurement(400, 72_000, 6_500)),
        *learned_sets("all.a2.1", Measurement(9, 70_000, 0), Measurement(1, 0, 7)),
    ]
    file, again = tmp_path / "marks.json", tmp_path / "again.sqlite"
    file.write_text(to_json("t", GRID, [*SETS, *words]), encoding="utf-8")
    assert [each for each in from_json(file.read_bytes())[2] if each.tile == GRID.tiles] == words
    assert CliRunner().invoke(app, ["import", str(file), str(again)]).exit_code == 0
    with KeeperStore(again, read_only=True) as store:
        assert sorted(each.author for each in store.load() if each.tile == GRID.tiles) == ["all.a1.1", "all.a2.1"]
    (row, *_) = json.loads(CliRunner().invoke(app, ["factors", str(again), "--json"]).stdout)["kinds"]
    assert (row["kind"], row["cells"], row["authors"]) == ("unknown 0-5", 409, 2)
    assert 2.5 < row["factor"] <= row["measured"] < 3.1
    assert "unknown 5-10" in CliRunner().invoke(app, ["factors", str(again)]).stdout
